"""Model files: one JSON file with the parameters and what is needed to use them safely."""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nfriction.atomic import write_atomically
from nfriction.friction import MODELS, FrictionModel, model_by_name
from nfriction.version import __version__

FORMAT, SCHEMA = "nfriction model", 1
# A neuro-fuzzy model of ten joints takes less than a megabyte.
LARGEST_FILE = 64 * 2**20
MOST_JOINTS = 1000


@dataclass(frozen=True)
class ModelInfo:
    """What a model file says besides the parameters.

    Attributes:
        joint_names: in the order of the last axis; empty where joints have no names.
        unit: of a joint's position, `"rad"` or `"m"`.
        sample_time: of the recordings it was trained on [s].
        input_ranges: smallest and largest trained value of each input by joint,
            `{"qd": [[low, high], ...], "qdd": ...}`.
        training_data: digest of each recording, by name.
        rig: the mechanism's parameters, as `Plant.to_dict` gives them.
        fit: how the fit ended.

    Raises:
        ValueError: if the unit is neither.
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
            raise ValueError(f'`unit` must be "rad" or "m", got {self.unit!r}.')


class ModelFileError(ValueError):
    """A model file is absent, damaged or not one of ours."""


# Type of every entry, by key.
ENTRIES: dict[str, type | tuple[type, ...]] = {
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


def parameter_hash(state: Mapping[str, Tensor]) -> str:
    """SHA-256 over names, shapes and values of a model's parameters and buffers."""
    digest = hashlib.sha256()
    for name in sorted(state):
        value = state[name].detach().to("cpu", torch.float64).contiguous()
        digest.update(f"{name}{tuple(value.shape)}".encode())
        digest.update(value.numpy().tobytes())
    return digest.hexdigest()


def describe(model: FrictionModel, info: ModelInfo) -> dict[str, Any]:
    """Everything a model file holds except the parameters, as plain JSON.

    Raises:
        ValueError: if the names of the joints are not one a joint.
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


def save(model: FrictionModel, path: str | Path, info: ModelInfo | None = None) -> Path:
    """Write a model to one JSON file, whole or not at all.

    Args:
        model: a friction model.
        path: file to write; an existing one is replaced, missing folders are made.
        info: what to say of the model besides its parameters.

    Returns:
        The path.

    Raises:
        ValueError: if a parameter is not finite, or `info` is not plain JSON.
        OSError: if the file cannot be written.
    """
    state = model.state_dict()
    for name, value in state.items():
        if not torch.isfinite(value).all():
            raise ValueError(f"parameter `{name}` is not finite; the model was not saved.")
    content = describe(model, info or ModelInfo())
    content["state"] = {name: value.tolist() for name, value in state.items()}
    try:
        # Once through JSON, so that the checksum sees what a reader will see.
        content = json.loads(json.dumps(content, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"`info` must be plain JSON with finite numbers: {error}.") from error
    content["checksum"] = _checksum(content)
    return write_atomically(path, json.dumps(content, indent=1).encode())


def load(path: str | Path, into: FrictionModel | None = None) -> FrictionModel:
    """Read a model file; no code of the file is ever run.

    Args:
        path: file that `save` wrote.
        into: model to fill, for a law or schedule of one's own; default a new one of the named
            models. It is left as it is where the file does not fit.

    Raises:
        ModelFileError: if the file is absent, damaged, of another schema, or of another model.
    """
    content = read_model_file(path)
    model = _named_model(path, content) if into is None else into
    _check_same_model(path, content, model)
    given, expected = content["state"], model.state_dict()
    if given.keys() != expected.keys():
        odd = sorted(given.keys() ^ expected.keys())
        raise ModelFileError(f"{path}: parameters are missing or not the model's: {_short(odd)}.")
    model.load_state_dict(
        {name: _parameter(path, name, given[name], value) for name, value in expected.items()}
    )
    return model


def info_of(path: str | Path) -> ModelInfo:
    """What a model file says besides the parameters.

    Raises:
        ModelFileError: if the file is absent or damaged.
    """
    content = read_model_file(path)
    try:
        return ModelInfo(**{f.name: content[f.name] for f in fields(ModelInfo)})
    except ValueError as error:
        raise ModelFileError(f"{path}: {error}") from error


def read_model_file(path: str | Path) -> dict[str, Any]:
    """Content of a model file, checked for form, size and damage but not yet a model.

    Raises:
        ModelFileError: if it is not a sound model file.
    """
    path = Path(path)
    size, content = _read_json(path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ModelFileError(f"{path}: not a model file of nfriction.")
    if content.get("schema") != SCHEMA:
        raise ModelFileError(
            f"{path}: schema {_short(content.get('schema'))} is not {SCHEMA}; another version "
            "wrote it."
        )
    for key, kind in ENTRIES.items():
        value = content.get(key)
        # JSON's true is an int to Python.
        if key not in content or not isinstance(value, kind) or isinstance(value, bool):
            raise ModelFileError(f"{path}: `{key}` is missing or of the wrong type.")
    if content.pop("checksum") != _checksum(content):
        raise ModelFileError(f"{path}: the checksum does not match; damaged or edited.")
    _check_sizes(path, content, size)
    return content


def _unit(revolute: str, position: str) -> str:
    """A unit for a revolute joint as that for a joint whose position is in `position`."""
    return revolute if position == "rad" else revolute.replace("N m", "N").replace("rad", "m")


def _checksum(content: Mapping[str, Any]) -> str:
    """SHA-256 of JSON content, however it was laid out."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


def _read_json(path: Path) -> tuple[int, Any]:
    """Size and content of a JSON file."""
    try:
        if path.exists() and not path.is_file():
            raise ModelFileError(f"{path}: not a file.")
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise ModelFileError(f"{path}: {size} bytes are too many for a model file.")
        return size, json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except FileNotFoundError:
        raise ModelFileError(f"{path}: no such file.") from None
    except OSError as error:
        raise ModelFileError(f"{path}: cannot be read ({error.strerror}).") from error
    except RecursionError:
        raise ModelFileError(f"{path}: nested too deeply for a model file.") from None
    except ModelFileError:
        raise
    except ValueError as error:
        raise ModelFileError(f"{path}: not a model file, or cut short ({error}).") from error


def _check_sizes(path: Path, content: Mapping[str, Any], size: int) -> None:
    """Refuse networks larger than what the file can hold, before they take memory."""
    joints, options = content["joints"], content["options"]
    terms = options.get("terms", [])
    terms = terms if isinstance(terms, list) else [terms]
    sizes = [joints, options.get("head_units", 1), *terms]
    sound = all(isinstance(n, int) and not isinstance(n, bool) and n > 0 for n in sizes)
    # Every rule and every unit has a number of its own in the file.
    if not sound or joints > MOST_JOINTS or joints * max(sizes[1], math.prod(terms)) > size:
        raise ModelFileError(f"{path}: a network of sizes {_short(sizes)} is refused.")


def _named_model(path: str | Path, content: Mapping[str, Any]) -> FrictionModel:
    name = content["model"]
    if name not in MODELS:
        raise ModelFileError(
            f"{path}: {_short(name)} is none of the named models ({', '.join(MODELS)}); make the "
            "model yourself and pass it as `into`."
        )
    try:
        return model_by_name(name)(
            content["joints"], v_smooth=content["v_smooth"], **content["options"]
        )
    except (ValueError, TypeError) as error:
        raise ModelFileError(f"{path}: {error}") from error


def _check_same_model(path: str | Path, content: Mapping[str, Any], model: FrictionModel) -> None:
    """A file must describe the model that it fills."""
    names = [c.get("name") if isinstance(c, dict) else None for c in content["coefficients"]]
    pairs = {
        "law": (content["law"], model.law.name),
        "coefficients": (names, list(model.law.names)),
        "joints": (content["joints"], model.joints),
        "v_smooth": (content["v_smooth"], model.v_smooth),
        "options": (content["options"], model.options()),
    }
    for key, (ours, theirs) in pairs.items():
        if ours != theirs:
            raise ModelFileError(
                f"{path}: `{key}` is {_short(ours)} in the file, {_short(theirs)} in the model."
            )


def _parameter(path: str | Path, name: str, given: Any, expected: Tensor) -> Tensor:
    """A parameter of a file as a tensor of the expected shape."""
    try:
        value = torch.tensor(given, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise ModelFileError(f"{path}: parameter `{name}` is no array of numbers.") from error
    if value.shape != expected.shape or not torch.isfinite(value).all():
        raise ModelFileError(
            f"{path}: parameter `{name}` must be finite of shape {tuple(expected.shape)}, got "
            f"shape {tuple(value.shape)}."
        )
    return value
