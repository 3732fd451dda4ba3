"""ATen operations on arrays of scalar nodes: pointwise ones, reductions, products and views.

Every function takes the graph and then the arguments of the operation in order, with tensors
replaced by object arrays of nodes, and returns an array of nodes (views really are views).
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from nfriction.codegen.scalar import Graph, Node, UnsupportedOperation, is_predicate

Nodes = np.ndarray
Operation = Callable[..., Any]

# Keys are ATen names without `aten::` and overload; in-place forms map to their base name.
OPERATIONS: dict[str, Operation] = {}


def supported_operations() -> list[str]:
    """Names of the ATen operations that can be compiled (others are decomposed if possible)."""
    return sorted(OPERATIONS)


def handles(*names: str) -> Callable[[Operation], Operation]:
    """Register the decorated function under ATen names."""

    def register(operation: Operation) -> Operation:
        for name in names:
            OPERATIONS[name] = operation
        return operation

    return register


def constants(graph: Graph, tensor: Tensor) -> Nodes:
    """The values of an ordinary tensor as constant nodes."""
    flat = np.empty(tensor.numel(), dtype=object)
    flat[:] = [graph.constant(x) for x in tensor.detach().cpu().reshape(-1).tolist()]
    return flat.reshape(tuple(tensor.shape))


def as_nodes(g: Graph, x: Any) -> Nodes:
    """An array, a node or a number as an array of nodes."""
    if isinstance(x, np.ndarray):
        return x
    out = np.empty((), dtype=object)
    out[()] = x if isinstance(x, Node) else g.constant(x)
    return out


def elementwise(g: Graph, function: Callable[..., Node], *operands: Any) -> Nodes:
    """`function` of corresponding elements, with operands broadcast."""
    arrays = np.broadcast_arrays(*(as_nodes(g, x) for x in operands))
    out = np.empty(arrays[0].size, dtype=object)
    out[:] = [function(*xs) for xs in zip(*(a.flat for a in arrays), strict=True)]
    return out.reshape(arrays[0].shape)


def number(g: Graph, node: Node) -> Node:
    """`node` as a number: true is 1."""
    if is_predicate(node):
        return g.apply("where", node, g.constant(1.0), g.constant(0.0))
    return node


def predicate(g: Graph, node: Node) -> Node:
    """`node` as a truth value: everything except zero is true."""
    return node if is_predicate(node) else g.apply("ne", node, g.constant(0.0))


def numbers(g: Graph, op: str, *operands: Any) -> Nodes:
    """The scalar operation `op` on corresponding elements, with truth values as numbers."""
    return elementwise(g, lambda *xs: g.apply(op, *(number(g, x) for x in xs)), *operands)


for _aten, _op in {
    **{
        name: name
        for name in (
            *("neg", "abs", "sqrt", "exp", "expm1", "log", "log1p", "floor", "ceil", "trunc"),
            *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
            *("mul", "atan2", "fmod", "pow", "lt", "le", "eq", "ne"),
        )
    },
    "maximum": "max",
    "minimum": "min",
}.items():
    OPERATIONS[_aten] = lambda g, *xs, op=_op: numbers(g, op, *xs)


@handles("add")
def add(g: Graph, a: Any, b: Any, alpha: float = 1) -> Nodes:
    return numbers(g, "add", a, numbers(g, "mul", b, alpha))


@handles("div")
def div(g: Graph, a: Any, b: Any, rounding_mode: str | None = None) -> Nodes:
    quotient = numbers(g, "div", a, b)
    return quotient if rounding_mode is None else numbers(g, rounding_mode, quotient)


@handles("softplus")
def _softplus(g: Graph, a: Nodes, beta: float = 1, threshold: float = 20) -> Nodes:
    scaled = numbers(g, "mul", a, beta)
    soft = div(g, numbers(g, "log1p", numbers(g, "exp", scaled)), beta)
    return where(g, numbers(g, "lt", threshold, scaled), a, soft)


@handles("remainder")
def _remainder(g: Graph, a: Any, b: Any) -> Nodes:
    def remainder(x: Node, y: Node) -> Node:
        zero = g.constant(0.0)
        rest = g.apply("fmod", x, y)
        opposed = g.apply("ne", g.apply("lt", rest, zero), g.apply("lt", y, zero))
        wrong = g.apply("and", g.apply("ne", rest, zero), opposed)
        return g.apply("where", wrong, g.apply("add", rest, y), rest)

    return elementwise(g, remainder, a, b)


@handles("clamp", "clamp_min")
def _clamp(g: Graph, a: Nodes, min: Any = None, max: Any = None) -> Nodes:
    raised = a if min is None else numbers(g, "max", a, min)
    return raised if max is None else numbers(g, "min", raised, max)


@handles("where")
def where(g: Graph, condition: Nodes, a: Any = None, b: Any = None) -> Nodes:
    if a is None or b is None:
        raise UnsupportedOperation("where(condition)", "has a shape known only at run time")

    def choose(c: Node, x: Node, y: Node) -> Node:
        if is_predicate(x) != is_predicate(y):
            x, y = number(g, x), number(g, y)
        return g.apply("where", c, x, y)

    return elementwise(g, choose, condition, a, b)


def _logical(op: str) -> Operation:
    def apply(g: Graph, *operands: Any) -> Nodes:
        return elementwise(g, lambda *xs: g.apply(op, *(predicate(g, x) for x in xs)), *operands)

    return apply


def _bitwise(name: str, op: str) -> None:
    def apply(g: Graph, *operands: Any) -> Nodes:
        if not all(is_predicate(x) for a in operands for x in as_nodes(g, a).flat):
            raise UnsupportedOperation(name, "is known for booleans only")
        return _logical(op)(g, *operands)

    OPERATIONS[name] = apply


for _aten, _op in {"and": "and", "or": "or", "xor": "ne", "not": "not"}.items():
    OPERATIONS[f"logical_{_aten}"] = _logical(_op)
    _bitwise(f"bitwise_{_aten}", _op)


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


def _extreme(op: str) -> Operation:
    def extreme(g: Graph, a: Nodes, dim: Any = None, keepdim: bool = False) -> Nodes:
        if isinstance(dim, int):
            raise UnsupportedOperation(f"{op}.dim", f"returns indices; use `torch.a{op}`")
        if isinstance(dim, np.ndarray):
            return numbers(g, op, a, dim)
        return _reduce(g, lambda xs: g.total(xs, op), a, dim, keepdim)

    return extreme


_amax = OPERATIONS["amax"] = OPERATIONS["max"] = _extreme("max")
OPERATIONS["amin"] = OPERATIONS["min"] = _extreme("min")


@handles("_softmax")
def _softmax(g: Graph, a: Nodes, dim: int, half_to_float: bool) -> Nodes:
    exps = numbers(g, "exp", numbers(g, "sub", a, _amax(g, a, [dim], True)))
    return numbers(g, "mul", exps, div(g, 1.0, _sum(g, exps, dim, True)))


@handles("cumsum")
def _cumsum(g: Graph, a: Nodes, dim: int, dtype: Any = None) -> Nodes:
    out = elementwise(g, lambda x: number(g, x), a)
    rows = np.moveaxis(out, dim, 0) if out.ndim else out[None]
    for i in range(1, len(rows)):
        rows[i : i + 1] = add(g, rows[i - 1 : i], rows[i : i + 1])
    return out


@handles("mm", "mv", "dot", "bmm")
def _matmul(g: Graph, a: Nodes, b: Nodes) -> Nodes:
    """Contract the last axis of `a` with the first (after the batch) of `b`."""
    if a.ndim == 3:
        return np.stack([_matmul(g, x, y) for x, y in zip(a, b, strict=True)])
    left, right = a.reshape(-1, a.shape[-1]), b.reshape(b.shape[0], -1).T
    out = np.empty(len(left) * len(right), dtype=object)
    out[:] = [g.total([g.apply("mul", *p) for p in zip(x, y)]) for x in left for y in right]  # noqa: B905
    return out.reshape(a.shape[:-1] + b.shape[1:])


# Copies, creation, views, joining and indexing compute nothing.


@handles("_to_copy")
def _to_copy(g: Graph, a: Nodes, dtype: Any = None, **_: Any) -> Nodes:
    if dtype is None:
        return a.copy()
    if dtype.is_floating_point:
        return elementwise(g, lambda x: number(g, x), a)
    if dtype.is_complex:
        raise UnsupportedOperation("_to_copy", "makes a complex tensor")
    if str(dtype) == "torch.bool":
        return elementwise(g, lambda x: predicate(g, x), a)
    return numbers(g, "trunc", a)


@handles("new_full")
def _full(g: Graph, a: Nodes, size: Sequence[int] | None, value: Any, **_: Any) -> Nodes:
    shape = a.shape if size is None else size
    return elementwise(g, lambda x: x, np.broadcast_to(as_nodes(g, value), shape))


@handles("view", "_unsafe_view", "reshape", "_reshape_alias")
def _view(g: Graph, a: Nodes, size: Sequence[int], *_: Any) -> Nodes:
    out = a.reshape(tuple(size))
    if out.size and not np.shares_memory(out, a):
        a.flags.writeable = out.flags.writeable = False  # torch may alias here, NumPy did not
    return out


@handles("squeeze")
def _squeeze(g: Graph, a: Nodes, dim: Any = None) -> Nodes:
    dims = range(a.ndim) if dim is None else [dim] if isinstance(dim, int) else dim
    axes = tuple(d % a.ndim for d in dims if a.ndim and a.shape[d] == 1)
    return a.squeeze(axes)


@handles("constant_pad_nd")
def _pad(g: Graph, a: Nodes, pad: Sequence[int], value: float = 0.0) -> Nodes:
    widths = [(0, 0)] * (a.ndim - len(pad) // 2)
    widths += [(pad[i], pad[i + 1]) for i in range(len(pad) - 2, -1, -2)]
    return np.pad(a, widths, constant_values=g.constant(value))  # type: ignore[call-overload]


def _static(name: str, index: Nodes) -> np.ndarray:
    if any(node.op != "constant" for node in index.flat):
        raise UnsupportedOperation(name, "has an index that is known only at run time")
    boolean = index.size > 0 and isinstance(index.flat[0].value, bool)
    values = np.array([node.value for node in index.flat], dtype=bool if boolean else np.int64)
    return values.reshape(index.shape)


def _subscript(name: str, indices: Sequence[Nodes | None]) -> tuple[Any, ...]:
    return tuple(slice(None) if i is None else _static(name, i) for i in indices)


@handles("index_put")
def _index_put(
    g: Graph, a: Nodes, indices: Sequence[Nodes | None], values: Nodes, accumulate: bool = False
) -> Nodes:
    if accumulate:
        raise UnsupportedOperation("index_put", "accumulates, which is not known here")
    out = a.copy()
    out[_subscript("index_put", indices)] = values
    return out


# All operations that need only one expression.
OPERATIONS |= {
    "full_like": lambda g, a, value, **_: _full(g, a, None, value),
    "ge": lambda g, a, b: numbers(g, "le", b, a),
    "gt": lambda g, a, b: numbers(g, "lt", b, a),
    "hypot": lambda g, a, b: numbers(
        g, "sqrt", add(g, numbers(g, "mul", a, a), numbers(g, "mul", b, b))
    ),
    "isnan": lambda g, a: numbers(g, "ne", a, a),
    "reciprocal": lambda g, a: div(g, 1.0, a),
    "relu": lambda g, a: numbers(g, "max", a, 0.0),
    "rsqrt": lambda g, a: div(g, 1.0, numbers(g, "sqrt", a)),
    "mean": lambda g, a, dim=None, keepdim=False, **_: _reduce(
        g, lambda xs: g.apply("div", g.total(xs), g.constant(len(xs))), a, dim, keepdim
    ),
    "prod": lambda g, a, dim=None, keepdim=False, **_: _reduce(
        g, lambda xs: g.total(xs, "mul"), a, dim, keepdim
    ),
    "sub": lambda g, a, b, alpha=1: numbers(g, "sub", a, numbers(g, "mul", b, alpha)),
    "sigmoid": lambda g, a: div(g, 1.0, add(g, 1.0, numbers(g, "exp", numbers(g, "neg", a)))),
    **dict.fromkeys(
        ("sign", "sgn"),
        lambda g, a: where(
            g, numbers(g, "lt", 0.0, a), 1.0, where(g, numbers(g, "lt", a, 0.0), -1.0, 0.0)
        ),
    ),
    **dict.fromkeys(
        ("addmm", "addmv", "baddbmm", "addbmm"),
        lambda g, c, a, b, beta=1, alpha=1: add(
            g, numbers(g, "mul", c, beta), _matmul(g, a, b), alpha
        ),
    ),
    **dict.fromkeys(
        ("copy", "fill"),
        lambda g, a, source, non_blocking=False: np.broadcast_to(
            elementwise(g, lambda x: number(g, x), source), a.shape
        ),
    ),
    # Memory that torch leaves uninitialised is set to zero, so that a trace is deterministic.
    **dict.fromkeys(
        ("zero", "zeros_like", "new_zeros", "empty_like", "new_empty"),
        lambda g, a, size=None, **_: _full(g, a, size, 0.0),
    ),
    **dict.fromkeys(("ones_like", "new_ones"), lambda g, a, size=None, **_: _full(g, a, size, 1.0)),
    # torch ignores the legacy empty 1-D tensor.
    "cat": lambda g, tensors, dim=0: np.concatenate(
        [t for t in tensors if t.shape != (0,)] or list(tensors), axis=dim
    ),
    "gather": lambda g, a, dim, index, sparse_grad=False: np.take_along_axis(
        a, _static("gather", index), axis=dim
    ),
    # Read-only: writing through it is refused.
    "diagonal": lambda g, a, offset=0, dim1=0, dim2=1: np.diagonal(a, offset, dim1, dim2),
    "transpose": lambda g, a, dim0, dim1: a.swapaxes(dim0, dim1) if a.ndim else a,
    "expand": lambda g, a, size, implicit=False: np.broadcast_to(
        a, [a.shape[i - len(size) + a.ndim] if n == -1 else n for i, n in enumerate(size)]
    ),
    "select": lambda g, a, dim, index: np.moveaxis(a, dim, 0)[int(index), ...],
    "slice": lambda g, a, dim=0, start=None, end=None, step=1: np.moveaxis(
        np.moveaxis(a, dim, 0)[start:end:step], 0, dim
    ),
    "split_with_sizes": lambda g, a, sizes, dim=0: np.split(a, np.cumsum(sizes)[:-1], dim),
    "unbind": lambda g, a, dim=0: [np.moveaxis(a, dim, 0)[i, ...] for i in range(a.shape[dim])],
    "flip": lambda g, a, dims: np.flip(a, tuple(dims)).copy(),
    "permute": lambda g, a, dims: a.transpose([d % a.ndim for d in dims]),
    "repeat": lambda g, a, repeats: np.tile(a, tuple(repeats)),
    "stack": lambda g, tensors, dim=0: np.stack(tensors, axis=dim),
    "unsqueeze": lambda g, a, dim: np.expand_dims(a, dim),
    **dict.fromkeys(
        ("index", "_unsafe_index"),
        lambda g, a, indices: as_nodes(g, a[_subscript("index", indices)]),
    ),
    **dict.fromkeys(("t", "numpy_T"), lambda g, a: a.T),
    **dict.fromkeys(("alias", "detach"), lambda g, a: a),
    **dict.fromkeys(
        ("clone", "contiguous", "lift_fresh", "lift_fresh_copy"),
        lambda g, a, memory_format=None: a.copy(),
    ),
}
