"""Verify an artefact against a model file: with its own vectors, and at many random points."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from nfriction.export.c_file import c_contract, c_runner
from nfriction.export.contract import (
    Contract,
    ContractError,
    ExportError,
    Parity,
    Runner,
    compare,
    contract_of,
    draw,
)
from nfriction.export.controller import Controller, controller_of
from nfriction.export.onnx_file import contract_of_onnx, onnx_runner
from nfriction.export.torch_files import contract_of_archive, program_runner, script_runner
from nfriction.friction.models import FrictionModel
from nfriction.io.model_file import ModelInfo

# Readers of an artefact's contract, and functions that run it, by the file's ending.
KINDS: dict[str, tuple[Callable[[Path], Contract], Callable[[Path, Controller], Runner]]] = {
    ".c": (c_contract, lambda path, _: c_runner(path)),
    ".pt": (contract_of_archive, script_runner),
    ".pt2": (contract_of_archive, program_runner),
    ".onnx": (contract_of_onnx, onnx_runner),
}
# A controller with a state goes through its points one by one.
MOST_SUCCESSIVE = 2000


@dataclass(frozen=True)
class Verdict:
    """Result of the comparison of an artefact with its model."""

    vectors: Parity  # at its own test vectors, including edges and NaN
    points: Parity  # at random points up to 10 % beyond the range, against the model itself
    differences: tuple[str, ...]  # between its metadata and the model file, in words

    @property
    def passed(self) -> bool:
        """True if the artefact matches the model."""
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

    An artefact is a program, and is verified by running it. For torch and ONNX, only the program
    that the installed versions write for the model is run, with the file's numbers; a file with
    another program is refused. C is compiled and run as it is, so only verify C from sources that
    you trust.

    Args:
        path: `.pt`, `.pt2`, `.onnx`, or `.c` with its `.contract.json` in the same folder.
        model: the model, as loaded from its file.
        info: the model file's description of the model; the sample time is the artefact's.
        points: number of random points; at most 2,000 if the controller has a state.

    Raises:
        ExportError: if it is not an artefact, its program is not the model's, or it cannot be run.
        ContractError: if its metadata are missing or damaged.
        ImportError: if a package that runs it is missing.
        OSError: if it cannot be read.
    """
    path = Path(path)
    if path.suffix not in KINDS:
        raise ExportError(f"{path} is not an artefact; it must be one of {', '.join(KINDS)}.")
    if not path.is_file():
        raise FileNotFoundError(2, "there is no such file", str(path))
    contract_at, runner = KINDS[path.suffix]
    contract = contract_at(path)
    try:
        info = replace(info or ModelInfo(), sample_time=contract.description.get("sample_time"))
    except (TypeError, ValueError) as error:
        raise ContractError(f"the metadata's sample time is damaged ({error}).") from error
    about = contract.description
    if about.get("joints") != model.joints:
        raise ExportError(
            f"the artefact has {about.get('joints')!r} joints, the model {model.joints}."
        )
    filtered = about.get("filter")
    try:
        controller = controller_of(
            model,
            info,
            torque_limit=about.get("torque_limit"),
            with_filter=filtered is not None,
            cutoff_hz=filtered["cutoff_hz"] if filtered else 20.0,
        )
    except (TypeError, KeyError, ValueError) as error:
        raise ContractError(f"the metadata's filter or limit is damaged ({error}).") from error
    # With the model's own contract, because tolerance and scales of a manipulated artefact might
    # accept anything.
    own = contract_of(model, controller, info, dtype=about["dtype"])
    count = min(points, MOST_SUCCESSIVE) if controller.state_size else points
    inputs = draw(controller, count, seed)
    if about["dtype"] == "float32":
        inputs = tuple(x.float().double() for x in inputs)
    differences = tuple(
        f"{what} {str(about.get(key))[:16]} instead of {own.description[key][:16]}"
        for what, key in (("model", "model"), ("parameters", "parameter_hash"))
        if about.get(key) != own.description[key]
    )
    try:
        run = runner(path, controller)
    except ExportError as error:
        if not differences:
            raise
        raise ExportError(f"{path} belongs to another model: {differences[0]}. {error}") from None
    try:
        # First, because this refuses outputs of another law by their shapes.
        at_points = compare(controller.run(*inputs), run(*inputs), own.tolerance, own.scales)
        vectors = run(*contract.inputs.values())
        at_vectors = compare(tuple(contract.outputs.values()), vectors, own.tolerance, own.scales)
    except (RuntimeError, TypeError, AttributeError, LookupError, ValueError) as error:
        if isinstance(error, (ExportError, ContractError)):
            raise
        raise ExportError(f"{path}: cannot be run by its metadata ({error}).") from error
    return Verdict(at_vectors, at_points, differences)
