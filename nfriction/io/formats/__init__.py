"""Recordings as files: CSV in the wild, Parquet, NPZ, MATLAB, HDF5 and MDF as tables.

A table is a pandas DataFrame with a column each for `time`, `q1` …, `qd1` …, `tau1` …, or for what
the file calls them; a CSV file leaves cells as text. Its `attrs` hold what the file tells beside
the numbers (`convention`, `unit`, `names`; `units` by column).

pandas is slow to import, so it is only when the first table comes.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nfriction.io.formats.files import read_table, stem, write_table
    from nfriction.io.formats.selection import Arrays, column_numbers, table_arrays

_HOME = {
    **dict.fromkeys(("read_table", "stem", "write_table"), "files"),
    **dict.fromkeys(("Arrays", "column_numbers", "table_arrays"), "selection"),
}

__all__ = ["Arrays", "column_numbers", "read_table", "stem", "table_arrays", "write_table"]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
