"""Artefacts of torch: TorchScript, for Python or LibTorch, and programs of `torch.export`.

A program in a file may do anything when it is loaded, so none is loaded: files are read as data,
and torch runs the program that it now writes for the model, with the numbers of the file, if both
programs are the same.
"""

import io
import math
import re
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import torch
from torch import Tensor, nn

from nfriction.export.contract import (
    LARGEST_FILE,
    Contract,
    ExportError,
    Runner,
    contract_of,
    draw,
    draw_motion,
    first_line,
    write_verified,
)
from nfriction.export.controller import Controller, controller_of, run_in_order
from nfriction.friction.models import FrictionModel
from nfriction.io.model_file import ModelInfo
from nfriction.version import __version__

# Name of the metadata in an artefact.
METADATA = "nfriction.json"
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError,
            ValueError, LookupError, OverflowError)  # fmt: skip
# Files of plain numbers, and files that may differ for one program: metadata and line numbers.
_NUMBERS = re.compile(r"constants/\d+|data/weights/weight_\d+|data/constants/tensor_\d+")
_BESIDE = re.compile(r"extra/nfriction\.json|code/.*\.debug_pkl|\.data/serialization_id")
# torch numbers the classes scripted since the process began.
_COUNTED = re.compile(rb"___torch_mangle_\d+")


def torchscript(
    model: FrictionModel,
    path: str | Path,
    info: ModelInfo | None = None,
    *,
    torque_limit: float | Sequence[float] | None = None,
    with_filter: bool = False,
    cutoff_hz: float = 20.0,
) -> Path:
    """Write a model as frozen TorchScript, with all joints in stacked tensors.

    The artefact is `module(qd, qdd, load) -> tau_f`, every argument (*batch, joint) in SI and
    float64, on the CPU. `module.step` gives torque, coefficients and status: `step(qd, qdd, load)`;
    with a memory, which the first call refuses, `step(qd, qdd, load, state)` from
    `initial_state(qd, qdd)`, with the filter `step(q, load, state)` from `initial_state(q)`, both
    with the next state as a fourth result. The metadata (see `Contract`) are JSON under
    `nfriction.json` in `_extra_files`. The file is compared with the model before it is kept.

    Args:
        path: file to write, usually `.pt`; missing folders are made.
        info: description of the model besides its parameters.
        torque_limit, with_filter, cutoff_hz: see `controller_of`.

    Returns:
        The path.

    Raises:
        ExportError: if this torch has no TorchScript, the model's law or schedule does not
            script, or the artefact differs from the model by more than 1e-12 of full scale.
        ValueError: if `info` or an option is malformed.
        OSError: if the file cannot be written.
    """
    controller = controller_of(
        model, info, torque_limit=torque_limit, with_filter=with_filter, cutoff_hz=cutoff_hz
    )
    contract = contract_of(model, controller, info)

    def runner(path: Path) -> Runner:
        with silent():
            module = torch.jit.load(str(path))
        if not controller.remembers:  # then it also has a `forward`
            inputs = draw_motion(controller, 1000)
            with torch.no_grad():
                expected, got = controller.torque(*inputs), module(*inputs)
            scale = torch.maximum(expected.abs().amax(0), contract.scales["tau_f"])
            error = float(((got - expected).abs() / scale.clamp_min(1e-300)).max())
            if not error <= contract.tolerance:
                raise ExportError(
                    f"the TorchScript differs from its model by {error:.1e} of full scale."
                )
        return _script_runner(module, controller)

    content = _script(controller, contract.to_json())
    return write_verified(path, content, contract, runner, "TorchScript")


def _script(controller: Controller, metadata: str) -> bytes:
    """The artefact's content."""
    buffer = io.BytesIO()  # into memory, so that the temporary file's name is not kept inside
    with silent():
        torch.jit.save(_compile(controller), buffer, _extra_files={METADATA: metadata})
    return buffer.getvalue()


def _script_runner(module: Any, controller: Controller) -> Runner:
    """Torque, coefficients and status of samples (sample, joint) in order."""

    @torch.no_grad()
    def run(*inputs: Tensor) -> tuple[Tensor, ...]:
        if not controller.state_size:
            return tuple(module.step(*inputs))
        # The state before the first step does not depend on the load, which comes last.
        start = module.initial_state(*(x[0] for x in inputs[:-1]))
        return run_in_order(module.step, inputs, start)

    return run


def script_runner(path: str | Path, controller: Controller) -> Runner:
    """Load a TorchScript with the controller's program; its numbers may differ."""
    with silent():
        module = torch.jit.load(own_program(path, _script(controller, "")), map_location="cpu")
    return _script_runner(module, controller)


class _Host(nn.Module):
    """A controller as hosts call it; `step` and `initial_state` depend on the kind of its state."""

    def __init__(self, controller: Controller) -> None:
        super().__init__()
        self.controller = controller

    def forward(self, qd: Tensor, qdd: Tensor, load: Tensor) -> Tensor:
        return self.controller.torque(qd, qdd, load)


class _Stateless(_Host):
    @torch.jit.export
    def step(self, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        tau_f, coefficients, status, _ = self.controller.step(qd, qdd, load, load)
        return tau_f, coefficients, status


class _Remembering(_Host):
    @torch.jit.export
    def step(
        self, qd: Tensor, qdd: Tensor, load: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.controller.step(qd, qdd, load, state)

    @torch.jit.export
    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return self.controller.initial_memory(qd, qdd)


class _Filtering(_Host):
    @torch.jit.export
    def step(self, q: Tensor, load: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.controller.filtered_step(q, load, state)

    @torch.jit.export
    def initial_state(self, q: Tensor) -> Tensor:
        return self.controller.filtered_start(q)


def _compile(controller: Controller) -> Any:
    """Script and freeze a controller."""
    try:
        from torch.jit.frontend import FrontendError
    except ImportError as error:
        raise ExportError(
            f"torch {torch.__version__} has no TorchScript; use an older torch for it."
        ) from error
    # TorchScript has no specific error class for code that it cannot compile.
    refusals = (FrontendError, RuntimeError, TypeError, ValueError, AttributeError, OSError,
                SyntaxError)  # fmt: skip
    model = controller.model
    try:
        # Tried separately from the model, so that the message refers to the law's own lines.
        qd, qdd, load = draw_motion(controller, 1)
        torch.jit.script(model.law.torque)(qd, load, model.schedule(qd, qdd), model.v_smooth)
    except refusals as error:
        raise ExportError(
            f"the law {model.law.name!r} cannot be scripted; it must be a function in a file, with "
            f"torch operations and annotated arguments:\n{error}"
        ) from error
    kind = (
        _Filtering if controller.filters else _Remembering if controller.remembers else _Stateless
    )
    module = kind(controller).eval()
    methods = [name for name in ("step", "initial_state") if hasattr(module, name)]
    try:
        return torch.jit.freeze(torch.jit.script(module), preserved_attrs=methods)
    except refusals as error:
        raise ExportError(f"the model cannot be scripted:\n{error}") from error


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
    argument (batch, joint) in SI and float64. If the controller has a state, that is the last
    argument and the last result, (batch, joint, number); a state of NaN is a fresh start. The
    metadata (see `Contract`) are JSON under `nfriction.json` in `extra_files`. The file is loaded
    again and compared with the model before it is put in place.

    Args, Returns, Raises: as `torchscript`; the file is usually `.pt2`.
    """
    controller = controller_of(
        model, info, torque_limit=torque_limit, with_filter=with_filter, cutoff_hz=cutoff_hz
    )
    contract = contract_of(model, controller, info)

    def runner(path: Path) -> Runner:
        # As bytes, because torch warns of files with another ending, such as the temporary one.
        with silent():
            program = torch.export.load(io.BytesIO(path.read_bytes())).module()
        return lambda *x: run_from_nan(program, x, controller.state_size)

    content = _program(controller, contract.to_json())
    return write_verified(path, content, contract, runner, "program")


def _program(controller: Controller, metadata: str) -> bytes:
    """The artefact's content."""
    program = exported(controller)
    for node in program.graph.nodes:  # the stack contains this machine's folders
        node.meta = {key: value for key, value in node.meta.items() if key == "val"}
    buffer = io.BytesIO()  # into memory, so that the temporary file's name is not kept inside
    try:
        program.example_inputs = None  # torch would pickle them
        with silent():
            torch.export.save(program, buffer, extra_files={METADATA: metadata})
    except ValueError as error:
        raise ExportError(
            f"torch {torch.__version__} cannot write this model as .pt2; use a newer one ({error})."
        ) from error
    return buffer.getvalue()


def program_runner(path: str | Path, controller: Controller) -> Runner:
    """Load a `.pt2` with the controller's program; its numbers may differ."""
    with silent():
        program = torch.export.load(own_program(path, _program(controller, ""))).module()
    return lambda *x: run_from_nan(program, x, controller.state_size)


@torch.no_grad()
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


class _Program(_Host):
    def forward(self, qd: Tensor, qdd: Tensor, load: Tensor) -> Any:
        return self.controller(qd, qdd, load)

    def _or_start(self, state: Tensor, *inputs: Tensor) -> Tensor:
        """The state, or that before a first sample if it is NaN."""
        return torch.where(state == state, state, self.controller.start(*inputs))


class _RememberingProgram(_Program):
    def forward(self, qd: Tensor, qdd: Tensor, load: Tensor, state: Tensor) -> Any:  # type: ignore[override]
        return self.controller(qd, qdd, load, self._or_start(state, qd, qdd))


class _FilteringProgram(_Program):
    def forward(self, q: Tensor, load: Tensor, state: Tensor) -> Any:  # type: ignore[override]
        return self.controller(q, load, self._or_start(state, q))


def exported(controller: Controller) -> torch.export.ExportedProgram:
    """The controller as a `torch.export` program with a dynamic batch."""
    example, kind = draw(controller, 7), _Program
    if controller.state_size:
        example = (*example, example[0].new_zeros(7, controller.joints, controller.state_size))
        kind = _FilteringProgram if controller.filters else _RememberingProgram
    batch = torch.export.Dim("batch")
    try:
        with silent():
            shapes = tuple({0: batch} for _ in example)
            module = kind(controller).eval()
            # Without `strict`, torch 2.11 refuses products of broadcast tensors.
            return torch.export.export(module, example, dynamic_shapes=shapes, strict=True)
    except (RuntimeError, TypeError, ValueError, AttributeError) as error:
        raise ExportError(f"torch cannot export the model:\n{error}") from error


@contextmanager
def silent() -> Iterator[None]:
    """Suppress warnings of torch to its own developers, and of torch.jit's deprecation."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*torch.jit.*")
        warnings.filterwarnings("ignore", category=FutureWarning)
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        yield


def contract_of_archive(path: str | Path) -> Contract:
    """Read the contract of an artefact of torch."""
    contract = Contract.from_json(_contents(path, path).get(f"extra/{METADATA}", b""))
    contract.require_dtype("float64")
    return contract


def own_program(path: str | Path, own: bytes) -> io.BytesIO:
    """An archive with our own program, as torch writes it for the model, and an artefact's numbers.

    Raises ExportError if the artefact at `path` is not an archive, or has another program.
    """
    given, ours = _contents(path, path), _contents(path, io.BytesIO(own))
    if _computed(given) != _computed(ours):
        raise ExportError(another_program(path))
    numbers = {name: given[name] for name in ours if _NUMBERS.fullmatch(name)}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in (ours | numbers).items():
            archive.writestr(f"archive/{name}", content)
    buffer.seek(0)
    return buffer


def another_program(path: str | Path) -> str:
    """The error of an artefact whose program is not the model's."""
    return (
        f"{path}: its program is not the one that nfriction {__version__} with torch "
        f"{torch.__version__} writes for this model, and other programs are not run; verify it "
        "with the versions that wrote it, or export the model again."
    )


def _computed(files: Mapping[str, bytes]) -> list[tuple[bytes, bytes]]:
    """All files that define the computation; for numbers only their size."""
    return sorted(
        (
            _COUNTED.sub(b"", name.encode(errors="backslashreplace")),
            b"%d" % len(content) if _NUMBERS.fullmatch(name) else _COUNTED.sub(b"", content),
        )
        for name, content in files.items()
        if not _BESIDE.fullmatch(name)
    )


def _contents(path: str | Path, source: str | Path | IO[bytes]) -> dict[str, bytes]:
    """All files of an archive by their name in its only folder; `path` names it in errors."""
    found: dict[str, bytes] = {}
    known: set[str] = set()
    try:
        if Path(path).stat().st_size > LARGEST_FILE:
            raise ExportError(f"{path}: too large for an artefact of nfriction.")
        with zipfile.ZipFile(source) as archive:
            entries = archive.infolist()
            if sum(max(entry.file_size, entry.compress_size) for entry in entries) > LARGEST_FILE:
                raise ExportError(f"{path}: too large for an artefact of nfriction.")
            for entry in entries:
                name = entry.filename.partition("/")[2]
                # torch looks for names without regard to case.
                if name.lower() in known:
                    raise ExportError(f"{path} contains {entry.filename[:80]!r} twice.")
                known.add(name.lower())
                found[name] = archive.read(entry)
    except _DAMAGED as error:
        if isinstance(error, ExportError):
            raise
        raise ExportError(f"{path} is no artefact of nfriction ({first_line(error)}).") from error
    return found
