"""Packs: like operations on many numbers, to be computed in a loop."""

from dataclasses import dataclass, field
from typing import Literal

from nfriction.codegen.scalar import Node

Kind = Literal["node", "table", "constants", "input", "pack", "gather"]


@dataclass(frozen=True, eq=False)
class Operand:
    """Numbers that a loop reads: element `index[i]` of `source` in round i.

    Attributes:
        kind: what `source` is: one node, the table, constants, an input array, a pack, or nodes
            to be gathered in an array.
    """

    kind: Kind
    source: "Node | str | Pack | tuple[Node, ...] | tuple[float, ...]"
    index: tuple[int, ...]

    @property
    def straight(self) -> bool:
        return self.index == tuple(range(len(self.index)))


@dataclass(eq=False)
class Pack:
    """Like operations on several numbers, to be computed in a loop.

    Attributes:
        nodes: what it computes, in order.
        op: of each node; "add", "max" or "min" where it reduces many terms.
        operands: of the operation, each with one index for every node.
        terms: for a reduction, by group of like terms: the sign and the operand, whose index runs
            over the first terms of all nodes, then the second ones, ...
        lone: terms of a reduction without their like, with one index for every node.
    """

    nodes: tuple[Node, ...]
    op: str
    operands: list[Operand] = field(default_factory=list)
    terms: list[tuple[int, Operand]] = field(default_factory=list)
    lone: list[tuple[int, Operand]] = field(default_factory=list)

    @property
    def reduces(self) -> bool:
        return bool(self.terms)

    def reads(self) -> list[Operand]:
        return [*self.operands, *(o for _, o in self.terms), *(o for _, o in self.lone)]


@dataclass(frozen=True)
class Packing:
    """Packs of a graph.

    Attributes:
        home: the pack that computes a node and its place there, by node number.
        columns: order in which the table's columns are wanted; a column may be wanted twice.
        column: place of each column in that order.
    """

    home: dict[int, tuple[Pack, int]]
    columns: list["Node"]
    column: dict[int, int]

    def place(self, node: Node) -> int:
        """Where the table holds a known number."""
        if node.number not in self.column:
            self.column[node.number] = len(self.columns)
            self.columns.append(node)
        return self.column[node.number]
