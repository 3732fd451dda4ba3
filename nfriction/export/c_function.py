"""One traced function as C: a static function for a joint, called for every joint."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from torch import Tensor

from nfriction.codegen import finite
from nfriction.codegen.function import fold
from nfriction.codegen.joints import TABLE, Template, template
from nfriction.codegen.loops import Names, body
from nfriction.codegen.packs import Pack, Packing, pack
from nfriction.codegen.scalar import Node, reachable
from nfriction.codegen.squares import completed
from nfriction.export.c_bounds import bounds_of
from nfriction.export.c_dialect import ControllerC, array, table
from nfriction.export.c_exp import LARGEST, LEAST
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


@dataclass(frozen=True)
class Emitted:
    """A function as text.

    Attributes:
        source: its tables and the static function of one joint.
        call: statements that call it for all joints.
        counts: whether they count the joints with `j`.
    """

    source: str
    call: tuple[str, ...]
    counts: bool


def emit(
    name: str,
    function: Callable[..., Any],
    inputs: Mapping[str, Tensor],
    outputs: Sequence[Output],
    dialect: ControllerC,
    arrays: Mapping[str, str] | None = None,
) -> Emitted:
    """Write a function of tensors whose first axis is the joint.

    Args:
        name: of the static function.
        function: a module or a bound method of one.
        inputs: example tensors by argument name.
        outputs: arrays that it fills, one a tensor returned.
        dialect: the C.
        arrays: what stands for an argument in the call, where that is not its name.
    """
    folded = fold(function, inputs)
    joints = next(iter(inputs.values())).shape[0]
    sizes = {key: x.numel() for key, x in inputs.items()}
    one = completed(template(folded.outputs, sizes, folded.known, joints))
    return _Function(name, one, outputs, dialect).emitted(arrays or {})


class _Function:
    def __init__(
        self, name: str, one: Template, outputs: Sequence[Output], dialect: ControllerC
    ) -> None:
        self.name, self.one, self.outputs, self.dialect = name, one, outputs, dialect
        self.names = Names(f"{name}_c")
        pairs = zip(outputs, one.outputs, strict=True)
        self.targets = [(output, i) for output, group in pairs for i in range(len(group))]

    def emitted(self, arrays: Mapping[str, str]) -> Emitted:
        graph = self.one.graph
        nodes = [node for group in self.one.outputs for node in group]
        nodes = finite.rebuilt(graph, finite.by_bits(graph, nodes), self._left_range)
        test = finite.border(nodes)
        usual = nodes if test is None else finite.decided(graph, nodes, test, True)
        packing = pack(self._wanted(usual))
        main = self._body(usual, packing)
        lines = [*main.declarations, *(f"(void){key};" for key in self.one.inputs)]
        if test is None:
            lines += main.lines()
        else:
            rare = finite.decided(graph, nodes, test, False)
            other = self._body(rare, Packing({}, packing.columns, packing.column))
            lines += _branches(self._tests(test), main, other)
        return Emitted(
            "\n".join([*self._tables(packing), self._function(lines, packing)]),
            self._call(packing, arrays),
            self.one.joints > 1,
        )

    def _function(self, lines: Sequence[str], packing: Packing) -> str:
        real = self.dialect.real
        arguments = [f"const {real} *{TABLE}"] if packing.columns else []
        arguments += [f"const {real} *{key}" for key in self.one.inputs]
        arguments += [f"{'int' if o.kind == 'int' else real} *{o.name}" for o in self.outputs]
        head = ",\n    ".join(arguments)
        inside = "\n    ".join(lines)
        return f"static void {self.name}(\n    {head})\n{{\n    {inside}\n}}\n"

    def _tables(self, packing: Packing) -> list[str]:
        real = self.dialect.real
        columns = [self._values(node) for node in packing.columns]
        arrays = [array(key, *value) for key, value in self.names.arrays.items()]
        if not columns:
            return arrays
        return [table(f"{self.name}_table", real, np.stack(columns, -1), self.dialect), *arrays]

    def _call(self, packing: Packing, arrays: Mapping[str, str]) -> tuple[str, ...]:
        sizes = dict(self.one.inputs)
        pairs = zip(self.outputs, self.one.outputs, strict=True)
        sizes |= {output.name: len(group) for output, group in pairs}
        single = self.one.joints == 1
        given = [f"{self.name}_table[{0 if single else 'j'}]"] if packing.columns else []
        for key, size in sizes.items():
            step = "" if single else f" + {size} * j" if size > 1 else " + j"
            given.append(arrays.get(key, key) + step)
        call = f"{self.name}({', '.join(given)});"
        if single:
            return (call,)
        return (f"for (j = 0; j < {self.one.joints}; ++j)", f"    {call}")

    def _left_range(self, node: Node, args: tuple[Node, ...]) -> Node | None:
        """`x != clamp(x, low, high)` as `x < low or high < x`, which is shorter."""
        if node.op != "ne":
            return None
        for x, clamped in (args, args[::-1]):
            for high, raised in _sides("min", clamped):
                for low, own in _sides("max", raised):
                    if own is x and (self._values(low) <= self._values(high)).all():
                        g = self.one.graph
                        return g.apply("or", g.apply("lt", x, low), g.apply("lt", high, x))
        return None

    def _values(self, node: Node) -> np.ndarray:
        """Known number of each joint, NaN for what is not known."""
        if node.op == "constant":
            return np.full(self.one.joints, node.value)
        if node.op == "input" and node.value[0] == TABLE:
            return self.one.table[:, node.value[1]]
        return np.full(self.one.joints, np.nan)

    def _wanted(self, nodes: Sequence[Node]) -> list[Node]:
        """What has to be computed: tests, values, and what whole numbers rest on."""
        wanted: list[Node] = []
        for (output, _), node in zip(self.targets, nodes, strict=True):
            if output.kind == "int":
                wanted += whole_leaves(node)
            else:
                wanted += [part for part in _guarded(node) if part is not None]
        return list({node.number: node for node in wanted}.values())

    def _body(self, nodes: Sequence[Node], packing: Packing) -> "_Block":
        """All that computes and stores the outputs."""

        def bound(node: Node) -> str:
            name, index = node.value
            return f"{name}[{packing.place(node) if name == TABLE else index}]"

        wanted = self._wanted(nodes)
        tests = [n for n in reachable(wanted) if n.op == "finite"]
        named = [*tests, *(n.args[0] for n in tests)]
        limits = bounds_of(self.one, wanted)

        def in_place(made: Pack) -> str | None:
            if made.op != "exp":
                return None
            within = (limits[n.args[0].number] for n in made.nodes)
            if not all(low >= LEAST and high <= LARGEST for low, high in within):
                return None
            return self.dialect.array_exp()

        made = body(wanted, packing, self.dialect, bound, named, self.names, in_place)
        texts = dict(zip((n.number for n in wanted), made.texts, strict=True))
        return _Block(made.declarations, made.statements, self._stores(nodes, texts))

    def _stores(self, nodes: Sequence[Node], texts: Mapping[int, str]) -> list["_Stores"]:
        """Stores to the outputs, by the test that decides whether they are NaN.

        NaN is stored as bits, whatever the compiler assumes of numbers.
        """
        tests = {test.number for test, _ in map(_guarded, nodes) if test is not None}
        found: dict[str, tuple[list[str], list[str], list[tuple[str, int]]]] = {}
        for (output, i), node in zip(self.targets, nodes, strict=True):
            target = f"{output.name}[{i}]"
            if output.kind == "int":
                guarded = node.op == "where" and node.args[0].number in tests
                test = node.args[0] if guarded else None
                sides = node.args[1:] if guarded else (node,)
                lines = [f"{target} = {whole(x, texts, self.dialect)};" for x in sides]
            else:
                test, value = _guarded(node)
                lines = [] if value is None else [f"{target} = {texts[value.number]};"]
            sound, broken, nans = found.setdefault(
                "" if test is None else texts[test.number], ([], [], [])
            )
            sound += lines[:1]
            broken += lines[1:]
            if output.kind == "real" and (value is None or test is not None):
                nans.append((output.name, i))
        return [_Stores(k, s, [*b, *self._fills(n)]) for k, (s, b, n) in found.items()]

    def _fills(self, places: Sequence[tuple[str, int]]) -> list[str]:
        """Calls that fill with NaN, one a run of neighbours."""
        runs: list[tuple[str, int, int]] = []
        for name, i in places:
            if runs and runs[-1][0] == name and runs[-1][1] + runs[-1][2] == i:
                runs[-1] = name, runs[-1][1], runs[-1][2] + 1
            else:
                runs.append((name, i, 1))
        fill = f"{self.dialect.prefix}_fill_nan"
        return [f"{fill}({name}{f' + {i}' if i else ''}, {n});" for name, i, n in runs]

    def _tests(self, test: Node) -> str:
        if test.op == "and":
            return " && ".join(self._tests(part) for part in test.args)
        name, index = test.args[0].value
        return self.dialect.call("finite", [f"{name}[{index}]"])


@dataclass(frozen=True)
class _Stores:
    """Stores where a test holds, and where it fails; an empty test holds, yet both are stored."""

    test: str
    sound: list[str]
    broken: list[str]

    def lines(self) -> list[str]:
        if not self.test:
            return [*self.sound, *self.broken]
        return [f"if ({self.test}) {{", *_indented(self.sound), "} else {",
                *_indented(self.broken), "}"]  # fmt: skip


@dataclass(frozen=True)
class _Block:
    """Declarations, statements, and the stores to the outputs."""

    declarations: list[str]
    statements: list[str]
    stores: list[_Stores]

    def lines(self) -> list[str]:
        return [*self.statements, *(line for store in self.stores for line in store.lines())]


def _branches(tests: str, usual: _Block, rare: _Block) -> list[str]:
    """The usual case where inputs pass their tests, the rare one otherwise."""
    bare = rare.lines()
    if len(usual.stores) == 1 and usual.stores[0].test and usual.stores[0].broken == bare:
        # Both kinds of failure end alike: one way out for both.
        last = [f"if ({usual.stores[0].test}) {{", *_indented(usual.stores[0].sound),
                "    return;", "}"]  # fmt: skip
        return [f"if ({tests}) {{", *_indented([*usual.statements, *last]), "}", *bare]
    return [
        f"if (!({tests})) {{",
        *_indented([*rare.declarations, *bare, "return;"]),
        "}",
        *usual.lines(),
    ]


def _indented(lines: Sequence[str]) -> list[str]:
    return [f"    {line}" for line in lines]


def _sides(op: str, node: Node) -> list[tuple[Node, Node]]:
    """Both ways to read the arguments of a maximum or minimum."""
    return [(*node.args,), (*node.args[::-1],)] if node.op == op else []  # type: ignore[list-item]


def _is_nan(node: Node) -> bool:
    return node.op == "constant" and isinstance(node.value, float) and math.isnan(node.value)


def _guarded(node: Node) -> tuple[Node | None, Node | None]:
    """The test without which an output is NaN, and its value; no value where it always is."""
    if _is_nan(node):
        return None, None
    if node.op == "where" and _is_nan(node.args[2]):
        return node.args[0], node.args[1]
    return None, node
