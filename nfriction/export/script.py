"""TorchScript: a frozen module that runs with torch alone, in Python or LibTorch."""

import copy
import json
import os
import tempfile
import warnings
from pathlib import Path

import torch
from torch import Tensor

from nfriction.friction import FrictionModel
from nfriction.modelfile import ModelInfo, describe

# Name under which the metadata lie in the archive.
METADATA = "nfriction.json"


class ExportError(RuntimeError):
    """An artefact could not be made, or does not equal its model."""


def torchscript(model: FrictionModel, path: str | Path, info: ModelInfo | None = None) -> Path:
    """Write a model as TorchScript, frozen, all joints in stacked tensors.

    The artefact is `module(qd, qdd, load) -> tau_f`, every argument (*batch, joint) in SI and
    float64; its metadata (names, units, ranges, hashes) are JSON under `nfriction.json` in
    `_extra_files`. It is loaded again and compared with the model before it takes its place.

    Args:
        model: a friction model.
        path: file to write, by custom `.pt`.
        info: what the metadata say of the model besides its parameters.

    Returns:
        The path.

    Raises:
        ExportError: if this torch has no TorchScript, the model's law does not script, or the
            artefact differs from the model by more than 1e-12 of full scale.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = json.dumps(describe(model, info or ModelInfo()), indent=1)
    frozen = copy.deepcopy(model).eval().requires_grad_(False)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(handle)
    try:
        with warnings.catch_warnings():
            # torch.jit is deprecated upstream; this is the one place that still needs it.
            warnings.filterwarnings("ignore", message=".*torch.jit.*")
            warnings.filterwarnings("ignore", category=DeprecationWarning, module="torch")
            try:
                scripted = torch.jit.freeze(torch.jit.script(frozen))
                torch.jit.save(scripted, temporary, _extra_files={METADATA: metadata})
                loaded = torch.jit.load(temporary)
            except AttributeError as error:
                raise ExportError(
                    f"torch {torch.__version__} has no TorchScript; use an older torch for it."
                ) from error
            except RuntimeError as error:
                raise ExportError(f"the model does not script: {error}") from error
        _check(model, loaded)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    finally:
        Path(temporary).unlink(missing_ok=True)
    return path


def sample_inputs(model: FrictionModel, count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Velocities, accelerations and loads that cover and exceed what a rig does."""
    generator = torch.Generator().manual_seed(seed)

    def normal(spread: float) -> Tensor:
        shape = (count, model.joints)
        return spread * torch.randn(shape, dtype=torch.float64, generator=generator)

    return normal(10.0), normal(100.0), normal(1.0).abs()


def _check(model: FrictionModel, loaded: torch.nn.Module) -> None:
    inputs = sample_inputs(model, 1000, seed=0)
    with torch.no_grad():
        expected, got = model(*inputs), loaded(*inputs)
    error = float((got - expected).abs().max() / expected.abs().max().clamp_min(1e-300))
    if not error <= 1e-12:
        raise ExportError(f"the TorchScript differs from its model by {error:.1e} of full scale.")
