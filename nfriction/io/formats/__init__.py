"""Recordings as files: CSV, Parquet, NPZ, MATLAB, HDF5 and MDF as tables.

A table is a pandas DataFrame with columns `time`, `q1` …, `qd1` …, `tau1` …, or the file's names
for them; cells of a CSV file stay text. Its `attrs` contain the file's other information:
`convention`, `unit`, `names`, and `units` by column.

pandas is slow to import, so only functions that make tables import it.
"""

from __future__ import annotations

import csv
import os
import zipfile
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING

from nfriction.io.files import shortened, write_atomically
from nfriction.io.formats.numbers import column_numbers
from nfriction.io.formats.selection import Arrays, table_arrays

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Arrays", "column_numbers", "read_table", "stem", "table_arrays", "write_table"]

# An hour of ten joints at 1 kHz with torque and velocity, as numbers [bytes].
LARGEST = 2**30
MOST_COLUMNS = 2000
# Measurements compress to perhaps a tenth; only nearly constant data exceed this ratio.
UNSUSPECTED, LARGEST_RATIO = 2**26, 200

# Modules and functions by ending, imported on use.
_READERS = {
    ".csv": "text:read_csv",
    ".csv.gz": "text:read_csv_gz",
    ".tsv": "text:read_csv",
    ".txt": "text:read_csv",
    ".parquet": "columnar:read_parquet",
    ".npz": "columnar:read_npz",
    ".mat": "measurements:read_mat",
    ".h5": "measurements:read_hdf5",
    ".hdf5": "measurements:read_hdf5",
    ".mf4": "measurements:read_mdf",
}
_WRITERS = {
    ".csv": "text:write_csv",
    ".csv.gz": "text:write_csv_gz",
    ".parquet": "columnar:write_parquet",
    ".npz": "columnar:write_npz",
}
# Errors of the readers on broken content. ValueError covers pandas' parser, pyarrow and Unicode;
# NotImplementedError and RuntimeError archives of unknown versions or with a password.
_BROKEN = (ValueError, OSError, OverflowError, NotImplementedError, RuntimeError,
           zipfile.BadZipFile, zlib.error, EOFError, csv.Error)  # fmt: skip


def read_table(path: str | os.PathLike[str], sources: Sequence[str] = ()) -> pd.DataFrame:
    """Read the table in a file; the ending selects the format.

    Args:
        sources: wanted columns, optionally with a unit after a colon; from formats with much other
            content only these and columns with our names are read.
    Raises:
        FileNotFoundError: there is no such file.
        ImportError: a format whose library is not installed.
        ValueError: an unknown ending, an empty, truncated or malformed file.
    """
    path = Path(path)
    reader = _READERS[_ending(path, _READERS, "read")]
    if not path.is_file():
        raise FileNotFoundError(f"there is no recording at '{path}'; check the path.")
    if path.stat().st_size == 0:
        raise ValueError(f"'{path}' is empty; a recording has a header and samples.")
    try:
        table: pd.DataFrame = resolve_name(f"{__name__}.{reader}")(path, sources)
    except _BROKEN as error:
        raise ValueError(
            f"'{path}' is truncated, ragged or not what its ending says ({shortened(error)}); "
            f"repair or fetch it again."
        ) from error
    return table


def write_table(table: pd.DataFrame, path: str | os.PathLike[str]) -> None:
    """Write a table atomically; the ending selects the format. Missing folders are made."""
    path = Path(path)
    writer = resolve_name(f"{__name__}.{_WRITERS[_ending(path, _WRITERS, 'written')]}")
    write_atomically(path, writer(table))


def stem(path: str | os.PathLike[str]) -> str:
    """A file's name without the ending of its format, as text that any file can hold."""
    name = os.fsencode(Path(path).name)[: -len(_ending(Path(path), _READERS, "read"))]
    try:
        return name.decode()
    except UnicodeDecodeError:
        # Names from older systems; Python's surrogate characters cannot be written.
        return name.decode("latin-1")


def most_unpacked(packed: int) -> int:
    """Largest unpacked size [bytes] accepted from a file of this size."""
    return min(LARGEST, max(UNSUSPECTED, LARGEST_RATIO * packed))


def refuse_bomb(unpacked: int, packed: int) -> None:
    """Raise ValueError if a file unpacks to far more [bytes] than measurements would."""
    refuse_size(unpacked, "unpacked bytes")
    if unpacked > most_unpacked(packed):
        raise ValueError(
            f"it unpacks to {unpacked} bytes or more, {unpacked // max(packed, 1)} times its size, "
            f"unlike recordings; if it is one, write it uncompressed"
        )


def refuse_size(count: int, unit: str = "bytes") -> None:
    """Raise ValueError if a file is larger than any recording."""
    if count > LARGEST:
        raise ValueError(
            f"it has {count} {unit}, more than the limit of {LARGEST}; cut it into parts"
        )


def _ending(path: Path, known: Iterable[str], verb: str) -> str:
    for ending in known:
        if path.name.lower().endswith(ending):
            return ending
    raise ValueError(
        f"'{path}' must end in one of {', '.join(known)}, the formats that can be {verb}."
    )
