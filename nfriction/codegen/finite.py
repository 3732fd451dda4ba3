"""Tests for NaN and infinity that no compiler option can remove.

Under `-ffast-math` a compiler takes every number to be finite and every such comparison to be
true. Emitted C tells by the bits instead. A module says `|a| + |b| < inf`, one comparison that NaN
fails too; here it becomes the test of a, b and whatever else flows into the sum.
"""

import math
from collections.abc import Callable, Mapping, Sequence

from nfriction.codegen.scalar import Graph, Node, UpdateRate, reachable

# NaN in, NaN out, whatever the other operand.
_CARRIES_NAN = frozenset({"add", "sub", "neg", "abs"})


def rebuilt(
    graph: Graph, outputs: Sequence[Node], rule: Callable[[Node, tuple[Node, ...]], Node | None]
) -> list[Node]:
    """`outputs` with nodes replaced: `rule` gets a node and its rebuilt arguments."""
    done: dict[int, Node] = {}
    for node in reachable(outputs):
        args = tuple(done[a.number] for a in node.args)
        replaced = rule(node, args)
        if replaced is None:
            replaced = graph.apply(node.op, *args) if args else node
        done[node.number] = replaced
    return [done[node.number] for node in outputs]


def by_bits(graph: Graph, outputs: Sequence[Node]) -> list[Node]:
    """`outputs` with comparisons of sizes against infinity turned into `finite` nodes."""

    def rule(node: Node, args: tuple[Node, ...]) -> Node | None:
        if node.op != "lt" or not _infinite(args[1]) or not _is_size(args[0]):
            return None
        leaves = _leaves(args[0])
        given = [leaf for leaf in leaves if _is_input(leaf)]
        tested = [_finite(graph, leaf) for leaf in given]
        # A sum of finite inputs overflows only where they are beyond all physics.
        if len(given) < len(leaves) or not _is_sum_of_sizes(args[0]):
            tested.append(_finite(graph, args[0].args[0] if args[0].op == "abs" else args[0]))
        return graph.total(tested, "and")

    return rebuilt(graph, outputs, rule)


def border(outputs: Sequence[Node]) -> Node | None:
    """The test of the most inputs: where it fails, little is left to compute."""
    tests = [node for node in reachable(outputs) if _inputs_tested(node)]
    return max(tests, key=_inputs_tested) if tests else None


def decided(graph: Graph, outputs: Sequence[Node], test: Node, value: bool) -> list[Node]:
    """`outputs` where a test, or with True all of its parts, is known to come out as `value`."""
    known: Mapping[int, Node] = {
        node.number: graph.constant(value)
        for node in ([*reachable([test])] if value else [test])
        if node.op in ("finite", "and")
    }
    return rebuilt(graph, outputs, lambda node, args: known.get(node.number))


def _finite(graph: Graph, node: Node) -> Node:
    return graph._intern("finite", (node,), None, max(node.rate, UpdateRate.PARAMETER))


def _infinite(node: Node) -> bool:
    return node.op == "constant" and node.value == math.inf


def _is_size(node: Node) -> bool:
    if node.op == "add":
        return all(_is_size(a) for a in node.args)
    return node.op == "abs"


def _is_sum_of_sizes(node: Node) -> bool:
    if node.op == "add":
        return all(_is_sum_of_sizes(a) for a in node.args)
    return node.op == "abs" and _is_input(node.args[0])


def _is_input(node: Node) -> bool:
    return node.op == "input" and node.rate > UpdateRate.PARAMETER


def _leaves(node: Node) -> list[Node]:
    """What flows into a sum, each once, in the order met."""
    found: dict[int, Node] = {}
    stack = [node]
    while stack:
        top = stack.pop()
        if top.op in _CARRIES_NAN:
            stack.extend(reversed(top.args))
        elif top.rate > UpdateRate.PARAMETER:
            found.setdefault(top.number, top)
    return list(found.values())


def _inputs_tested(node: Node) -> int:
    """How many inputs a chain of tests asks for; 0 for anything else."""
    if node.op == "finite":
        return int(_is_input(node.args[0]))
    if node.op == "and":
        parts = [_inputs_tested(a) for a in node.args]
        return sum(parts) if all(parts) else 0
    return 0
