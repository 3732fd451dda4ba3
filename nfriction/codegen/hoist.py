"""Find what depends on parameters alone, which a rollout computes once and not in every step."""

from collections.abc import Sequence
from functools import partial, reduce

from nfriction.codegen.scalar import Graph, Node, UpdateRate, reachable

Groups = Sequence[Sequence[Node]]


def hoist(graph: Graph, groups: Groups) -> tuple[list[tuple[Node, ...]], list[Node]]:
    """Find what can be computed less often than the outputs themselves.

    Args:
        graph: extended where products are regrouped.
        groups: outputs, in groups that belong together.

    Returns:
        The groups to compute in every step, and the nodes that these read and parameters decide,
        arguments first.
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
    # Arguments come before their users, so that each is rewritten when it is asked for.
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
    """The product of what is computed once, as a tree, and of the others, in order."""
    once = [part for part in parts if part.rate < UpdateRate.STEP]
    others = [part for part in parts if part.rate == UpdateRate.STEP]
    products = [graph.total(once, "mul")] if once else []
    if others:
        products.append(reduce(partial(graph.apply, "mul"), others))
    return reduce(partial(graph.apply, "mul"), products)
