"""Texts of what packed code reads and computes in one round of its loops."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from nfriction.codegen.emit import ATOM, C, expression
from nfriction.codegen.packs import Operand, Pack
from nfriction.codegen.places import LANE, Loop, at, place
from nfriction.codegen.plan import Plan
from nfriction.codegen.scalar import Node, is_predicate

Text = tuple[str, int]
"""An expression and how tightly it binds."""


@dataclass
class Names:
    """Names of a function.

    Attributes:
        prefix: of constant arrays.
        arrays: C type and values of those, by name.
        taken: number of variables.
    """

    prefix: str
    arrays: dict[str, tuple[str, list[str]]] = field(default_factory=dict)
    taken: int = 0

    def constant(self, kind: str, values: list[str]) -> str:
        """The name of an array; the same one for the same values."""
        for name, known in self.arrays.items():
            if known == (kind, values):
                return name
        name = f"{self.prefix}{len(self.arrays)}"
        self.arrays[name] = kind, values
        return name


@dataclass
class Elements:
    """Variables of a function and texts of operands.

    Args:
        plan: what is computed, and which packs are written into their readers.
        dialect: the language.
        bound: text of an input.
        names: taken in the function.
        called: what inputs and the table are called, where not by their names.
        lanes: so many numbers lie side by side at every place.
    """

    plan: Plan
    dialect: C
    bound: Callable[[Node], str]
    names: Names
    called: Mapping[str, str]
    lanes: int
    _texts: dict[int, Text] = field(default_factory=dict)
    _arrays: dict[int, str] = field(default_factory=dict)
    _variables: dict[str, list[str]] = field(default_factory=dict)
    _locals: dict[int, str] = field(default_factory=dict)  # of one round, by inlined pack

    def declarations(self) -> list[str]:
        return [f"{kind} {', '.join(names)};" for kind, names in self._variables.items()]

    def _declare(self, kind: str, letter: str, size: int = 0) -> str:
        """A new variable, or an array of a size."""
        name = f"{letter}{self.names.taken}"
        self.names.taken += 1
        self._variables.setdefault(kind, []).append(f"{name}[{size}]" if size else name)
        return name

    def _array(self, node: Node, count: int, more: int = 0) -> str:
        return self._declare(self._type(node), "v", count * self.lanes + more)

    def _type(self, node: Node) -> str:
        return "int" if is_predicate(node) else self.dialect.real

    def _text(self, node: Node) -> Text:
        home = self.plan.packing.home.get(node.number)
        if home:
            return f"{self._arrays[id(home[0])]}[{at(home[1], self.lanes)}]", ATOM
        return self._texts[node.number]

    def _value(self, made: Pack, loops: list[Loop], before: list[str]) -> Text:
        """What a pack computes in one round; statements needed first go to `before`."""
        if made.reduces:
            return self._written_out(made, loops, before)
        operands = [self._element(o, loops, before) for o in made.operands]
        return expression(made.op, operands, self.dialect)

    def _written_out(self, made: Pack, loops: list[Loop], before: list[str]) -> Text:
        """A sum of few terms in one expression: compilers do several of them side by side."""
        total: Text | None = None
        for sign, operand in made.lone:
            total = self._joined(made.op, sign, total, self._element(operand, loops, before))
        for sign, operand in made.terms:
            rounds = len(operand.index) // len(made.nodes)
            for k in range(rounds):
                self._locals.clear()
                element = self._element(operand, [(str(k), rounds), *loops], before)
                total = self._joined(made.op, sign, total, element)
        self._locals.clear()
        assert total is not None
        return total

    def _inside(self, made: Pack, loops: list[Loop], before: list[str]) -> Text:
        """A pack within the loop that reads it; read twice, it gets a variable."""
        if len(self.plan.readers[id(made)]) == 1:
            return self._value(made, loops, before)
        if id(made) not in self._locals:
            text, _ = self._value(made, loops, before)
            self._locals[id(made)] = self._declare(self._type(made.nodes[0]), "t")
            before.append(f"{self._locals[id(made)]} = {text};")
        return self._locals[id(made)], ATOM

    def _joined(self, op: str, sign: int, total: Text | None, text: Text) -> Text:
        if total is None:
            return text if sign > 0 else expression("neg", [text], self.dialect)
        step = op if op != "add" or sign > 0 else "sub"
        return expression(step, [total, text], self.dialect)

    def _element(
        self, operand: Operand, loops: list[Loop], before: list[str], of: Operand | None = None
    ) -> Text:
        """What an operand is in one round of the loops; `of`: the operand whose part it is."""
        source, lanes = operand.source, self.lanes
        if isinstance(source, Node):
            return self._text(source)
        if isinstance(source, Pack) and id(source) in self.plan.inlined:
            return self._inside(source, loops, before)
        if isinstance(source, Pack):
            array = self._arrays[id(source)]
        elif operand.kind == "gather":
            array = self._arrays[id(of or operand)]
        elif operand.kind == "constants":
            array, lanes = self._constants(source), 1
        else:
            array = self.called.get(str(source), str(source))
        return f"{array}[{self._place(operand.index, loops, lanes)}]", ATOM

    def _constants(self, values: object) -> str:
        assert isinstance(values, tuple)
        predicate = any(isinstance(x, bool) for x in values)
        kind = "int" if predicate else self.dialect.real
        return self.names.constant(kind, [self.dialect.literal(x) for x in values])

    def _place(self, index: Sequence[int], loops: list[Loop], lanes: int) -> str:
        text = place(index, loops, lanes)
        if text is not None:
            return text
        kind = "unsigned char" if max(index) < 256 else "unsigned short"
        table = self.names.constant(kind, [str(i) for i in index])
        looked_up = f"{table}[{place(range(len(index)), loops)}]"
        return f"{lanes} * {looked_up} + {LANE}" if lanes > 1 else looked_up
