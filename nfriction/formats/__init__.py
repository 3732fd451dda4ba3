"""Recordings as files: CSV in the wild, Parquet, NPZ, MATLAB, HDF5 and MDF as tables.

A table is a pandas DataFrame with a column each for `time`, `q1` …, `qd1` …, `tau1` …, or for what
the file calls them; a CSV file leaves cells as text. Its `attrs` hold what the file tells beside
the numbers (`convention`, `unit`, `names`; `units` by column).
"""

from nfriction.formats.files import read_table, stem, write_table
from nfriction.formats.selection import Arrays, column_numbers, table_arrays

__all__ = ["Arrays", "column_numbers", "read_table", "stem", "table_arrays", "write_table"]
