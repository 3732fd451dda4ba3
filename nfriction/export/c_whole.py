"""Whole numbers of a model, such as its status, in the arithmetic of C's int."""

from collections.abc import Mapping

from nfriction.codegen.emit import expression
from nfriction.codegen.scalar import Node
from nfriction.export.c_dialect import ControllerC


def _is_whole(node: Node) -> bool:
    """Whether a number is whole because of how it is made."""
    if node.op == "constant":
        return isinstance(node.value, float) and node.value.is_integer() and abs(node.value) < 2**15
    if node.op == "where":
        return _is_whole(node.args[1]) and _is_whole(node.args[2])
    return node.op in ("add", "sub", "mul", "trunc") and all(_is_whole(a) for a in node.args)


def whole_leaves(node: Node) -> list[Node]:
    """What has to be computed as it is for a whole number."""
    if not _is_whole(node):
        return [node]
    if node.op == "where":
        return [node.args[0], *whole_leaves(node.args[1]), *whole_leaves(node.args[2])]
    return [leaf for a in node.args for leaf in whole_leaves(a)]


def whole(node: Node, texts: Mapping[int, str], dialect: ControllerC) -> str:
    """A whole number in the arithmetic of int."""
    if not _is_whole(node):
        return f"(int)({texts[node.number]})"
    if node.op == "constant":
        return f"{int(node.value)}" if node.value >= 0 else f"({int(node.value)})"
    if node.op == "trunc":
        return whole(node.args[0], texts, dialect)
    if node.op == "where":
        test, a, b = texts[node.args[0].number], *(whole(x, texts, dialect) for x in node.args[1:])
        return f"(({test}) ? {a} : {b})"
    text, _ = expression(node.op, [(whole(a, texts, dialect), 0) for a in node.args], dialect)
    return text
