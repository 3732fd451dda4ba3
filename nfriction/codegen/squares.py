"""Complete the squares of quadratic forms: `q x² + l x + c` becomes `q (x - m)² + c'`.

Vectorised code expands distances into products of matrices, which is fast on many samples. On one
sample the expanded form only costs digits: large terms of both signs cancel, which single
precision feels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nfriction.codegen.finite import rebuilt
from nfriction.codegen.joints import TABLE, Template
from nfriction.codegen.scalar import Node, UpdateRate, reachable

# A constant this small beside what it is the difference of, in units of rounding, is none.
_NOTHING = 8.0 * float(np.finfo(np.float64).eps)


def completed(one: Template) -> Template:
    """The template with quadratic forms as sums of squares."""
    rewriter = _Rewriter(one)
    nodes = [node for group in one.outputs for node in group]
    found = rebuilt(one.graph, nodes, rewriter.rule)
    outputs, start = [], 0
    for group in one.outputs:
        outputs.append(tuple(found[start : start + len(group)]))
        start += len(group)
    return replace(one, outputs=tuple(outputs), table=np.stack(rewriter.columns, -1)
                   if rewriter.columns else one.table)  # fmt: skip


@dataclass
class _Form:
    """Terms of a sum by what they multiply."""

    square: dict[int, np.ndarray]
    linear: dict[int, np.ndarray]
    bases: dict[int, Node]
    constant: np.ndarray
    rest: list[Node]


class _Rewriter:
    def __init__(self, one: Template) -> None:
        self.one, self.graph = one, one.graph
        self.columns = list(one.table.T)
        nodes = reachable([node for group in one.outputs for node in group])
        self._uses: dict[int, int] = {}
        for node in (a for n in nodes for a in n.args):
            self._uses[node.number] = self._uses.get(node.number, 0) + 1
        self._inner = {
            a.number for n in nodes if n.op == "add" for a in n.args if self._continues(a)
        }

    def rule(self, node: Node, args: tuple[Node, ...]) -> Node | None:
        """A rewritten sum at its root; the sums inside it are left to it."""
        if node.op != "add" or node.number in self._inner:
            return None
        form = self._form(self._terms(args, node.args))
        pairs = [
            n for n in form.square
            if n in form.linear and (form.square[n] != 0).all()
        ]  # fmt: skip
        if len(pairs) < 2:
            return None
        terms, size = list(form.rest), np.abs(form.constant)
        for n in pairs:
            q, linear = form.square[n], form.linear[n]
            terms.append(self._square(q, form.bases[n], -0.5 * linear / q))
            removed = 0.25 * linear * linear / q
            form.constant = form.constant - removed
            size = size + np.abs(removed)
        for n, q in form.square.items():
            if n not in pairs:
                base = form.bases[n]
                terms.append(self._times(q, self.graph.apply("mul", base, base)))
        for n, linear in form.linear.items():
            if n not in pairs:
                terms.append(self._times(linear, form.bases[n]))
        total = self.graph.total(terms)
        if (np.abs(form.constant) <= _NOTHING * size).all():
            return total
        return self.graph.apply("add", self._known(form.constant), total)

    def _continues(self, node: Node) -> bool:
        return node.op == "add" and self._uses.get(node.number, 0) == 1

    def _terms(self, args: Sequence[Node], originals: Sequence[Node]) -> list[Node]:
        """Terms of a sum whose arguments are rebuilt; single-use sums inside are entered."""
        terms: list[Node] = []
        for argument, original in zip(args, originals, strict=True):
            if self._continues(original) and argument is original:
                terms += self._terms(argument.args, argument.args)
            else:
                terms.append(argument)
        return terms

    def _form(self, terms: Sequence[Node]) -> _Form:
        form = _Form({}, {}, {}, np.zeros(self.one.joints), [])
        for term in terms:
            own = self._values(term)
            if own is not None:
                form.constant = form.constant + own
                continue
            factor, base = self._factor(term)
            if factor is None:
                form.rest.append(term)
                continue
            squared = base.op == "mul" and base.args[0] is base.args[1]
            base = base.args[0] if squared else base
            side = form.square if squared else form.linear
            form.bases[base.number] = base
            side[base.number] = side.get(base.number, np.zeros(self.one.joints)) + factor
        return form

    def _factor(self, term: Node) -> tuple[np.ndarray | None, Node]:
        """A known factor of a term and what it multiplies."""
        if term.op == "mul":
            for known, other in (term.args, term.args[::-1]):
                values = self._values(known)
                if values is not None:
                    return values, other
        return None, term

    def _square(self, q: np.ndarray, base: Node, middle: np.ndarray) -> Node:
        """`q (base - middle)²`; a shift that the base has already is taken into the middle."""
        if base.op == "sub":
            shift = self._values(base.args[1])
            if shift is not None:
                base, middle = base.args[0], middle + shift
        distance = self.graph.apply("sub", base, self._known(middle))
        return self._times(q, self.graph.apply("mul", distance, distance))

    def _times(self, factor: np.ndarray, node: Node) -> Node:
        return self.graph.apply("mul", self._known(factor), node)

    def _values(self, node: Node) -> np.ndarray | None:
        if node.op == "constant" and isinstance(node.value, float):
            return np.full(self.one.joints, node.value)
        if node.op == "input" and node.value[0] == TABLE:
            return self.columns[node.value[1]]
        return None

    def _known(self, values: np.ndarray) -> Node:
        self.columns.append(values)
        return self.graph.input(TABLE, len(self.columns) - 1, UpdateRate.PARAMETER)
