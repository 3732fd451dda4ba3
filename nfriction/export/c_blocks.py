"""Pieces of an exported C function: what reads, what stores, and what is stored where."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from nfriction.codegen.joints import TABLE
from nfriction.codegen.places import LANE, at
from nfriction.codegen.scalar import Node


@dataclass(frozen=True)
class View:
    """How a function names the numbers of one joint.

    Attributes:
        sizes: how many a joint has in each argument.
        table: name of the table.
        every: whether arguments hold the numbers of every joint, `LANE` being this one, rather
            than those of this joint alone.
        lanes: columns of the table have a number for so many joints.
    """

    sizes: Mapping[str, int]
    table: str = TABLE
    every: bool = False
    lanes: int = 1

    def number(self, name: str, index: int) -> str:
        """A number of the table, or of an argument."""
        if name == TABLE:
            return f"{self.table}[{at(index, self.lanes)}]"
        return f"{name}[{self._place(name, index)}]"

    def address(self, name: str, index: int) -> str:
        """Where a number of an argument lies."""
        where = self._place(name, index)
        return name if where == "0" else f"{name} + {where}"

    def _place(self, name: str, index: int) -> str:
        if not self.every:
            return str(index)
        first = LANE if self.sizes[name] == 1 else f"{self.sizes[name]} * {LANE}"
        return f"{first} + {index}" if index else first


@dataclass(frozen=True)
class Stores:
    """Stores where a test holds, and where it fails; an empty test holds, yet both are stored."""

    test: str
    sound: list[str]
    broken: list[str]

    def lines(self) -> list[str]:
        if not self.test:
            return [*self.sound, *self.broken]
        return choice(self.test, self.sound, self.broken)


@dataclass(frozen=True)
class Block:
    """Declarations, statements, and the stores to the outputs."""

    declarations: list[str]
    statements: list[str]
    stores: list[Stores]

    def lines(self) -> list[str]:
        return [*self.statements, *(line for store in self.stores for line in store.lines())]


def branches(tests: str, usual: Block, rare: Block) -> list[str]:
    """The usual case where inputs pass their tests, the rare one otherwise."""
    bare = rare.lines()
    if alike(usual, rare):
        # Both kinds of failure end alike: one way out for both.
        last = [f"if ({usual.stores[0].test}) {{", *indented(usual.stores[0].sound),
                "    return;", "}"]  # fmt: skip
        return [f"if ({tests}) {{", *indented([*usual.statements, *last]), "}", *bare]
    return [
        f"if (!({tests})) {{",
        *indented([*rare.declarations, *bare, "return;"]),
        "}",
        *usual.lines(),
    ]


def alike(usual: Block, rare: Block) -> bool:
    """Whether outputs that fail their test are those of broken inputs."""
    return (
        len(usual.stores) == 1
        and bool(usual.stores[0].test)
        and usual.stores[0].broken == rare.lines()
    )


def choice(test: str, sound: Sequence[str], broken: Sequence[str]) -> list[str]:
    """`if` and `else`."""
    return [f"if ({test}) {{", *indented(sound), "} else {", *indented(broken), "}"]


def indented(lines: Sequence[str]) -> list[str]:
    """Lines one level further in."""
    return [f"    {line}" for line in lines]


def guarded(node: Node) -> tuple[Node | None, Node | None]:
    """The test without which an output is NaN, and its value; no value where it always is."""
    if _is_nan(node):
        return None, None
    if node.op == "where" and _is_nan(node.args[2]):
        return node.args[0], node.args[1]
    return None, node


def _is_nan(node: Node) -> bool:
    return node.op == "constant" and isinstance(node.value, float) and math.isnan(node.value)
