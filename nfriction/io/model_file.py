"""Model files: one JSON file contains the parameters and everything needed to use them safely.

`ModelInfo` is the description stored with the parameters: form, units and origin.

A file is checked for form, size and damage before a model is made from it; it contains no code.
"""

import copy
import hashlib
import json
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nfriction.friction import memory_names, model_by_name, model_names
from nfriction.friction.models import FrictionModel
from nfriction.io.files import (
    checked_json,
    is_intact,
    numbers,
    parse_json,
    shortened,
    write_atomically,
)
from nfriction.plant import Plant
from nfriction.plant.rigs import from_dict
from nfriction.version import __version__

FORMAT, SCHEMA = "nfriction model", 1


@dataclass(frozen=True)
class ModelInfo:
    """Facts about a model besides its parameters.

    Attributes:
        joint_names: in the order of the last axis; empty where joints have no names.
        unit: of a joint's position, `"rad"` or `"m"`.
        sample_time: of the training recordings [s]; None if they differ.
        input_ranges: smallest and largest training value of each input by joint,
            `{"qd": [[low, high], ...], "qdd": ...}`.
        training_data: digest of each recording, by name.
        rig: the mechanism's parameters, as `Plant.to_dict` gives them.
        fit: how the fit ended.

    Raises:
        ValueError: an entry has the wrong type or value.
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
        rated = self.fit.get("usability", ("", ""))
        pair = isinstance(rated, list | tuple) and len(rated) == 2
        if not pair or not all(isinstance(text, str) for text in rated):
            raise ValueError(f"a fit's `usability` must be two texts, got {str(rated)[:80]!r}.")
        for name, given in self.input_ranges.items():
            if name not in ("qd", "qdd"):
                raise ValueError(
                    f'`input_ranges` must be of "qd" and "qdd", got {str(name)[:80]!r}.'
                )
            pairs = numbers(f"input_ranges[{name!r}]", given)
            sound = isinstance(pairs, list) and all(isinstance(p, list) for p in pairs)
            if not sound or not all(len(p) == 2 and p[0] <= p[1] for p in pairs):
                raise ValueError(
                    f"`input_ranges` of {name} must be [lowest, highest] for each joint, got "
                    f"{str(given)[:80]}."
                )

    @property
    def rating(self) -> str:
        """Usability of the fit with the reason, as "doubtful: ..."; empty if unknown."""
        return ": ".join(text for text in self.fit.get("usability", ()) if text)


def parameter_hash(state: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, shapes and values of a model's parameters and buffers."""
    digest = hashlib.sha256()
    # Sorted, because the order in which a module registers its buffers does not matter.
    for name in sorted(state):
        # As one type on the CPU, so that the device does not change the hash.
        value = state[name].detach().to("cpu", torch.float64).contiguous()
        digest.update(f"{name}{tuple(value.shape)}".encode())
        digest.update(value.numpy().tobytes())
    return digest.hexdigest()


def check_joints(info: ModelInfo, joints: int) -> None:
    """Refuse names, or a rig, of another number of joints; only `load_plant` needs a sound rig."""
    names, count = info.joint_names, joints
    if isinstance(names, str) or len(names) not in (0, joints):
        raise ValueError(f"`joint_names` must name {joints} joints, got {shortened(names, 80)}.")
    rig = info.rig or {}
    masses = rig.get("mass")
    # The matrices of a chain grow with the square of its links.
    if isinstance(masses, list) and len(masses) > joints:
        count = len(masses)
    else:
        with suppress(*_UNFIT), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            count = from_dict(rig).joints
    if count != joints:
        raise ValueError(f"`rig` has {count} joints, the model {joints}: give that of its fit.")


def describe(model: FrictionModel, info: ModelInfo) -> dict[str, Any]:
    """Everything in a model file except the parameters, as plain JSON."""
    check_joints(info, model.joints)
    torque = unit_for("N m", info.unit)
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
            {"name": c.name, "unit": unit_for(c.unit, info.unit), "positive": c.positive}
            for c in model.law.coefficients
        ],
        "units": {"qd": f"{info.unit}/s", "qdd": f"{info.unit}/s^2",
                  "load": torque if model.law.reads_drive else "-", "tau_f": torque},
        "parameter_hash": parameter_hash(model.state_dict()),
        **asdict(info),
    }  # fmt: skip


def unit_for(revolute: str, position: str) -> str:
    """A revolute joint's unit, adapted to positions in `"rad"` or `"m"`."""
    return revolute if position == "rad" else revolute.replace("N m", "N").replace("rad", "m")


# A neuro-fuzzy model of ten joints takes less than a megabyte.
LARGEST_FILE = 64 * 2**20
MOST_JOINTS, DEEPEST = 1000, 32
# Errors of building a mechanism from foreign JSON.
_UNFIT = (ValueError, TypeError, AttributeError, RuntimeError, OverflowError)
# Type of every entry, by key.
_ENTRIES: dict[str, type | tuple[type, ...]] = {
    "model": str,
    "law": str,
    "joints": int,
    "v_smooth": float,
    "options": dict,
    "coefficients": list,
    "parameter_hash": str,
    "joint_names": list,
    "unit": str,
    "sample_time": (float, int, type(None)),
    "input_ranges": dict,
    "training_data": dict,
    "rig": (dict, type(None)),
    "fit": dict,
    "state": dict,
    "checksum": str,
}


class ModelFileError(ValueError):
    """A file is absent, damaged or not a model file."""


def require_model(model: object) -> None:
    """Raise TypeError if the argument is not a friction model."""
    if not isinstance(model, FrictionModel):
        raise TypeError(
            f"a friction model is needed, got {type(model).__name__}; that of a fit is "
            "`result.model`."
        )


def save(model: FrictionModel, path: str | Path, info: ModelInfo | None = None) -> Path:
    """Write a model to one JSON file, atomically.

    Args:
        path: file to write; an existing one is replaced, missing folders are made.
        info: facts about the model besides its parameters.

    Returns:
        The path.

    Raises:
        TypeError: it is not a friction model.
        ValueError: a parameter is not finite, or `info` is not plain JSON or has other joints.
        OSError: the file cannot be written.
    """
    require_model(model)
    state = model.state_dict()
    for name, value in state.items():
        if not torch.isfinite(value).all():
            raise ValueError(f"parameter `{name}` is not finite; the model was not saved.")
    content = describe(model, info or ModelInfo())
    content["state"] = {name: value.tolist() for name, value in state.items()}
    try:
        content = checked_json(content)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`info` must be plain JSON with finite numbers: {error}.") from error
    return write_atomically(path, json.dumps(content, indent=1).encode())


def load(path: str | Path, into: FrictionModel | None = None) -> FrictionModel:
    """Read a model file.

    A new model has gradients switched off, so that rollouts are compiled. To train it further:
    `model.requires_grad_(True)`.

    Args:
        path: file that `save` wrote.
        into: model to fill, for a law or schedule of your own; by default a new one of the named
            models. It stays unchanged if the file does not fit, and keeps its gradient settings.

    Returns:
        The model; `load_info` gives its description, `load_plant` the mechanism.

    Raises:
        ModelFileError: the file is absent, damaged, of another schema, or of another model.
    """
    content = read_model_file(path)
    with _naming(path):
        name, names = content["model"], (*model_names(), *memory_names())
        if into is None and name not in names:
            raise ValueError(
                f"{shortened(repr(name), 80)} is not one of the named models ({', '.join(names)}); "
                "create the model yourself and pass it as `into`."
            )
        model = into
        if model is None:
            joints, v_smooth = content["joints"], content["v_smooth"]
            model = model_by_name(name)(joints, v_smooth=v_smooth, **content["options"])
        _check_same_model(content, model)
        given, expected = content["state"], model.state_dict()
        if given.keys() != expected.keys():
            odd = shortened(sorted(given.keys() ^ expected.keys()), 80)
            raise ValueError(f"parameters are missing or do not belong to the model: {odd}.")
        state = {name: _parameter(name, given[name], value) for name, value in expected.items()}
        _check_torque(model, state)
    model.load_state_dict(state)
    return model.requires_grad_(False) if into is None else model


def load_info(path: str | Path) -> ModelInfo:
    """Read the description in a model file: everything besides the parameters.

    Raises:
        ModelFileError: the file is absent or damaged.
    """
    return _info(read_model_file(path))


def load_plant(path: str | Path) -> Plant:
    """Read the mechanism that a model was fitted with, including fitted plant parameters.

    Raises:
        ModelFileError: the file is absent or damaged, or does not describe the mechanism.
    """
    rig = read_model_file(path)["rig"]
    with _naming(path):
        if rig is None:
            raise ValueError(
                "does not describe the mechanism; save with "
                "`ModelInfo(rig=plant.to_dict())` to include it."
            )
        try:
            return from_dict(rig)
        except _UNFIT as error:
            raise ValueError(f"`rig` is no mechanism ({shortened(repr(error), 80)}).") from error


def read_model_file(path: str | Path) -> dict[str, Any]:
    """Content of a model file, checked for form, size and damage."""
    path = Path(path)
    with _naming(path):
        if path.exists() and not path.is_file():
            raise ValueError("not a file.")
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise ValueError(f"it is too large for a model file ({size} bytes).")
        try:
            content = parse_json(path.read_text(encoding="utf-8"))
        except ValueError as error:
            binary = "it is binary, as an artefact is" * isinstance(error, UnicodeDecodeError)
            raise ValueError(f"not a model file, or cut short ({binary or error}).") from error
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError("not a model file of nfriction.")
        if content.get("schema") != SCHEMA:
            schema = shortened(repr(content.get("schema")), 80)
            raise ValueError(f"its schema is {schema}, not {SCHEMA}; another version wrote it.")
        for key, kind in _ENTRIES.items():
            value = content.get(key)
            # JSON's true is an int to Python.
            if key not in content or not isinstance(value, kind) or isinstance(value, bool):
                raise ValueError(f"`{key}` is missing or of the wrong type.")
        if not is_intact(content):
            raise ValueError("the checksum does not match; damaged or edited.")
        _check_sizes(content, size)
        check_joints(_info(content), content["joints"])
        # Content nested more deeply could not be copied and written again.
        inside = [v for k, v in content.items() if k != "state"]
        for _ in range(DEEPEST):
            nested = [v.values() if isinstance(v, dict) else v
                      for v in inside if isinstance(v, (dict, list))]  # fmt: skip
            inside = [value for part in nested for value in part]
        if inside:
            raise ValueError("nested too deeply for a model file.")
    return content


@contextmanager
def _naming(path: str | Path) -> Iterator[None]:
    """Convert errors of the block to `ModelFileError` with the file's name."""
    try:
        yield
    except FileNotFoundError:
        raise ModelFileError(f"{path}: no such file.") from None
    except OSError as error:
        raise ModelFileError(f"{path}: cannot be read ({error.strerror}).") from error
    except RecursionError:
        raise ModelFileError(f"{path}: nested too deeply for a model file.") from None
    except (ValueError, TypeError) as error:
        raise ModelFileError(f"{path}: {error}") from error


def _info(content: Mapping[str, Any]) -> ModelInfo:
    return ModelInfo(**{f.name: content[f.name] for f in fields(ModelInfo)})


def _check_same_model(content: Mapping[str, Any], model: FrictionModel) -> None:
    names = [c.get("name") if isinstance(c, dict) else None for c in content["coefficients"]]
    pairs = {
        "law": (content["law"], model.law.name),
        "coefficients": (names, list(model.law.names)),
        "joints": (content["joints"], model.joints),
        "v_smooth": (content["v_smooth"], model.v_smooth),
        "options": (content["options"], model.options()),
    }
    # By key, so that the message names the first difference; as JSON, where true is not 1.
    for key, (ours, theirs) in pairs.items():
        if json.dumps(ours, sort_keys=True) != json.dumps(theirs, sort_keys=True):
            ours, theirs = (shortened(repr(x), 80) for x in (ours, theirs))
            raise ValueError(f"`{key}` is {ours} in the file, {theirs} in the model.")


def _check_torque(model: FrictionModel, state: Mapping[str, Tensor]) -> None:
    """Refuse finite parameters whose exponentials overflow."""
    trial = copy.deepcopy(model)
    trial.load_state_dict(dict(state))
    qd, qdd, load = torch.tensor([[0.0, 0.5], [0.0, 0.0], [1.0, 1.0]], dtype=torch.float64)
    qd, qdd, load = (x[:, None].expand(-1, model.joints) for x in (qd, qdd, load))
    with torch.no_grad():
        coefficients = trial.coefficients(qd, qdd)
        found = [coefficients, trial.steady_torque(qd, load, coefficients)]
        if trial.state_size:
            found.append(trial.advance(qd, qdd, trial.initial_state(qd, qdd)))
    if not all(x.isfinite().all() for x in found):
        raise ValueError("its parameters give a torque that is not finite.")


def _parameter(name: str, given: Any, expected: Tensor) -> Tensor:
    try:
        value = torch.tensor(numbers(name, given), dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"parameter `{name}` is not an array of numbers.") from error
    if value.shape != expected.shape or not torch.isfinite(value).all():
        raise ValueError(
            f"parameter `{name}` must be finite of shape {tuple(expected.shape)}, got shape "
            f"{tuple(value.shape)}."
        )
    return value


def _check_sizes(content: Mapping[str, Any], size: int) -> None:
    """Refuse networks larger than the file, before they take memory."""
    joints, options = content["joints"], content["options"]
    terms = options.get("terms", [])
    terms = terms if isinstance(terms, list) else [terms]
    sizes = [joints, options.get("head_units", 1), options.get("elements", 1), *terms]
    sound = all(isinstance(n, int) and not isinstance(n, bool) and n > 0 for n in sizes)
    # Each rule and each unit has at least one number in the file.
    if not sound or joints > MOST_JOINTS or joints * max(sizes[1], math.prod(terms)) > size:
        raise ValueError(f"a network of sizes {shortened(repr(sizes), 80)} is refused.")
