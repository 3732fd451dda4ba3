"""What an exported C function is made of, whichever way it goes through the joints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from nfriction.codegen.elements import Names
from nfriction.codegen.joints import TABLE, Template
from nfriction.codegen.loops import body
from nfriction.codegen.packs import Pack, Packing
from nfriction.codegen.places import at
from nfriction.codegen.plan import InPlace
from nfriction.codegen.scalar import Node, reachable
from nfriction.export.c_blocks import Block, Stores, View, guarded
from nfriction.export.c_bounds import bounds_of
from nfriction.export.c_dialect import ControllerC
from nfriction.export.c_exp import LARGEST, LEAST, LESS
from nfriction.export.c_whole import whole, whole_leaves


@dataclass(frozen=True)
class Output:
    """An output array of a C function.

    Attributes:
        name: of the argument.
        kind: "real", or "int" for what is a whole number by construction.
    """

    name: str
    kind: Literal["real", "int"] = "real"


class Parts:
    """Texts of the blocks of one function.

    Args:
        name: of the function.
        one: what a joint computes.
        outputs: arrays that it fills.
        dialect: the C.
    """

    def __init__(
        self, name: str, one: Template, outputs: Sequence[Output], dialect: ControllerC
    ) -> None:
        self.name, self.one, self.outputs, self.dialect = name, one, outputs, dialect
        self.names = Names(f"{name}_c")
        pairs = list(zip(outputs, one.outputs, strict=True))
        self.targets = [(output, i) for output, group in pairs for i in range(len(group))]
        self.sizes = {**one.inputs, **{output.name: len(group) for output, group in pairs}}

    def left_range(self, node: Node, args: tuple[Node, ...]) -> Node | None:
        """`x != clamp(x, low, high)` as `x < low or high < x`, which is shorter."""
        if node.op != "ne":
            return None
        for x, clamped in (args, args[::-1]):
            for high, raised in _sides("min", clamped):
                for low, own in _sides("max", raised):
                    if own is x and (self.values(low) <= self.values(high)).all():
                        g = self.one.graph
                        return g.apply("or", g.apply("lt", x, low), g.apply("lt", high, x))
        return None

    def values(self, node: Node) -> np.ndarray:
        """Known number of each joint, NaN for what is not known."""
        if node.op == "constant":
            return np.full(self.one.joints, node.value)
        if node.op == "input" and node.value[0] == TABLE:
            return self.one.table[:, node.value[1]]
        return np.full(self.one.joints, np.nan)

    def wanted(self, nodes: Sequence[Node]) -> list[Node]:
        """What has to be computed: tests, values, and what whole numbers rest on."""
        wanted: list[Node] = []
        for (output, _), node in zip(self.targets, nodes, strict=True):
            if output.kind == "int":
                wanted += whole_leaves(node)
            else:
                wanted += [part for part in guarded(node) if part is not None]
        return list({node.number: node for node in wanted}.values())

    def in_place(self, nodes: Sequence[Node]) -> InPlace:
        """The calls of our own exponential that may serve for packs of what `nodes` need."""
        limits = bounds_of(self.one, self.wanted(nodes))

        def in_place(made: Pack) -> str | None:
            if made.op not in LESS:
                return None
            within = (limits[n.args[0].number] for n in made.nodes)
            if not all(low >= LEAST and high <= LARGEST for low, high in within):
                return None
            return self.dialect.array_exp(LESS[made.op])

        return in_place

    def block(
        self, nodes: Sequence[Node], packing: Packing, view: View,
        own: Mapping[str, str] | None = None,
    ) -> Block:  # fmt: skip
        """All that computes and stores the outputs; with copies of inputs in lanes."""

        def bound(node: Node) -> str:
            name, index = node.value
            if own and name in own:
                return f"{own[name]}[{at(index, view.lanes)}]"
            return view.number(name, packing.place(node) if name == TABLE else index)

        wanted = self.wanted(nodes)
        tests = [n for n in reachable(wanted) if n.op == "finite"]
        named = [*tests, *(n.args[0] for n in tests)]
        arrays = {TABLE: view.table, **(own or {})}
        # What computes in double is no microcontroller, and has vectors to fill.
        made = body(wanted, packing, self.dialect, bound, named, self.names, self.in_place(nodes),
                    arrays=arrays, lanes=view.lanes if own else 1,
                    multiple=4 if self.dialect.real == "double" else 1)  # fmt: skip
        texts = dict(zip((n.number for n in wanted), made.texts, strict=True))
        return Block(made.declarations, made.statements, self._stores(nodes, texts, view))

    def _stores(self, nodes: Sequence[Node], texts: Mapping[int, str], view: View) -> list[Stores]:
        """Stores to the outputs, by the test that decides whether they are NaN.

        NaN is stored as bits, whatever the compiler assumes of numbers.
        """
        tests = {test.number for test, _ in map(guarded, nodes) if test is not None}
        found: dict[str, tuple[list[str], list[str], list[tuple[str, int]]]] = {}
        for (output, i), node in zip(self.targets, nodes, strict=True):
            target = view.number(output.name, i)
            if output.kind == "int":
                decides = node.op == "where" and node.args[0].number in tests
                test = node.args[0] if decides else None
                sides = node.args[1:] if decides else (node,)
                lines = [f"{target} = {whole(x, texts, self.dialect)};" for x in sides]
            else:
                test, value = guarded(node)
                lines = [] if value is None else [f"{target} = {texts[value.number]};"]
            sound, broken, nans = found.setdefault(
                "" if test is None else texts[test.number], ([], [], [])
            )
            sound += lines[:1]
            broken += lines[1:]
            if output.kind == "real" and (value is None or test is not None):
                nans.append((output.name, i))
        return [Stores(k, s, [*b, *self._fills(n, view)]) for k, (s, b, n) in found.items()]

    def _fills(self, places: Sequence[tuple[str, int]], view: View) -> list[str]:
        """Calls that fill with NaN, one a run of neighbours."""
        runs: list[tuple[str, int, int]] = []
        for name, i in places:
            if runs and runs[-1][0] == name and runs[-1][1] + runs[-1][2] == i:
                runs[-1] = name, runs[-1][1], runs[-1][2] + 1
            else:
                runs.append((name, i, 1))
        fill = f"{self.dialect.prefix}_fill_nan"
        return [f"{fill}({view.address(name, i)}, {n});" for name, i, n in runs]

    def tests(self, test: Node, view: View) -> str:
        """The text of a chain of tests of inputs."""
        if test.op == "and":
            return " && ".join(self.tests(part, view) for part in test.args)
        return self.dialect.call("finite", [view.number(*test.args[0].value)])


def _sides(op: str, node: Node) -> list[tuple[Node, Node]]:
    """Both ways to read the arguments of a maximum or minimum."""
    return [(*node.args,), (*node.args[::-1],)] if node.op == op else []  # type: ignore[list-item]
