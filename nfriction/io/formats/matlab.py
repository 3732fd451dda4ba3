"""MATLAB files: version 5 read here, version 7.3 as the HDF5 that it is.

SciPy's reader ends the whole process on some damaged files, which a stranger's file must not; the
format of numbers, text, cells and structs is small enough to read it safely.

References:
    MathWorks, MAT-File Format (level 5).
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nfriction.io.formats.hdf5 import SIGNATURE, read_hdf5
from nfriction.io.formats.limits import most_unpacked, refuse_bomb, refuse_size
from nfriction.io.formats.nested import DEEPEST, MOST, nested_table

_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8",
            13: "u8"}  # fmt: skip
_TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
# Classes of arrays: cells, structs, text, and numbers of every kind.
_CELL, _STRUCT, _CHAR, _NUMERIC = 1, 2, 4, range(6, 16)


@dataclass
class _State:
    """Byte order of a file, and how many arrays were read of it."""

    order: str
    arrays: int = 0


def read_mat(path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Table of the signals asked for; variables and fields by name, see `nested`.

    Raises:
        ImportError: a file of version 7.3 and no h5py.
        ValueError: no such file, a damaged one, or one of another version.
    """
    with path.open("rb") as file:
        start = file.read(1024)
    if SIGNATURE in start:
        return read_hdf5(path, sources)
    return nested_table(read_version_5(path.read_bytes()), sources)


def read_version_5(content: bytes) -> dict[str, Any]:
    """Variables of a file: arrays, text, cells as lists, structs as dicts or lists of them.

    Sparse arrays, objects and functions are None.

    Raises:
        ValueError: damaged, too large, or of another version.
    """
    refuse_size(len(content))
    if len(content) < _HEADER or content[126:128] not in (b"IM", b"MI"):
        raise ValueError("it is no MATLAB file of version 5 or 7.3")
    order = "<" if content[126:128] == b"IM" else ">"
    variables: dict[str, Any] = {}
    state, unpacked = _State(order), 0
    for kind, data in _elements(memoryview(content)[_HEADER:], order):
        if kind == _COMPRESSED:
            plain = _unpacked(data, most_unpacked(len(content)) - unpacked)
            unpacked += len(plain)
            refuse_bomb(unpacked, len(content))
            kind, data = next(_elements(memoryview(plain), order))
        if kind == _MATRIX:
            name, value = _matrix(data, state, 0)
            variables[name] = value
    return variables


def _unpacked(data: memoryview, limit: int) -> bytes:
    stream = zlib.decompressobj()
    plain = stream.decompress(data, limit + 1)
    if len(plain) < 8:
        raise ValueError("a variable in it is cut short")
    return plain


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Type and content of the elements in a row."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        begin = at + 8
        if kind >> 16:  # a small element: its size in the type's upper half, content beside it
            kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
            at += 8
            if size > 4:
                raise ValueError("a small element in it is too large")
        else:
            at = begin + size
            # Only what is packed is not padded.
            at += 0 if kind == _COMPRESSED else -size % 8
        if begin + size > len(data):
            raise ValueError("it ends within an element")
        yield kind, data[begin : begin + size]


def _matrix(data: memoryview, state: _State, depth: int) -> tuple[str, Any]:
    """Name and value of an array element."""
    state.arrays += 1
    if depth > DEEPEST or state.arrays > MOST:
        raise ValueError("it is nested too deeply, or has too many parts")
    order = state.order
    if not len(data):  # an empty cell or field
        return "", np.zeros((0, 0))
    parts = _elements(data, order)
    try:
        flags = int(_numbers(*next(parts), order)[0])
        kind = flags & 0xFF
        if kind not in (_CELL, _STRUCT, _CHAR, *_NUMERIC):
            return "", None
        shape = _numbers(*next(parts), order).tolist()
        _agree(all(isinstance(length, int) and length >= 0 for length in shape))
        name = _text(*next(parts), order)
        # A complex number is no sample of a joint.
        if kind in _NUMERIC and flags & 0x0800:
            return name, None
        if kind in _NUMERIC:
            numbers = _numbers(*next(parts), order)
            _agree(math.prod(shape) == len(numbers))
            return name, numbers.reshape(shape, order="F")
        if kind == _CHAR:
            return name, _text(*next(parts), order)
        fields = [""]
        if kind == _STRUCT:
            width = int(_numbers(*next(parts), order)[0])
            names = bytes(next(parts)[1])
            _agree(0 < width <= 64 or not names)
            fields = [
                names[k : k + width].split(b"\0")[0].decode("latin-1")
                for k in range(0, len(names), max(width, 1))
            ]
        count = math.prod(shape)
        _agree(0 <= count * max(len(fields), 1) <= MOST)
        values = [
            {field: _nested(*next(parts), state, depth) for field in fields} for _ in range(count)
        ]
    except (StopIteration, IndexError) as error:
        raise ValueError("an array in it is cut short") from error
    if kind == _CELL:
        return name, [value[""] for value in values]
    return name, values[0] if count == 1 else values


def _nested(kind: int, data: memoryview, state: _State, depth: int) -> Any:
    _agree(kind == _MATRIX)
    return _matrix(data, state, depth + 1)[1]


def _numbers(kind: int, data: memoryview, order: str) -> np.ndarray:
    _agree(kind in _NUMBERS)
    form = np.dtype(order + _NUMBERS[kind])
    _agree(len(data) % form.itemsize == 0)
    return np.frombuffer(data, form).astype(form.newbyteorder("="))


def _text(kind: int, data: memoryview, order: str) -> str:
    _agree(kind in _TEXTS)
    encoding = _TEXTS[kind]
    if encoding in ("utf-16", "utf-32"):
        encoding += "-le" if order == "<" else "-be"
    return bytes(data).decode(encoding, errors="replace")


def _agree(sound: bool) -> None:
    if not sound:
        raise ValueError("an array in it contradicts itself")
