"""One traced function as C: a static function for a joint, called for every joint, or one for all.

Where a model has exponentials in plenty, all joints are computed side by side: their exponentials
go through one loop, and compilers make vector instructions of the rest. Elsewhere, one joint after
the other is as quick and shorter.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from nfriction.codegen import finite
from nfriction.codegen.function import specialise
from nfriction.codegen.joints import TABLE, template
from nfriction.codegen.packing import pack
from nfriction.codegen.packs import Packing
from nfriction.codegen.places import LANE, at
from nfriction.codegen.scalar import Node, reachable
from nfriction.codegen.squares import completed
from nfriction.export.c_blocks import (
    View,
    alike,
    branches,
    choice,
    indented,
)
from nfriction.export.c_dialect import ControllerC, array, table
from nfriction.export.c_exp import by_exponentials
from nfriction.export.c_parts import Output, Parts


@dataclass(frozen=True)
class Emitted:
    """A function as text.

    Attributes:
        source: its tables and the static function.
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
    folded = specialise(function, inputs)
    joints = next(iter(inputs.values())).shape[0]
    sizes = {key: x.numel() for key, x in inputs.items()}
    one = completed(template(folded.outputs, sizes, folded.known, joints))
    return _Function(name, one, outputs, dialect).emitted(arrays or {})


class _Function(Parts):
    def emitted(self, arrays: Mapping[str, str]) -> Emitted:
        graph = self.one.graph
        nodes = [node for group in self.one.outputs for node in group]
        nodes = finite.rebuilt(graph, finite.by_bits(graph, nodes), self.left_range)
        test = finite.border(nodes)
        usual = nodes if test is None else finite.decided(graph, nodes, test, True)
        rare = None if test is None else finite.decided(graph, nodes, test, False)
        packing = pack(self.wanted(usual))
        in_place = self.in_place(usual)
        if any(in_place(made) for made, _ in packing.home.values()):
            several = self.one.joints > 1
            if several or self.dialect.real == "double":  # on a microcontroller it costs flash
                usual = by_exponentials(graph, usual)
                packing = pack(self.wanted(usual), calls=("expm1",))
            if several:
                return self._side_by_side(test, usual, rare, packing, arrays)
        return self._one_by_one(test, usual, rare, packing, arrays)

    def _one_by_one(
        self, test: Node | None, usual: list[Node], rare: list[Node] | None, packing: Packing,
        arrays: Mapping[str, str],
    ) -> Emitted:  # fmt: skip
        """A function of one joint's numbers, called in a loop."""
        view = View(self.sizes)
        main = self.block(usual, packing, view)
        lines = [*main.declarations, *(f"(void){key};" for key in self.one.inputs)]
        if test is None or rare is None:
            lines += main.lines()
        else:
            other = self.block(rare, _unpacked(packing), view)
            lines += branches(self.tests(test, view), main, other)
        parts = [*self._arrays(), self._function(lines, bool(packing.columns))]
        columns = self._columns(packing)
        if columns:
            rows = table(f"{self.name}_table", self.dialect.real, np.stack(columns, -1),
                         self.dialect)  # fmt: skip
            parts.insert(0, rows)
        single = self.one.joints == 1
        given = [f"{self.name}_table[{0 if single else LANE}]"] if columns else []
        for key, size in self.sizes.items():
            step = "" if single else f" + {size} * {LANE}" if size > 1 else f" + {LANE}"
            given.append(arrays.get(key, key) + step)
        call = f"{self.name}({', '.join(given)});"
        head = f"for ({LANE} = 0; {LANE} < {self.one.joints}; ++{LANE})"
        return Emitted("\n".join(parts), (call,) if single else (head, f"    {call}"), not single)

    def _side_by_side(
        self, test: Node | None, usual: list[Node], rare: list[Node] | None, packing: Packing,
        arrays: Mapping[str, str],
    ) -> Emitted:  # fmt: skip
        """A function of all joints' numbers; inputs that are not finite count as zero at first."""
        lanes, real = self.one.joints, self.dialect.real
        name = f"{self.name}_table"
        view = View(self.sizes, name, every=True, lanes=lanes)
        read = {n.value[0] for n in reachable(self.wanted(usual)) if n.op == "input"}
        own = {key: f"{key}_now" for key in self.one.inputs if key in read}
        main = self.block(usual, packing, view, own)
        lines = [*main.declarations]
        lines += [f"{real} {copy}[{lanes * self.sizes[key]}];" for key, copy in own.items()]
        reads = self._reads(view, own, "" if rare is None else f"sound[{LANE}]")
        stores = [line for store in main.stores for line in store.lines()]
        if test is not None and rare is not None:
            lines.append(f"int sound[{lanes}];")
            reads.insert(0, f"sound[{LANE}] = {self.tests(test, view)};")
            other = self.block(rare, _unpacked(packing), view)
            if alike(main, other):
                both = f"sound[{LANE}] && {main.stores[0].test}"
                stores = choice(both, main.stores[0].sound, other.lines())
            else:
                stores = choice(f"sound[{LANE}]", stores, [*other.declarations, *other.lines()])
        head = f"for ({LANE} = 0; {LANE} < {lanes}; ++{LANE}) {{"
        lines += [f"(void){key};" for key in self.one.inputs]
        lines += [head, *indented(reads), "}", *main.statements, head, *indented(stores), "}"]
        numbers = [self.dialect.literal(float(x)) for c in self._columns(packing) for x in c]
        columns = [array(name, real, numbers)] if numbers else []
        parts = [*columns, *self._arrays(), self._function(lines, False)]
        call = f"{self.name}({', '.join(arrays.get(key, key) for key in self.sizes)});"
        return Emitted("\n".join(parts), (call,), False)

    def _reads(self, view: View, own: Mapping[str, str], test: str) -> list[str]:
        """Copies of the inputs, joints side by side; zero where a test fails."""
        zero = self.dialect.literal(0.0)
        lines = []
        for key, copy in own.items():
            for i in range(self.sizes[key]):
                given = view.number(key, i)
                value = f"{test} ? {given} : {zero}" if test else given
                lines.append(f"{copy}[{at(i, view.lanes)}] = {value};")
        return lines

    def _function(self, lines: Sequence[str], with_table: bool) -> str:
        real = self.dialect.real
        arguments = [f"const {real} *{TABLE}"] if with_table else []
        arguments += [f"const {real} *{key}" for key in self.one.inputs]
        arguments += [f"{'int' if o.kind == 'int' else real} *{o.name}" for o in self.outputs]
        head = ",\n    ".join(arguments)
        inside = "\n    ".join(lines)
        return f"static void {self.name}(\n    {head})\n{{\n    {inside}\n}}\n"

    def _arrays(self) -> list[str]:
        return [array(key, *value) for key, value in self.names.arrays.items()]

    def _columns(self, packing: Packing) -> list[np.ndarray]:
        return [self.values(node) for node in packing.columns]


def _unpacked(packing: Packing) -> Packing:
    """No loops, with the same table."""
    return Packing({}, packing.columns, packing.column)
