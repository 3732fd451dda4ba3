"""MATLAB files: version 5 by SciPy in a worker process, version 7.3 as the HDF5 that it is.

References:
    MathWorks, MAT-File Format (level 5).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nfriction.io.formats.files import most_unpacked, refuse_bomb, refuse_size
from nfriction.io.formats.hdf5 import SIGNATURE, read_hdf5
from nfriction.io.formats.nested import Signals, choose_signals
from nfriction.io.formats.worker import read_in_worker, read_main

if TYPE_CHECKING:
    import pandas as pd

_HEADER, _COMPRESSED = 128, 15


def read_mat(path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Table of the signals asked for; variables and fields by name, see `nested`.

    Raises:
        ImportError: a file of version 7.3 and no h5py.
        ValueError: a damaged file, or one of another version.
    """
    with path.open("rb") as file:
        start = file.read(1024)
    if SIGNATURE in start:
        return read_hdf5(path, sources)
    if len(start) < _HEADER or start[126:128] not in (b"IM", b"MI"):
        raise ValueError("it is no MATLAB file of version 5 or 7.3")
    refuse_size(path.stat().st_size)
    _check_unpacked_size(path.read_bytes())
    return read_in_worker(__name__, "SciPy", path, sources)


def main() -> None:
    """Read a file in a worker process."""
    read_main(read_signals)


def read_signals(path: Path, sources: Sequence[str]) -> Signals:
    """Signals of a file of version 5; SciPy's own errors on damage pass."""
    from scipy.io import loadmat

    content = {name: _nested(value) for name, value in loadmat(path).items()}
    return choose_signals(content, sources)


def _nested(value: Any) -> Any:
    """SciPy's records as dicts, or lists of them, its cells as lists, its text as str."""
    # Subclasses hold MATLAB's objects and functions, which are no signals.
    if type(value) is not np.ndarray:
        return value
    if value.dtype.names:
        fields = value.dtype.names
        records = [{f: _nested(record[f]) for f in fields} for record in value.ravel(order="F")]
        return records[0] if len(records) == 1 else records
    if value.dtype.kind == "O":
        return [_nested(cell) for cell in value.ravel(order="F")]
    return str(value.item()) if value.dtype.kind == "U" and value.size == 1 else value


def _check_unpacked_size(content: bytes) -> None:
    """Refuse compression bombs: SciPy inflates without a limit."""
    order = "<" if content[126:128] == b"IM" else ">"
    at, unpacked = _HEADER, 0
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        at += 8 + size
        if kind == _COMPRESSED:
            limit = most_unpacked(len(content)) - unpacked + 1
            unpacked += len(zlib.decompressobj().decompress(content[at - size : at], limit))
            refuse_bomb(unpacked, len(content))
