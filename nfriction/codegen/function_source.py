"""The source of a compiled function: a loop over rows around what one row needs."""

from collections.abc import Sequence

import numpy as np

from nfriction.codegen.emit import C_PRELUDE, COMPILED, PYTHON_PRELUDE, c_function, python_function
from nfriction.codegen.graph import Program
from nfriction.codegen.partition import Partition
from nfriction.codegen.scalar import Level, Node

Groups = Sequence[tuple[Node, ...]]
"""Nodes of each output array."""


def _bound(program: Program, split: Partition) -> tuple[dict[int, str], dict[int, str]]:
    inputs: dict[int, str] = {}
    offset = 0
    for port in program.inputs:
        own = port.name.startswith("x")
        for i, node in enumerate(port.nodes):
            inputs[node.number] = f"{port.name}[{i}]" if own else f"p[{offset + i}]"
        offset += 0 if own else len(port.nodes)
    once = {n.number: f"once[{i}]" for i, n in enumerate(split.hoisted[Level.PARAMETER])}
    return inputs, inputs | once


def c_source(
    program: Program,
    split: Partition,
    groups: Groups,
    shapes: list[tuple[int, ...]],
) -> str:
    inputs, known = _bound(program, split)
    once = split.hoisted[Level.PARAMETER]
    given, taken = _sizes("x", shapes), _sizes("y", [(len(g),) for g in groups])
    named = dict(zip(taken, groups, strict=True))
    arrays = [f"const double *{x}" for x in given] + [f"double *{y}" for y in taken]
    rows = [f"{a} + r * {size}" for a, size in {**given, **taken}.items()]
    return "\n".join(
        [
            C_PRELUDE,
            c_function("nf_once", ["p"], {"once": once}, inputs),
            c_function("nf_row", ["p", "once", *given], named, known),
            "#if defined(_WIN32)\n__declspec(dllexport)\n#endif",
            f"void nf_function(ptrdiff_t rows, const double *p, {', '.join(arrays)})",
            "{",
            f"    double once[{max(1, len(once))}];",
            "    ptrdiff_t r;",
            "    nf_once(p, once);",
            "    for (r = 0; r < rows; ++r)",
            f"        nf_row(p, once, {', '.join(rows)});",
            "}\n",
        ]
    )


def python_source(
    program: Program,
    split: Partition,
    groups: Groups,
    shapes: list[tuple[int, ...]],
) -> str:
    inputs, known = _bound(program, split)
    once = split.hoisted[Level.PARAMETER]
    sizes = _sizes("x", shapes) | _sizes("y", [(len(g),) for g in groups])
    flat = [node for group in groups for node in group]
    targets = [f"y{i}[{j}]" for i, group in enumerate(groups) for j in range(len(group))]
    slots = [f"once[{i}]" for i in range(len(once))]
    rows = ", ".join(f"moved({a}, r * {size})" for a, size in sizes.items())
    return "\n".join(
        [
            PYTHON_PRELUDE,
            python_function("nf_once", ["p", "once"], once, inputs, into=slots),
            python_function("nf_row", ["p", "once", *sizes], flat, known, into=targets),
            f"@njit(void(REALS, COUNT, REALS{', REALS' * len(sizes)}), {COMPILED})",
            f"def nf_function(once, rows, p, {', '.join(sizes)}):",
            "    nf_once(p, once)",
            "    for r in range(rows):",
            f"        nf_row(p, once, {rows})\n",
        ]
    )


def _sizes(prefix: str, shapes: Sequence[tuple[int, ...]]) -> dict[str, int]:
    return {f"{prefix}{i}": int(np.prod(s, dtype=int)) for i, s in enumerate(shapes)}
