"""torch.export: a `.pt2` program for runtimes that take one, with the metadata inside."""

import io
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from nfriction.export.contract import (
    Contract,
    ExportError,
    Runner,
    contract_of,
    first_line,
    write_verified,
)
from nfriction.export.controller import Controller, controller_of, run_in_order
from nfriction.export.test_vectors import draw
from nfriction.export.torch_archive import METADATA, check_program, contents, repacked
from nfriction.friction.models import FrictionModel
from nfriction.io.files import parse_json
from nfriction.io.model_file import ModelInfo

# All that an archive of ours holds.
_OURS = re.compile(
    r"data/weights/(weight_\d+|model_weights_config\.json)"
    r"|data/constants/(tensor_\d+|model_constants_config\.json)"
    r"|data/sample_inputs/model\.pt|models/model\.json|extra/nfriction\.json"
    r"|archive_format|archive_version|byteorder|version|\.data/(version|serialization_id|.*)"
)


def pt2(
    model: FrictionModel,
    path: str | Path,
    info: ModelInfo | None = None,
    *,
    torque_limit: float | Sequence[float] | None = None,
    with_filter: bool = False,
    cutoff_hz: float = 20.0,
) -> Path:
    """Write a model as a `torch.export` program with a batch of any size.

    `torch.export.load(path).module()(qd, qdd, load)` gives torque, coefficients and status, every
    argument (batch, joint) in SI and float64. Where the controller has a state, that is the last
    argument and the last result, (batch, joint, number); one that is NaN is a fresh start. The
    metadata (see `Contract`) are JSON under `nfriction.json` in `extra_files`. The file is loaded
    again and compared with the model before it takes its place.

    Args:
        model: a friction model.
        path: file to write, by custom `.pt2`; missing folders are made.
        info: description of the model besides its parameters.
        torque_limit, with_filter, cutoff_hz: see `controller_of`.

    Returns:
        The path.

    Raises:
        ExportError: if torch cannot export the model, or the artefact differs from it.
        ValueError: if `info` or an option is malformed.
        OSError: if the file cannot be written.
    """
    controller = controller_of(
        model, info, torque_limit=torque_limit, with_filter=with_filter, cutoff_hz=cutoff_hz
    )
    contract = contract_of(model, controller, info)
    program = exported(controller)
    try:
        program.example_inputs = None  # torch would pickle them
    except ValueError as error:
        raise ExportError(
            f"torch {torch.__version__} writes pickled objects into a .pt2; use a newer one for it."
        ) from error
    for node in program.graph.nodes:  # the stack names this machine's folders
        node.meta = {key: value for key, value in node.meta.items() if key == "val"}
    buffer = io.BytesIO()  # into memory, so that the temporary file's name is not kept inside
    with silent():
        torch.export.save(program, buffer, extra_files={METADATA: contract.to_json()})
    return write_verified(path, buffer.getvalue(), open_pt2, "program")


def open_pt2(path: str | Path) -> tuple[Contract, Runner]:
    """Load an artefact; returns its contract, and how to run it.

    A damaged one may lead torch to errors of its own besides; see `verify_artefact`.

    Raises:
        ExportError: if it is no program of `torch.export`, or holds more than arithmetic of
            tensors.
        ContractError: if its metadata are absent or damaged.
        OSError: if it cannot be read.
    """
    files = contents(path, _OURS, "program")
    _refuse_foreign_objects(path, files)
    contract = Contract.from_json(files.get(f"extra/{METADATA}", b""))
    try:
        with silent():
            module = torch.export.load(repacked(files)).module()
    except (RuntimeError, ArithmeticError, AttributeError, AssertionError, LookupError, TypeError,
            ValueError) as error:  # fmt: skip
        raise ExportError(f"{path}: no program of nfriction ({first_line(error)}).") from error
    size = contract.state_size

    @torch.no_grad()
    def run(*inputs: Tensor) -> tuple[Any, ...]:
        return run_from_nan(module, inputs, size)

    return contract, run


def _refuse_foreign_objects(path: str | Path, files: Mapping[str, bytes]) -> None:
    """Refuse an archive that holds more than tensors and JSON: torch would unpickle it."""
    try:
        check_program(parse_json(files["models/model.json"]))
        for name, content in files.items():
            if name.endswith("_config.json"):
                config = parse_json(content)["config"]
                if any(entry["use_pickle"] for entry in config.values()):
                    raise ExportError("it holds pickled objects, which are refused.")
            if name.endswith(".pt") and content:
                raise ExportError("it holds pickled inputs, which are refused.")
    except ExportError as error:
        raise ExportError(f"{path}: {error}") from None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ExportError(f"{path}: damaged ({first_line(error)}).") from error


def run_from_nan(step: Any, inputs: Sequence[Tensor], state_size: int) -> tuple[Any, ...]:
    """Run a program over samples (sample, joint) in order; its state, if any, starts as NaN."""
    if not state_size:
        return tuple(step(*inputs))
    state = inputs[0].new_full((1, inputs[0].shape[1], state_size), math.nan)
    found = run_in_order(
        lambda *x: [torch.as_tensor(y) for y in step(*x)], (x[:, None] for x in inputs), state
    )
    return tuple(x[:, 0] for x in found)


# Programs keep the names of their arguments, so that each kind of controller has its own.


class _Program(nn.Module):
    def __init__(self, controller: Controller) -> None:
        super().__init__()
        self.controller = controller

    def forward(self, qd: Tensor, qdd: Tensor, load: Tensor) -> Any:
        return self.controller(qd, qdd, load)

    def _or_start(self, state: Tensor, *inputs: Tensor) -> Tensor:
        """The state, or that before a first sample where it is NaN."""
        return torch.where(state == state, state, self.controller.start(*inputs))


class _RememberingProgram(_Program):
    def forward(self, qd: Tensor, qdd: Tensor, load: Tensor, state: Tensor) -> Any:  # type: ignore[override]
        return self.controller(qd, qdd, load, self._or_start(state, qd, qdd))


class _FilteringProgram(_Program):
    def forward(self, q: Tensor, load: Tensor, state: Tensor) -> Any:  # type: ignore[override]
        return self.controller(q, load, self._or_start(state, q))


def exported(controller: Controller) -> torch.export.ExportedProgram:
    """The controller as a `torch.export` program with a dynamic batch.

    Raises:
        ExportError: if torch cannot export it.
    """
    example, kind = draw(controller, 7), _Program
    if controller.state_size:
        example = (*example, example[0].new_zeros(7, controller.joints, controller.state_size))
        kind = _FilteringProgram if controller.filters else _RememberingProgram
    batch = torch.export.Dim("batch")
    try:
        with silent():
            shapes = tuple({0: batch} for _ in example)
            return torch.export.export(kind(controller).eval(), example, dynamic_shapes=shapes)
    except (RuntimeError, TypeError, ValueError, AttributeError) as error:
        raise ExportError(f"torch cannot export the model:\n{error}") from error


@contextmanager
def silent() -> Iterator[None]:
    """Suppress warnings of torch to its own developers."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=FutureWarning)
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        yield
