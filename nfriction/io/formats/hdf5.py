"""HDF5 files, and MATLAB's version 7.3, which is HDF5 with habits of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nfriction.io.formats.files import refuse_bomb
from nfriction.io.formats.nested import DEEPEST, MOST, choose_signals

if TYPE_CHECKING:
    import pandas as pd

SIGNATURE = b"\x89HDF\r\n\x1a\n"


def read_hdf5(path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Table of the signals asked for; groups and data sets by name, see `nested`.

    Raises:
        ImportError: h5py is not installed.
        ValueError: no HDF5 file.
    """
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
