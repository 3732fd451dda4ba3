"""TorchScript: a frozen module that runs with torch alone, in Python or LibTorch."""

import copy
import json
import warnings
from pathlib import Path

import torch
from torch import Tensor

from nfriction.atomic import replacing
from nfriction.friction import FrictionModel
from nfriction.modelfile import ModelInfo, describe

# Name under which the metadata lie in the archive.
METADATA = "nfriction.json"
# Largest difference from the model over the largest torque: sums may be taken in another order.
TOLERANCE = 1e-12


class ExportError(RuntimeError):
    """An artefact could not be made, or does not equal its model."""


def torchscript(model: FrictionModel, path: str | Path, info: ModelInfo | None = None) -> Path:
    """Write a model as TorchScript, frozen, all joints in stacked tensors.

    The artefact is `module(qd, qdd, load) -> tau_f`, every argument (*batch, joint) in SI and
    float64, on the CPU; its metadata (names, units, ranges, hashes) are JSON under
    `nfriction.json` in `_extra_files`. It is loaded again and compared with the model before it
    takes its place.

    Args:
        model: a friction model.
        path: file to write, by custom `.pt`; missing folders are made.
        info: what the metadata say of the model besides its parameters.

    Returns:
        The path.

    Raises:
        ExportError: if this torch has no TorchScript, the model's law or schedule does not
            script, or the artefact differs from the model by more than 1e-12 of full scale.
        OSError: if the file cannot be written.
    """
    frozen = copy.deepcopy(model).to("cpu", torch.float64).eval().requires_grad_(False)
    metadata = json.dumps(describe(frozen, info or ModelInfo()), indent=1, allow_nan=False)
    with replacing(path) as temporary:
        with warnings.catch_warnings():
            # torch.jit is deprecated upstream; this is the one place that still needs it.
            warnings.filterwarnings("ignore", message=".*torch.jit.*")
            _compile(frozen, temporary, metadata)
            loaded = torch.jit.load(str(temporary))
        _check(frozen, loaded)
    return Path(path)


def sample_inputs(model: FrictionModel, count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Velocities, accelerations and loads that cover and exceed what a rig does."""
    generator = torch.Generator().manual_seed(seed)

    def normal(spread: float) -> Tensor:
        shape = (count, model.joints)
        return spread * torch.randn(shape, dtype=torch.float64, generator=generator)

    return normal(10.0), normal(100.0), normal(1.0).abs()


def _compile(model: FrictionModel, path: Path, metadata: str) -> None:
    """Script, freeze and write a model."""
    try:
        from torch.jit.frontend import FrontendError
    except ImportError as error:
        raise ExportError(
            f"torch {torch.__version__} has no TorchScript; use an older torch for it."
        ) from error
    # TorchScript has no error class of its own for code that it cannot compile.
    refusals = (FrontendError, RuntimeError, TypeError, ValueError, AttributeError, OSError,
                SyntaxError)  # fmt: skip
    try:
        # Tried apart from the model, so that the message is about the law's own lines.
        qd, qdd, load = sample_inputs(model, 1, seed=0)
        torch.jit.script(model.law.torque)(qd, load, model.schedule(qd, qdd), model.v_smooth)
    except refusals as error:
        raise ExportError(
            f"the law {model.law.name!r} does not script; it must be a function in a file, of "
            f"torch operations and annotated arguments:\n{error}"
        ) from error
    try:
        scripted = torch.jit.freeze(torch.jit.script(model))
    except refusals as error:
        raise ExportError(f"the model does not script:\n{error}") from error
    torch.jit.save(scripted, str(path), _extra_files={METADATA: metadata})


def _check(model: FrictionModel, loaded: torch.nn.Module) -> None:
    inputs = sample_inputs(model, 1000, seed=0)
    with torch.no_grad():
        expected, got = model(*inputs), loaded(*inputs)
    error = float((got - expected).abs().max() / expected.abs().max().clamp_min(1e-300))
    if not error <= TOLERANCE:
        raise ExportError(f"the TorchScript differs from its model by {error:.1e} of full scale.")
