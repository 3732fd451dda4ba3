"""A controller as one C file and its header."""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from nfriction.codegen import UnsupportedOperation
from nfriction.codegen.emit import Real
from nfriction.export.c_dialect import ControllerC, bits
from nfriction.export.c_exp import exponential
from nfriction.export.c_function import Emitted, Output, emit
from nfriction.export.c_header import (
    filter_signatures,
    header_of,
    init_signature,
    step_signature,
)
from nfriction.export.controller import AnyController
from nfriction.export.errors import ExportError
from nfriction.export.filtered import FILTER_STATE, FilteredController
from nfriction.export.flat import shortened
from nfriction.export.unfiltered import Controller, MemoryController, for_single_precision


@dataclass(frozen=True)
class Source:
    """The texts of an export.

    Attributes:
        code: the `.c` file.
        header: the `.h` file.
    """

    code: str
    header: str


class _Motion(nn.Module):
    """The filter of a controller alone: positions to velocity and acceleration."""

    def __init__(self, controller: FilteredController) -> None:
        super().__init__()
        self.filtered = copy.deepcopy(controller)
        self.filtered.remembers = False  # type: ignore[misc]
        self.filtered.inner = _Given()  # type: ignore[assignment]

    def initial_state(self, q: Tensor) -> Tensor:
        return self.filtered.initial_state(q)

    def forward(self, q: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        qd, qdd, _, following = self.filtered.for_finite(q, torch.zeros_like(q), state)
        finite = q.abs() < math.inf
        return (
            torch.where(finite, qd, math.nan),
            torch.where(finite, qdd, math.nan),
            torch.where(finite.unsqueeze(-1), following, state),
        )


class _Given(nn.Module):
    """Takes the place of a friction model and hands on what it is given."""

    def for_finite(self, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return qd, qdd, load


def source_of(
    controller: AnyController, description: Mapping[str, Any], real: Real, name: str, prefix: str
) -> Source:
    """C of a controller.

    Args:
        controller: of `controller_of`.
        description: what the header's comment says of it.
        real: "double" or "float".
        name: of the files, without suffix.
        prefix: of all names in them.

    Raises:
        ExportError: if the law or schedule uses an operation that has no C form, or a number of
            the model is not finite.
    """
    inner = controller.inner if isinstance(controller, FilteredController) else controller
    assert isinstance(inner, (Controller, MemoryController))
    inner = shortened(inner, number_by_number=True)
    if real == "float":
        inner = for_single_precision(inner)
    dialect = ControllerC(real, prefix)
    try:
        parts = [_step(inner, dialect)]
        if isinstance(inner, MemoryController):
            parts.insert(0, _init(inner, dialect))
        if isinstance(controller, FilteredController):
            parts += _filter(controller, dialect)
    except UnsupportedOperation as error:
        raise ExportError(f"the model has no C form: {error}") from error
    except ValueError as error:
        raise ExportError(f"the model has no C form: {error}") from error
    includes = "#include <limits.h>\n#include <math.h>\n#include <string.h>\n"
    head = f'/* Made by nfriction; do not edit. {name}.h says what it is. */\n#include "{name}.h"\n'
    rapid = exponential(prefix, real) if "array_exp" in dialect.used else ""
    code = [f"{head}\n{includes}", dialect.functions(), bits(prefix, real), rapid, *parts]
    header = header_of(controller, inner, description, real, prefix)
    return Source("\n".join(part for part in code if part), header)


def _example(joints: int, *size: int) -> Tensor:
    # All different, so that nothing looks alike by chance.
    count = math.prod((joints, *size))
    return torch.linspace(0.5, 1.5, count, dtype=torch.float64).reshape(joints, *size)


def _examples(joints: int, *names: str) -> dict[str, Tensor]:
    return {name: _example(joints) for name in names}


def _public(
    signature: str,
    emitted: Sequence[Emitted],
    before: Sequence[str] = (),
    after: Sequence[str] = (),
) -> str:
    """Static functions, and the public one that calls them; `before` starts with declarations."""
    counts = any(one.counts for one in emitted)
    lines = ["int j;"] if counts else []
    lines += [*before, *(line for one in emitted for line in one.call), *after]
    inside = "\n    ".join(lines)
    sources = "\n".join(one.source for one in emitted)
    return f"{sources}\n{signature}\n{{\n    {inside}\n}}\n"


def _step(inner: Controller | MemoryController, dialect: ControllerC) -> str:
    prefix, joints = dialect.prefix, inner.joints
    inputs = _examples(joints, "qd", "qdd", "load")
    outputs = [Output("tau"), Output("coefficients"), Output("status", "int")]
    before: list[str] = []
    if isinstance(inner, MemoryController):
        inputs["last"] = _example(joints, inner.state_size)
        outputs.append(Output("following"))
        before = [
            f"{prefix}_real last[{joints * inner.state_size}];",
            "memcpy(last, state->memory, sizeof last);",
        ]
    arrays = {"following": "state->memory"}
    made = emit(f"{prefix}_step_joint", inner, inputs, outputs, dialect, arrays)
    return _public(step_signature(inner, prefix), [made], before)


def _init(inner: MemoryController, dialect: ControllerC) -> str:
    name = f"{dialect.prefix}_init_joint"
    inputs = _examples(inner.joints, "qd", "qdd")
    arrays = {"following": "state->memory"}
    made = emit(name, inner.initial_state, inputs, [Output("following")], dialect, arrays)
    return _public(init_signature(dialect.prefix), [made])


def _filter(controller: FilteredController, dialect: ControllerC) -> list[str]:
    """The filter, in double always: differences of positions cost digits that float lacks."""
    prefix, joints = dialect.prefix, controller.joints
    single = dialect.real == "float"
    own = ControllerC("double", f"{prefix}_filter") if single else dialect
    motion = _Motion(controller)
    inputs = {**_examples(joints, "q"), "last": _example(joints, FILTER_STATE)}
    outputs = [Output("qd"), Output("qdd"), Output("following")]
    memory = {"following": "filter->memory"}
    arrays = {**memory, "qd": "velocity", "qdd": "acceleration"} if single else memory
    step = emit(f"{prefix}_filter_joint", motion, inputs, outputs, own, arrays)
    rest = emit(
        f"{prefix}_filter_rest",
        motion.initial_state,
        _examples(joints, "q"),
        [Output("following")],
        own,
        memory,
    )
    before = [
        f"double last[{joints * FILTER_STATE}];",
        "memcpy(last, filter->memory, sizeof last);",
    ]
    after = []
    if single:
        before.insert(0, f"double velocity[{joints}], acceleration[{joints}];")
        before.insert(0, "int i;")
        after = [f"for (i = 0; i < {joints}; ++i) {{", "    qd[i] = (float)velocity[i];",
                 "    qdd[i] = (float)acceleration[i];", "}"]  # fmt: skip
    init, stepping, reset = filter_signatures(prefix)
    return [
        *([own.functions(), bits(own.prefix, "double")] if single else []),
        _public(init, [rest]),
        f"{reset}\n{{\n    {prefix}_filter_init(filter, q);\n}}\n",
        _public(stepping, [step], before, after),
    ]
