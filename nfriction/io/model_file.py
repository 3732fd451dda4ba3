"""Saving and loading: one JSON file holds the parameters and what is needed to use them safely."""

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nfriction.friction.model import FrictionModel
from nfriction.friction.models import MODELS, model_by_name
from nfriction.io.atomic import write_atomically
from nfriction.io.model_content import ModelFileError, checksum_of, read_model_file, short
from nfriction.io.model_info import ModelInfo, describe
from nfriction.plant import Plant
from nfriction.plant.rigs import from_dict

# What building a mechanism from foreign JSON may raise.
_UNFIT = (ValueError, TypeError, AttributeError, RuntimeError, OverflowError)


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
    content["checksum"] = checksum_of(content)
    return write_atomically(path, json.dumps(content, indent=1).encode())


def load(path: str | Path, into: FrictionModel | None = None) -> FrictionModel:
    """Read a model file; no code of the file is ever run.

    A new model comes without gradients, so that rollouts take the compiled way. To train it
    further: `model.requires_grad_(True)`.

    Args:
        path: file that `save` wrote.
        into: model to fill, for a law or schedule of one's own; default a new one of the named
            models. It is left as it is where the file does not fit, and keeps its gradients.

    Returns:
        The model; `load_info` gives what the file says of it, `load_plant` the mechanism.

    Raises:
        ModelFileError: if the file is absent, damaged, of another schema, or of another model.
    """
    content = read_model_file(path)
    model = _named_model(path, content) if into is None else into
    _check_same_model(path, content, model)
    given, expected = content["state"], model.state_dict()
    if given.keys() != expected.keys():
        odd = sorted(given.keys() ^ expected.keys())
        raise ModelFileError(f"{path}: parameters are missing or not the model's: {short(odd)}.")
    state = {name: _parameter(path, name, given[name], value) for name, value in expected.items()}
    _check_finite(path, model, state)
    model.load_state_dict(state)
    return model.requires_grad_(False) if into is None else model


def load_info(path: str | Path) -> ModelInfo:
    """What a model file says besides the parameters.

    Raises:
        ModelFileError: if the file is absent or damaged.
    """
    content = read_model_file(path)
    try:
        return ModelInfo(**{f.name: content[f.name] for f in fields(ModelInfo)})
    except ValueError as error:
        raise ModelFileError(f"{path}: {error}") from error


def load_plant(path: str | Path) -> Plant:
    """The mechanism that a model was fitted with, terms adjusted by the fit included.

    Raises:
        ModelFileError: if the file is absent or damaged, or says nothing of the mechanism.
    """
    content = read_model_file(path)
    rig, joints = content["rig"], content["joints"]
    if rig is None:
        raise ModelFileError(
            f"{path}: says nothing of the mechanism; save with "
            "`ModelInfo(rig=plant.to_dict())` to have it there."
        )
    mass = rig.get("mass")
    # The matrices of a chain take memory with the square of its links.
    if isinstance(mass, list) and len(mass) > joints:
        raise ModelFileError(f"{path}: `rig` has {len(mass)} masses, the model {joints} joints.")
    try:
        plant = from_dict(rig)
    except _UNFIT as error:
        raise ModelFileError(f"{path}: `rig` is no mechanism ({short(error)}).") from error
    if plant.joints != joints:
        raise ModelFileError(f"{path}: `rig` has {plant.joints} joints, the model {joints}.")
    return plant


def _named_model(path: str | Path, content: Mapping[str, Any]) -> FrictionModel:
    name = content["model"]
    if name not in MODELS:
        raise ModelFileError(
            f"{path}: {short(name)} is none of the named models ({', '.join(MODELS)}); make the "
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
                f"{path}: `{key}` is {short(ours)} in the file, {short(theirs)} in the model."
            )


def _check_finite(path: str | Path, model: FrictionModel, state: Mapping[str, Tensor]) -> None:
    """Refuse parameters that are finite and yet, through an exponential, make no finite torque."""
    qd, qdd, load = torch.tensor([[0.0, 0.5], [0.0, 0.0], [1.0, 1.0]], dtype=torch.float64)
    inputs = tuple(x[:, None].expand(-1, model.joints) for x in (qd, qdd, load))
    with torch.no_grad():
        torque = torch.func.functional_call(model, dict(state), inputs)
    if not torque.isfinite().all():
        raise ModelFileError(f"{path}: with its parameters the model gives no finite torque.")


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
