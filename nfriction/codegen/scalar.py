"""A graph of scalar operations that simplifies itself while it is built.

Nodes are hash-consed: the same operation on the same arguments is the same node, so common
subexpressions never arise. Each node has an `UpdateRate`: that of its most volatile argument.
"""

import math
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from enum import IntEnum
from typing import Any

import numpy as np


class CodegenError(RuntimeError):
    """Base of all errors that the code generator raises on purpose."""


class UnsupportedOperation(CodegenError):  # noqa: N818
    """A traced module uses an operation that has no scalar form here.

    The torch rollout runs every module; only the compiled one has this limitation.
    """

    def __init__(self, operation: str, reason: str = "has no scalar form here") -> None:
        super().__init__(
            f"operation `{operation}` {reason}; rewrite it with the operations listed in "
            "`nfriction.codegen.supported_operations()`; otherwise fits are slow, and "
            'simulations need `rollout(..., backend="torch")`.'
        )


class SelfCheckFailed(CodegenError):  # noqa: N818
    """A compiled model disagrees with eager torch and must not be used."""


class Incomparable(CodegenError):  # noqa: N818
    """Something that a trace may read cannot be compared with its previous value."""


class UpdateRate(IntEnum):
    """Frequency at which a value has to be computed; lower values mean less often."""

    CONSTANT = 0
    PARAMETER = 1
    STEP = 2


class Node:
    """One scalar value: a constant, an element of an input, or an operation on other nodes."""

    __slots__ = ("args", "number", "op", "rate", "value")

    def __init__(
        self, op: str, args: tuple["Node", ...], value: Any, rate: UpdateRate, number: int
    ) -> None:
        self.op = op
        self.args = args
        self.value = value  # of a constant: float or bool; of an input: (name, flat index)
        self.rate = rate
        self.number = number

    def __repr__(self) -> str:
        shown = self.value if not self.args else ", ".join(f"%{a.number}" for a in self.args)
        return f"%{self.number} = {self.op}({shown})"


# Every scalar operation with its meaning; the emitters support the same set.
EVALUATE: dict[str, Callable[..., Any]] = {
    **{
        name: getattr(np, name)
        for name in (
            *("abs", "sqrt", "exp", "expm1", "log", "log1p", "floor", "ceil", "trunc", "fmod"),
            *("sin", "cos", "tan", "sinh", "cosh", "tanh", "where", "add"),
        )
    },
    **{
        name: getattr(np, ufunc)
        for name, ufunc in {
            "sub": "subtract", "mul": "multiply", "div": "divide", "neg": "negative",
            "pow": "power", "asin": "arcsin", "acos": "arccos", "atan": "arctan",
            "atan2": "arctan2", "lt": "less", "le": "less_equal", "eq": "equal",
            "ne": "not_equal", "and": "logical_and", "or": "logical_or", "not": "logical_not",
            # Both propagate NaN, as torch does.
            "max": "maximum", "min": "minimum",
        }.items()
    },
}  # fmt: skip

PREDICATES = frozenset({"lt", "le", "eq", "ne", "and", "or", "not"})
_COMMUTATIVE = frozenset({"add", "mul", "max", "min", "eq", "ne", "and", "or"})


class Graph:
    """Builds simplified scalar nodes."""

    def __init__(self) -> None:
        self._nodes: dict[tuple[Any, ...], Node] = {}

    def __len__(self) -> int:
        return len(self._nodes)

    def _intern(self, op: str, args: tuple[Node, ...], value: Any, rate: UpdateRate) -> Node:
        # With repr, -0.0 and 0.0 differ, True and 1.0 differ, and NaN equals itself.
        key = (op, *(a.number for a in args)) if args else (op, repr(value))
        node = self._nodes.get(key)
        if node is None:
            node = self._nodes[key] = Node(op, args, value, rate, len(self._nodes))
        return node

    def constant(self, value: float | bool) -> Node:
        """A literal; booleans remain booleans, all other numbers become floats."""
        value = bool(value) if isinstance(value, (bool, np.bool_)) else float(value)
        return self._intern("constant", (), value, UpdateRate.CONSTANT)

    def input(self, name: str, index: int, rate: UpdateRate = UpdateRate.STEP) -> Node:
        """Element `index` (flat) of the input called `name`."""
        return self._intern("input", (), (name, index), rate)

    def apply(self, op: str, *args: Node) -> Node:
        """The simplified value of `op` on `args`."""
        rate = max([a.rate for a in args])
        if rate == UpdateRate.CONSTANT:
            with np.errstate(all="ignore"):
                folded = EVALUATE[op](*(np.asarray(a.value) for a in args))
            return self.constant(folded.item())
        rule = _RULES.get(op)
        simpler = rule(self, *args) if rule else None
        if simpler is not None:
            return simpler
        # In canonical order, so that a + b and b + a are one node.
        if op in _COMMUTATIVE and args[0].number > args[1].number:
            args = args[::-1]
        return self._intern(op, args, None, rate)

    def total(self, terms: Sequence[Node], op: str = "add") -> Node:
        """`terms` reduced by `op` as a balanced tree: less round-off, more parallelism."""
        if not terms:
            return self.constant(0.0)
        while len(terms) > 1:
            pairs = [self.apply(op, a, b) for a, b in zip(terms[::2], terms[1::2], strict=False)]
            terms = [*pairs, terms[-1]] if len(terms) % 2 else pairs
        return terms[0]

    def known(self, op: str, *args: Node) -> bool:
        """Return true if exactly this operation is already in the graph."""
        return (op, *(a.number for a in args)) in self._nodes


def is_predicate(node: Node) -> bool:
    """Return true for a truth value, false for a number."""
    if node.op == "where":
        return is_predicate(node.args[1])
    return node.op in PREDICATES or isinstance(node.value, bool)


def reachable(outputs: Iterable[Node], stop: Container[int] = ()) -> list[Node]:
    """Nodes that `outputs` need, arguments first; those numbered in `stop` are not entered."""
    seen: dict[int, Node] = {}
    stack = list(outputs)
    while stack:
        node = stack.pop()
        if node.number in seen:
            continue
        seen[node.number] = node
        if node.number not in stop:
            stack.extend(node.args)
    # Node numbers increase and arguments are created first, so sorting is topological.
    return [seen[number] for number in sorted(seen)]


def evaluate(outputs: Sequence[Node], inputs: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Values of `outputs` computed with NumPy, each with the shape of the batch.

    The last axis of an input is the flat index; leading axes are a batch.
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


# Rules that simplify an operation without changing its value. Signs are moved outward (which is
# exact, as rounding is symmetric), so that a - b and b - a share a node. A product with a literal
# zero is zero even though 0 * NaN is NaN: a zero written in the model means "no such coupling", and
# callers test the state itself for NaN.
Rule = Callable[..., Node | None]


def _is(node: Node, value: float) -> bool:
    return node.op == "constant" and node.value == value


def _add(g: Graph, a: Node, b: Node) -> Node | None:
    if _is(a, 0.0):
        return b
    if _is(b, 0.0):
        return a
    if a.op == b.op == "neg":
        return g.apply("neg", g.apply("add", a.args[0], b.args[0]))
    if b.op == "neg":
        return g.apply("sub", a, b.args[0])
    if a.op == "neg":
        return g.apply("sub", b, a.args[0])
    return None


def _sub(g: Graph, a: Node, b: Node) -> Node | None:
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


def _mul(g: Graph, a: Node, b: Node) -> Node | None:
    for x, y in ((a, b), (b, a)):
        if _is(x, 1.0):
            return y
        if _is(x, -1.0):
            return g.apply("neg", y)
        if _is(x, 0.0):
            return g.constant(0.0)
    return _unsigned(g, "mul", a, b)


def _div(g: Graph, a: Node, b: Node) -> Node | None:
    if _is(b, 1.0):
        return a
    if b.op == "constant" and b.value != 0.0 and abs(math.frexp(b.value)[0]) == 0.5:
        return g.apply("mul", a, g.constant(1.0 / b.value))  # a power of two: exact
    return _unsigned(g, "div", a, b)


def _unsigned(g: Graph, op: str, a: Node, b: Node) -> Node | None:
    """A product or quotient with the signs of its operands moved in front."""
    signs = (a.op == "neg") + (b.op == "neg")
    if not signs:
        return None
    bare = g.apply(op, *(x.args[0] if x.op == "neg" else x for x in (a, b)))
    return bare if signs == 2 else g.apply("neg", bare)


def _pow(g: Graph, a: Node, b: Node) -> Node | None:
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


def _where(g: Graph, condition: Node, a: Node, b: Node) -> Node | None:
    if a is b:
        return a
    if condition.op == "constant":
        return a if condition.value else b
    if condition.op == "not":
        return g.apply("where", condition.args[0], b, a)
    return None


def _logical(deciding: bool) -> Rule:
    """The rule for a conjunction or disjunction, which one `deciding` operand determines."""

    def rule(g: Graph, a: Node, b: Node) -> Node | None:
        for x, y in ((a, b), (b, a)):
            if x.op == "constant":
                return g.constant(deciding) if bool(x.value) == deciding else y
        return _same(g, a, b)

    return rule


def _same(g: Graph, a: Node, b: Node) -> Node | None:
    return a if a is b else None


def _mirrored(op: str, odd: bool) -> Rule:
    """The rule for an odd or even function."""

    def rule(g: Graph, a: Node) -> Node | None:
        if a.op != "neg":
            return None
        value = g.apply(op, a.args[0])
        return g.apply("neg", value) if odd else value

    return rule


_RULES: dict[str, Rule] = {
    "add": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "neg": lambda g, a: a.args[0] if a.op == "neg" else None,
    "pow": _pow,
    "where": _where,
    "and": _logical(False),
    "or": _logical(True),
    "max": _same,
    "min": _same,
    **{op: _mirrored(op, odd=True) for op in ("sin", "tan", "tanh", "atan", "asin", "sinh")},
    **{op: _mirrored(op, odd=False) for op in ("cos", "cosh", "abs")},
}
