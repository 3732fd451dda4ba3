"""Rules that make a scalar operation simpler without changing its value.

Each takes the graph and the operation's arguments and returns a simpler node, or None.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nfriction.codegen.scalar import Graph, Node

_ODD = frozenset({"sin", "tan", "tanh", "atan", "asin", "sinh"})
_EVEN = frozenset({"cos", "cosh", "abs"})


def _is(node: "Node", value: float) -> bool:
    return node.op == "constant" and node.value == value


# Signs are moved outward (exactly: rounding is symmetric) so that a - b and b - a share a node.
# A literal zero annihilates its partner even though 0 * NaN is NaN: a zero written in the model
# says "no such coupling", and whoever runs the code tests the state itself for NaN.


def _add(g: "Graph", a: "Node", b: "Node") -> "Node | None":
    if _is(a, 0.0):
        return b
    if _is(b, 0.0):
        return a
    if a.op == "neg" and b.op == "neg":
        return g.apply("neg", g.apply("add", a.args[0], b.args[0]))
    if b.op == "neg":
        return g.apply("sub", a, b.args[0])
    if a.op == "neg":
        return g.apply("sub", b, a.args[0])
    return None


def _sub(g: "Graph", a: "Node", b: "Node") -> "Node | None":
    if _is(b, 0.0):
        return a
    if _is(a, 0.0):
        return g.apply("neg", b)
    if b.op == "neg":
        return g.apply("add", a, b.args[0])
    if a.op == "neg":
        return g.apply("neg", g.apply("add", a.args[0], b))
    if a is not b and g.known("sub", b, a):
        return g.apply("neg", g.apply("sub", b, a))
    return None


def _mul(g: "Graph", a: "Node", b: "Node") -> "Node | None":
    for x, y in ((a, b), (b, a)):
        if _is(x, 1.0):
            return y
        if _is(x, -1.0):
            return g.apply("neg", y)
        if _is(x, 0.0):
            return g.constant(0.0)
    if a.op == "neg" and b.op == "neg":
        return g.apply("mul", a.args[0], b.args[0])
    if a.op == "neg":
        return g.apply("neg", g.apply("mul", a.args[0], b))
    if b.op == "neg":
        return g.apply("neg", g.apply("mul", a, b.args[0]))
    return None


def _div(g: "Graph", a: "Node", b: "Node") -> "Node | None":
    if _is(b, 1.0):
        return a
    if b.op == "constant" and b.value != 0.0 and abs(math.frexp(b.value)[0]) == 0.5:
        return g.apply("mul", a, g.constant(1.0 / b.value))  # a power of two: exact
    if a.op == "neg" and b.op == "neg":
        return g.apply("div", a.args[0], b.args[0])
    if a.op == "neg":
        return g.apply("neg", g.apply("div", a.args[0], b))
    if b.op == "neg":
        return g.apply("neg", g.apply("div", a, b.args[0]))
    return None


def _neg(g: "Graph", a: "Node") -> "Node | None":
    if a.op == "neg":
        return a.args[0]
    return None


def _pow(g: "Graph", a: "Node", b: "Node") -> "Node | None":
    if b.op != "constant":
        return None
    if b.value == 0.5:
        return g.apply("sqrt", a)
    if b.value == -0.5:
        return g.apply("div", g.constant(1.0), g.apply("sqrt", a))
    if not abs(b.value) <= 8 or b.value != int(b.value):
        return None
    power = g.total([a] * abs(int(b.value)), "mul") if b.value else g.constant(1.0)
    return power if b.value >= 0 else g.apply("div", g.constant(1.0), power)


def _where(g: "Graph", condition: "Node", a: "Node", b: "Node") -> "Node | None":
    if a is b:
        return a
    if condition.op == "constant":
        return a if condition.value else b
    if condition.op == "not":
        return g.apply("where", condition.args[0], b, a)
    return None


def _and(g: "Graph", a: "Node", b: "Node") -> "Node | None":
    for x, y in ((a, b), (b, a)):
        if x.op == "constant":
            return y if x.value else g.constant(False)
    return a if a is b else None


def _or(g: "Graph", a: "Node", b: "Node") -> "Node | None":
    for x, y in ((a, b), (b, a)):
        if x.op == "constant":
            return g.constant(True) if x.value else y
    return a if a is b else None


def _same(g: "Graph", a: "Node", b: "Node") -> "Node | None":
    return a if a is b else None


def _odd(op: str) -> Callable[..., "Node | None"]:
    def rule(g: "Graph", a: "Node") -> "Node | None":
        return g.apply("neg", g.apply(op, a.args[0])) if a.op == "neg" else None

    return rule


def _even(op: str) -> Callable[..., "Node | None"]:
    def rule(g: "Graph", a: "Node") -> "Node | None":
        return g.apply(op, a.args[0]) if a.op == "neg" else None

    return rule


SIMPLIFY: dict[str, Callable[..., "Node | None"]] = {
    "add": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "neg": _neg,
    "pow": _pow,
    "where": _where,
    "and": _and,
    "or": _or,
    "max": _same,
    "min": _same,
    **{op: _odd(op) for op in _ODD},
    **{op: _even(op) for op in _EVEN},
}
