"""Reductions and products."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from nfriction.codegen.errors import UnsupportedOperation
from nfriction.codegen.operations.pointwise import add, reciprocal, sub
from nfriction.codegen.operations.registry import (
    Nodes,
    elementwise,
    handles,
    number,
    numbers,
)
from nfriction.codegen.scalar import Graph, Node


def _reduce(
    g: Graph, function: Callable[[list[Node]], Node], a: Nodes, dim: Any, keepdim: bool
) -> Nodes:
    dims = range(a.ndim) if dim is None or dim == [] else [dim] if isinstance(dim, int) else dim
    axes = sorted({d % a.ndim for d in dims}) if a.ndim else []
    kept = [i for i in range(a.ndim) if i not in axes]
    rows = a.transpose(kept + axes).reshape(math.prod(a.shape[i] for i in kept), -1)
    out = np.empty(len(rows), dtype=object)
    out[:] = [function([number(g, x) for x in row]) for row in rows]
    shape = [1 if i in axes else n for i, n in enumerate(a.shape)]
    return out.reshape(shape if keepdim else [a.shape[i] for i in kept])


@handles("sum")
def _sum(g: Graph, a: Nodes, dim: Any = None, keepdim: bool = False, **_: Any) -> Nodes:
    return _reduce(g, g.total, a, dim, keepdim)


@handles("mean")
def _mean(g: Graph, a: Nodes, dim: Any = None, keepdim: bool = False, **_: Any) -> Nodes:
    return _reduce(g, lambda xs: g.apply("div", g.total(xs), g.constant(len(xs))), a, dim, keepdim)


@handles("prod")
def _prod(g: Graph, a: Nodes, dim: Any = None, keepdim: bool = False, **_: Any) -> Nodes:
    return _reduce(g, lambda xs: g.total(xs, "mul"), a, dim, keepdim)


@handles("amax", "max")
def _amax(g: Graph, a: Nodes, dim: Any = None, keepdim: bool = False) -> Nodes:
    if isinstance(dim, int):
        raise UnsupportedOperation("max.dim", "returns indices; use `torch.amax`")
    if isinstance(dim, np.ndarray):
        return numbers(g, "max", a, dim)
    return _reduce(g, lambda xs: g.total(xs, "max"), a, dim, keepdim)


@handles("amin", "min")
def _amin(g: Graph, a: Nodes, dim: Any = None, keepdim: bool = False) -> Nodes:
    if isinstance(dim, int):
        raise UnsupportedOperation("min.dim", "returns indices; use `torch.amin`")
    if isinstance(dim, np.ndarray):
        return numbers(g, "min", a, dim)
    return _reduce(g, lambda xs: g.total(xs, "min"), a, dim, keepdim)


@handles("logsumexp")
def _logsumexp(g: Graph, a: Nodes, dim: Any, keepdim: bool = False) -> Nodes:
    def logsumexp(xs: list[Node]) -> Node:
        top = g.total(xs, "max")
        infinite = g.apply("eq", g.apply("abs", top), g.constant(math.inf))
        top = g.apply("where", infinite, g.constant(0.0), top)
        exps = [g.apply("exp", g.apply("sub", x, top)) for x in xs]
        return g.apply("add", g.apply("log", g.total(exps)), top)

    return _reduce(g, logsumexp, a, dim, keepdim)


@handles("_softmax")
def _softmax(g: Graph, a: Nodes, dim: int, half_to_float: bool) -> Nodes:
    exps = numbers(g, "exp", sub(g, a, _amax(g, a, [dim], True)))
    return numbers(g, "mul", exps, reciprocal(g, _sum(g, exps, dim, True)))


@handles("_log_softmax")
def _log_softmax(g: Graph, a: Nodes, dim: int, half_to_float: bool) -> Nodes:
    return sub(g, a, _logsumexp(g, a, dim, True))


@handles("cumsum")
def _cumsum(g: Graph, a: Nodes, dim: int, dtype: Any = None) -> Nodes:
    out = elementwise(g, lambda x: number(g, x), a)
    rows = np.moveaxis(out, dim, 0) if out.ndim else out[None]
    for i in range(1, len(rows)):
        rows[i : i + 1] = add(g, rows[i - 1 : i], rows[i : i + 1])
    return out


@handles("linalg_vector_norm")
def _vector_norm(
    g: Graph, a: Nodes, ord: float = 2, dim: Any = None, keepdim: bool = False, dtype: Any = None
) -> Nodes:
    if ord == 2:
        return numbers(g, "sqrt", _sum(g, numbers(g, "mul", a, a), dim, keepdim))
    if ord == 1:
        return _sum(g, numbers(g, "abs", a), dim, keepdim)
    if ord == math.inf:
        return _amax(g, numbers(g, "abs", a), None if dim is None else [*dim], keepdim)
    raise UnsupportedOperation("linalg_vector_norm", f"is not known for ord={ord}")


@handles("mm", "mv", "dot", "bmm")
def _matmul(g: Graph, a: Nodes, b: Nodes) -> Nodes:
    """Contract the last axis of `a` with the first (after the batch) of `b`."""
    if a.ndim == 3:
        return np.stack([_matmul(g, x, y) for x, y in zip(a, b, strict=True)])
    left, right = a.reshape(-1, a.shape[-1]), b.reshape(b.shape[0], -1).T
    out = np.empty(len(left) * len(right), dtype=object)
    out[:] = [g.total([g.apply("mul", *p) for p in zip(x, y)]) for x in left for y in right]  # noqa: B905
    return out.reshape(a.shape[:-1] + b.shape[1:])


@handles("addmm", "addmv", "baddbmm", "addbmm")
def _addmm(g: Graph, c: Nodes, a: Nodes, b: Nodes, beta: float = 1, alpha: float = 1) -> Nodes:
    return add(g, numbers(g, "mul", c, beta), _matmul(g, a, b), alpha)
