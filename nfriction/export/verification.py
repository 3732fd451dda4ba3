"""Prove an artefact equal to a model file: by its own vectors, and at many points besides."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nfriction.export.c_run import beside, c_contract, c_runner
from nfriction.export.contract import (
    Contract,
    ContractError,
    Parity,
    Runner,
    compare,
    run_through,
)
from nfriction.export.controller import AnyController, controller_of
from nfriction.export.errors import ExportError
from nfriction.export.filtered import FilteredController
from nfriction.export.onnx_file import open_onnx
from nfriction.export.points import draw
from nfriction.export.runner import open_apart
from nfriction.export.unfiltered import Controller, MemoryController
from nfriction.friction.models import FrictionModel
from nfriction.io.model_info import ModelInfo, parameter_hash

LARGEST_FILE = 256 * 2**20


def open_c(path: str | Path) -> tuple[Contract, Runner]:
    """Compile a controller's C: what the metadata beside it say, and how to run it.

    Raises:
        ExportError: if there is no compiler, or it refuses the file.
        ContractError: if the metadata are absent or damaged.
    """
    path = Path(path)
    metadata = beside(path)
    if not metadata.is_file():
        raise ContractError(f"{path}: its metadata, {metadata.name}, do not lie beside it.")
    if max(path.stat().st_size, metadata.stat().st_size) > LARGEST_FILE:
        raise ExportError(f"{path}: too large for a controller of nfriction.")
    contract = c_contract(path)
    prefix = contract.description.get("prefix")
    if not isinstance(prefix, str) or not prefix.isidentifier():
        raise ContractError(f"{metadata}: lacks the prefix of the functions.")
    return contract, c_runner(path)


Batches = Callable[..., Sequence[Sequence[Any]]]
"""Runs several batches of samples, each a sequence of inputs, through an artefact."""


def _here(opener: Callable[[str | Path], tuple[Contract, Runner]]) -> Callable[..., Any]:
    """An opener of artefacts that are run in this process."""

    def opened(path: str | Path) -> tuple[Contract, Batches]:
        contract, run = opener(path)
        return contract, lambda *batches: [run(*batch) for batch in batches]

    return opened


OPENERS: dict[str, Callable[[str | Path], tuple[Contract, Batches]]] = {
    ".c": _here(open_c),
    ".pt": open_apart,
    ".pt2": open_apart,
    ".onnx": _here(open_onnx),
}
# A controller with a state goes through its points one by one.
MOST_SUCCESSIVE = 2000


@dataclass(frozen=True)
class Verdict:
    """What became of an artefact's proof.

    Attributes:
        vectors: at the test vectors that it carries, edges and NaN among them.
        points: at points drawn to 10 % beyond the range, against the model itself.
        differences: what its metadata say otherwise than the model file, in words.
    """

    vectors: Parity
    points: Parity
    differences: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether the artefact is the model."""
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

    An artefact is a program, and running it is how it is verified. Those of torch run in a process
    of their own and only if they are arithmetic of tensors alone; C is compiled and run as it is,
    so verify it from hands that you trust.

    Args:
        path: `.pt`, `.pt2`, `.onnx`, or `.c` with its `.contract.json` beside it.
        model: the model, as loaded from its file.
        info: what the model file says besides the parameters.
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
    count = points if isinstance(controller, Controller) else min(points, MOST_SUCCESSIVE)
    inputs = draw(controller, count, seed)
    if contract.description["dtype"] == "float32":
        inputs = tuple(x.float().double() for x in inputs)
    try:
        vectors, drawn = run(tuple(contract.inputs.values()), inputs)
        at_vectors = compare(tuple(contract.outputs.values()), vectors, contract.tolerance)
        at_points = compare(run_through(controller, inputs), drawn, contract.tolerance)
    except (RuntimeError, TypeError, AttributeError, IndexError) as error:
        if isinstance(error, ExportError):
            raise
        raise ExportError(f"{path}: cannot be run by its metadata ({error}).") from error
    return Verdict(at_vectors, at_points, tuple(_differences(contract, controller, model)))


def _controller(
    model: FrictionModel, info: ModelInfo | None, told: Mapping[str, Any]
) -> AnyController:
    """The controller that the artefact says it is, made of the model."""
    if told.get("joints") != model.joints:
        raise ExportError(
            f"the artefact has {told.get('joints')!r} joints, the model {model.joints}."
        )
    filtered = told.get("filter")
    try:
        return controller_of(
            model,
            info,
            torque_limit=told.get("torque_limit"),
            with_filter=filtered is not None,
            cutoff_hz=filtered["cutoff_hz"] if filtered else 20.0,
        )
    except (TypeError, KeyError, ValueError) as error:
        raise ContractError(f"the metadata's filter or limit is damaged ({error}).") from error


def _differences(contract: Contract, controller: AnyController, model: FrictionModel) -> list[str]:
    """What the metadata say otherwise than the model."""
    inner = controller.inner if isinstance(controller, FilteredController) else controller
    assert isinstance(inner, (Controller, MemoryController))
    hashed = parameter_hash(inner.model.state_dict())
    told = contract.description
    pairs = {
        "model": (told.get("model"), type(model).__name__),
        "parameters": (told.get("parameter_hash"), hashed),
    }
    return [
        f"its {name} are not the model's ({str(ours)[:16]}, not {theirs[:16]})"
        for name, (ours, theirs) in pairs.items()
        if ours != theirs
    ]
