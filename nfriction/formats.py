"""Recordings as files: CSV, gzipped CSV, Parquet and NPZ, read and written as tables.

A table is a pandas DataFrame with a column each for `time`, `q1` …, `qd1` …, `tau1` …, which a CSV
file leaves as text; its `attrs` hold what the file tells beside the numbers (`convention`, `unit`,
`names`).
"""

from __future__ import annotations

import gzip
import io
import os
import re
import uuid
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ATTRIBUTES = ("convention", "unit", "names")


def read_table(path: str | os.PathLike[str]) -> pd.DataFrame:
    """The table in a file; the file's ending tells its format.

    Raises:
        FileNotFoundError: there is no such file.
        ImportError: a Parquet file and no pyarrow.
        ValueError: an unknown ending, an empty, truncated or malformed file.
    """
    path = Path(path)
    reader, _ = _format(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no recording at '{path}'; check the path.")
    content = path.read_bytes()
    if not content:
        raise ValueError(f"'{path}' is empty; a recording has a header and samples.")
    try:
        return reader(content)
    except _BROKEN as error:
        raise ValueError(
            f"'{path}' is truncated, ragged or not what its ending says ({error}); "
            f"mend or fetch it again."
        ) from error


def write_table(table: pd.DataFrame, path: str | os.PathLike[str]) -> None:
    """Write a table whole or not at all; the file's ending tells the format."""
    path = Path(path)
    _, writer = _format(path)
    content = writer(table)
    unfinished = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    try:
        with open(unfinished, "xb") as file:
            file.write(content)
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def table_arrays(table: pd.DataFrame, columns: dict[str, str]) -> dict[str, Array]:
    """Arrays time, q and, where every joint has them, qd and tau.

    Args:
        table: with columns time, q1 …, perhaps qd1 …, tau1 …; others are ignored.
        columns: the table's name for ours where they differ.
    """
    unknown = [key for key in columns if not re.fullmatch(r"time|(q|qd|tau)[1-9]\d*", key)]
    if unknown:
        raise ValueError(
            f"`columns` maps time, q1 …, qd1 …, tau1 … to the file's names, got keys {unknown}."
        )
    claimed = set(columns.values())
    sources = {c: c for c in map(str, table.columns) if c not in claimed and c not in columns}
    sources |= columns
    joints = max((int(c[1:]) for c in sources if re.fullmatch(r"q[1-9]\d*", c)), default=1)
    needed = ["time", *(f"q{k + 1}" for k in range(joints))]
    missing = [c for c in needed if sources.get(c) not in table.columns]
    if missing:
        raise ValueError(
            f"column {', '.join(sources.get(c, c) for c in missing)} is missing; "
            f"found {', '.join(map(str, table.columns))}. "
            f'Name the columns with columns={{"{missing[0]}": "..."}}.'
        )
    arrays = {"time": column_numbers(table, sources["time"])}
    for key in ("q", "qd", "tau"):
        group = [sources.get(f"{key}{k + 1}") for k in range(joints)]
        present = [c for c in group if c is not None and c in table.columns]
        if len(present) == joints:
            arrays[key] = np.stack([column_numbers(table, c) for c in present], axis=1)
    return arrays


def column_numbers(table: pd.DataFrame, column: str) -> Array:
    """A column as float64; empty cells are NaN, a cell that is no number is named."""
    cells = table[column].to_numpy(dtype=object, na_value=np.nan)
    try:
        return cells.astype(np.float64)
    except (TypeError, ValueError) as error:
        row = next(row for row, cell in enumerate(cells) if not _is_number(cell))
        raise ValueError(
            f"column {column}, row {row} (counted from 0 below the header) must be a number, "
            f"got {cells[row]!r}."
        ) from error


def _is_number(cell: object) -> bool:
    try:
        float(cell)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return False
    return True


def _read_csv(content: bytes) -> pd.DataFrame:
    text = content.decode("utf-8-sig")
    attributes = {}
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        key, _, value = line[1:].partition(":")
        if key.strip() in _ATTRIBUTES:
            attributes[key.strip()] = value.strip()
    table = pd.read_csv(
        io.StringIO(text),
        comment="#",
        # Text, for Python's float() is exact where the parser's own default is not.
        dtype=str,
        skipinitialspace=True,
    )
    if not isinstance(table.index, pd.RangeIndex):
        raise ValueError("its rows have more cells than its header")
    table.columns = table.columns.astype(str).str.strip()
    table.attrs.update(attributes)
    return table


def _write_csv(table: pd.DataFrame) -> bytes:
    comments = [f"# {key}: {table.attrs[key]}\n" for key in _ATTRIBUTES if key in table.attrs]
    return ("".join(comments) + table.to_csv(index=False, lineterminator="\n")).encode()


def _read_csv_gz(content: bytes) -> pd.DataFrame:
    return _read_csv(gzip.decompress(content))


def _write_csv_gz(table: pd.DataFrame) -> bytes:
    # Without the moment of writing, equal recordings make equal files.
    return gzip.compress(_write_csv(table), mtime=0)


def _read_parquet(content: bytes) -> pd.DataFrame:
    _need_pyarrow()
    return pd.read_parquet(io.BytesIO(content), engine="pyarrow")


def _write_parquet(table: pd.DataFrame) -> bytes:
    _need_pyarrow()
    buffer = io.BytesIO()
    table.to_parquet(buffer, engine="pyarrow", index=False)
    return buffer.getvalue()


def _need_pyarrow() -> None:
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise ImportError(
            "Parquet files need pyarrow: pip install nfriction[parquet]; or use .csv.gz or .npz."
        ) from error


def _read_npz(content: bytes) -> pd.DataFrame:
    columns: dict[str, np.ndarray] = {}
    attributes = {}
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        for key in archive.files:
            values = archive[key]
            if key in _ATTRIBUTES:
                attributes[key] = str(values)
            elif values.ndim == 2:
                columns |= {f"{key}{k + 1}": column for k, column in enumerate(values.T)}
            else:
                columns[key] = np.atleast_1d(values)
    table = pd.DataFrame(columns)
    table.attrs.update(attributes)
    return table


def _write_npz(table: pd.DataFrame) -> bytes:
    arrays = {key: np.array(table.attrs[key]) for key in _ATTRIBUTES if key in table.attrs}
    for column in table.columns:
        stem = column.rstrip("0123456789")
        if stem not in arrays:
            group = [c for c in table.columns if c.rstrip("0123456789") == stem]
            arrays[stem] = table[group].to_numpy() if stem != column else table[column].to_numpy()
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


_Reader = Callable[[bytes], pd.DataFrame]
_Writer = Callable[[pd.DataFrame], bytes]
_FORMATS: dict[str, tuple[_Reader, _Writer]] = {
    ".csv": (_read_csv, _write_csv),
    ".csv.gz": (_read_csv_gz, _write_csv_gz),
    ".parquet": (_read_parquet, _write_parquet),
    ".npz": (_read_npz, _write_npz),
}
# What the readers raise on broken content; ValueError covers pandas' parser, pyarrow and Unicode.
_BROKEN = (ValueError, EOFError, OSError, zlib.error, zipfile.BadZipFile)


def _format(path: Path) -> tuple[_Reader, _Writer]:
    for ending, functions in _FORMATS.items():
        if path.name.lower().endswith(ending):
            return functions
    raise ValueError(f"'{path}' must end in one of {', '.join(_FORMATS)}, the formats known.")
