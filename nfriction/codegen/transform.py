"""Rewrite traced programs: exact derivatives, and hoisting of step-invariant computations.

Derivatives use forward mode on the scalar graph. Values that depend only on parameters are hoisted
out of the steps.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial, reduce

from nfriction.codegen.graph import Port, Program
from nfriction.codegen.scalar import (
    Graph,
    Node,
    UnsupportedOperation,
    UpdateRate,
    is_predicate,
    reachable,
)

Tangents = Mapping[int, Node]
Rule = Callable[..., Node]


def with_jacobian(program: Program, wrt: Sequence[str]) -> Program:
    """The program with its Jacobian by the named inputs, (outputs, inputs), as last output."""
    graph = program.graph
    outputs = [node for port in program.outputs for node in port.nodes]
    one, zero = graph.constant(1.0), graph.constant(0.0)
    named = {port.name: port for port in program.inputs}
    needed = reachable(outputs)
    columns = [
        tangents(graph, needed, {node.number: one}) for name in wrt for node in named[name].nodes
    ]
    entries = tuple(column.get(node.number, zero) for node in outputs for column in columns)
    jacobian = Port("jacobian", (len(outputs), len(columns)), entries)
    return Program(graph, program.inputs, (*program.outputs, jacobian))


def tangents(graph: Graph, nodes: Iterable[Node], seed: Tangents) -> dict[int, Node]:
    """Derivatives by node number along the direction of a seed; omitted where they are zero.

    `nodes` include everything that they need, arguments first.
    """
    found = dict(seed)
    for node in nodes:
        # Comparisons are step functions: their derivative is zero wherever it exists.
        if not any(a.number in found for a in node.args) or is_predicate(node):
            continue
        moving = [found.get(a.number) for a in node.args]
        rule = _RULES.get(node.op)
        if rule is None:
            raise UnsupportedOperation(node.op, "has no derivative here")
        found[node.number] = rule(graph, node, *moving)
    return found


def _add(g: Graph, node: Node, da: Node | None, db: Node | None) -> Node:
    return g.total([d for d in (da, db) if d is not None])


def _sub(g: Graph, node: Node, da: Node | None, db: Node | None) -> Node:
    if db is None:
        return _one(da)
    return g.apply("neg", db) if da is None else g.apply("sub", da, db)


def _mul(g: Graph, node: Node, da: Node | None, db: Node | None) -> Node:
    a, b = node.args
    terms = [g.apply("mul", d, x) for d, x in ((da, b), (db, a)) if d is not None]
    return g.total(terms)


def _div(g: Graph, node: Node, da: Node | None, db: Node | None) -> Node:
    b = node.args[1]
    if db is None:
        return g.apply("div", _one(da), b)
    # Uses the quotient itself, which is known: (da - (a / b) db) / b.
    fall = g.apply("mul", node, db)
    over = g.apply("neg", fall) if da is None else g.apply("sub", da, fall)
    return g.apply("div", over, b)


def _pow(g: Graph, node: Node, da: Node | None, db: Node | None) -> Node:
    a, b = node.args
    terms = []
    if da is not None:
        lower = g.apply("mul", b, g.apply("pow", a, g.apply("sub", b, g.constant(1.0))))
        zero = g.constant(0.0)
        terms.append(g.apply("mul", da, g.apply("where", g.apply("eq", b, zero), zero, lower)))
    if db is not None:
        zero, rise = g.constant(0.0), g.apply("mul", node, g.apply("log", a))
        # At 0 the power stays 0, while the logarithm is infinite.
        terms.append(g.apply("mul", db, g.apply("where", g.apply("eq", a, zero), zero, rise)))
    return g.total(terms)


def _where(g: Graph, node: Node, _: Node | None, da: Node | None, db: Node | None) -> Node:
    # Only the branch taken matters; NaN from the other one is not propagated.
    zero = g.constant(0.0)
    return g.apply("where", node.args[0], da or zero, db or zero)


def _select(op: str) -> Rule:
    """The rule for a maximum or minimum: the derivative of the selected operand."""

    def rule(g: Graph, node: Node, da: Node | None, db: Node | None) -> Node:
        zero = g.constant(0.0)
        a, b = node.args
        first = g.apply("lt", b, a) if op == "max" else g.apply("lt", a, b)
        return g.apply("where", first, da or zero, db or zero)

    return rule


def _chain(slope: Callable[[Graph, Node, Node], Node]) -> Rule:
    """The rule for a function of one argument; `slope` gets the graph, argument and value."""

    def rule(g: Graph, node: Node, da: Node | None) -> Node:
        return g.apply("mul", slope(g, node.args[0], node), _one(da))

    return rule


def _one(*candidates: Node | None) -> Node:
    return next(c for c in candidates if c is not None)


_RULES: dict[str, Rule] = {
    "add": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "pow": _pow,
    "where": _where,
    "max": _select("max"),
    "min": _select("min"),
    "neg": lambda g, node, da: g.apply("neg", da),
    "abs": _chain(
        lambda g, a, _: g.apply(
            "where", g.apply("lt", a, g.constant(0.0)), g.constant(-1.0), g.constant(1.0)
        )
    ),
    "sqrt": _chain(lambda g, a, value: g.apply("div", g.constant(0.5), value)),
    "exp": _chain(lambda g, a, value: value),
    "log": _chain(lambda g, a, value: g.apply("div", g.constant(1.0), a)),
    "sin": _chain(lambda g, a, value: g.apply("cos", a)),
    "cos": _chain(lambda g, a, value: g.apply("neg", g.apply("sin", a))),
    "tanh": _chain(
        lambda g, a, value: g.apply("sub", g.constant(1.0), g.apply("mul", value, value))
    ),
    "atan": _chain(
        lambda g, a, value: g.apply(
            "div", g.constant(1.0), g.apply("add", g.constant(1.0), g.apply("mul", a, a))
        )
    ),
}


Groups = Sequence[Sequence[Node]]


def hoist(graph: Graph, groups: Groups) -> tuple[list[tuple[Node, ...]], list[Node]]:
    """The groups to compute in every step, and their nodes that depend only on parameters.

    Each of these nodes is listed once, arguments first. Regrouping products extends the graph.
    """
    outputs = _regrouped(graph, [node for group in groups for node in group])
    read = {
        argument
        for node in reachable(outputs)
        if node.rate == UpdateRate.STEP
        for argument in node.args
    }
    once = {n for n in read.union(outputs) if n.rate == UpdateRate.PARAMETER and n.args}
    nodes = iter(outputs)
    apart = [tuple(next(nodes) for _ in group) for group in groups]
    return apart, sorted(once, key=lambda node: node.number)


def _regrouped(graph: Graph, outputs: Sequence[Node]) -> list[Node]:
    """Rewrite products so that their less volatile factors meet first and can be hoisted.

    `(a * x) * b` becomes `(a * b) * x` if a and b change less often than x, and division by such a
    value becomes multiplication by its reciprocal. Each changes a result by one or two units in the
    last place; sums are left alone, because regrouping them can cause cancellation.
    """
    nodes = reachable(outputs)
    uses = Counter(argument.number for node in nodes for argument in node.args)
    inner = {
        argument.number
        for node in nodes
        if node.op in ("mul", "div")
        for argument in (node.args if node.op == "mul" else node.args[:1])
        if argument.op in ("mul", "div") and uses[argument.number] == 1
    }
    done: dict[int, Node] = {}
    factors: dict[int, list[Node]] = {}
    one = graph.constant(1.0)
    # Arguments precede their users, so each is already rewritten when it is needed.
    for node in nodes:
        args = [done[a.number] for a in node.args]
        if node.op == "mul":
            parts = [f for a in node.args for f in factors.get(a.number, [done[a.number]])]
        elif node.op == "div" and node.args[1].rate < node.args[0].rate:
            numerator = node.args[0]
            parts = list(factors.get(numerator.number, [done[numerator.number]]))
            parts.append(graph.apply("div", one, args[1]))
        else:
            done[node.number] = graph.apply(node.op, *args) if args else node
            continue
        done[node.number] = _product(graph, parts)
        if node.number in inner:
            factors[node.number] = parts
    return [done[node.number] for node in outputs]


def _product(graph: Graph, parts: Sequence[Node]) -> Node:
    """The product of the factors computed once, as a tree, and of the others, in order."""
    once = [part for part in parts if part.rate < UpdateRate.STEP]
    others = [part for part in parts if part.rate == UpdateRate.STEP]
    products = [graph.total(once, "mul")] if once else []
    if others:
        products.append(reduce(partial(graph.apply, "mul"), others))
    return reduce(partial(graph.apply, "mul"), products)
