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
from nfriction.export.c_dialect import ControllerC, bits, comment
from nfriction.export.c_function import Emitted, Output, emit
from nfriction.export.controller import (
    CLAMPED,
    FILTER_STATE,
    NOT_FINITE,
    SATURATED,
    AnyController,
    Controller,
    FilteredController,
    MemoryController,
)
from nfriction.export.errors import ExportError


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
    if real == "float":
        inner = _single(inner)
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
    code = [f"{head}\n{includes}", dialect.functions(), bits(prefix, real), *parts]
    header = _header(controller, inner, description, real, prefix)
    return Source("\n".join(part for part in code if part), header)


def _single(controller: Controller | MemoryController) -> Controller | MemoryController:
    """With ranges such that no number in single precision changes its side by their rounding."""
    single = copy.deepcopy(controller)
    for name in ("qd", "qdd"):
        for edge, inward in (("lower", math.inf), ("upper", -math.inf)):
            exact = single.get_buffer(f"{name}_{edge}")
            near = exact.float()
            outside = near.double() < exact if edge == "lower" else near.double() > exact
            next_in = torch.nextafter(near, torch.full_like(near, inward))
            exact.copy_(torch.where(outside, next_in, near))
    return single


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
    return _public(_step_signature(inner, prefix), [made], before)


def _step_signature(inner: Controller | MemoryController, prefix: str) -> str:
    real, joints = f"{prefix}_real", f"{prefix.upper()}_JOINTS"
    state = [f"{prefix}_state *state"] if isinstance(inner, MemoryController) else []
    arguments = [
        *state,
        *(f"const {real} {x}[{joints}]" for x in ("qd", "qdd", "load")),
        f"{real} tau[{joints}]",
        f"{real} coefficients[{joints} * {prefix.upper()}_COEFFICIENTS]",
        f"int status[{joints}]",
    ]
    return f"void {prefix}_step(\n    " + ",\n    ".join(arguments) + ")"


def _init(inner: MemoryController, dialect: ControllerC) -> str:
    name = f"{dialect.prefix}_init_joint"
    inputs = _examples(inner.joints, "qd", "qdd")
    arrays = {"following": "state->memory"}
    made = emit(name, inner.initial_state, inputs, [Output("following")], dialect, arrays)
    return _public(_init_signature(dialect.prefix), [made])


def _init_signature(prefix: str) -> str:
    arguments = ", ".join(
        f"const {prefix}_real {x}[{prefix.upper()}_JOINTS]" for x in ("qd", "qdd")
    )
    return f"void {prefix}_init(\n    {prefix}_state *state, {arguments})"


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
    init, step_signature, reset = _filter_signatures(prefix)
    return [
        *([own.functions(), bits(own.prefix, "double")] if single else []),
        _public(init, [rest]),
        f"{reset}\n{{\n    {prefix}_filter_init(filter, q);\n}}\n",
        _public(step_signature, [step], before, after),
    ]


def _filter_signatures(prefix: str) -> tuple[str, str, str]:
    real, joints = f"{prefix}_real", f"{prefix.upper()}_JOINTS"
    rest = f"({prefix}_filter *filter, const double q[{joints}])"
    step = (
        f"void {prefix}_filter_step(\n    {prefix}_filter *filter, const double q[{joints}],\n"
        f"    {real} qd[{joints}], {real} qdd[{joints}])"
    )
    return f"void {prefix}_filter_init{rest}", step, f"void {prefix}_filter_reset{rest}"


def _header(
    controller: AnyController,
    inner: Controller | MemoryController,
    description: Mapping[str, Any],
    real: Real,
    prefix: str,
) -> str:
    upper = prefix.upper()
    memory = inner.state_size if isinstance(inner, MemoryController) else 0
    filters = isinstance(controller, FilteredController)
    sizes = {
        "JOINTS": inner.joints,
        "COEFFICIENTS": inner.coefficient_count,
        "STATE_SIZE": memory,
        "FILTER_SIZE": FILTER_STATE if filters else 0,
        "CLAMPED": CLAMPED,
        "NOT_FINITE": NOT_FINITE,
        "SATURATED": SATURATED,
    }
    parts = [
        _banner(description),
        f"#ifndef {upper}_H\n#define {upper}_H\n",
        "\n".join(f"#define {upper}_{key} {value}" for key, value in sizes.items()) + "\n",
        '#ifdef __cplusplus\nextern "C" {\n#endif\n',
        f"typedef {real} {prefix}_real;\n",
    ]
    if memory:
        parts.append(
            "/* What the coefficients remember of earlier samples. */\ntypedef struct {\n"
            f"    {prefix}_real memory[{upper}_JOINTS * {upper}_STATE_SIZE];\n"
            f"}} {prefix}_state;\n\n"
            "/* Memory before the first sample, whose motion is given. */\n"
            f"{_init_signature(prefix)};\n"
        )
    parts.append(
        "/* Friction torque, coefficients (joint by joint) and status bits of every joint.\n"
        " * No array may be NULL, and no output may lie where an input does. */\n"
        f"{_step_signature(inner, prefix)};\n"
    )
    if filters:
        init, step, reset = _filter_signatures(prefix)
        parts.append(
            f"/* Two causal low-pass filters in series, each of {FILTER_STATE // 2 - 1} states.\n"
            " * Positions are double: their differences would cost float its digits. */\n"
            f"typedef struct {{\n    double memory[{upper}_JOINTS * {upper}_FILTER_SIZE];\n"
            f"}} {prefix}_filter;\n\n"
            f"/* A filter that has rested at positions q; the same to start anew. */\n{init};\n"
            f"{reset};\n\n"
            "/* Velocity and acceleration of one more sample, to be taken at the sample time. */\n"
            f"{step};\n"
        )
    parts.append("#ifdef __cplusplus\n}\n#endif\n\n#endif\n")
    return "\n".join(parts)


def _banner(description: Mapping[str, Any]) -> str:
    """What the controller is, as a comment; names and units are foreign text."""
    units = description["units"]
    names = list(description["joint_names"]) or [
        f"joint {i + 1}" for i in range(description["joints"])
    ]
    time = description["sample_time"]
    lines = [
        f"{description['model']}: friction of {description['joints']} joints, made by nfriction "
        f"{description['version']} (schema {description['schema']}).",
        "",
        "Inputs: " + ", ".join(f"{x} [{units[x]}]" for x in ("qd", "qdd", "load")) + ".",
        f"Outputs: tau [{units['tau_f']}], on the left of M(q) qdd + bias(q, qd) + tau = drive; "
        "coefficients:",
        "    " + ", ".join(f"{c['name']} [{c['unit']}]" for c in description["coefficients"]),
        f"Sample time: {'any' if time is None else f'{time!r} s'}.",
        "Joints, in order:",
        *(f"    {name}" for name in names),
        "Trained ranges:",
        *(f"    {key}: {value}" for key, value in sorted(description["input_ranges"].items())),
        "Outside them the coefficients stay as at the edge while the law goes on (CLAMPED). NaN or",
        "infinity gives NaN for that joint (NOT_FINITE), under -ffast-math too. SATURATED: the "
        "torque limit.",
        f"Torque limit: {description['torque_limit']}.",
        f"Filter: {description['filter']}.",
        f"Parameters: {description['parameter_hash']}.",
        *(f"Training data: {k}: {v}" for k, v in sorted(description["training_data"].items())),
    ]
    wrapped = "\n".join(f" * {comment(line)}".rstrip() for line in lines)
    return f"/*\n{wrapped}\n */"
