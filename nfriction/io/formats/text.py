"""CSV as loggers write it: any separator, decimal commas, a row of units, odd encodings.

The header determines the separator: a tab if it has one, else a semicolon, a comma, or blanks. The
decimal sign is the one with which all columns are numbers, the other sign separates thousands: a
single `0,5` or `1.234.567` decides for the whole file. A line `# decimal: ,` states it.
"""

import csv
import gzip
import io
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from nfriction.io.formats import MOST_COLUMNS, most_unpacked, refuse_bomb, refuse_size
from nfriction.io.formats.numbers import decimal_sign, is_number
from nfriction.io.formats.selection import is_unit

ATTRIBUTES = ("convention", "unit", "names")

_SEPARATORS = ("\t", ";", ",")
# Number of lines within which a table must begin, after its titles.
MOST_TITLES = 20
_NAMES = {"\t": "tabs", ";": "semicolons", ",": "commas", " ": "blanks"}


def read_csv(path: Path, _: object = ()) -> pd.DataFrame:
    """Table of text cells; `attrs` contain comments, units, aliases and the decimal sign."""
    return parse_csv(_decoded(path.read_bytes()))


def read_csv_gz(path: Path, _: object = ()) -> pd.DataFrame:
    with gzip.open(path) as file:
        content = file.read(most_unpacked(path.stat().st_size) + 1)
    refuse_bomb(len(content), path.stat().st_size)
    return parse_csv(_decoded(content))


def write_csv(table: pd.DataFrame) -> bytes:
    comments = [f"# {key}: {table.attrs[key]}\n" for key in ATTRIBUTES if key in table.attrs]
    return ("".join(comments) + table.to_csv(index=False, lineterminator="\n")).encode()


def write_csv_gz(table: pd.DataFrame) -> bytes:
    # Without the time of writing, equal recordings make equal files.
    return gzip.compress(write_csv(table), mtime=0)


def parse_csv(text: str) -> pd.DataFrame:
    """Table of a CSV text."""
    # Only whole lines are comments, because a column may be called "enc #1".
    content = [line for line in io.StringIO(text) if line.strip() and not _is_comment(line)]
    if not content:
        raise ValueError("it has no header")
    content = _without_title(content)
    lines = content[:3]
    separator = _separator(lines[0].rstrip("\r\n"), lines[1:])
    header = next(csv.reader([lines[0]], delimiter=separator, skipinitialspace=True))
    most = max(len(line.split(None if separator == " " else separator)) for line in lines)
    if most > MOST_COLUMNS:
        raise ValueError(f"it has {most} columns, more than the limit of {MOST_COLUMNS}")
    table = pd.read_csv(
        io.StringIO("".join(content)),
        sep=r"\s+" if separator == " " else separator,
        # As text, because Python's float() is exact but the parser's default is not.
        dtype=str,
        skipinitialspace=True,
    )
    # pandas turns surplus cells into an index.
    if not isinstance(table.index, pd.RangeIndex):
        raise ValueError(
            "its rows have more cells than its header; with decimal commas, cells must be "
            "separated by semicolons or tabs"
        )
    names = [cell.strip() for cell in header]
    table.columns = _unique(str(column).strip() for column in table.columns)
    # A trailing separator creates a last column without name or content.
    unnamed = [c for c in table.columns if c.startswith("Unnamed: ") and table[c].isna().all()]
    table = table.drop(columns=unnamed)
    table, units = _without_units_row(table)
    aliases: dict[str, str] = {}
    for column in table.columns:
        # "time [s]" may also be called "time".
        named = re.fullmatch(r"(.*\S)\s*(\[[^\[\]]*\]|\([^()]*\))", column)
        if not named:
            continue
        if is_unit(named[2]):
            units.setdefault(column, named[2])
        # "position (left)" and "position (right)" have no common short name.
        alike = [c for c in table.columns if c.startswith((f"{named[1]} ", f"{named[1]}["))]
        if named[1] not in table.columns and (is_unit(named[2]) or alike == [column]):
            aliases.setdefault(named[1], column)
    repeated = sorted(n for n, count in Counter(names).items() if n and count > 1)
    settings = _comments(text)
    # Files that separate cells by commas hardly use commas in numbers.
    usual = "." if separator == "," else ","
    decimal, undecided = decimal_sign(table, settings.pop("decimal", None), usual)
    table.attrs.update(settings, units=units, aliases=aliases, repeated=repeated)
    table.attrs.update(decimal=decimal, undecided=undecided)
    return table


def _decoded(content: bytes) -> str:
    refuse_size(len(content), "bytes")
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16")
    if b"\0" in content:
        raise ValueError("it contains NUL bytes, so it is not text")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        # Older loggers use this encoding, in which every byte is a letter.
        return content.decode("latin-1")


def _comments(text: str) -> dict[str, str]:
    """Settings in comment lines before the header."""
    found = {}
    for line in io.StringIO(text):
        if not _is_comment(line):
            break
        key, _, value = line.lstrip()[1:].partition(":")
        if key.strip() in (*ATTRIBUTES, "decimal"):
            found[key.strip()] = value.strip()
    return found


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("#")


def _without_title(lines: list[str]) -> list[str]:
    """The lines from the header on, below titles and settings of a logger.

    The header is the first line of words that names all columns of the first row of numbers but
    one; without such a row, the first line with several cells.
    """
    head = lines[:MOST_TITLES]
    usual = (s for s in _SEPARATORS if 2 * sum(s in line for line in head) > len(head))
    separator = next(usual, None)
    cells = [[c.strip() for c in line.split(separator) if c.strip()] for line in head]
    first = next((k for k, row in enumerate(cells) if _are_numbers(row)), 0)
    for least, rows in ((max(2, len(cells[first]) - 1), cells[:first]), (2, cells)):
        for k, row in enumerate(rows):
            if len(row) >= least and not any(map(_is_numeric, row)):
                return lines[k:]
    return lines


def _is_numeric(cell: str) -> bool:
    """True for numbers with any signs for decimals and thousands, and for dates."""
    return re.fullmatch(r"[-+]?[\d.,]*\d[\d.,]*(e[-+]?\d+)?", cell, re.IGNORECASE) is not None


def _are_numbers(cells: list[str]) -> bool:
    """True for a row of numbers, which may contain some text; a setting begins with a word."""
    found = [*map(_is_numeric, cells)]
    return len(found) > 1 and found[0] and 2 * sum(found) > len(found)


def _separator(header: str, rows: list[str]) -> str:
    """The header's separator, unless the rows contradict it."""
    found = next((s for s in _SEPARATORS if s in header), None)
    if found is None:
        # A header of one word gives a table of one column.
        found = " " if len(header.split()) > 1 else ","
    for row in rows:
        # A separator that ranks before the header's cannot be part of a number.
        higher = _SEPARATORS[: _SEPARATORS.index(found)] if found in _SEPARATORS else _SEPARATORS
        other = next((s for s in higher if s in row and '"' not in row), None)
        if other is not None and not (found == " " and other == ","):
            raise ValueError(
                f"its header is separated by {_NAMES[found]}, its rows by {_NAMES[other]}; "
                "use the same separator"
            )
    return found


def _unique(names: Iterable[str]) -> list[str]:
    """Names made unique as in pandas, but after blanks are stripped."""
    found: dict[str, None] = {}
    for name in names:
        own, k = name, 0
        while own in found:
            own, k = f"{name}.{k + 1}", k + 1
        found[own] = None
    return list(found)


def _without_units_row(table: pd.DataFrame) -> tuple[pd.DataFrame, dict[str, str]]:
    """The table without a row of units under its header, and those units by column."""
    if table.empty:
        return table, {}
    first = {c: str(cell).strip() for c, cell in table.iloc[0].items() if isinstance(cell, str)}
    if not first or any(is_number(cell) for cell in first.values()):
        return table, {}
    if not any(is_unit(cell) for cell in first.values()):
        return table, {}
    # Dimensionless columns have an empty or dashed unit.
    silent = {"", "[]", "[-]", "()", "(-)", "-"}
    units = {str(c): cell for c, cell in first.items() if cell not in silent}
    return table.iloc[1:].reset_index(drop=True), units
