"""Parquet and NPZ: tables that are stored column by column."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd

from nfriction.formats.limits import refuse_size
from nfriction.formats.text import ATTRIBUTES


def read_parquet(path: Path, _: object = ()) -> pd.DataFrame:
    _need_pyarrow()
    from pyarrow.parquet import ParquetFile

    content = io.BytesIO(path.read_bytes())
    # Equal numbers pack to almost nothing, so the file's size tells little.
    metadata = ParquetFile(content).metadata
    refuse_size(8 * metadata.num_rows * metadata.num_columns)
    try:
        return pd.read_parquet(content, engine="pyarrow")
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"what it says of its columns is damaged: {error!r}") from error


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
    content = io.BytesIO(path.read_bytes())
    with zipfile.ZipFile(content) as archive:
        refuse_size(sum(entry.file_size for entry in archive.infolist()), "unpacked bytes")
    with np.load(content, allow_pickle=False) as arrays:
        for key in arrays.files:
            try:
                values = arrays[key]
            except MemoryError as error:
                # An array's header may claim any size.
                raise ValueError(f"array {key} is larger than memory") from error
            if key in ATTRIBUTES:
                attributes[key] = str(values)
            elif values.ndim == 2:
                columns |= {f"{key}{k + 1}": column for k, column in enumerate(values.T)}
            else:
                columns[key] = np.atleast_1d(values)
    table = pd.DataFrame(columns)
    table.attrs.update(attributes)
    return table


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
