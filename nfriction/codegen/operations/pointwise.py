"""Pointwise operations."""

from typing import Any

from nfriction.codegen.errors import UnsupportedOperation
from nfriction.codegen.operations.registry import (
    OPERATIONS,
    Nodes,
    Operation,
    as_nodes,
    elementwise,
    handles,
    number,
    numbers,
    predicate,
)
from nfriction.codegen.scalar import Graph, Node, is_predicate


def _register_pointwise(aten: str, op: str) -> None:
    OPERATIONS[aten] = lambda g, *xs: numbers(g, op, *xs)


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
    _register_pointwise(_aten, _op)


@handles("add")
def add(g: Graph, a: Any, b: Any, alpha: float = 1) -> Nodes:
    return numbers(g, "add", a, numbers(g, "mul", b, alpha))


@handles("sub")
def sub(g: Graph, a: Any, b: Any, alpha: float = 1) -> Nodes:
    return numbers(g, "sub", a, numbers(g, "mul", b, alpha))


@handles("rsub")
def _rsub(g: Graph, a: Any, b: Any, alpha: float = 1) -> Nodes:
    return sub(g, b, a, alpha)


@handles("div")
def div(g: Graph, a: Any, b: Any, rounding_mode: str | None = None) -> Nodes:
    quotient = numbers(g, "div", a, b)
    return quotient if rounding_mode is None else numbers(g, rounding_mode, quotient)


@handles("reciprocal")
def reciprocal(g: Graph, a: Nodes) -> Nodes:
    return div(g, 1.0, a)


@handles("rsqrt")
def _rsqrt(g: Graph, a: Nodes) -> Nodes:
    return div(g, 1.0, numbers(g, "sqrt", a))


@handles("sigmoid")
def _sigmoid(g: Graph, a: Nodes) -> Nodes:
    return div(g, 1.0, add(g, 1.0, numbers(g, "exp", numbers(g, "neg", a))))


@handles("softplus")
def _softplus(g: Graph, a: Nodes, beta: float = 1, threshold: float = 20) -> Nodes:
    scaled = numbers(g, "mul", a, beta)
    soft = div(g, numbers(g, "log1p", numbers(g, "exp", scaled)), beta)
    return where(g, _gt(g, scaled, threshold), a, soft)


@handles("hypot")
def _hypot(g: Graph, a: Nodes, b: Nodes) -> Nodes:
    return numbers(g, "sqrt", add(g, numbers(g, "mul", a, a), numbers(g, "mul", b, b)))


@handles("sign", "sgn")
def _sign(g: Graph, a: Nodes) -> Nodes:
    return where(g, _gt(g, a, 0.0), 1.0, where(g, numbers(g, "lt", a, 0.0), -1.0, 0.0))


@handles("silu")
def _silu(g: Graph, a: Nodes) -> Nodes:
    return numbers(g, "mul", a, _sigmoid(g, a))


@handles("addcmul")
def _addcmul(g: Graph, a: Nodes, b: Nodes, c: Nodes, value: float = 1) -> Nodes:
    return add(g, a, numbers(g, "mul", b, c), value)


@handles("addcdiv")
def _addcdiv(g: Graph, a: Nodes, b: Nodes, c: Nodes, value: float = 1) -> Nodes:
    return add(g, a, numbers(g, "div", b, c), value)


@handles("lerp")
def _lerp(g: Graph, a: Nodes, b: Nodes, weight: Any) -> Nodes:
    return add(g, a, numbers(g, "mul", weight, sub(g, b, a)))


@handles("relu")
def _relu(g: Graph, a: Nodes) -> Nodes:
    return numbers(g, "max", a, 0.0)


@handles("remainder")
def _remainder(g: Graph, a: Any, b: Any) -> Nodes:
    def remainder(x: Node, y: Node) -> Node:
        zero = g.constant(0.0)
        rest = g.apply("fmod", x, y)
        opposed = g.apply("ne", g.apply("lt", rest, zero), g.apply("lt", y, zero))
        wrong = g.apply("and", g.apply("ne", rest, zero), opposed)
        return g.apply("where", wrong, g.apply("add", rest, y), rest)

    return elementwise(g, remainder, a, b)


@handles("clamp")
def _clamp(g: Graph, a: Nodes, min: Any = None, max: Any = None) -> Nodes:
    raised = a if min is None else numbers(g, "max", a, min)
    return raised if max is None else numbers(g, "min", raised, max)


@handles("clamp_min")
def _clamp_min(g: Graph, a: Nodes, min: Any) -> Nodes:
    return _clamp(g, a, min=min)


@handles("clamp_max")
def _clamp_max(g: Graph, a: Nodes, max: Any) -> Nodes:
    return _clamp(g, a, max=max)


@handles("gt")
def _gt(g: Graph, a: Any, b: Any) -> Nodes:
    return numbers(g, "lt", b, a)


@handles("ge")
def _ge(g: Graph, a: Any, b: Any) -> Nodes:
    return numbers(g, "le", b, a)


@handles("isnan")
def _isnan(g: Graph, a: Nodes) -> Nodes:
    return numbers(g, "ne", a, a)


@handles("where")
def where(g: Graph, condition: Nodes, a: Any = None, b: Any = None) -> Nodes:
    if a is None or b is None:
        raise UnsupportedOperation("where(condition)", "has a shape known only at run time")

    def choose(c: Node, x: Node, y: Node) -> Node:
        if is_predicate(x) != is_predicate(y):
            x, y = number(g, x), number(g, y)
        return g.apply("where", c, x, y)

    return elementwise(g, choose, condition, a, b)


@handles("masked_fill")
def _masked_fill(g: Graph, a: Nodes, mask: Nodes, value: Any) -> Nodes:
    return where(g, mask, value, a)


def _logical(op: str) -> Operation:
    def apply(g: Graph, *operands: Any) -> Nodes:
        return elementwise(g, lambda *xs: g.apply(op, *(predicate(g, x) for x in xs)), *operands)

    return apply


OPERATIONS["logical_and"] = _logical("and")
OPERATIONS["logical_or"] = _logical("or")
OPERATIONS["logical_xor"] = _logical("ne")
OPERATIONS["logical_not"] = _logical("not")


def _bitwise(name: str, op: str) -> None:
    def apply(g: Graph, *operands: Any) -> Nodes:
        if not all(is_predicate(x) for a in operands for x in as_nodes(g, a).flat):
            raise UnsupportedOperation(name, "is known for booleans only")
        return _logical(op)(g, *operands)

    OPERATIONS[name] = apply


for _aten, _op in {"and": "and", "or": "or", "xor": "ne", "not": "not"}.items():
    _bitwise(f"bitwise_{_aten}", _op)
