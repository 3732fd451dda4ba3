"""Functions for numba in which sin, cos, exp and tanh are computed four at a time.

As in C (see `lanes`), calls that do not wait for each other are collected; `vectors` computes them.
"""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from nfriction.codegen.emit import Python, python_text, statements
from nfriction.codegen.lanes import FAMILY, WIDTH, phases
from nfriction.codegen.scalar import Node, reachable


def prelude() -> str:
    """The import of the collected functions.

    numba keeps machine code as long as the text stays the same, so their text counts with it.
    """
    digest = hashlib.sha256()
    for name in ("vectors.py", "lanes.py", "straight.py"):
        digest.update(Path(__file__).with_name(name).read_bytes())
    return (
        f"from nfriction.codegen.vectors import exp4, sincos4, tanh4  # {digest.hexdigest()[:16]}\n"
    )


def function(
    name: str,
    arguments: Sequence[str],
    outputs: Sequence[Node],
    bound: Mapping[int, str],
    into: Sequence[str] = (),
) -> str:
    """A function that returns `outputs` as a tuple, or assigns them to elements `into`."""
    return python_text(name, arguments, *_body(outputs, dict(bound)), into)


def _body(outputs: Sequence[Node], bound: dict[int, str]) -> tuple[list[str], list[str]]:
    """Statements phase by phase, and one expression per output."""
    nodes = reachable(outputs, [n for n in reachable(outputs) if n.number in bound])
    phase = phases(nodes, bound)
    lines: list[str] = []
    for now in range(max(phase.values(), default=0)):
        calls = [
            n for n in nodes
            if n.op in FAMILY and n.number not in bound and phase[n.number] == now
        ]  # fmt: skip
        # What a later phase reads too gets a name that outlives this one.
        kept = {
            a.number: a
            for n in nodes
            for a in n.args
            if phase[n.number] > now and phase[a.number] <= now and a.args
            and a.number not in bound and a.op not in FAMILY
        }  # fmt: skip
        given = list({n.args[0].number: n.args[0] for n in calls}.values())
        more, texts = statements([*given, *kept.values()], bound, Python())
        lines += more
        for node, text in zip(kept.values(), texts[len(given) :], strict=True):
            lines.append(f"k{node.number} = {text}")
        text_of = dict(zip((n.number for n in given), texts, strict=False))
        for family in dict.fromkeys(FAMILY[n.op] for n in calls):
            same = [n for n in calls if FAMILY[n.op] == family]
            _collect(family, same, text_of, lines, bound)
        bound |= {number: f"k{number}" for number in kept}
    more, texts = statements(outputs, bound, Python())
    return lines + more, texts


def _collect(
    family: str,
    calls: Sequence[Node],
    text_of: Mapping[int, str],
    lines: list[str],
    bound: dict[int, str],
) -> None:
    """Calls of one family that do not wait for each other; their results are bound to names."""
    arguments = list(dict.fromkeys(node.args[0].number for node in calls))
    results = ("sin", "cos") if family == "sincos" else (family,)
    for first in range(0, len(arguments), WIDTH):
        numbers = arguments[first : first + WIDTH]
        idle = WIDTH - len(numbers)
        names = [n for r in results for n in [*(f"{r}_{i}" for i in numbers), *["_"] * idle]]
        texts = [*(text_of[number] for number in numbers), *["0.0"] * idle]
        lines.append(f"{', '.join(names)} = {family}4({', '.join(texts)})")
    for node in calls:
        bound[node.number] = f"{node.op}_{node.args[0].number}"
