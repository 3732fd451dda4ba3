"""One function for all joints: walk the scalars of every joint in step and keep what differs.

Where the joints of a model do the same with other numbers, the code is needed once and the numbers
go into a table with a row a joint.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from nfriction.codegen.scalar import Graph, Node, UpdateRate

TABLE = "p"
"""Name of the input that stands for a row of the table."""


@dataclass(frozen=True)
class Template:
    """What one joint computes.

    Attributes:
        graph: where the nodes live; inputs called `TABLE` are columns of `table`.
        outputs: for each output array, the nodes of one joint.
        inputs: numbers that a joint takes from each input array.
        table: known numbers, shape (joint, column).
    """

    graph: Graph
    outputs: tuple[tuple[Node, ...], ...]
    inputs: dict[str, int]
    table: np.ndarray

    @property
    def joints(self) -> int:
        return len(self.table)


class _Unlike(Exception):  # noqa: N818
    """Joints do different things, or look at one another."""


def template(
    outputs: Sequence[Sequence[Node]],
    inputs: Mapping[str, int],
    known: Mapping[int, float],
    joints: int,
) -> Template:
    """One joint's work, or all of it as a single row where the joints are not alike.

    Args:
        outputs: for each output array its nodes, joint by joint.
        inputs: numbers in each input array, joint by joint.
        known: value of each node that is no input of the code to emit, by node number.
        joints: how many joints.
    """
    try:
        return _template(outputs, inputs, known, joints)
    except _Unlike:
        return _template(outputs, inputs, known, 1)


def _template(
    outputs: Sequence[Sequence[Node]],
    inputs: Mapping[str, int],
    known: Mapping[int, float],
    joints: int,
) -> Template:
    if any(size % joints for size in (*map(len, outputs), *inputs.values())):
        raise _Unlike
    own = {name: size // joints for name, size in inputs.items()}
    merge = _Merge(own, known)
    counts = [len(nodes) // joints for nodes in outputs]
    rows = [
        tuple(nodes[j * count + i] for j in range(joints))
        for nodes, count in zip(outputs, counts, strict=True)
        for i in range(count)
    ]
    merged = iter(merge(rows))
    groups = tuple(tuple(islice(merged, count)) for count in counts)
    table = np.array(merge.columns, dtype=np.float64).reshape(-1, joints).T
    return Template(merge.graph, groups, own, table)


class _Merge:
    """Rebuilds corresponding nodes of all joints as one node of a graph of its own."""

    def __init__(self, inputs: Mapping[str, int], known: Mapping[int, float]) -> None:
        self.graph = Graph()
        self.columns: list[tuple[float, ...]] = []
        self._inputs = inputs
        self._known = known
        self._done: dict[tuple[int, ...], Node] = {}

    def __call__(self, outputs: Sequence[tuple[Node, ...]]) -> list[Node]:
        found: dict[tuple[int, ...], tuple[Node, ...]] = {}
        stack = list(outputs)
        while stack:
            top = stack.pop()
            if _key(top) not in found:
                found[_key(top)] = top
                stack.extend(self._arguments(top))
        # In the order of the trace, which has what belongs to one tensor side by side.
        for key in sorted(found):
            self._done[key] = self._merged(found[key])
        return [self._done[_key(nodes)] for nodes in outputs]

    def _leaf(self, node: Node) -> bool:
        return node.op == "constant" or node.number in self._known

    def _arguments(self, nodes: tuple[Node, ...]) -> list[tuple[Node, ...]]:
        if all(self._leaf(node) for node in nodes):
            return []
        first = nodes[0]
        if any(n.op != first.op or len(n.args) != len(first.args) for n in nodes):
            raise _Unlike
        return list(zip(*(node.args for node in nodes), strict=True))

    def _merged(self, nodes: tuple[Node, ...]) -> Node:
        first = nodes[0]
        if all(self._leaf(node) for node in nodes):
            return self._number(nodes)
        if first.op == "input":
            return self._input(nodes)
        return self.graph.apply(first.op, *(self._done[_key(a)] for a in self._arguments(nodes)))

    def _number(self, nodes: tuple[Node, ...]) -> Node:
        first = nodes[0]
        if all(node.op == "constant" and repr(node.value) == repr(first.value) for node in nodes):
            return self.graph.constant(first.value)
        values = [n.value if n.op == "constant" else self._known[n.number] for n in nodes]
        if any(isinstance(value, bool) for value in values):
            raise _Unlike
        self.columns.append(tuple(float(value) for value in values))
        return self.graph.input(TABLE, len(self.columns) - 1, UpdateRate.PARAMETER)

    def _input(self, nodes: tuple[Node, ...]) -> Node:
        places = set()
        for joint, node in enumerate(nodes):
            name, index = node.value
            places.add((name, index - joint * self._inputs[name]))
        name, index = places.pop()
        if places or not 0 <= index < self._inputs[name]:
            raise _Unlike
        return self.graph.input(name, index)


def _key(nodes: tuple[Node, ...]) -> tuple[int, ...]:
    return tuple(node.number for node in nodes)
