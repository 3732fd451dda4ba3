"""Find loops in straight scalar code: like operations on many numbers become one pack.

A sum over 25 rules, ten radial units, five memberships: torch wrote them as tensors, the trace
made scalars of them. Code size counts on a microcontroller, so nodes that do the same are packed
again, from the sums down to what they add. Every element of a pack is checked, so a pack computes
what its nodes say; what fits no pack stays scalar.
"""

from collections.abc import Sequence

from nfriction.codegen.joints import TABLE
from nfriction.codegen.packs import Operand, Pack, Packing
from nfriction.codegen.scalar import Node, reachable

_FEWEST = 4  # elements of a loop
_FEWEST_TERMS = 8  # of all sums of a pack together: fewer are as small written out
_MOST_NODES = 20_000  # larger graphs would take minutes to search
_FAMILY = {"add": "add", "sub": "add", "max": "max", "min": "min"}
_COMMUTATIVE = frozenset({"add", "mul", "max", "min", "eq", "ne", "and", "or"})
_RANK = {"known": 0, "constant": 1, "other": 2}


def pack(outputs: Sequence[Node], calls: Sequence[str] = ()) -> Packing:
    """Pack what `outputs` need.

    Args:
        outputs: nodes to be computed.
        calls: operations of one argument that are packed however few there are of them.
    """
    packer = _Packer(outputs)
    if len(packer.nodes) <= _MOST_NODES:
        for seed in packer.seeds():
            packer.add(seed)
        for op in calls:
            packer.collect(op)
    return packer.packing


def kind(node: Node) -> str:
    if node.op == "constant":
        return "constant"
    return "known" if node.op == "input" and node.value[0] == TABLE else "other"


def ordered(node: Node) -> tuple[Node, ...]:
    """Arguments of a node, known numbers first where the order does not matter."""
    if node.op not in _COMMUTATIVE:
        return node.args
    return tuple(sorted(node.args, key=lambda a: (_RANK[kind(a)], a.number)))


Group = tuple[int, str, tuple[str, ...]]
"""Sign, operation and kinds of arguments of like terms."""


def _group(sign: int, term: Node) -> Group:
    return sign, term.op, tuple(kind(a) for a in ordered(term))


class _Packer:
    def __init__(self, outputs: Sequence[Node]) -> None:
        self.outputs = outputs
        self.nodes = reachable(outputs)
        self.packing = Packing({}, [], {})
        self._uses: dict[int, int] = {}
        self._counted: dict[int, tuple[tuple[Group, int], ...]] = {}
        for node in (*(a for n in self.nodes for a in n.args), *outputs):
            self._uses[node.number] = self._uses.get(node.number, 0) + 1

    def seeds(self) -> list[list[Node]]:
        """Reductions that could share a loop, those that need no others first."""
        inner: set[int] = set()
        roots: dict[int, tuple[object, ...]] = {}
        for node in reversed(self.nodes):
            shape = () if node.number in inner else self._shape(node)
            if shape:
                roots[node.number] = shape
            if shape or node.number in inner:
                inner.update(a.number for a in node.args if self._continues(node, a))
        depth: dict[int, int] = {}
        found: dict[tuple[object, ...], list[Node]] = {}
        for node in self.nodes:
            below = max((depth[a.number] for a in node.args), default=0)
            if node.number in roots:
                found.setdefault((below, roots[node.number]), []).append(node)
            depth[node.number] = below + (node.number in roots)
        return [found[key] for key in sorted(found, key=_depth)]

    def add(self, nodes: list[Node]) -> None:
        """Pack reductions of the same shape, where that is worth a loop."""
        free = [n for n in nodes if n.number not in self.packing.home]
        if free and len(free) * len(self._terms(free[0])) >= _FEWEST_TERMS:
            self._try(free)

    def collect(self, op: str) -> None:
        """Pack what is left of an operation, those that do not wait for each other together."""
        depth: dict[int, int] = {}
        found: dict[int, list[Node]] = {}
        for node in self.nodes:
            depth[node.number] = max((depth[a.number] for a in node.args), default=0)
            if node.op == op and node.number not in self.packing.home:
                found.setdefault(depth[node.number], []).append(node)
                depth[node.number] += 1
        for nodes in found.values():
            for group in [nodes] if self._independent(nodes) else [[node] for node in nodes]:
                made = self._register(group, op)
                made.operands.append(self._operand([node.args[0] for node in group]))

    def _continues(self, node: Node, argument: Node) -> bool:
        """Whether a sum goes on in an argument of which nobody else asks."""
        family = _FAMILY.get(node.op)
        same = family is not None and _FAMILY.get(argument.op) == family
        return same and self._uses[argument.number] == 1

    def _terms(self, node: Node) -> list[tuple[int, Node]]:
        """Signed terms of a sum, or of a maximum or minimum."""
        terms: list[tuple[int, Node]] = []
        stack = [(1, node, True)]
        while stack:
            sign, top, enters = stack.pop()
            if not enters:
                terms.append((sign, top))
                continue
            for i, argument in reversed(list(enumerate(top.args))):
                own = -sign if top.op == "sub" and i == 1 else sign
                stack.append((own, argument, self._continues(top, argument)))
        return terms

    def _groups(self, node: Node) -> dict[Group, list[Node]]:
        groups: dict[Group, list[Node]] = {}
        for sign, term in self._terms(node):
            groups.setdefault(_group(sign, term), []).append(term)
        # In the order of the trace, in which tensors have their elements side by side.
        return {key: sorted(groups[key], key=lambda n: n.number) for key in sorted(groups)}

    def _shape(self, node: Node) -> tuple[object, ...]:
        """What reductions must share to be one pack; empty for what is none."""
        counts = self._counts(node)
        large = {group for group, count in counts if count >= _FEWEST}
        if not large:
            return ()
        for argument in node.args:
            if self._continues(node, argument):
                inside = dict(self._counts(argument))
                if all(inside.get(group) == count for group, count in counts if group in large):
                    return ()  # it only adds something to what is one
        return (_FAMILY[node.op], counts)

    def _counts(self, node: Node) -> tuple[tuple[Group, int], ...]:
        if node.op not in _FAMILY:
            return ()
        if node.number not in self._counted:
            groups = self._groups(node)
            self._counted[node.number] = tuple((group, len(own)) for group, own in groups.items())
        return self._counted[node.number]

    def _try(self, nodes: Sequence[Node]) -> Pack | None:
        """A pack of nodes, if they are alike and no loop would wait for itself."""
        shapes = {self._shape(node) for node in nodes}
        if len(shapes) > 1 or not self._independent(nodes):
            return None
        if shapes.pop():
            return self._reduction(nodes)
        if len(nodes) < _FEWEST or len({(n.op, len(n.args)) for n in nodes}) > 1:
            return None
        return self._elementwise(nodes)

    def _register(self, nodes: Sequence[Node], op: str) -> Pack:
        made = Pack(tuple(nodes), op)
        self.packing.home.update({n.number: (made, i) for i, n in enumerate(nodes)})
        return made

    def _elementwise(self, nodes: Sequence[Node]) -> Pack | None:
        if not nodes[0].args:
            return None
        packing = self.packing
        before = Packing(dict(packing.home), list(packing.columns), dict(packing.column))
        made = self._register(nodes, nodes[0].op)
        columns = list(zip(*(ordered(n) for n in nodes), strict=True))
        if len(columns) == 2 and set(columns[0]).isdisjoint(columns[1]):
            # Both sides of a product may come out of one loop.
            self._operand([*columns[0], *columns[1]])
        for arguments in columns:
            made.operands.append(self._operand(arguments))
        kinds = {operand.kind for operand in made.operands}
        if "gather" in kinds and not kinds & {"table", "pack", "input"}:
            self._restore(before)  # moving numbers into arrays and out again is no gain
            return None
        return made

    def _restore(self, before: Packing) -> None:
        packing = self.packing
        packing.home.clear()
        packing.home.update(before.home)
        packing.columns[:] = before.columns
        packing.column.clear()
        packing.column.update(before.column)

    def _reduction(self, nodes: Sequence[Node]) -> Pack:
        made = self._register(nodes, _FAMILY[nodes[0].op])
        groups = [self._groups(node) for node in nodes]
        for group, first in groups[0].items():
            sign = group[0]
            if len(first) >= _FEWEST:
                every = [own[group][i] for i in range(len(first)) for own in groups]
                made.terms.append((sign, self._operand(every)))
                continue
            for i in range(len(first)):
                made.lone.append((sign, self._operand([own[group][i] for own in groups])))
        return made

    def _operand(self, nodes: Sequence[Node]) -> Operand:
        unique = list({node.number: node for node in nodes}.values())
        place = {node.number: i for i, node in enumerate(unique)}
        index = tuple(place[node.number] for node in nodes)
        kinds = {kind(node) for node in unique}
        homes = {
            id(self.packing.home[n.number][0]) if n.number in self.packing.home else 0
            for n in unique
        }
        if len(unique) == 1 and homes == {0}:
            return Operand("node", unique[0], index)
        if "other" not in kinds:
            if kinds == {"constant"}:
                return Operand("constants", tuple(n.value for n in unique), index)
            return self._table(unique, index)
        if len({n.value[0] if n.op == "input" else None for n in unique} - {None}) == 1 and all(
            n.op == "input" for n in unique
        ):
            return Operand("input", unique[0].value[0], tuple(n.value[1] for n in nodes))
        if homes == {0}:
            made = self._try(unique)
            if made:
                return Operand("pack", made, index)
        if len(homes) == 1 and homes != {0}:
            own = self.packing.home[unique[0].number][0]
            return Operand("pack", own, tuple(self.packing.home[n.number][1] for n in nodes))
        return Operand("gather", tuple(unique), index)

    def _table(self, unique: Sequence[Node], index: tuple[int, ...]) -> Operand:
        """Columns of the table, side by side."""
        packing = self.packing
        known = [packing.column.get(node.number) for node in unique]
        first = known[0]
        if first is None or known != list(range(first, first + len(known))):
            first = len(packing.columns)
            for node in unique:
                packing.column.setdefault(node.number, len(packing.columns))
                packing.columns.append(node)
        return Operand("table", TABLE, tuple(first + i for i in index))

    def _independent(self, nodes: Sequence[Node]) -> bool:
        """Whether none of the nodes needs another of them, be it through loops already made."""
        wanted = {node.number for node in nodes}
        seen: set[int] = set()
        stack = [a for node in nodes for a in node.args]
        while stack:
            node = stack.pop()
            if node.number in wanted:
                return False
            if node.number in seen:
                continue
            home = self.packing.home.get(node.number)
            # A loop needs all that its members need.
            group = home[0].nodes if home else (node,)
            seen.update(member.number for member in group)
            stack.extend(a for member in group for a in member.args if a.number not in seen)
        return True


def _depth(key: tuple[object, ...]) -> int:
    assert isinstance(key[0], int)
    return key[0]
