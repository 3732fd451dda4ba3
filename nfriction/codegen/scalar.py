"""A graph of scalar operations that simplifies itself while it is built.

Nodes are hash-consed: the same operation on the same arguments is the same node, so common
subexpressions never arise. Each node carries a `Level` that tells how long its value stays the
same during a rollout; an operation has the level of its most volatile argument.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import IntEnum
from typing import Any

import numpy as np

from nfriction.codegen.simplify import SIMPLIFY


class Level(IntEnum):
    """How long a value lives: the lower, the more seldom it has to be computed."""

    CONSTANT = 0
    PARAMETER = 1
    STEP = 2
    STAGE = 3


class Node:
    """One scalar value: a constant, an element of an input, or an operation on other nodes."""

    __slots__ = ("args", "level", "number", "op", "value")

    def __init__(
        self, op: str, args: tuple["Node", ...], value: Any, level: Level, number: int
    ) -> None:
        self.op = op
        self.args = args
        self.value = value  # of a constant: float or bool; of an input: (name, flat index)
        self.level = level
        self.number = number

    def __repr__(self) -> str:
        shown = self.value if not self.args else ", ".join(f"%{a.number}" for a in self.args)
        return f"%{self.number} = {self.op}({shown})"


EVALUATE: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    "abs": np.abs,
    "pow": np.power,
    "fmod": np.fmod,
    "atan2": np.arctan2,
    "max": np.maximum,  # both propagate NaN, as torch does
    "min": np.minimum,
    "sqrt": np.sqrt,
    "exp": np.exp,
    "expm1": np.expm1,
    "log": np.log,
    "log1p": np.log1p,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "floor": np.floor,
    "ceil": np.ceil,
    "trunc": np.trunc,
    "lt": np.less,
    "le": np.less_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "and": np.logical_and,
    "or": np.logical_or,
    "not": np.logical_not,
    "where": np.where,
    "finite": np.isfinite,  # made by `finite.py` alone, for C that tells it by the bits
}
"""Every scalar operation with its meaning; the emitters spell the same ones in C and Python."""

PREDICATES = frozenset({"lt", "le", "eq", "ne", "and", "or", "not", "finite"})
_COMMUTATIVE = frozenset({"add", "mul", "max", "min", "eq", "ne", "and", "or"})


class Graph:
    """Builds simplified scalar nodes."""

    def __init__(self) -> None:
        self._nodes: dict[tuple[Any, ...], Node] = {}

    def __len__(self) -> int:
        return len(self._nodes)

    def _intern(self, op: str, args: tuple[Node, ...], value: Any, level: Level) -> Node:
        # repr tells -0.0 from 0.0 and True from 1.0, and makes NaN equal to itself.
        key = (op, *(a.number for a in args)) if args else (op, repr(value))
        node = self._nodes.get(key)
        if node is None:
            node = self._nodes[key] = Node(op, args, value, level, len(self._nodes))
        return node

    def constant(self, value: float | bool) -> Node:
        """A literal; booleans stay booleans, every other number becomes a float."""
        value = bool(value) if isinstance(value, (bool, np.bool_)) else float(value)
        return self._intern("constant", (), value, Level.CONSTANT)

    def input(self, name: str, index: int, level: Level = Level.STAGE) -> Node:
        """Element `index` (flat) of the input called `name`."""
        return self._intern("input", (), (name, index), level)

    def apply(self, op: str, *args: Node) -> Node:
        """The simplified value of `op` on `args`."""
        if all(a.op == "constant" for a in args):
            with np.errstate(all="ignore"):
                folded = EVALUATE[op](*(np.asarray(a.value) for a in args))
            return self.constant(folded.item())
        rule = SIMPLIFY.get(op)
        simpler = rule(self, *args) if rule else None
        if simpler is not None:
            return simpler
        if op in _COMMUTATIVE and args[0].number > args[1].number:
            args = args[::-1]
        return self._intern(op, args, None, max(a.level for a in args))

    def total(self, terms: Sequence[Node], op: str = "add") -> Node:
        """`terms` folded by `op` as a balanced tree: less rounding, more parallelism."""
        if not terms:
            return self.constant(0.0)
        while len(terms) > 1:
            pairs = [self.apply(op, a, b) for a, b in zip(terms[::2], terms[1::2], strict=False)]
            terms = [*pairs, terms[-1]] if len(terms) % 2 else pairs
        return terms[0]

    def known(self, op: str, *args: Node) -> bool:
        """Whether this very operation is already in the graph."""
        return (op, *(a.number for a in args)) in self._nodes


def is_predicate(node: Node) -> bool:
    """Whether a node is a truth value rather than a number."""
    if node.op == "where":
        return is_predicate(node.args[1])
    return node.op in PREDICATES or isinstance(node.value, bool)


def reachable(outputs: Iterable[Node], stop: Iterable[Node] = ()) -> list[Node]:
    """Nodes that `outputs` need, arguments first; `stop` nodes are listed but not entered."""
    border = {node.number for node in stop}
    seen: dict[int, Node] = {}
    stack = list(outputs)
    while stack:
        node = stack.pop()
        if node.number in seen:
            continue
        seen[node.number] = node
        if node.number not in border:
            stack.extend(node.args)
    # Numbers rise with creation and arguments are created first: sorting is topological.
    return [seen[number] for number in sorted(seen)]


def evaluate(outputs: Sequence[Node], inputs: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Values of `outputs`, computed in NumPy.

    Args:
        outputs: the wanted nodes.
        inputs: by name, arrays whose last axis is the flat index; leading axes are a batch.

    Returns:
        One array of the batch shape per output.
    """
    values: dict[int, Any] = {}
    with np.errstate(all="ignore"):
        for node in reachable(outputs):
            if node.op == "constant":
                values[node.number] = node.value
            elif node.op == "input":
                name, index = node.value
                values[node.number] = inputs[name][..., index]
            else:
                values[node.number] = EVALUATE[node.op](*(values[a.number] for a in node.args))
    return [np.asarray(values[node.number]) for node in outputs]
