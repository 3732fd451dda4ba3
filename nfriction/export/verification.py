"""Verify an artefact against a model file: by its own vectors, and at many points besides."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nfriction.export.c_file import open_c
from nfriction.export.contract import (
    Contract,
    ContractError,
    ExportError,
    Parity,
    compare,
    contract_of,
    draw,
)
from nfriction.export.controller import Controller, controller_of
from nfriction.export.onnx_file import open_onnx, read_onnx
from nfriction.export.torch_archive import contract_of_archive
from nfriction.export.torch_files import open_pt2, open_torchscript
from nfriction.friction.models import FrictionModel
from nfriction.io import sandbox
from nfriction.io.model_file import ModelInfo

# A controller with a state goes through its points one by one.
MOST_SUCCESSIVE = 2000


@dataclass(frozen=True)
class Verdict:
    """Result of the comparison of an artefact with its model.

    Attributes:
        vectors: at the test vectors that it carries, edges and NaN among them.
        points: at points drawn to 10 % beyond the range, against the model itself.
        differences: differences of its metadata from the model file, in words.
    """

    vectors: Parity
    points: Parity
    differences: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """True where the artefact is the model."""
        return self.vectors.passed and self.points.passed and not self.differences


def verify_artefact(
    path: str | Path,
    model: FrictionModel,
    info: ModelInfo | None = None,
    *,
    points: int = 5000,
    seed: int = 1,
) -> Verdict:
    """Compare an artefact with the model that it should be.

    An artefact is a program, and running it is how it is verified. Those of torch and ONNX run in a
    process of their own with limits of time and memory, those of torch only if they are arithmetic
    of tensors alone; C is compiled and run as it is, so only verify files from sources that you
    trust.

    Args:
        path: `.pt`, `.pt2`, `.onnx`, or `.c` with its `.contract.json` beside it.
        model: the model, as loaded from its file.
        info: the model file's description of the model.
        points: how many to draw; at most 2,000 where the controller has a state.
        seed: of the draw.

    Raises:
        ExportError: if it is no artefact, or cannot be run.
        ContractError: if its metadata are absent or damaged.
        ImportError: if a package that runs it is missing.
        OSError: if it cannot be read.
    """
    path = Path(path)
    opener = OPENERS.get(path.suffix)
    if opener is None:
        raise ExportError(f"{path}: no artefact to verify; it must be one of {', '.join(OPENERS)}.")
    if not path.is_file():
        raise FileNotFoundError(2, "there is no such file", str(path))
    contract, run = opener(path)
    controller = _controller(model, info, contract.description)
    # By the model's own contract: tolerance and scales of a doctored artefact might pass anything.
    own = contract_of(model, controller, info, dtype=contract.description["dtype"])
    count = min(points, MOST_SUCCESSIVE) if controller.state_size else points
    inputs = draw(controller, count, seed)
    if contract.description["dtype"] == "float32":
        inputs = tuple(x.float().double() for x in inputs)
    try:
        vectors, drawn = run(tuple(contract.inputs.values()), inputs)
        # First, since it refuses the outputs of another law by their shapes.
        at_points = compare(controller.run(*inputs), drawn, own.tolerance, own.scales)
        at_vectors = compare(tuple(contract.outputs.values()), vectors, own.tolerance, own.scales)
    except (RuntimeError, TypeError, AttributeError, IndexError) as error:
        if isinstance(error, ExportError):
            raise
        raise ExportError(f"{path}: cannot be run by its metadata ({error}).") from error
    differences = tuple(
        f"its {name} are not the model's ({str(contract.description.get(key))[:16]}, "
        f"not {own.description[key][:16]})"
        for name, key in (("model", "model"), ("parameters", "parameter_hash"))
        if contract.description.get(key) != own.description[key]
    )
    return Verdict(at_vectors, at_points, differences)


def _controller(
    model: FrictionModel, info: ModelInfo | None, described: Mapping[str, Any]
) -> Controller:
    """The controller that the artefact says it is, made of the model."""
    if described.get("joints") != model.joints:
        raise ExportError(
            f"the artefact has {described.get('joints')!r} joints, the model {model.joints}."
        )
    filtered = described.get("filter")
    try:
        return controller_of(
            model,
            info,
            torque_limit=described.get("torque_limit"),
            with_filter=filtered is not None,
            cutoff_hz=filtered["cutoff_hz"] if filtered else 20.0,
        )
    except (TypeError, KeyError, ValueError) as error:
        raise ContractError(f"the metadata's filter or limit is damaged ({error}).") from error


# Programs of torch and ONNX are run in a process of their own, which may perish of them.

ISOLATED = {".pt": open_torchscript, ".pt2": open_pt2, ".onnx": open_onnx}
# Processor time [s]: to begin with, and for a sample of a controller with a state.
STARTING, BY_SAMPLE = 120.0, 0.01
ROOM = 2**34
# Numbers that come out for one that goes in: expanded from nothing, they would fill the disk.
MOST_BY_NUMBER = 1000
_INPUTS, _OUTPUTS = "inputs.npz", "outputs.npz"


def open_apart(path: str | Path) -> tuple[Contract, Any]:
    """Read the metadata of an artefact, and give a function that runs batches of samples by it."""
    onnx = Path(path).suffix == ".onnx"
    contract = read_onnx(path)[1] if onnx else contract_of_archive(path)

    def run(*batches: Sequence[Tensor]) -> list[tuple[Tensor, ...]]:
        with tempfile.TemporaryDirectory() as folder:
            return _run(Path(path), batches, Path(folder))

    return contract, run


def _run(path: Path, batches: Sequence[Sequence[Tensor]], folder: Path) -> list[tuple[Tensor, ...]]:
    given = {f"{k}_{i}": x.numpy() for k, b in enumerate(batches) for i, x in enumerate(b)}
    np.savez(folder / _INPUTS, **given)  # type: ignore[arg-type]
    seconds = STARTING + BY_SAMPLE * sum(len(batch[0]) for batch in batches)
    asked = {"path": str(path.absolute()), "batches": [len(batch) for batch in batches]}
    try:
        sandbox.run_isolated(__name__, asked, folder, seconds=seconds)
        with np.load(folder / _OUTPUTS, allow_pickle=False) as found:
            return [
                tuple(torch.from_numpy(found[f"{k}_{i}"]) for i in range(3))
                for k in range(len(batches))
            ]
    except sandbox.InvalidFile as error:
        raise ExportError(str(error)) from None
    except (sandbox.WorkerDied, OSError, ValueError, LookupError, TypeError) as error:
        raise ExportError(f"{path}: cannot be run ({error}).") from None


def main() -> None:
    """Work as the process."""
    torch.set_num_threads(1)
    sandbox.worker_main(work, refusals=(ExportError, ContractError), memory=ROOM)


def work(asked: Mapping[str, Any], folder: Path) -> None:
    """Run batches of inputs in the folder through an artefact, and write what comes out."""
    path = Path(asked["path"])
    _, run = ISOLATED[path.suffix](path)
    found: dict[str, Any] = {}
    with np.load(folder / _INPUTS, allow_pickle=False) as given:
        for k, count in enumerate(asked["batches"]):
            inputs = [torch.from_numpy(given[f"{k}_{i}"]) for i in range(count)]
            try:
                outputs = [torch.as_tensor(x) for x in run(*inputs)]
                if max(x.numel() for x in outputs) > MOST_BY_NUMBER * inputs[0].numel():
                    raise ValueError("its outputs are too large")
                found |= {f"{k}_{i}": x.numpy() for i, x in enumerate(outputs)}
            except (RuntimeError, TypeError, AttributeError, LookupError, ValueError) as error:
                raise ExportError(f"{path}: cannot be run by its metadata ({error}).") from error
    np.savez(folder / _OUTPUTS, **found)


# Runs several batches of samples, each a sequence of inputs, through an artefact.
Batches = Callable[..., Sequence[Sequence[Any]]]


def open_here(path: str | Path) -> tuple[Contract, Batches]:
    """As `open_apart`, for C, which is run in this process."""
    contract, run = open_c(path)
    return contract, lambda *batches: [run(*batch) for batch in batches]


OPENERS: dict[str, Callable[[str | Path], tuple[Contract, Batches]]] = {
    ".c": open_here,
    ".pt": open_apart,
    ".pt2": open_apart,
    ".onnx": open_apart,
}
