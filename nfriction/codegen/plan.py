"""What packed code computes in which order, and which packs are written into their readers."""

from collections.abc import Callable, Iterator, Sequence

from nfriction.codegen.packs import Operand, Pack, Packing
from nfriction.codegen.scalar import Node

_FEW_TERMS = 5  # so many are written out

Unit = Node | Pack
"""What is computed at one go."""

InPlace = Callable[[Pack], str | None]
"""A C statement that does a pack's operation on an `{array}` of `{count}`, if there is one."""


class Plan:
    """Order and inlining of what `wanted` needs.

    Args:
        wanted: nodes to be computed.
        packing: what goes into loops.
        named: nodes that need a variable of their own, because their address is taken.
        in_place: see `InPlace`.

    Attributes:
        order: all units, what others need first.
        uses: how often nodes are read one by one, by node number.
        inlined: `id` of the packs that need no array.
        readers: by `id` of a pack, the packs that read it.
    """

    def __init__(
        self, wanted: Sequence[Node], packing: Packing, named: Sequence[Node], in_place: InPlace
    ) -> None:
        self.wanted, self.packing, self.in_place = wanted, packing, in_place
        self.order = self._ordered()
        self.uses: dict[int, int] = {}
        self.readers: dict[int, list[tuple[Pack, Operand]]] = {}
        self.inlined: set[int] = set()
        self._count([*wanted, *named, *named])
        for unit in self.order:
            if isinstance(unit, Pack) and self._vanishes(unit):
                self.inlined.add(id(unit))

    def is_inlined(self, source: object) -> bool:
        """Whether an operand's source is a pack that is written where it is read."""
        return isinstance(source, Pack) and id(source) in self.inlined

    def indices(self, made: Pack) -> Iterator[tuple[int, ...]]:
        """Places that each round reads, term by term, those of packs written into it included."""
        count = len(made.nodes)
        for operand in made.reads():
            if isinstance(operand.source, Pack) and self.is_inlined(operand.source):
                for index in self.indices(operand.source):
                    yield from _parts(index, count)
            elif operand.kind != "node":
                yield from _parts(operand.index, count)

    def gathered(self, made: Pack) -> list[Operand]:
        """Operands that have to be gathered in an array before a pack's loop, each once."""
        found = [o for o in made.reads() if o.kind == "gather"]
        for operand in made.reads():
            if isinstance(operand.source, Pack) and self.is_inlined(operand.source):
                found += self.gathered(operand.source)
        return list({id(o): o for o in found}.values())

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
                needs += [self._unit(node) for node in nodes_of(operand)]
        return needs

    def _ordered(self) -> list[Unit]:
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

    def _count(self, alone: list[Node]) -> None:
        for unit in self.order:
            if isinstance(unit, Node):
                alone += unit.args
                continue
            for operand in unit.reads():
                if operand.kind == "pack":
                    self.readers.setdefault(id(operand.source), []).append((unit, operand))
                elif operand.kind in ("node", "gather"):
                    # A value that a loop reads in every round is computed before it.
                    alone += nodes_of(operand) * (2 if operand.kind == "node" else 1)
        for node in alone:
            self.uses[node.number] = self.uses.get(node.number, 0) + 1

    def _vanishes(self, made: Pack) -> bool:
        """Whether a pack can be written into the one loop that reads it."""
        readers = self.readers.get(id(made), [])
        if not readers or self.in_place(made) or any(n.number in self.uses for n in made.nodes):
            return False
        reader = readers[0][0]
        if self._sums(made) and reader.reduces:
            return False
        if any(other is not reader for other, _ in readers[1:]):
            return False
        return (not made.reduces or few_terms(made)) and all(
            o.straight and len(o.index) == len(made.nodes) for _, o in readers
        )

    def _sums(self, made: Pack) -> bool:
        """Whether a pack is a sum, or has one written into it."""
        inner = [o.source for o in made.reads() if self.is_inlined(o.source)]
        return made.reduces or any(self._sums(s) for s in inner if isinstance(s, Pack))


def few_terms(made: Pack) -> bool:
    """Whether the terms of a pack's sums are written out."""
    return all(len(o.index) <= _FEW_TERMS * len(made.nodes) for _, o in made.terms)


def nodes_of(operand: Operand) -> list[Node]:
    """The nodes that an operand's source is, where it is some."""
    source = operand.source if isinstance(operand.source, tuple) else (operand.source,)
    return [node for node in source if isinstance(node, Node)]


def _parts(index: tuple[int, ...], size: int) -> list[tuple[int, ...]]:
    return [index[i : i + size] for i in range(0, len(index), size)]
