"""Scalar nodes as C, double or float.

Values used once are written where they are used, the others become constants of the function.
The text depends on the graph alone, so the same model gives the same bytes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from nfriction.codegen.scalar import Node, is_predicate, reachable

Real = Literal["double", "float"]

_INLINE = 64  # characters; longer single-use values get a line of their own

# How tightly an operator binds; an atom or a call binds tightest.
ATOM, _UNARY, _PRODUCT, _SUM, _COMPARE, _NOT, _AND, _OR = 9, 8, 7, 6, 5, 4, 3, 2
_INFIX = {
    "add": ("+", _SUM),
    "sub": ("-", _SUM),
    "mul": ("*", _PRODUCT),
    "div": ("/", _PRODUCT),
    "lt": ("<", _COMPARE),
    "le": ("<=", _COMPARE),
    "eq": ("==", _COMPARE),
    "ne": ("!=", _COMPARE),
}
_C_NAMES = {"abs": "fabs"}

# The two functions that the emitted C relies on both propagate NaN.
C_PRELUDE = """\
#include <math.h>
#include <stddef.h>

static double nf_max(double a, double b) { return a > b || a != a ? a : b; }
static double nf_min(double a, double b) { return a < b || a != a ? a : b; }
"""


@dataclass(frozen=True)
class C:
    """C with C89 syntax and the functions of the C99 `math.h`."""

    real: Real = "double"

    def literal(self, value: float | bool) -> str:
        if isinstance(value, bool):
            return "1" if value else "0"
        single = self.real == "float"
        if single:
            with np.errstate(over="ignore"):
                value = float(np.float32(value))
        if np.isnan(value):
            return "(HUGE_VAL - HUGE_VAL)"
        if np.isinf(value):
            return "HUGE_VAL" if value > 0 else "(-HUGE_VAL)"
        text = f"{np.float32(value)!s}f" if single else repr(value)
        return f"({text})" if text.startswith("-") else text

    def call(self, op: str, args: Sequence[str]) -> str:
        suffix = "f" if self.real == "float" else ""
        name = f"nf_{op}" if op in ("max", "min") else _C_NAMES.get(op, op) + suffix
        return f"{name}({', '.join(args)})"

    def logical(self, op: str) -> str:
        return {"and": "&&", "or": "||", "not": "!"}[op]

    def where(self, condition: str, a: str, b: str) -> str:
        return f"({condition} ? {a} : {b})"

    def define(self, name: str, text: str, predicate: bool) -> str:
        return f"const {'int' if predicate else self.real} {name} = {text};"


def statements(
    outputs: Sequence[Node], bound: Mapping[int, str], dialect: C
) -> tuple[list[str], list[str]]:
    """Definitions of local values, and one expression per output.

    Args:
        outputs: nodes to express.
        bound: text of nodes that are already at hand (inputs, hoisted values), by node number.
        dialect: the language.
    """
    nodes = reachable(outputs, [n for n in reachable(outputs) if n.number in bound])
    uses: dict[int, int] = {}
    for node in nodes:
        if node.number not in bound:
            for argument in node.args:
                uses[argument.number] = uses.get(argument.number, 0) + 1
    for node in outputs:
        uses[node.number] = uses.get(node.number, 0) + 1
    lines: list[str] = []
    texts: dict[int, tuple[str, int]] = {}

    def write(node: Node) -> None:
        if node.number in bound:
            texts[node.number] = bound[node.number], ATOM
        elif node.op == "constant":
            texts[node.number] = dialect.literal(node.value), ATOM
        elif node.op == "input":
            raise AssertionError(f"input {node.value} has no name here")
        else:
            text, binding = expression(node.op, [texts[a.number] for a in node.args], dialect)
            if uses[node.number] > 1 or len(text) > _INLINE:
                name = f"t{len(lines)}"
                lines.append(dialect.define(name, text, is_predicate(node)))
                text, binding = name, ATOM
            texts[node.number] = text, binding

    for node in nodes:
        write(node)
    return lines, [texts[node.number][0] for node in outputs]


def expression(op: str, operands: Sequence[tuple[str, int]], dialect: C) -> tuple[str, int]:
    """Text of an operation, and how tightly it binds, of operands given likewise."""

    def operand(i: int, binding: int) -> str:
        text, own = operands[i]
        return text if own >= binding else f"({text})"

    if op in _INFIX:
        sign, binding = _INFIX[op]
        # Compilers warn of comparisons side by side.
        left = operand(0, binding + (binding == _COMPARE))
        return f"{left} {sign} {operand(1, binding + 1)}", binding
    if op == "neg":
        return f"-{operand(0, ATOM)}", _UNARY
    if op == "not":
        return f"{dialect.logical('not')}{operand(0, ATOM)}", _NOT
    if op in ("and", "or"):
        sides = [operand(i, ATOM) for i in range(len(operands))]
        return f" {dialect.logical(op)} ".join(sides), _AND if op == "and" else _OR
    if op == "where":
        return dialect.where(*(operand(i, _SUM) for i in range(3))), ATOM
    return dialect.call(op, [text for text, _ in operands]), ATOM


def c_function(
    name: str,
    arguments: Sequence[str],
    outputs: Mapping[str, Sequence[Node]],
    bound: Mapping[int, str],
    qualifier: str = "static ",
) -> str:
    """A C function of doubles that writes each of `outputs` to the array of that name.

    Args:
        name: of the function.
        arguments: names of its input arrays.
        outputs: nodes by output array.
        bound: text of the input nodes.
        qualifier: what stands before `void`.
    """
    nodes = [node for group in outputs.values() for node in group]
    lines, texts = statements(nodes, bound, C())
    targets = [f"{array}[{i}]" for array, group in outputs.items() for i in range(len(group))]
    lines += [f"{target} = {text};" for target, text in zip(targets, texts, strict=True)]
    signature = [f"const double *{a}" for a in arguments] + [f"double *{a}" for a in outputs]
    unused = [f"(void){a};" for a in (*arguments, *outputs)]
    body = "\n    ".join(lines + unused)
    return f"{qualifier}void {name}({', '.join(signature)})\n{{\n    {body}\n}}\n"
