"""Copies, creation, views, joining and indexing: operations that compute nothing."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nfriction.codegen.errors import UnsupportedOperation
from nfriction.codegen.operations.registry import (
    Nodes,
    as_nodes,
    elementwise,
    handles,
    number,
    numbers,
    predicate,
)
from nfriction.codegen.scalar import Graph


@handles("clone", "contiguous", "lift_fresh", "lift_fresh_copy")
def _clone(g: Graph, a: Nodes, memory_format: Any = None) -> Nodes:
    return a.copy()


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


@handles("copy")
def _copy(g: Graph, a: Nodes, source: Any, non_blocking: bool = False) -> Nodes:
    return np.broadcast_to(elementwise(g, lambda x: number(g, x), source), a.shape)


@handles("fill")
def _fill(g: Graph, a: Nodes, value: Any) -> Nodes:
    return _copy(g, a, value)


@handles("zero", "zeros_like", "new_zeros")
def _zeros(g: Graph, a: Nodes, size: Sequence[int] | None = None, **_: Any) -> Nodes:
    return _full(g, a, size, 0.0)


@handles("ones_like", "new_ones")
def _ones(g: Graph, a: Nodes, size: Sequence[int] | None = None, **_: Any) -> Nodes:
    return _full(g, a, size, 1.0)


@handles("empty_like", "new_empty")
def _empty(g: Graph, a: Nodes, size: Sequence[int] | None = None, **_: Any) -> Nodes:
    return _full(g, a, size, 0.0)


@handles("new_full")
def _full(g: Graph, a: Nodes, size: Sequence[int] | None, value: Any, **_: Any) -> Nodes:
    return elementwise(
        g, lambda x: x, np.broadcast_to(as_nodes(g, value), a.shape if size is None else size)
    )


@handles("full_like")
def _full_like(g: Graph, a: Nodes, value: Any, **_: Any) -> Nodes:
    return _full(g, a, None, value)


@handles("view", "_unsafe_view", "reshape", "_reshape_alias")
def _view(g: Graph, a: Nodes, size: Sequence[int], *_: Any) -> Nodes:
    out = a.reshape(tuple(size))
    if out.size and not np.shares_memory(out, a):
        a.flags.writeable = out.flags.writeable = False  # torch may alias here, NumPy did not
    return out


@handles("permute")
def _permute(g: Graph, a: Nodes, dims: Sequence[int]) -> Nodes:
    return a.transpose([d % a.ndim for d in dims])


@handles("transpose")
def _transpose(g: Graph, a: Nodes, dim0: int, dim1: int) -> Nodes:
    return a.swapaxes(dim0, dim1) if a.ndim else a


@handles("t", "numpy_T")
def _t(g: Graph, a: Nodes) -> Nodes:
    return a.T


@handles("expand")
def _expand(g: Graph, a: Nodes, size: Sequence[int], implicit: bool = False) -> Nodes:
    lead = len(size) - a.ndim
    return np.broadcast_to(a, [a.shape[i - lead] if n == -1 else n for i, n in enumerate(size)])


@handles("select")
def _select(g: Graph, a: Nodes, dim: int, index: int) -> Nodes:
    return np.moveaxis(a, dim, 0)[int(index), ...]


@handles("slice")
def _slice(
    g: Graph, a: Nodes, dim: int = 0, start: Any = None, end: Any = None, step: int = 1
) -> Nodes:
    return np.moveaxis(np.moveaxis(a, dim, 0)[start:end:step], 0, dim)


@handles("squeeze")
def _squeeze(g: Graph, a: Nodes, dim: Any = None) -> Nodes:
    dims = range(a.ndim) if dim is None else [dim] if isinstance(dim, int) else dim
    axes = tuple(d % a.ndim for d in dims if a.ndim and a.shape[d] == 1)
    return a.squeeze(axes)


@handles("unsqueeze")
def _unsqueeze(g: Graph, a: Nodes, dim: int) -> Nodes:
    return np.expand_dims(a, dim)


@handles("unbind")
def _unbind(g: Graph, a: Nodes, dim: int = 0) -> list[Nodes]:
    return [_select(g, a, dim, i) for i in range(a.shape[dim])]


@handles("split")
def _split(g: Graph, a: Nodes, size: int, dim: int = 0) -> list[Nodes]:
    length = a.shape[dim]
    return [_slice(g, a, dim, i, i + size) for i in range(0, max(length, 1), size)]


@handles("split_with_sizes")
def _split_with_sizes(g: Graph, a: Nodes, sizes: Sequence[int], dim: int = 0) -> list[Nodes]:
    stops = np.cumsum(sizes)
    return [_slice(g, a, dim, s - n, s) for s, n in zip(stops, sizes, strict=True)]


@handles("alias", "detach")
def _alias(g: Graph, a: Nodes) -> Nodes:
    return a


@handles("diagonal")
def _diagonal(g: Graph, a: Nodes, offset: int = 0, dim1: int = 0, dim2: int = 1) -> Nodes:
    return np.diagonal(a, offset, dim1, dim2)  # read-only: writing through it is refused


@handles("flip")
def _flip(g: Graph, a: Nodes, dims: Sequence[int]) -> Nodes:
    return np.flip(a, tuple(dims)).copy()


@handles("roll")
def _roll(g: Graph, a: Nodes, shifts: Sequence[int], dims: Sequence[int] = ()) -> Nodes:
    return np.roll(a, tuple(shifts), tuple(dims)) if dims else np.roll(a, shifts[0])


@handles("constant_pad_nd")
def _pad(g: Graph, a: Nodes, pad: Sequence[int], value: float = 0.0) -> Nodes:
    widths = [(0, 0)] * (a.ndim - len(pad) // 2)
    widths += [(pad[i], pad[i + 1]) for i in range(len(pad) - 2, -1, -2)]
    return np.pad(a, widths, constant_values=g.constant(value))  # type: ignore[call-overload]


@handles("cat")
def _cat(g: Graph, tensors: Sequence[Nodes], dim: int = 0) -> Nodes:
    # torch ignores the historic empty 1-D tensor.
    return np.concatenate([t for t in tensors if t.shape != (0,)] or list(tensors), axis=dim)


@handles("stack")
def _stack(g: Graph, tensors: Sequence[Nodes], dim: int = 0) -> Nodes:
    return np.stack(tensors, axis=dim)


@handles("repeat")
def _repeat(g: Graph, a: Nodes, repeats: Sequence[int]) -> Nodes:
    return np.tile(a, tuple(repeats))


def _static(name: str, index: Nodes) -> np.ndarray:
    if any(node.op != "constant" for node in index.flat):
        raise UnsupportedOperation(name, "has an index that is known only at run time")
    boolean = index.size > 0 and isinstance(index.flat[0].value, bool)
    values = np.array([node.value for node in index.flat], dtype=bool if boolean else np.int64)
    return values.reshape(index.shape)


def _subscript(name: str, indices: Sequence[Nodes | None]) -> tuple[Any, ...]:
    return tuple(slice(None) if i is None else _static(name, i) for i in indices)


@handles("index", "_unsafe_index")
def _index(g: Graph, a: Nodes, indices: Sequence[Nodes | None]) -> Nodes:
    return as_nodes(g, a[_subscript("index", indices)])


@handles("index_put")
def _index_put(
    g: Graph, a: Nodes, indices: Sequence[Nodes | None], values: Nodes, accumulate: bool = False
) -> Nodes:
    if accumulate:
        raise UnsupportedOperation("index_put", "accumulates, which is not known here")
    out = a.copy()
    out[_subscript("index_put", indices)] = values
    return out


@handles("index_select")
def _index_select(g: Graph, a: Nodes, dim: int, index: Nodes) -> Nodes:
    return np.take(a, _static("index_select", index), axis=dim)


@handles("gather")
def _gather(g: Graph, a: Nodes, dim: int, index: Nodes, sparse_grad: bool = False) -> Nodes:
    return np.take_along_axis(a, _static("gather", index), axis=dim)
