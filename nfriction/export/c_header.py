"""The header of an exported controller: its comment, types and the signatures of its functions."""

from collections.abc import Mapping
from typing import Any

from nfriction.codegen.emit import Real
from nfriction.export.c_dialect import comment
from nfriction.export.controller import AnyController
from nfriction.export.filtered import FILTER_STATE, FilteredController
from nfriction.export.unfiltered import NOT_FINITE, OUTSIDE, SATURATED, Controller, MemoryController


def header_of(
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
        "OUTSIDE": OUTSIDE,
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
            f"{init_signature(prefix)};\n"
        )
    parts.append(
        "/* Friction torque, coefficients (joint by joint) and status bits of every joint.\n"
        " * No array may be NULL, and no output may lie where an input does. */\n"
        f"{step_signature(inner, prefix)};\n"
    )
    if filters:
        init, step, reset = filter_signatures(prefix)
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
        f"Outside them (OUTSIDE): {description['edges']['outside_input_ranges']}.",
        "NaN or infinity gives NaN for that joint (NOT_FINITE), under -ffast-math too.",
        "SATURATED: the torque limit.",
        f"Torque limit: {description['torque_limit']}.",
        f"Filter: {description['filter']}.",
        f"Parameters: {description['parameter_hash']}.",
        *(f"Training data: {k}: {v}" for k, v in sorted(description["training_data"].items())),
    ]
    wrapped = "\n".join(f" * {comment(line)}".rstrip() for line in lines)
    return f"/*\n{wrapped}\n */"


def step_signature(inner: Controller | MemoryController, prefix: str) -> str:
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


def init_signature(prefix: str) -> str:
    arguments = ", ".join(
        f"const {prefix}_real {x}[{prefix.upper()}_JOINTS]" for x in ("qd", "qdd")
    )
    return f"void {prefix}_init(\n    {prefix}_state *state, {arguments})"


def filter_signatures(prefix: str) -> tuple[str, str, str]:
    real, joints = f"{prefix}_real", f"{prefix.upper()}_JOINTS"
    rest = f"({prefix}_filter *filter, const double q[{joints}])"
    step = (
        f"void {prefix}_filter_step(\n    {prefix}_filter *filter, const double q[{joints}],\n"
        f"    {real} qd[{joints}], {real} qdd[{joints}])"
    )
    return f"void {prefix}_filter_init{rest}", step, f"void {prefix}_filter_reset{rest}"
