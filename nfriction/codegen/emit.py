"""Scalar nodes as LLVM IR, one number at a time or a vector of independent ones.

Products are fused into sums here, depending only on the graph, and not by LLVM, so the same graph
gives bitwise identical results for a single candidate and in a batch.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby

from nfriction.codegen.ir import Body, real, truth
from nfriction.codegen.scalar import Node, is_predicate, reachable

_FAMILIES = {"sin": "sincos", "cos": "sincos", "exp": "exp", "tanh": "tanh"}
VECTORISED = frozenset(_FAMILIES)
_ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv", "fmod": "frem"}
_COMPARISONS = {"lt": "olt", "le": "ole", "eq": "oeq", "ne": "une"}
_INTRINSICS = {"abs": "fabs", "sqrt": "sqrt", "floor": "floor", "ceil": "ceil", "trunc": "trunc"}


def write_function(
    body: Body,
    name: str,
    outputs: Mapping[str, Sequence[Node]],
    places: Mapping[int, tuple[str, int]],
    shared: Sequence[str],
    inputs: Sequence[str],
    width: int = 0,
    seldom: bool = False,
) -> None:
    """Write a function of arrays.

    Args:
        outputs: nodes, by the name of the array to which they are written.
        places: array and index of each given node.
        shared: names of the arrays that never change and have one number per element.
        inputs: names of the other arrays that are read; an output may be one of them, because all
            of them are read before any is written.
        width: numbers per element of `inputs` and `outputs`, consecutive in memory; 0 for one.
        seldom: the function runs once per rollout, so short code matters more than speed.
    """
    given = [*shared, *dict.fromkeys([*inputs, *outputs])]
    heads = [f"ptr {'noalias readonly ' if a in shared else ''}%{a}" for a in given]
    with body.function(f"define internal void @{name}({', '.join(heads)}) nounwind"):
        vectorised = frozenset() if seldom else VECTORISED
        _Writer(body, places, shared, width, vectorised).write(outputs)
        body.run("ret void")


class _Writer:
    """Statements of one function."""

    def __init__(
        self,
        body: Body,
        places: Mapping[int, tuple[str, int]],
        shared: Sequence[str],
        width: int,
        vectorised: frozenset[str],
    ) -> None:
        self.body = body
        self.vectorised = vectorised
        self.places = places
        self.shared = frozenset(shared)
        self.width = width
        self.text: dict[int, str] = {}
        self.targets: dict[int, list[tuple[str, int]]] = {}
        self.results: dict[tuple[str, int], Sequence[str]] = {}  # by function and argument
        self.fused: dict[int, int] = {}  # position of the product fused into a sum, by node number
        self.absorbed: set[int] = set()

    def write(self, groups: Mapping[str, Sequence[Node]]) -> None:
        """Compute outputs; arrays that are not shared are loaded before anything is stored."""
        outputs = [node for group in groups.values() for node in group]
        order = reachable(outputs, self.places)
        # An output may be an input array, so a store could destroy values not yet read.
        for node in order:
            if node.number in self.places and self.places[node.number][0] not in self.shared:
                self._value(node)
        self._fuse(order, outputs)
        for array, group in groups.items():
            for i, node in enumerate(group):
                self.targets.setdefault(node.number, []).append((array, i))
        if self.width:
            for node in order:
                self._node(node)
        else:
            self._phases(order)

    def _value(self, node: Node) -> str:
        """The text of a node's value."""
        found = self.text.get(node.number)
        if found is None:
            if node.op == "constant":
                found = self.body.constant(node.value, self.width)
            elif node.number in self.places:
                found = self._load(*self.places[node.number])
            else:
                raise AssertionError(f"{node!r} has no value here")
            self.text[node.number] = found
        return found

    def _number(self, node: Node) -> str:
        """The value as a number: true is one."""
        text = self._value(node)
        if not is_predicate(node):
            return text
        return self.body.let(f"uitofp {truth(self.width)} {text} to {real(self.width)}")

    def _truth(self, node: Node) -> str:
        """The value as a truth value: anything except zero is true, including NaN."""
        text = self._value(node)
        if is_predicate(node):
            return text
        zero = self.body.constant(0.0, self.width)
        return self.body.let(f"fcmp une {real(self.width)} {text}, {zero}")

    def _load(self, array: str, index: int) -> str:
        if array not in self.shared:
            return self.body.load(f"%{array}", index, real(self.width))
        one, kind = self.body.load(f"%{array}", index), real(self.width)
        if not self.width:
            return one
        first = self.body.let(f"insertelement {kind} poison, double {one}, i64 0")
        every = f"<{self.width} x i32> zeroinitializer"
        return self.body.let(f"shufflevector {kind} {first}, {kind} poison, {every}")

    def _fuse(self, order: Sequence[Node], outputs: Sequence[Node]) -> None:
        """Find products that are used only by one sum."""
        computed = [n for n in order if n.number not in self.places]
        uses = Counter(a.number for n in computed for a in n.args)
        uses.update(n.number for n in outputs)
        for node in computed:
            if node.op not in ("add", "sub"):
                continue
            for i in (1, 0):
                factor = node.args[i]
                alone = uses[factor.number] == 1 and factor.number not in self.places
                if factor.op == "mul" and alone:
                    self.fused[node.number] = i
                    self.absorbed.add(factor.number)
                    break

    def _phases(self, order: Sequence[Node]) -> None:
        """Write all nodes; mutually independent calls share vectors."""
        phase: dict[int, int] = {}
        for node in order:
            before = [] if node.number in self.places else node.args
            phase[node.number] = max(
                (phase[a.number] + self._collects(a) for a in before), default=0
            )
        for _, group in groupby(sorted(order, key=lambda n: (phase[n.number], n.number)),
                                lambda n: phase[n.number]):  # fmt: skip
            calls: dict[str, list[Node]] = {}
            for node in group:
                if self._collects(node):
                    calls.setdefault(_FAMILIES[node.op], []).append(node)
                else:
                    self._node(node)
            for family, nodes in calls.items():
                self._collected(family, nodes)

    def _collects(self, node: Node) -> bool:
        return node.op in self.vectorised and node.number not in self.places

    def _collected(self, family: str, calls: Sequence[Node]) -> None:
        body = self.body
        arguments = list({n.args[0].number: n.args[0] for n in calls}.values())
        while arguments:
            width = 4 if len(arguments) <= 4 else 8
            taken, arguments = arguments[:width], arguments[width:]
            kind, x = real(width), "zeroinitializer"
            for i, argument in enumerate(taken):
                one = self._number(argument)
                x = body.let(f"insertelement {kind} {x}, double {one}, i64 {i}")
            found = body.family(family, x, width)
            for i, argument in enumerate(taken):
                self.results[family, argument.number] = [
                    body.let(f"extractelement {kind} {y}, i64 {i}") for y in found
                ]
        for node in calls:
            self._node(node)

    def _node(self, node: Node) -> None:
        if node.number in self.absorbed:
            return
        if node.args and node.number not in self.places:
            self.text[node.number] = self._expression(node)
        for array, i in self.targets.get(node.number, ()):
            self.body.store(self._number(node), f"%{array}", i, real(self.width))

    def _expression(self, node: Node) -> str:
        body, op, args, kind = self.body, node.op, node.args, real(self.width)
        if node.number in self.fused:
            return self._sum_of_product(node)
        if op in ("eq", "ne") and all(is_predicate(a) for a in args):
            a, b = map(self._value, args)
            return body.let(f"icmp {op} {truth(self.width)} {a}, {b}")
        if op in ("and", "or"):
            a, b = map(self._truth, args)
            return body.let(f"{op} {truth(self.width)} {a}, {b}")
        if op == "not":
            true = body.constant(True, self.width)
            return body.let(f"xor {truth(self.width)} {self._truth(args[0])}, {true}")
        if op == "where":
            chosen = self._value if is_predicate(node) else self._number
            of = truth(self.width) if is_predicate(node) else kind
            condition, a, b = self._truth(args[0]), chosen(args[1]), chosen(args[2])
            return body.let(f"select {truth(self.width)} {condition}, {of} {a}, {of} {b}")
        operands = [self._number(a) for a in args]
        if op in _ARITHMETIC:
            return body.let(f"{_ARITHMETIC[op]} {kind} {operands[0]}, {operands[1]}")
        if op in _COMPARISONS:
            return body.let(f"fcmp {_COMPARISONS[op]} {kind} {operands[0]}, {operands[1]}")
        if op == "neg":
            return body.let(f"fneg {kind} {operands[0]}")
        if op in ("max", "min"):
            return self._extreme("ogt" if op == "max" else "olt", *operands)
        if op in _INTRINSICS:
            return body.call(_INTRINSICS[op], operands, self.width)
        if op in self.vectorised:
            key = _FAMILIES[op], args[0].number
            if key not in self.results:
                self.results[key] = body.family(_FAMILIES[op], operands[0], self.width)
            return self.results[key][-1 if op == "cos" else 0]
        return body.each(op, [f"{kind} {x}" for x in operands], self.width)

    def _sum_of_product(self, node: Node) -> str:
        """A product and a sum with a single rounding (fused multiply-add)."""
        place = self.fused[node.number]
        a, b = (self._number(f) for f in node.args[place].args)
        other = self._number(node.args[1 - place])
        if node.op == "sub":
            minus = f"fneg {real(self.width)} "
            if place == 1:
                a = self.body.let(minus + a)
            else:
                other = self.body.let(minus + other)
        return self.body.call("fmuladd", [a, b, other], self.width)

    def _extreme(self, sign: str, a: str, b: str) -> str:
        """The larger or smaller value; NaN is propagated."""
        kind, test = real(self.width), truth(self.width)
        first = self.body.let(f"fcmp {sign} {kind} {a}, {b}")
        missing = self.body.let(f"fcmp uno {kind} {a}, {a}")
        either = self.body.let(f"or {test} {first}, {missing}")
        return self.body.let(f"select {test} {either}, {kind} {a}, {kind} {b}")
