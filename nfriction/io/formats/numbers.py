"""Numbers written as text: decimal points or commas, thousands with or without separators."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nfriction.io.files import shortened

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

# Decimal signs, and the thousands separator used with each.
THOUSANDS = {",": ".", ".": ","}
_NUMBER = {
    decimal: re.compile(
        rf"[+-]?(\d*|[1-9]\d{{0,2}}(\{thousands}\d{{3}})+)(\{decimal}\d*)?([eE][+-]?\d+)?", re.ASCII
    )
    for decimal, thousands in THOUSANDS.items()
}
_FOUR_DIGITS = re.compile(r"[+-]?\d{4}", re.ASCII)


def decimal_sign(table: pd.DataFrame, stated: str | None, usual: str) -> tuple[str, list[str]]:
    """The decimal sign of a table of text cells, and the columns that are ambiguous.

    `stated` is the sign that the file states, if it does; `usual` the guess if all columns can be
    read both ways and move equally smoothly. Without commas it is the point.
    """
    if stated is not None and stated not in THOUSANDS:
        raise ValueError(
            f"its line `# decimal:` must state , or . as the sign, got {stated[:20]!r}"
        )
    columns = {str(name): _texts(table[name]) for name in table.columns}
    comma = {name for name, cells in columns.items() if _fits(cells, ",")}
    if not comma and stated != ",":
        return ".", []
    point = {name for name, cells in columns.items() if _fits(cells, ".")}
    only_comma, only_point = comma - point, point - comma
    # In comma-separated files, quoted cells may contain anything.
    if only_comma and only_point and usual == ",":
        raise ValueError(
            f"column {min(only_comma)} has decimal commas and column {min(only_point)} decimal "
            "points; write all numbers in the same way"
        )
    found = "." if only_point else "," if only_comma else None
    if stated and found not in (stated, None):
        raise ValueError(
            f"column {min(only_point or only_comma)} has {found!r} as its decimal sign, the line "
            f"`# decimal:` states {stated!r}; correct one of them"
        )
    decimal = stated or found
    if decimal:
        return decimal, []
    undecided = sorted(comma & point)
    if not any("," in cell for name in undecided for cell in columns[name]):
        usual = "."
    # A mechanism moves smoothly: 999 is followed by 1,000 and not by 1.000.
    jumps = {
        sign: round(sum(_largest_jump(columns[name], sign) for name in undecided), 6)
        for sign in THOUSANDS
    }
    return min(jumps, key=lambda sign: (jumps[sign], sign != usual)), undecided


def column_numbers(table: pd.DataFrame, column: str) -> Array:
    """A column as float64; empty cells are NaN. A ValueError names a cell that is not a number."""
    cells = table[column].to_numpy(dtype=object, na_value=np.nan)
    # A table that was not read here states none: its text is read as Python does.
    decimal = str(table.attrs.get("decimal"))
    texts = _texts(table[column]) if decimal in THOUSANDS else []
    # Cells that are not such numbers stay unchanged, for the message.
    if texts and (decimal == "," or any("," in x for x in texts)) and _fits(texts, decimal):
        cells = np.array([_plain(c, decimal) if isinstance(c, str) else c for c in cells], object)
    try:
        return cells.astype(np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        row = next(row for row, cell in enumerate(cells) if not is_number(cell))
        got = shortened(repr(cells[row]), 80)
        if re.search(r"\d:\d\d", got):
            got += (
                "; give dates and clock times in seconds, as `(x - x[0]).dt.total_seconds()` with "
                "`x = pandas.to_datetime(...)`"
            )
        raise ValueError(
            f"column {column}, row {row} (counted from 0 below the header) must be a number, "
            f"got {got}."
        ) from error


def is_number(cell: object) -> bool:
    """True if Python reads the cell as a float."""
    try:
        float(cell)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return False
    return True


def _texts(cells: pd.Series) -> list[str]:
    return [cell.strip() for cell in cells if isinstance(cell, str)]


def _fits(cells: Sequence[str], decimal: str) -> bool:
    """True if cells with commas or points exist and are all numbers with this decimal sign."""
    form, thousands = _NUMBER[decimal], THOUSANDS[decimal]
    signed = (cell for cell in cells if "," in cell or "." in cell)
    if not all(form.fullmatch(cell) for cell in signed):
        return False
    grouped = any(thousands in cell for cell in cells)
    # A column has separators in all its thousands or in none.
    if grouped and any(_FOUR_DIGITS.match(cell) for cell in cells):
        return False
    return grouped or any(decimal in cell for cell in cells)


def _largest_jump(cells: Sequence[str], decimal: str) -> float:
    """Largest change from one cell to the next as a share of the column's range."""
    plain = (_plain(cell, decimal) for cell in cells)
    values = np.array([float(text) for text in plain if is_number(text)])
    span = float(np.ptp(values)) if len(values) else 0.0
    return float(np.abs(np.diff(values)).max()) / span if span else 0.0


def _plain(cell: str, decimal: str) -> str:
    """A number as Python writes it."""
    return cell.replace(THOUSANDS[decimal], "").replace(decimal, ".")
