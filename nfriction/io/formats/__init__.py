"""Recordings as files: CSV, Parquet, NPZ, MATLAB, HDF5 and MDF as tables.

A table is a pandas DataFrame with columns `time`, `q1` …, `qd1` …, `tau1` …, or the file's names of
them; cells of a CSV file stay text. Its `attrs` hold the file's other information: `convention`,
`unit`, `names`, and `units` by column.

pandas is slow to import, so only functions that make tables import it.
"""

from nfriction.io.formats.files import read_table, stem, write_table
from nfriction.io.formats.numbers import column_numbers
from nfriction.io.formats.selection import Arrays, table_arrays

__all__ = ["Arrays", "column_numbers", "read_table", "stem", "table_arrays", "write_table"]
