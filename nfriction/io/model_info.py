"""Description of a model: its form, units, and origin, as plain JSON."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from torch import Tensor

from nfriction.friction.models import FrictionModel
from nfriction.io.strict_json import numbers
from nfriction.version import __version__

FORMAT, SCHEMA = "nfriction model", 1


@dataclass(frozen=True)
class ModelInfo:
    """Facts about a model besides its parameters.

    Attributes:
        joint_names: in the order of the last axis; empty where joints have no names.
        unit: of a joint's position, `"rad"` or `"m"`.
        sample_time: of the recordings it was trained on [s]; None where they differ.
        input_ranges: smallest and largest trained value of each input by joint,
            `{"qd": [[low, high], ...], "qdd": ...}`.
        training_data: digest of each recording, by name.
        rig: the mechanism's parameters, as `Plant.to_dict` gives them.
        fit: how the fit ended.

    Raises:
        ValueError: an entry is of another kind.
    """

    joint_names: Sequence[str] = ()
    unit: str = "rad"
    sample_time: float | None = None
    input_ranges: Mapping[str, Any] = field(default_factory=dict)
    training_data: Mapping[str, str] = field(default_factory=dict)
    rig: Mapping[str, Any] | None = None
    fit: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.unit not in ("rad", "m"):
            raise ValueError(f'`unit` must be "rad" or "m", got {str(self.unit)[:80]!r}.')
        step = self.sample_time
        if step is not None and not 0 < numbers("sample_time", step) < math.inf:
            raise ValueError(f"`sample_time` must be positive and finite [s], or None, got {step}.")
        texts = [*self.joint_names, *self.training_data, *self.training_data.values()]
        for text in texts:
            if not isinstance(text, str):
                raise ValueError(
                    "`joint_names` must be texts, and `training_data` map names to digests, got "
                    f"{str(text)[:80]!r}."
                )
        for name, given in self.input_ranges.items():
            pairs = numbers(f"input_ranges[{name!r}]", given)
            sound = isinstance(pairs, list) and all(isinstance(p, list) for p in pairs)
            if not sound or not all(len(p) == 2 and p[0] <= p[1] for p in pairs):
                raise ValueError(
                    f"`input_ranges` of {name} must be [lowest, highest] for each joint, got "
                    f"{str(given)[:80]}."
                )


def parameter_hash(state: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, shapes and values of a model's parameters and buffers."""
    digest = hashlib.sha256()
    # The order in which a module registers its buffers is no property of the model.
    for name in sorted(state):
        # In one type on the CPU, so that the device does not change the hash.
        value = state[name].detach().to("cpu", torch.float64).contiguous()
        digest.update(f"{name}{tuple(value.shape)}".encode())
        digest.update(value.numpy().tobytes())
    return digest.hexdigest()


def describe(model: FrictionModel, info: ModelInfo) -> dict[str, Any]:
    """Everything a model file holds except the parameters, as plain JSON.

    Raises:
        ValueError: not one name for each joint.
    """
    if info.joint_names and len(info.joint_names) != model.joints:
        raise ValueError(
            f"`joint_names` must name {model.joints} joints, got {list(info.joint_names)}."
        )
    return {
        "format": FORMAT,
        "schema": SCHEMA,
        "version": __version__,
        "model": type(model).__name__,
        "law": model.law.name,
        "joints": model.joints,
        "v_smooth": model.v_smooth,
        "options": model.options(),
        "coefficients": [
            {"name": c.name, "unit": _unit(c.unit, info.unit), "positive": c.positive}
            for c in model.law.coefficients
        ],
        "units": {"qd": f"{info.unit}/s", "qdd": f"{info.unit}/s^2", "load": "-",
                  "tau_f": _unit("N m", info.unit)},
        "parameter_hash": parameter_hash(model.state_dict()),
        **asdict(info),
    }  # fmt: skip


def _unit(revolute: str, position: str) -> str:
    return revolute if position == "rad" else revolute.replace("N m", "N").replace("rad", "m")
