"""Places in arrays as C expressions of the variables of the loops around them."""

from collections.abc import Sequence

import numpy as np

Loop = tuple[str, int]
"""Variable and count of a loop; a number in place of a variable is that round of it."""

LANE = "j"
"""Variable that counts the lanes: what is computed for several joints at a time."""


def affine(index: Sequence[int], counts: Sequence[int]) -> tuple[int, tuple[int, ...]] | None:
    """Start and step by loop, if `index` is linear in the variables of loops of these counts.

    Args:
        index: a number for every round, the last loop running fastest.
        counts: of the loops, the outermost first.
    """
    grid = np.asarray(index).reshape(counts)
    start = grid.flat[0]
    steps = [int(grid.take(1, a).flat[0] - start) if n > 1 else 0 for a, n in enumerate(counts)]
    if (grid != start + np.tensordot(steps, np.indices(counts), 1)).any():
        return None
    return int(start), tuple(steps)


def place(index: Sequence[int], loops: Sequence[Loop], lanes: int = 1) -> str | None:
    """`index` as an expression of the loops' variables; None where it is none.

    Args:
        index: a number for every round of the loops, the last one running fastest.
        loops: around the expression, the outermost first.
        lanes: how many numbers lie side by side at every place, `LANE` counting them.
    """
    loops = list(loops)
    while len(loops) > 1 and loops[0][0].isdigit():
        size = len(index) // loops[0][1]
        start = size * int(loops[0][0])
        index, loops = index[start : start + size], loops[1:]
    loops = [loop for loop in loops if loop[1] > 1] or loops[-1:]
    variables, counts = zip(*loops, strict=True)
    found = affine(index, counts)
    if found is None and len(loops) == 1:
        variable, count = loops[0]
        for divisor in (d for d in range(2, count) if count % d == 0):
            found = affine(index, (count // divisor, divisor))
            if found is not None:
                variables = (f"{variable} / {divisor}", f"{variable} % {divisor}")
                break
    return None if found is None else _total(*found, variables, lanes)


def at(number: int, lanes: int = 1) -> str:
    """The expression of one place."""
    return _total(number, (), (), lanes)


def regular(indices: Sequence[Sequence[int]], count: int) -> list[Loop]:
    """One loop, or two where that makes places in all arrays linear in their variables."""
    if not all(affine(index, (count,)) for index in indices):
        for columns in (d for d in range(2, count) if count % d == 0):
            if all(affine(index, (count // columns, columns)) for index in indices):
                return [("k", count // columns), ("i", columns)]
    return [("i", count)]


def _total(start: int, steps: Sequence[int], variables: Sequence[str], lanes: int) -> str:
    parts = []
    for step, variable in zip(steps, variables, strict=True):
        if variable.isdigit():
            start += step * int(variable)
        elif step:
            inner = f"({variable})" if " " in variable else variable
            parts.append(variable if step * lanes == 1 else f"{step * lanes} * {inner}")
    lane = [LANE] if lanes > 1 else []
    first = [str(start * lanes)] if start or not (parts or lane) else []
    return " + ".join([*first, *parts, *lane])
