"""Packed scalars as C89: what is alike in loops over arrays, the rest line by line.

With lanes all of it is done for several joints at a time: every scalar is an array over the lanes,
and every loop has one over the lanes inside, which compilers make vector instructions of.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nfriction.codegen.elements import Elements, Names, Text
from nfriction.codegen.emit import ATOM, C, expression
from nfriction.codegen.packs import Operand, Pack, Packing
from nfriction.codegen.places import LANE, Loop, at, place, regular
from nfriction.codegen.plan import InPlace, Plan, few_terms, nodes_of
from nfriction.codegen.scalar import Node, is_predicate

_FEW_SUMS = 6  # so many have a variable each, which stays in a register
_INLINE = 64  # characters; longer values get a variable of their own


@dataclass(frozen=True)
class Body:
    """A function's inside.

    Attributes:
        declarations: of its variables, which C89 wants first.
        statements: what computes them.
        texts: of the wanted nodes, in order.
    """

    declarations: list[str]
    statements: list[str]
    texts: list[str]


def body(
    wanted: Sequence[Node],
    packing: Packing,
    dialect: C,
    bound: Callable[[Node], str],
    named: Sequence[Node],
    names: Names,
    in_place: InPlace = lambda made: None,
    *,
    arrays: Mapping[str, str] | None = None,
    lanes: int = 1,
    multiple: int = 1,
) -> Body:
    """Statements that compute `wanted`.

    Args:
        wanted: nodes of which the text is asked for.
        packing: what goes into loops.
        dialect: the language.
        bound: text of an input.
        named: nodes that need a variable of their own, because their address is taken.
        names: taken in the function; constant arrays that the statements need are added.
        in_place: what does a pack's operation of one operand on an array, if there is such.
        arrays: what inputs and the table are called, where not by their names.
        lanes: so many numbers lie side by side in all of these, and in what is computed.
        multiple: arrays for `in_place` are filled up with zeros to a multiple of this.
    """
    plan = Plan(wanted, packing, named, in_place)
    writer = _Writer(multiple, plan, dialect, bound, names, arrays or {}, lanes)
    texts = writer.write()
    return Body(writer.declarations(), writer.lines, texts)


class _Writer(Elements):
    def __init__(self, multiple: int, *given: Any) -> None:
        super().__init__(*given)
        self.multiple = multiple
        self.lines: list[str] = []
        self._waiting: list[str] = []  # for the loop over the lanes
        self._waiting_for_tests = False

    def write(self) -> list[str]:
        for unit in self.plan.order:
            if isinstance(unit, Node):
                self._scalar(unit)
            elif id(unit) not in self.plan.inlined:
                self._pack(unit)
        texts = [self._text(node)[0] for node in self.plan.wanted]
        self._nest([], [])
        return texts

    def _alone(self, line: str, test: bool = False) -> None:
        """A statement outside all loops but that over the lanes.

        Tests get a loop of their own: compilers do not vectorise one that has a branch.
        """
        if self.lanes == 1:
            self.lines.append(line)
            return
        if test != self._waiting_for_tests:
            self._nest([], [])
            self._waiting_for_tests = test
        self._waiting.append(line)

    def _nest(self, loops: Sequence[Loop], inside: list[str], by_lane: bool = True) -> None:
        """Statements within loops, after those that wait for the loop over the lanes."""
        if self._waiting:
            waiting, self._waiting = self._waiting, []
            self._nest([], waiting)
        if not inside:
            return
        lane = [(LANE, self.lanes)] if by_lane else []
        for variable, count in reversed([*loops, *lane]):
            if count > 1:
                if variable not in self._variables.setdefault("int", []):
                    self._variables["int"].append(variable)
                inside = _loop(variable, count, inside)
        self.lines += inside

    def _scalar(self, node: Node) -> None:
        if node.op == "constant":
            text: Text = self.dialect.literal(node.value), ATOM
        elif node.op == "input":
            text = self.bound(node), ATOM
        else:
            text = expression(node.op, [self._text(a) for a in node.args], self.dialect)
            if self.plan.uses.get(node.number, 0) > 1 or len(text[0]) > _INLINE:
                name = self._declare(self._type(node), "t", self.lanes if self.lanes > 1 else 0)
                name = f"{name}[{LANE}]" if self.lanes > 1 else name
                self._alone(f"{name} = {text[0]};", is_predicate(node))
                text = name, ATOM
        self._texts[node.number] = text

    def _pack(self, made: Pack) -> None:
        call = self.plan.in_place(made)
        more = -len(made.nodes) * self.lanes % self.multiple if call else 0
        for operand in self.plan.gathered(made):
            self._gather(operand, more)
        if made.reduces and not few_terms(made):
            self._reduce(made)
            return
        if call and made.operands[0].kind == "gather":
            name = self._arrays[id(made.operands[0])]
            self._nest([], [])
        else:
            name = self._array(made.nodes[0], len(made.nodes), more)
            self._fill(made, made.operands[0] if call else None, name)
        self._arrays[id(made)] = name
        if call:
            count = len(made.nodes) * self.lanes
            zero = self.dialect.literal(0.0)
            self.lines += [f"{name}[{count + i}] = {zero};" for i in range(more)]
            self.lines.append(call.format(array=name, count=count + more))

    def _fill(self, made: Pack, only: Operand | None, name: str) -> None:
        """A loop that computes a pack, or one operand of it only."""
        count = len(made.nodes)
        loops = regular(list(self.plan.indices(made)), count)
        inside: list[str] = []
        self._locals.clear()
        value = self._element(only, loops, inside) if only else self._value(made, loops, inside)
        target = f"{name}[{place(range(count), loops, self.lanes)}]"
        self._nest(loops, [*inside, f"{target} = {value[0]};"])

    def _gather(self, operand: Operand, more: int) -> None:
        nodes = nodes_of(operand)
        name = self._arrays[id(operand)] = self._array(nodes[0], len(nodes), more)
        for i, node in enumerate(nodes):
            self._alone(f"{name}[{at(i, self.lanes)}] = {self._text(node)[0]};")

    def _reduce(self, made: Pack) -> None:
        """Sums side by side, term by term: none waits for the last addition of its own."""
        count = len(made.nodes)
        name = self._arrays[id(made)] = self._array(made.nodes[0], count)
        if count <= _FEW_SUMS:
            own = [self._declare(self.dialect.real, "a") for _ in range(count)]
            lines: list[str] = []
            for which, total in enumerate(own):
                self._locals.clear()
                lines.append(f"{total} = {self._start(made, [(str(which), count)], lines)};")
            for sign, operand in made.terms:
                rounds, step = len(operand.index) // count, []
                for which, total in enumerate(own):
                    step += self._step(made, sign, operand, (str(which), count), total)
                lines += _loop("k", rounds, step)
                if "k" not in self._variables.setdefault("int", []):
                    self._variables["int"].append("k")
            lines += [f"{name}[{at(i, self.lanes)}] = {total};" for i, total in enumerate(own)]
            self._nest([], lines)
            return
        total = f"{name}[{place(range(count), [('i', count)], self.lanes)}]"
        start: list[str] = []
        self._locals.clear()
        value = self._start(made, [("i", count)], start)
        self._nest([("i", count)], [*start, f"{total} = {value};"])
        for sign, operand in made.terms:
            step = self._step(made, sign, operand, ("i", count), total)
            self._nest([("k", len(operand.index) // count), ("i", count)], step)

    def _step(self, made: Pack, sign: int, operand: Operand, which: Loop, total: str) -> list[str]:
        """What adds one round of terms to a sum."""
        lines: list[str] = []
        self._locals.clear()
        element = self._element(operand, [("k", len(operand.index) // which[1]), which], lines)
        return [*lines, f"{total} = {self._joined(made.op, sign, (total, ATOM), element)[0]};"]

    def _start(self, made: Pack, loops: list[Loop], before: list[str]) -> str:
        """What a sum starts with: its lone terms, or zero; a maximum with its first term."""
        text: Text | None = None
        for sign, operand in made.lone:
            text = self._joined(made.op, sign, text, self._element(operand, loops, before))
        if text is not None or made.op == "add":
            return text[0] if text is not None else self.dialect.literal(0.0)
        operand = made.terms[0][1]
        first = Operand(operand.kind, operand.source, operand.index[: len(made.nodes)])
        return self._element(first, loops, before, operand)[0]


def _loop(variable: str, count: int, inside: list[str]) -> list[str]:
    """Statements in a loop; a single one, with loops around it or not, needs no braces."""
    head = f"for ({variable} = 0; {variable} < {count}; ++{variable})"
    indented = [f"    {line}" for line in inside]
    if all(line.lstrip().startswith("for ") for line in inside[:-1]) and inside[-1].endswith(";"):
        return [head, *indented]
    return [f"{head} {{", *indented, "}"]
