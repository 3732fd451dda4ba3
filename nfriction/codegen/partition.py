"""Split a scalar graph by how often each value has to be computed.

A rollout evaluates its stage function four times a step, thousands of steps, many candidates.
What depends on parameters alone is computed once a rollout, what depends on values held over the
step once a step; the stage keeps only what follows the state.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from nfriction.codegen.scalar import Graph, Level, Node, reachable


@dataclass(frozen=True)
class Partition:
    """Outputs of a program and the values to compute before.

    Attributes:
        outputs: nodes to compute last.
        hoisted: by level, the nodes that something more volatile reads, in topological order.
    """

    outputs: tuple[Node, ...]
    hoisted: dict[Level, tuple[Node, ...]]


def partition(graph: Graph, outputs: Sequence[Node]) -> Partition:
    """Find what can be computed less often than the outputs themselves."""
    outputs = _regrouped(graph, outputs)
    read: dict[int, Node] = {}
    for node in reachable(outputs):
        for argument in node.args:
            if argument.level < node.level:
                read[argument.number] = argument
    for node in outputs:
        if node.level < Level.STAGE:
            read[node.number] = node
    hoisted = {
        level: tuple(n for _, n in sorted(read.items()) if n.level == level and n.args)
        for level in (Level.PARAMETER, Level.STEP)
    }
    return Partition(tuple(outputs), hoisted)


def _regrouped(graph: Graph, outputs: Sequence[Node]) -> list[Node]:
    """Rewrite products so that their less volatile factors meet first and can be hoisted.

    `(a * x) * b` becomes `(a * b) * x` where a and b live longer than x, and dividing by a
    longer-lived value becomes multiplying by its reciprocal. Each moves a result by an ulp or
    two; sums are left alone, because regrouping them can cancel.
    """
    nodes = reachable(outputs)
    uses: dict[int, int] = {}
    for node in nodes:
        for argument in node.args:
            uses[argument.number] = uses.get(argument.number, 0) + 1
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
    for node in nodes:
        args = [done[a.number] for a in node.args]
        if node.op == "mul":
            parts = [f for a in node.args for f in factors.get(a.number, [done[a.number]])]
        elif node.op == "div" and node.args[1].level < node.args[0].level:
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


def _product(graph: Graph, parts: list[Node]) -> Node:
    product: Node | None = None
    for level in Level:
        same = [part for part in parts if part.level == level]
        if same:
            group = graph.total(same, "mul") if level < Level.STAGE else _chain(graph, same)
            product = group if product is None else graph.apply("mul", product, group)
    assert product is not None
    return product


def _chain(graph: Graph, parts: list[Node]) -> Node:
    product = parts[0]
    for part in parts[1:]:
        product = graph.apply("mul", product, part)
    return product
