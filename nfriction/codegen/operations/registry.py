"""The table of ATen operations on arrays of scalar nodes, and their common parts.

Every function takes the graph and then the operation's own arguments in their order, with tensors
replaced by object arrays of nodes, and returns such an array (views really are views).
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from torch import Tensor

from nfriction.codegen.scalar import Graph, Node, is_predicate

Nodes = np.ndarray
Operation = Callable[..., Any]

# By the ATen name without `aten::` and overload; in-place forms map to their base name.
OPERATIONS: dict[str, Operation] = {}


def supported_operations() -> list[str]:
    """Names of the ATen operations that can be compiled (others are decomposed where known)."""
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
    """`function` of corresponding elements, operands broadcast."""
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
    """`node` as a truth value: everything but zero is true."""
    return node if is_predicate(node) else g.apply("ne", node, g.constant(0.0))


def numbers(g: Graph, op: str, *operands: Any) -> Nodes:
    """The scalar operation `op` on corresponding elements, truth values taken as numbers."""
    return elementwise(g, lambda *xs: g.apply(op, *(number(g, x) for x in xs)), *operands)
