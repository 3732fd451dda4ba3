"""From a table's columns to a recording's arrays: names, units, numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from nfriction.formats.units import canonical_unit, is_unit, slides, to_si

Array = NDArray[np.float64]

OURS = re.compile(r"time|(q|qd|tau)[1-9]\d{0,3}", re.ASCII)


class Source(NamedTuple):
    """A column of a table and the unit it is said to be in."""

    column: str
    unit: str | None


class Arrays(NamedTuple):
    """What a table holds of a recording, in SI.

    Attributes:
        values: time, q and, where every joint has them, qd and tau.
        slides: whether positions are said to be lengths; None where nothing is said.
    """

    values: dict[str, Array]
    slides: bool | None


def table_arrays(
    table: pd.DataFrame, columns: Mapping[str, str] | None = None, *, degrees: bool = False
) -> Arrays:
    """Arrays time, q and, where every joint has them, qd and tau.

    Args:
        table: with columns time, q1 …, perhaps qd1 …, tau1 …; others are ignored.
        columns: the table's name for ours where they differ, perhaps with a unit: "enc_1:deg".
        degrees: positions and velocities that say no unit are in degrees.
    Raises:
        ValueError: a column or unit that is missing, unknown or contradicts another.
    """
    # A table made elsewhere may number its columns.
    table = table.set_axis([str(name) for name in table.columns], axis=1)
    columns = {key: str(name) for key, name in (columns or {}).items()}
    sources = _sources(table, columns)
    joints = max((int(key[1:]) for key in sources if re.fullmatch(r"q\d+", key)), default=1)
    # Of a lone q9999 one missing column tells enough.
    needed = ["time", *(f"q{k + 1}" for k in range(min(joints, len(sources) + 1)))]
    missing = [key for key in needed if key not in sources]
    if missing:
        raise ValueError(_missing(table, columns, missing))
    arrays = {"time": _column(table, "time", sources["time"])}
    for key in ("q", "qd", "tau"):
        group = [sources.get(f"{key}{k + 1}") for k in range(joints)]
        present = [_default_unit(key, s, degrees) for s in group if s is not None]
        if len(present) == joints:
            arrays[key] = np.stack([_column(table, key, s) for s in present], axis=1)
    said = [s.unit for key, s in sources.items() if re.fullmatch(r"q\d+", key) and s.unit]
    kinds = {slides(unit) for unit in said}
    if len(kinds) > 1:
        raise ValueError(f"positions must all be angles or all be lengths, got {', '.join(said)}.")
    return Arrays(arrays, kinds.pop() if kinds else None)


def parse_source(spec: str, names: set[str]) -> Source | None:
    """The column that a specification such as "enc_1" or "enc_1:deg" names, None if not there."""
    stem, _, unit = spec.rpartition(":")
    if spec in names:
        return Source(spec, None)
    return Source(stem, unit) if stem in names and is_unit(unit) else None


def column_numbers(table: pd.DataFrame, column: str) -> Array:
    """A column as float64; empty cells are NaN, a cell that is no number is named."""
    cells = table[column].to_numpy(dtype=object, na_value=np.nan)
    try:
        return cells.astype(np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        row = next(row for row, cell in enumerate(cells) if not _is_number(cell))
        shown = repr(cells[row])
        raise ValueError(
            f"column {column}, row {row} (counted from 0 below the header) must be a number, "
            f"got {shown if len(shown) < 80 else shown[:77] + '...'}."
        ) from error


def _sources(table: pd.DataFrame, columns: dict[str, str]) -> dict[str, Source]:
    """Where each of time, q1 … comes from."""
    unknown = [key for key in columns if not OURS.fullmatch(key)]
    if unknown:
        raise ValueError(
            f"`columns` maps time, q1 …, qd1 …, tau1 … to the file's names, got keys {unknown}."
        )
    names = set(table.columns)
    aliases = _texts(table, "aliases")
    mapped = {
        key: parse_source(spec, names) or parse_source(spec, set(aliases))
        for key, spec in columns.items()
    }
    found = {key: source for key, source in mapped.items() if source is not None}
    claimed = {aliases.get(s.column, s.column) for s in found.values()}
    for name in (*names, *aliases):
        if OURS.fullmatch(name) and name not in columns and aliases.get(name, name) not in claimed:
            found[name] = Source(name, None)
    return {key: _known(table, aliases, source) for key, source in found.items()}


def _known(table: pd.DataFrame, aliases: dict[str, str], source: Source) -> Source:
    """A source by the table's own name for it, with the unit that the file says."""
    column = aliases.get(source.column, source.column)
    if column in table.attrs.get("repeated", ()) or (table.columns == column).sum() > 1:
        raise ValueError(f"column {column} is there more than once; rename one of them.")
    said = _texts(table, "units").get(column)
    if source.unit and said and not is_unit(said):
        said = None  # a word of the user's own; what he says counts
    if source.unit and said and canonical_unit(said) != canonical_unit(source.unit):
        raise ValueError(
            f"column {column} is said to be in {source.unit!r}, but the file says {said!r}."
        )
    return Source(column, source.unit or said)


def _default_unit(key: str, source: Source, degrees: bool) -> Source:
    if not degrees or key not in ("q", "qd"):
        return source
    unit = "deg" if key == "q" else "deg/s"
    if source.unit and canonical_unit(source.unit) != unit:
        raise ValueError(
            f"`degrees=True`, but column {source.column} is said to be in {source.unit!r}; "
            f"drop one of the two."
        )
    return Source(source.column, unit)


def _column(table: pd.DataFrame, kind: str, source: Source) -> Array:
    values = column_numbers(table, source.column)
    if source.unit is None:
        return values
    try:
        return to_si(kind, values, source.unit)
    except ValueError as error:
        raise ValueError(f"column {source.column}: {error}") from error


def _missing(table: pd.DataFrame, columns: dict[str, str], missing: list[str]) -> str:
    found = [str(name) for name in table.attrs.get("found", table.columns)]
    shown = ", ".join(name[:60] for name in found[:30]) + (
        f" … ({len(found)} in all)" if len(found) > 30 else ""
    )
    first = columns.get(missing[0], missing[0])
    stem, _, unit = first.rpartition(":")
    note = f" {unit!r} is no unit known." if stem in found and not is_unit(unit) else ""
    return (
        f"column {', '.join(columns.get(c, c) for c in missing[:10])} is missing; found "
        f'{shown}.{note} Name the columns with columns={{"{missing[0]}": "..."}}, a unit after '
        f'a colon where it is not SI, as in "enc_1:deg".'
    )


def _texts(table: pd.DataFrame, key: str) -> dict[str, str]:
    """A mapping among a table's attributes, which may come from a foreign file."""
    given = table.attrs.get(key)
    return {str(k): str(v) for k, v in given.items()} if isinstance(given, dict) else {}


def _is_number(cell: object) -> bool:
    try:
        float(cell)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return False
    return True
