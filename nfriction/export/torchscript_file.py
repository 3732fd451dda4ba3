"""TorchScript: a frozen module that runs with torch alone, in Python or LibTorch."""

import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from nfriction.export.contract import (
    Contract,
    ContractError,
    ExportError,
    Runner,
    contract_of,
    first_line,
    verify,
)
from nfriction.export.controller import Controller, controller_of, run_in_order
from nfriction.export.test_vectors import draw_motion
from nfriction.export.torch_archive import METADATA, check_script, check_source, contents, repacked
from nfriction.friction.models import FrictionModel
from nfriction.io.files import atomic_write
from nfriction.io.model_file import ModelInfo

# All that an archive of ours holds.
_OURS = re.compile(
    r"data\.pkl|code/__torch__/[\w./]+\.py(\.debug_pkl)?|constants/\d+|constants\.pkl|version"
    r"|byteorder|\.data/(serialization_id|version)|extra/nfriction\.json"
)


def torchscript(
    model: FrictionModel,
    path: str | Path,
    info: ModelInfo | None = None,
    *,
    torque_limit: float | Sequence[float] | None = None,
    with_filter: bool = False,
    cutoff_hz: float = 20.0,
) -> Path:
    """Write a model as TorchScript, frozen, all joints in stacked tensors.

    The artefact is `module(qd, qdd, load) -> tau_f`, every argument (*batch, joint) in SI and
    float64, on the CPU. `module.step` gives torque, coefficients and status: `step(qd, qdd, load)`;
    with a memory `step(qd, qdd, load, state)` from `initial_state(qd, qdd)`, with the filter
    `step(q, load, state)` from `initial_state(q)`, both with the next state as a fourth result. The
    metadata (see `Contract`) are JSON under `nfriction.json` in `_extra_files`. It is loaded again
    and compared with the model before it takes its place.

    Args:
        model: a friction model.
        path: file to write, by custom `.pt`; missing folders are made.
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
    buffer = io.BytesIO()  # into memory, so that the temporary file's name is not kept inside
    with _silent():
        scripted = _compile(controller)
        torch.jit.save(scripted, buffer, _extra_files={METADATA: contract.to_json()})
    with atomic_write(path) as temporary:
        temporary.write_bytes(buffer.getvalue())
        with _silent():
            loaded = torch.jit.load(str(temporary))
        _check(controller, loaded, contract)
    return Path(path)


def run_torchscript(module: Any, inputs: Sequence[Tensor], state_size: int) -> tuple[Tensor, ...]:
    """Torque, coefficients and status of samples (sample, joint) in order, for `verify`."""
    if not state_size:
        return tuple(module.step(*inputs))
    # The load, which comes last, has no part in the state.
    return run_in_order(module.step, inputs, module.initial_state(*(x[0] for x in inputs[:-1])))


def open_torchscript(path: str | Path) -> tuple[Contract, Runner]:
    """Load an artefact; returns its contract, and how to run it.

    A damaged file can end the process in `torch.jit.load`; see `verify_artefact`.

    Raises:
        ExportError: if it is no TorchScript, lacks the methods of ours, or holds more than
            arithmetic of tensors.
        ContractError: if its metadata are absent or damaged.
        OSError: if it cannot be read.
    """
    files = contents(path, _OURS, "TorchScript")
    # Pickles of line numbers are not looked at, and so not handed on.
    needed = {name: x for name, x in files.items() if not name.endswith(".debug_pkl")}
    try:
        for name, content in files.items():
            check_source(name, content)
        contract = Contract.from_json(files.get(f"extra/{METADATA}", b""))
        with _silent():
            module = torch.jit.load(repacked(needed), map_location="cpu")
        if not hasattr(module, "step"):
            raise ExportError("a TorchScript, but none of nfriction: it has no `step`.")
        for name in _methods(module):
            check_script(getattr(module, name).inlined_graph)
    except ExportError as error:
        raise ExportError(f"{path}: {error}") from None
    except ContractError:
        raise
    except RecursionError:
        raise ExportError(f"{path}: nested without end.") from None
    except (RuntimeError, ValueError, LookupError, AttributeError, TypeError) as error:
        raise ExportError(f"{path}: no TorchScript ({first_line(error)}).") from error
    size = contract.state_size

    @torch.no_grad()
    def run(*inputs: Tensor) -> tuple[Tensor, ...]:
        return run_torchscript(module, inputs, size)

    return contract, run


class _Host(nn.Module):
    """A controller as hosts call it; `step` and `initial_state` come with the kind of its state."""

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


@contextmanager
def _silent() -> Iterator[None]:
    """torch.jit is deprecated upstream; this is the one place that still needs it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*torch.jit.*")
        yield


def _compile(controller: Controller) -> Any:
    """Script and freeze a controller."""
    try:
        from torch.jit.frontend import FrontendError
    except ImportError as error:
        raise ExportError(
            f"torch {torch.__version__} has no TorchScript; use an older torch for it."
        ) from error
    # TorchScript has no error class of its own for code that it cannot compile.
    refusals = (FrontendError, RuntimeError, TypeError, ValueError, AttributeError, OSError,
                SyntaxError)  # fmt: skip
    model = controller.model
    try:
        # Tried apart from the model, so that the message is about the law's own lines.
        qd, qdd, load = draw_motion(controller, 1)
        torch.jit.script(model.law.torque)(qd, load, model.schedule(qd, qdd), model.v_smooth)
    except refusals as error:
        raise ExportError(
            f"the law {model.law.name!r} does not script; it must be a function in a file, of "
            f"torch operations and annotated arguments:\n{error}"
        ) from error
    kind = (
        _Filtering if controller.filters else _Remembering if controller.remembers else _Stateless
    )
    module = kind(controller).eval()
    methods = [name for name in _methods(module) if name != "forward"]
    try:
        return torch.jit.freeze(torch.jit.script(module), preserved_attrs=methods)
    except refusals as error:
        raise ExportError(f"the model does not script:\n{error}") from error


def _methods(module: Any) -> list[str]:
    """Names of the methods for hosts."""
    return [name for name in ("forward", "step", "initial_state") if hasattr(module, name)]


def _check(controller: Controller, loaded: Any, contract: Contract) -> None:
    """Refuse an artefact that is not the model."""
    inputs = draw_motion(controller, 1000)
    with torch.no_grad():
        expected, got = controller.torque(*inputs), loaded(*inputs)
        scale = torch.maximum(expected.abs().amax(0), contract.scales["tau_f"]).clamp_min(1e-300)
        error = float(((got - expected).abs() / scale).max())
        if not error <= contract.tolerance:
            raise ExportError(
                f"the TorchScript differs from its model by {error:.1e} of full scale."
            )
        size = contract.state_size
        parity = verify(lambda *x: run_torchscript(loaded, x, size), contract)
    if not parity.passed:
        raise ExportError(f"the TorchScript differs from its model: {parity}.")
