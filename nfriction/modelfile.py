"""Model files: one JSON file with the parameters and what is needed to use them safely."""

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nfriction.friction import FrictionModel, model_by_name

FORMAT, SCHEMA = "nfriction model", 1
# A neuro-fuzzy model of ten joints takes less than a megabyte.
LARGEST_FILE = 64 * 2**20
LARGEST_NETWORK = 1000


@dataclass(frozen=True)
class ModelInfo:
    """What a model file says besides the parameters.

    Attributes:
        joint_names: in the order of the last axis.
        unit: of a joint's position, `"rad"` or `"m"`.
        sample_time: of the recordings it was trained on [s].
        input_ranges: smallest and largest trained value of each input by joint,
            `{"qd": [[low, high], ...], "qdd": ...}`.
        training_data: digest of each recording, by name.
        rig: the mechanism's parameters, as `Plant.to_dict` gives them.
        fit: how the fit ended.
    """

    joint_names: Sequence[str] = ()
    unit: str = "rad"
    sample_time: float | None = None
    input_ranges: Mapping[str, Any] = field(default_factory=dict)
    training_data: Mapping[str, str] = field(default_factory=dict)
    rig: Mapping[str, Any] | None = None
    fit: Mapping[str, Any] = field(default_factory=dict)


class ModelFileError(ValueError):
    """A model file is absent, damaged or not one of ours."""


def parameter_hash(state: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, shapes and values of a model's parameters and buffers."""
    digest = hashlib.sha256()
    for name in sorted(state):
        value = state[name].detach().to("cpu", torch.float64).contiguous()
        digest.update(f"{name}{tuple(value.shape)}".encode())
        digest.update(value.numpy().tobytes())
    return digest.hexdigest()


def describe(model: FrictionModel, info: ModelInfo) -> dict[str, Any]:
    """Everything a model file holds except the parameters, as plain JSON."""
    from nfriction import __version__

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
            {"name": c.name, "unit": c.unit, "positive": c.positive}
            for c in model.law.coefficients
        ],
        "units": {"qd": f"{info.unit}/s", "qdd": f"{info.unit}/s^2", "load": "-",
                  "tau_f": "N m" if info.unit == "rad" else "N"},
        "parameter_hash": parameter_hash(model.state_dict()),
        **asdict(info),
    }  # fmt: skip


def save(model: FrictionModel, path: str | Path, info: ModelInfo | None = None) -> Path:
    """Write a model to one JSON file, whole or not at all.

    Args:
        model: a friction model.
        path: file to write; an existing one is replaced.
        info: what to say of the model besides its parameters.

    Returns:
        The path.

    Raises:
        ValueError: if a parameter is not finite.
    """
    state = model.state_dict()
    for name, value in state.items():
        if not torch.isfinite(value).all():
            raise ValueError(f"parameter `{name}` is not finite; the model was not saved.")
    content = describe(model, info or ModelInfo())
    content["state"] = {name: value.tolist() for name, value in state.items()}
    return write_atomically(path, json.dumps(content, indent=1).encode())


def load(path: str | Path, into: FrictionModel | None = None) -> FrictionModel:
    """Read a model file; no code of the file is ever run.

    Args:
        path: file that `save` wrote.
        into: model to fill, for a law or schedule of one's own; default the named model.

    Raises:
        ModelFileError: if the file is absent, damaged, or of a newer schema.
    """
    content = read_model_file(path)
    if into is None:
        try:
            into = model_by_name(content["model"])(
                content["joints"], v_smooth=content["v_smooth"], **content["options"]
            )
        except (ValueError, TypeError) as error:
            raise ModelFileError(f"{path}: {error}") from error
    expected = into.state_dict()
    state = {}
    for name, value in expected.items():
        if name not in content["state"]:
            raise ModelFileError(f"{path}: parameter `{name}` is missing.")
        try:
            given = torch.tensor(content["state"][name], dtype=torch.float64)
        except (TypeError, ValueError) as error:
            raise ModelFileError(f"{path}: parameter `{name}` is not an array.") from error
        if given.shape != value.shape or not torch.isfinite(given).all():
            raise ModelFileError(
                f"{path}: parameter `{name}` must be finite of shape {tuple(value.shape)}, got "
                f"shape {tuple(given.shape)}."
            )
        state[name] = given
    if parameter_hash(state) != content["parameter_hash"]:
        raise ModelFileError(f"{path}: the parameters do not match their hash; damaged or edited.")
    into.load_state_dict(state)
    return into


def read_model_file(path: str | Path) -> dict[str, Any]:
    """Content of a model file, checked for form and size but not yet a model."""
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise ModelFileError(f"{path}: {size} bytes is too large for a model file.")
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ModelFileError(f"{path}: no such file.") from None
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ModelFileError(f"{path}: not a model file, or cut short ({error}).") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ModelFileError(f"{path}: not a model file of nfriction.")
    if content.get("schema") != SCHEMA:
        raise ModelFileError(
            f"{path}: schema {content.get('schema')} is not {SCHEMA}; another version wrote it."
        )
    kinds = {"model": str, "joints": int, "v_smooth": float, "options": dict, "state": dict,
             "parameter_hash": str}  # fmt: skip
    for key, kind in kinds.items():
        if not isinstance(content.get(key), kind):
            raise ModelFileError(f"{path}: `{key}` is missing or no {kind.__name__}.")
    sizes = [content["joints"], content["options"].get("head_units", 1)]
    sizes += content["options"].get("terms", [])
    if not all(isinstance(n, int) and 0 < n <= LARGEST_NETWORK for n in sizes):
        raise ModelFileError(f"{path}: a network of sizes {sizes} is refused.")
    return content


def write_atomically(path: str | Path, content: bytes) -> Path:
    """Write a file through a temporary one beside it, so that it is never half there."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return path
