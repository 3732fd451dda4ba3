"""Parquet and NPZ: tables stored column by column."""

import io
import math
import re
import struct
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd

from nfriction.io.formats import MOST_COLUMNS, refuse_bomb
from nfriction.io.formats.text import ATTRIBUTES

_HEADER = re.compile(
    rb"\{'descr': '([<>|][fiu][1248]|\|b1|[<>]U\d{1,6})', 'fortran_order': (True|False), "
    rb"'shape': \((\d{0,19}(?:, ?\d{1,19})*),?\), \}\s*"
)


def read_parquet(path: Path, _: object = ()) -> pd.DataFrame:
    _need_pyarrow()
    from pyarrow.parquet import ParquetFile

    content = io.BytesIO(path.read_bytes())
    # Equal numbers compress to almost nothing, so the file's size does not limit the table's.
    metadata = ParquetFile(content).metadata
    if metadata.num_columns > MOST_COLUMNS:
        raise ValueError(f"it has more than {MOST_COLUMNS} columns")
    refuse_bomb(8 * metadata.num_rows * metadata.num_columns, path.stat().st_size)
    try:
        table = pd.read_parquet(content, engine="pyarrow")
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"the description of its columns is damaged: {error!r}") from error
    # pandas copies all attributes at every step, so unknown ones are dropped.
    table.attrs = {k: table.attrs[k] for k in ATTRIBUTES if isinstance(table.attrs.get(k), str)}
    return table


def write_parquet(table: pd.DataFrame) -> bytes:
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


def read_npz(path: Path, _: object = ()) -> pd.DataFrame:
    columns: dict[str, np.ndarray] = {}
    attributes = {}
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        refuse_bomb(sum(entry.file_size for entry in entries), path.stat().st_size)
        arrays = {e.filename.removesuffix(".npy"): _array(archive.read(e)) for e in entries}
    for key, values in arrays.items():
        if key in ATTRIBUTES:
            attributes[key] = str(values)
        elif values.ndim == 2:
            if values.shape[1] > MOST_COLUMNS:
                raise ValueError(f"array {key[:40]} has more than {MOST_COLUMNS} columns")
            columns |= {f"{key}{k + 1}": column for k, column in enumerate(values.T)}
        else:
            columns[key] = np.atleast_1d(values)
    table = pd.DataFrame(columns)
    table.attrs.update(attributes)
    return table


def _array(content: bytes) -> np.ndarray:
    """A vector, a matrix or a text of a `.npy` file.

    NumPy's reader evaluates the header, accepts objects and records, and allocates the claimed
    size; here the header has one form, and its claims must match the data.
    """
    if content[:6] != b"\x93NUMPY" or len(content) < 12:
        raise ValueError("it contains something that is not an array")
    wide = content[6] > 1
    size, begin = struct.unpack_from("<I" if wide else "<H", content, 8)[0], 12 if wide else 10
    header = _HEADER.fullmatch(content[begin : begin + size])
    if header is None:
        raise ValueError("an array in it is neither numbers nor text, or its header is damaged")
    kind, columns_first, lengths = header.groups()
    shape = [int(length) for length in lengths.replace(b",", b" ").split()]
    form, data = np.dtype(kind.decode()), memoryview(content)[begin + size :]
    if len(shape) > 2 or math.prod(shape) * form.itemsize != len(data):
        raise ValueError(f"an array in it has {len(data)} bytes, which do not fit its shape")
    if form.kind == "U":
        # NumPy accepts invalid code points, which crash the interpreter later.
        order = "be" if form.byteorder == ">" else "le"
        return np.array(bytes(data).decode(f"utf-32-{order}").rstrip("\0"))
    return np.frombuffer(data, form).reshape(shape, order="F" if columns_first == b"True" else "C")


def write_npz(table: pd.DataFrame) -> bytes:
    arrays = {key: np.array(table.attrs[key]) for key in ATTRIBUTES if key in table.attrs}
    for column in table.columns:
        stem = column.rstrip("0123456789")
        if stem not in arrays:
            group = [c for c in table.columns if c.rstrip("0123456789") == stem]
            arrays[stem] = table[group].to_numpy() if stem != column else table[column].to_numpy()
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()
