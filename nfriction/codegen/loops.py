"""Packed scalars as C89: what is alike in loops over arrays, the rest line by line."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from nfriction.codegen.emit import ATOM, C, expression
from nfriction.codegen.packs import Operand, Pack, Packing
from nfriction.codegen.scalar import Node, is_predicate

_FEW_TERMS = 5  # so many are written out
_FEW_SUMS = 6  # so many have a variable each, which stays in a register
_INLINE = 64  # characters; longer values get a variable of their own

Text = tuple[str, int]
"""An expression and how tightly it binds."""
Loop = tuple[str, int]
"""Variable and count of a loop."""
Unit = Node | Pack


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
    in_place: Callable[[Pack], str | None] = lambda made: None,
) -> Body:
    """Statements that compute `wanted`.

    Args:
        wanted: nodes of which the text is asked for.
        packing: what goes into loops.
        dialect: the language.
        bound: text of an input.
        named: nodes that need a variable of their own, because their address is taken.
        names: taken in the function; constant arrays that the statements need are added.
        in_place: a C function `f(array, count)` that does a pack's operation of one operand, if
            there is one for it.
    """
    writer = _Writer(wanted, packing, dialect, bound, named, names, in_place)
    texts = writer.write()
    return Body(writer.declarations(), writer.lines, texts)


@dataclass
class _Writer:
    wanted: Sequence[Node]
    packing: Packing
    dialect: C
    bound: Callable[[Node], str]
    named: Sequence[Node]
    names: Names
    in_place: Callable[[Pack], str | None]
    lines: list[str] = field(default_factory=list)
    _uses: dict[int, int] = field(default_factory=dict)
    _texts: dict[int, Text] = field(default_factory=dict)
    _arrays: dict[int, str] = field(default_factory=dict)
    _variables: dict[str, list[str]] = field(default_factory=dict)
    _readers: dict[int, list[tuple[Pack, Operand]]] = field(default_factory=dict)
    _inlined: set[int] = field(default_factory=set)
    _locals: dict[int, str] = field(default_factory=dict)  # of one round, by inlined pack

    def write(self) -> list[str]:
        order = self._ordered()
        self._inspect(order)
        for unit in order:
            if isinstance(unit, Node):
                self._scalar(unit)
            elif id(unit) not in self._inlined:
                self._loop(unit)
        return [self._text(node)[0] for node in self.wanted]

    def declarations(self) -> list[str]:
        return [f"{kind} {', '.join(names)};" for kind, names in self._variables.items()]

    def _declare(self, kind: str, letter: str, size: int = 0) -> str:
        """A new variable, or an array of a size."""
        name = f"{letter}{self.names.taken}"
        self.names.taken += 1
        self._variables.setdefault(kind, []).append(f"{name}[{size}]" if size else name)
        return name

    def _unit(self, node: Node) -> Unit:
        home = self.packing.home.get(node.number)
        return home[0] if home else node

    def _needs(self, unit: Unit) -> list[Unit]:
        if isinstance(unit, Node):
            return [self._unit(a) for a in unit.args]
        needs: list[Unit] = []
        for operand in unit.reads():
            if operand.kind == "pack":
                assert isinstance(operand.source, Pack)
                needs.append(operand.source)
            elif operand.kind in ("node", "gather"):
                needs += [self._unit(node) for node in _nodes(operand)]
        return needs

    def _ordered(self) -> list[Unit]:
        """All that is needed, what others need first."""
        done: dict[int, Unit] = {}
        stack: list[tuple[Unit, bool]] = [(self._unit(n), False) for n in reversed(self.wanted)]
        while stack:
            unit, ready = stack.pop()
            if id(unit) in done:
                continue
            if ready:
                done[id(unit)] = unit
                continue
            stack.append((unit, True))
            stack += [(need, False) for need in reversed(self._needs(unit))]
        return list(done.values())

    def _inspect(self, order: Sequence[Unit]) -> None:
        """How often nodes are read one by one, and which packs need no array."""
        alone: list[Node] = [*self.wanted, *self.named, *self.named]
        for unit in order:
            if isinstance(unit, Node):
                alone += unit.args
                continue
            for operand in unit.reads():
                if operand.kind == "pack":
                    assert isinstance(operand.source, Pack)
                    self._readers.setdefault(id(operand.source), []).append((unit, operand))
                elif operand.kind in ("node", "gather"):
                    # A value that a loop reads in every round is computed before it.
                    alone += _nodes(operand) * (2 if operand.kind == "node" else 1)
        for node in alone:
            self._uses[node.number] = self._uses.get(node.number, 0) + 1
        for unit in order:
            if isinstance(unit, Pack) and self._vanishes(unit):
                self._inlined.add(id(unit))

    def _vanishes(self, made: Pack) -> bool:
        """Whether a pack can be written into the one loop that reads it."""
        readers = self._readers.get(id(made), [])
        if not readers or any(n.number in self._uses for n in made.nodes):
            return False
        if self.in_place(made):
            return False
        reader = readers[0][0]
        if self._sums(made) and reader.reduces:
            return False
        if any(other is not reader for other, _ in readers[1:]):
            return False
        return (not made.reduces or _few_terms(made)) and all(
            o.straight and len(o.index) == len(made.nodes) for _, o in readers
        )

    def _sums(self, made: Pack) -> bool:
        """Whether a pack is a sum, or has one written into it."""
        return made.reduces or any(self._sums(inner) for inner in self._written_in(made))

    def _written_in(self, made: Pack) -> list[Pack]:
        sources = [o.source for o in made.reads()]
        return [s for s in sources if isinstance(s, Pack) and id(s) in self._inlined]

    def _type(self, node: Node) -> str:
        return "int" if is_predicate(node) else self.dialect.real

    def _text(self, node: Node) -> Text:
        home = self.packing.home.get(node.number)
        if home:
            return f"{self._arrays[id(home[0])]}[{home[1]}]", ATOM
        return self._texts[node.number]

    def _scalar(self, node: Node) -> None:
        if node.op == "constant":
            text: Text = self.dialect.literal(node.value), ATOM
        elif node.op == "input":
            text = self.bound(node), ATOM
        else:
            text = expression(node.op, [self._text(a) for a in node.args], self.dialect)
            if self._uses.get(node.number, 0) > 1 or len(text[0]) > _INLINE:
                name = self._declare(self._type(node), "t")
                self.lines.append(f"{name} = {text[0]};")
                text = name, ATOM
        self._texts[node.number] = text

    def _loop(self, made: Pack) -> None:
        count = len(made.nodes)
        for operand in {id(o): o for o in self._gathered(made)}.values():
            self._gather(operand)
        name = self._declare(self._type(made.nodes[0]), "v", count)
        self._arrays[id(made)] = name
        if made.reduces and not _few_terms(made):
            self._reduce(made, name)
            return
        function = self.in_place(made)
        loops = self._loops(made)
        inside: list[str] = []
        self._locals.clear()
        if function:
            text, _ = self._element(made.operands[0], loops, inside)
        else:
            text, _ = self._value(made, loops, inside)
        inside.append(f"{name}[{_index(range(count), loops)}] = {text};")
        for loop in reversed(loops[1:]):
            outer: list[str] = []
            self._open(loop, inside, outer)
            inside = outer
        self._open(loops[0], inside, self.lines)
        if function:
            self.lines.append(f"{function}({name}, {count});")

    def _loops(self, made: Pack) -> list[Loop]:
        """One loop, or two where that makes places in all arrays linear in their variables."""
        count = len(made.nodes)
        read = [list(index) for index in self._indices(made)]
        if not all(_plane(index, count) for index in read):
            for columns in (d for d in range(2, count) if count % d == 0):
                if all(_plane(index, columns) for index in read):
                    return [("k", count // columns), ("i", columns)]
        return [("i", count)]

    def _indices(self, made: Pack) -> Iterator[tuple[int, ...]]:
        """Places that each round reads, term by term, those of packs written into it included."""
        count = len(made.nodes)
        for operand in made.reads():
            if isinstance(operand.source, Pack) and id(operand.source) in self._inlined:
                for index in self._indices(operand.source):
                    yield from _parts(index, count)
            elif operand.kind != "node":
                yield from _parts(operand.index, count)

    def _reduce(self, made: Pack, name: str) -> None:
        """Sums side by side, term by term: none waits for the last addition of its own."""
        count = len(made.nodes)
        few = count <= _FEW_SUMS
        own = [self._declare(self.dialect.real, "a") for _ in range(count)] if few else []
        # Each sum: the loop's variable or number, and where it grows.
        sums = [(str(i), total) for i, total in enumerate(own)] or [("i", f"{name}[i]")]
        start: list[str] = []
        for which, total in sums:
            self._locals.clear()
            start.append(f"{total} = {self._start(made, [(which, count)], start)};")
        if few:
            self.lines += start
        else:
            self._open(("i", count), start, self.lines)
        for sign, operand in made.terms:
            rounds = len(operand.index) // count
            step: list[str] = []
            for which, total in sums:
                self._locals.clear()
                element = self._element(operand, [("k", rounds), (which, count)], step)
                step.append(f"{total} = {self._joined(made.op, sign, (total, ATOM), element)[0]};")
            inner: list[str] = []
            if not few:
                self._open(("i", count), step, inner)
            self._open(("k", rounds), step if few else inner, self.lines)
        self.lines += [f"{name}[{i}] = {total};" for i, total in enumerate(own)]

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

    def _open(self, loop: Loop, inside: list[str], into: list[str]) -> None:
        variable, count = loop
        if count == 1:
            into += inside
            return
        if variable not in self._variables.setdefault("int", []):
            self._variables["int"].append(variable)
        head = f"for ({variable} = 0; {variable} < {count}; ++{variable})"
        if len(inside) == 1 or (len(inside) == 2 and inside[0].startswith("for ")):
            into += [head, *(f"    {line}" for line in inside)]
        else:
            into += [f"{head} {{", *(f"    {line}" for line in inside), "}"]

    def _gathered(self, made: Pack) -> list[Operand]:
        found = [o for o in made.reads() if o.kind == "gather"]
        for operand in made.reads():
            if isinstance(operand.source, Pack) and id(operand.source) in self._inlined:
                found += self._gathered(operand.source)
        return found

    def _gather(self, operand: Operand) -> None:
        nodes = _nodes(operand)
        name = self._declare(self._type(nodes[0]), "v", len(nodes))
        self._arrays[id(operand)] = name
        self.lines += [f"{name}[{i}] = {self._text(node)[0]};" for i, node in enumerate(nodes)]

    def _value(self, made: Pack, loops: list[Loop], before: list[str]) -> Text:
        """What a pack computes in one round; statements needed first go to `before`."""
        if made.reduces:
            return self._written_out(made, loops, before)
        return expression(
            made.op, [self._element(o, loops, before) for o in made.operands], self.dialect
        )

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
        if len(self._readers[id(made)]) == 1:
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
        source = operand.source
        if operand.kind == "node":
            assert isinstance(source, Node)
            return self._text(source)
        if isinstance(source, Pack) and id(source) in self._inlined:
            return self._inside(source, loops, before)
        if isinstance(source, Pack):
            array = self._arrays[id(source)]
        elif operand.kind == "gather":
            array = self._arrays[id(of or operand)]
        elif operand.kind == "constants":
            assert isinstance(source, tuple)
            predicate = any(isinstance(x, bool) for x in source)
            values = [self.dialect.literal(x) for x in source]  # type: ignore[arg-type]
            array = self.names.constant("int" if predicate else self.dialect.real, values)
        else:
            array = str(source)
        return f"{array}[{self._place(operand.index, loops)}]", ATOM

    def _place(self, index: Sequence[int], loops: list[Loop]) -> str:
        text = _index(index, loops)
        if text is None:
            kind = "unsigned char" if max(index) < 256 else "unsigned short"
            table = self.names.constant(kind, [str(i) for i in index])
            return f"{table}[{_index(range(len(index)), loops)}]"
        return text


def _parts(index: tuple[int, ...], size: int) -> list[tuple[int, ...]]:
    return [index[i : i + size] for i in range(0, len(index), size)]


def _few_terms(made: Pack) -> bool:
    return all(len(o.index) <= _FEW_TERMS * len(made.nodes) for _, o in made.terms)


def _nodes(operand: Operand) -> list[Node]:
    source = operand.source if isinstance(operand.source, tuple) else (operand.source,)
    return [node for node in source if isinstance(node, Node)]


def _index(index: Sequence[int], loops: Sequence[Loop]) -> str | None:
    """`index` as a function of the loops' variables: a plane, or a plane over i / d and i % d."""
    index = list(index)
    if len(loops) > 1 and loops[0][0].isdigit():
        # One round of the outermost loop, written out.
        size = len(index) // loops[0][1]
        start = size * int(loops[0][0])
        return _index(index[start : start + size], loops[1:])
    if len(loops) == 2:
        (outer, rows), (inner, columns) = loops
        if rows == 1:
            return _line(index, inner)
        found = _plane(index, columns)
        return None if found is None else _sum(found, (outer, inner))
    return _line(index, loops[0][0])


def _line(index: list[int], variable: str) -> str | None:
    found = _plane(index, len(index))
    if found is not None:
        return _sum(found, ("0", variable))
    for divisor in range(2, len(index)):
        if len(index) % divisor == 0 and (found := _plane(index, divisor)) is not None:
            return _sum(found, (f"{variable} / {divisor}", f"{variable} % {divisor}"))
    return None


def _plane(index: list[int], columns: int) -> tuple[int, int, int] | None:
    """Start, step by row and step by column, if `index` is that."""
    start = index[0]
    down = index[columns] - start if columns < len(index) else 0
    across = index[1] - start if columns > 1 else 0
    fits = all(x == start + down * (i // columns) + across * (i % columns)
               for i, x in enumerate(index))  # fmt: skip
    return (start, down, across) if fits else None


def _sum(plane: tuple[int, int, int], variables: tuple[str, str]) -> str:
    start, *steps = plane
    parts = []
    for step, variable in zip(steps, variables, strict=True):
        if variable.isdigit():
            start += step * int(variable)
        elif step:
            parts.append(variable if step == 1 else f"{step} * {_grouped(variable)}")
    return " + ".join([str(start), *parts] if start or not parts else parts)


def _grouped(variable: str) -> str:
    return f"({variable})" if " " in variable else variable
