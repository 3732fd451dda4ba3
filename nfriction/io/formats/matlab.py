"""MATLAB and HDF5 files: MATLAB's version 5 by SciPy in a worker process, version 7.3 is HDF5.

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
from nfriction.io.formats.signals import (
    DEEPEST,
    MOST,
    Signals,
    choose_signals,
    read_in_worker,
    read_main,
)

if TYPE_CHECKING:
    import pandas as pd

SIGNATURE = b"\x89HDF\r\n\x1a\n"
_HEADER, _COMPRESSED = 128, 15


def read_mat(path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Table of the signals asked for; variables and fields by name, see `signals`."""
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
        # Elements at the top level are not padded.
        at += 8 + size
        if kind == _COMPRESSED:
            limit = most_unpacked(len(content)) - unpacked + 1
            unpacked += len(zlib.decompressobj().decompress(content[at - size : at], limit))
            refuse_bomb(unpacked, len(content))


def read_hdf5(path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Table of the signals asked for; groups and data sets by name, see `signals`."""
    try:
        import h5py
    except ImportError as error:
        raise ImportError(
            "HDF5 files and MATLAB's version 7.3 need h5py: pip install nfriction[hdf5]; or save "
            "with `save('run.mat', '-v7')`."
        ) from error
    try:
        with h5py.File(path, "r") as file:
            content = _Reader(file, path.stat().st_size).group(file, 0)
    except (OSError, RuntimeError, KeyError, TypeError, MemoryError) as error:
        raise ValueError(f"h5py cannot read it: {error}") from error
    return choose_signals(content, sources, slashes=True).table()


class _Reader:
    """Plain dicts, lists and arrays from an open file."""

    def __init__(self, file: Any, size: int) -> None:
        self.file = file
        self.size = size
        self.count = 0
        self.bytes = 0

    def group(self, group: Any, depth: int) -> dict[str, Any]:
        # MATLAB keeps the targets of references in "#refs#".
        names = [name for name in group if not name.startswith("#")]
        return {
            name: self.item(group[name], depth + 1)
            for name in names
            # Other links may lead out of the file.
            if type(group.get(name, getlink=True)).__name__ == "HardLink"
        }

    def item(self, item: Any, depth: int) -> Any:
        self.count += 1
        if depth > DEEPEST or self.count > MOST:
            raise ValueError("it is nested too deeply, or in a loop")
        if not hasattr(item, "shape"):  # a group, or a type that has a name
            content = self.group(item, depth) if hasattr(item, "keys") else {}
            return _struct_array(content)
        self.bytes += int(item.size or 0) * item.dtype.itemsize
        # Before it is read: chunks that were never written take no space in the file.
        refuse_bomb(self.bytes, self.size)
        if item.dtype.kind == "O":
            return self._referred(item, depth)
        if item.dtype.kind not in "fiub" or item.shape is None:
            return None
        # Never read other files; an empty array stores its shape in place of samples.
        if item.external or item.is_virtual or item.attrs.get("MATLAB_empty"):
            return None
        values = np.asarray(item[()])
        kind = item.attrs.get("MATLAB_class")
        if kind == b"char":
            return "".join(map(chr, values.ravel().tolist()))
        # MATLAB stores column by column, so matrices appear transposed.
        return values if kind is None else values.T

    def _referred(self, item: Any, depth: int) -> list[Any]:
        """Targets of the references of a cell, or of a field of an array of structs."""
        import h5py

        if h5py.check_ref_dtype(item.dtype) is not h5py.Reference:
            return []
        return [
            self.item(self.file[reference], depth + 1) if reference else None
            for reference in np.asarray(item[()]).ravel()
        ]


def _struct_array(content: dict[str, Any]) -> dict[str, Any] | list[dict[str, Any]]:
    """Turn fields that are all lists of one length into the array of structs that they were."""
    lengths = {len(value) if isinstance(value, list) else -1 for value in content.values()}
    if len(lengths) != 1 or -1 in lengths:
        return content
    return [{name: value[k] for name, value in content.items()} for k in range(lengths.pop())]
