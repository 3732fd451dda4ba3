"""Scalar nodes as expressions and statements of C.

Values used once are written where they are used, the others become constants of the function.
The text depends on the graph alone, so the same model gives the same bytes.
"""

from collections.abc import Mapping, Sequence

from nfriction.codegen.scalar import Node, is_predicate, reachable
from nfriction.export.c_code.dialect import ControllerC

_INLINE = 64  # characters; longer single-use values get a line of their own

# How tightly an operator binds; an atom or a call binds tightest.
ATOM, _UNARY, _PRODUCT, _SUM, _COMPARE, _NOT, _AND, _OR = 9, 8, 7, 6, 5, 4, 3, 2
_INFIX = {
    "add": ("+", _SUM),
    "sub": ("-", _SUM),
    "mul": ("*", _PRODUCT),
    "div": ("/", _PRODUCT),
    "lt": ("<", _COMPARE),
    "le": ("<=", _COMPARE),
    "eq": ("==", _COMPARE),
    "ne": ("!=", _COMPARE),
}


def statements(
    outputs: Sequence[Node], bound: Mapping[int, str], dialect: ControllerC
) -> tuple[list[str], list[str]]:
    """Definitions of local values, and one expression per output.

    Args:
        outputs: nodes to express.
        bound: text of nodes that are already at hand (inputs, hoisted values), by node number.
        dialect: the language.
    """
    nodes = reachable(outputs, [n for n in reachable(outputs) if n.number in bound])
    uses: dict[int, int] = {}
    for node in nodes:
        if node.number not in bound:
            for argument in node.args:
                uses[argument.number] = uses.get(argument.number, 0) + 1
    for node in outputs:
        uses[node.number] = uses.get(node.number, 0) + 1
    lines: list[str] = []
    texts: dict[int, tuple[str, int]] = {}

    def write(node: Node) -> None:
        if node.number in bound:
            texts[node.number] = bound[node.number], ATOM
        elif node.op == "constant":
            texts[node.number] = dialect.literal(node.value), ATOM
        elif node.op == "input":
            raise AssertionError(f"input {node.value} has no name here")
        else:
            text, binding = expression(node.op, [texts[a.number] for a in node.args], dialect)
            if uses[node.number] > 1 or len(text) > _INLINE:
                name = f"t{len(lines)}"
                kind = "int" if is_predicate(node) else dialect.real
                lines.append(f"const {kind} {name} = {text};")
                text, binding = name, ATOM
            texts[node.number] = text, binding

    for node in nodes:
        write(node)
    return lines, [texts[node.number][0] for node in outputs]


def expression(
    op: str, operands: Sequence[tuple[str, int]], dialect: ControllerC
) -> tuple[str, int]:
    """Text of an operation, and how tightly it binds, of operands given likewise."""

    def operand(i: int, binding: int) -> str:
        text, own = operands[i]
        return text if own >= binding else f"({text})"

    if op in _INFIX:
        sign, binding = _INFIX[op]
        # Compilers warn of comparisons side by side.
        left = operand(0, binding + (binding == _COMPARE))
        return f"{left} {sign} {operand(1, binding + 1)}", binding
    if op == "neg":
        return f"-{operand(0, ATOM)}", _UNARY
    if op == "not":
        return f"!{operand(0, ATOM)}", _NOT
    if op in ("and", "or"):
        sides = [operand(i, ATOM) for i in range(len(operands))]
        return (" && ".join(sides), _AND) if op == "and" else (" || ".join(sides), _OR)
    if op == "where":
        condition, a, b = (operand(i, _SUM) for i in range(3))
        return f"({condition} ? {a} : {b})", ATOM
    return dialect.call(op, [text for text, _ in operands]), ATOM
