"""Files of recordings: which reader an ending needs, and writing whole or not at all."""

from __future__ import annotations

import csv
import os
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd

from nfriction.io.atomic import write_atomically
from nfriction.io.formats import columnar, hdf5, matlab, mdf, text

_Reader = Callable[[Path, Sequence[str]], pd.DataFrame]
_Writer = Callable[[pd.DataFrame], bytes]

_READERS: dict[str, _Reader] = {
    ".csv": text.read_csv,
    ".csv.gz": text.read_csv_gz,
    ".tsv": text.read_csv,
    ".txt": text.read_csv,
    ".parquet": columnar.read_parquet,
    ".npz": columnar.read_npz,
    ".mat": matlab.read_mat,
    ".h5": hdf5.read_hdf5,
    ".hdf5": hdf5.read_hdf5,
    ".mf4": mdf.read_mdf,
}
_WRITERS: dict[str, _Writer] = {
    ".csv": text.write_csv,
    ".csv.gz": text.write_csv_gz,
    ".parquet": columnar.write_parquet,
    ".npz": columnar.write_npz,
}
# What the readers raise on broken content; ValueError covers pandas' parser, pyarrow and Unicode,
# NotImplementedError and RuntimeError archives of unknown versions or behind a password.
_BROKEN = (ValueError, OSError, OverflowError, NotImplementedError, RuntimeError,
           zipfile.BadZipFile, zlib.error, EOFError, csv.Error)  # fmt: skip


def read_table(path: str | os.PathLike[str], sources: Sequence[str] = ()) -> pd.DataFrame:
    """The table in a file; the file's ending tells its format.

    Args:
        path: of the file.
        sources: names of what is wanted, perhaps with a unit after a colon; formats that hold much
            else give only these and what bears our own names.
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
        return reader(path, sources)
    except _BROKEN as error:
        told = str(error)
        told = told if len(told) <= 500 else f"{told[:497]}..."  # it may cite what is in the file
        raise ValueError(
            f"'{path}' is truncated, ragged or not what its ending says ({told}); "
            f"mend or fetch it again."
        ) from error


def write_table(table: pd.DataFrame, path: str | os.PathLike[str]) -> None:
    """Write a table whole or not at all; the file's ending tells the format.

    Missing folders are made.

    Raises:
        ValueError: an unknown ending.
        OSError: the file cannot be written.
    """
    path = Path(path)
    write_atomically(path, _WRITERS[_ending(path, _WRITERS, "written")](table))


def stem(path: str | os.PathLike[str]) -> str:
    """A file's name without the ending of its format."""
    name = Path(path).name
    return name[: -len(_ending(Path(path), _READERS, "read"))]


def _ending(path: Path, known: dict[str, _Reader] | dict[str, _Writer], done: str) -> str:
    for ending in known:
        if path.name.lower().endswith(ending):
            return ending
    raise ValueError(
        f"'{path}' must end in one of {', '.join(known)}, the formats that are {done}."
    )
