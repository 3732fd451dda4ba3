"""Bounds of the scalars of a template, whatever finite inputs it is given."""

import math
from collections.abc import Sequence

import numpy as np

from nfriction.codegen.joints import TABLE, Template
from nfriction.codegen.scalar import Node, reachable

Bounds = tuple[float, float]

_ANY: Bounds = (-math.inf, math.inf)
_MONOTONE = {"exp": np.exp, "expm1": np.expm1, "tanh": np.tanh, "sqrt": np.sqrt}


def bounds_of(one: Template, nodes: Sequence[Node]) -> dict[int, Bounds]:
    """Least and largest value of all that `nodes` need, by node number.

    Interval arithmetic, but for two things: a square is not negative, nor is the distance of a
    number to a maximum that it takes part in. Roundings are left to the caller's margin.
    """
    found: dict[int, Bounds] = {}
    with np.errstate(all="ignore"):
        for node in reachable(nodes):
            found[node.number] = _bounds(one, node, [found[a.number] for a in node.args])
    return found


def _bounds(one: Template, node: Node, args: list[Bounds]) -> Bounds:
    if node.op == "constant":
        return float(node.value), float(node.value)
    if node.op == "input":
        name, index = node.value
        column = one.table[:, index] if name == TABLE else np.array(_ANY)
        return float(column.min()), float(column.max())
    if node.op in _MONOTONE:
        low, high = (float(_MONOTONE[node.op](max(x, 0.0) if node.op == "sqrt" else x))
                     for x in args[0])  # fmt: skip
        return low, high
    if node.op == "neg":
        return -args[0][1], -args[0][0]
    if node.op == "abs":
        low, high = args[0]
        return max(0.0, low, -high), max(-low, high)
    if node.op in ("max", "min"):
        pick = max if node.op == "max" else min
        return pick(a[0] for a in args), pick(a[1] for a in args)
    if node.op == "mul":
        corners = [float(np.float64(a) * b) for a in args[0] for b in args[1]]
        if any(math.isnan(c) for c in corners):
            corners = list(_ANY)
        same = node.args[0] is node.args[1]
        return max(min(corners), 0.0) if same else min(corners), max(corners)
    if node.op == "add":
        low, high = args[0][0] + args[1][0], args[0][1] + args[1][1]
        return (max(low, 0.0) if _reaches(node) else low), high
    if node.op == "sub":
        a, b = node.args
        low, high = args[0][0] - args[1][1], args[0][1] - args[1][0]
        return low, min(high, 0.0) if _takes_part(a, b) else high
    return _ANY


def _reaches(node: Node) -> bool:
    """Whether a sum is `a + max(-a, ...)`."""
    for a, b in (node.args, node.args[::-1]):
        if any(leaf.op == "neg" and leaf.args[0] is a for leaf in _compared(b)):
            return True
    return False


def _takes_part(a: Node, b: Node) -> bool:
    return b.op == "max" and any(leaf is a for leaf in _compared(b))


def _compared(node: Node) -> list[Node]:
    """What a maximum is taken of."""
    if node.op != "max":
        return []
    return [leaf for a in node.args for leaf in (_compared(a) if a.op == "max" else [a])]
