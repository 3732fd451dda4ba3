"""ASAM MDF measurement files (.mf4) through asammdf, read in a process of its own.

A damaged file can end the process that reads it, keep it busy for ever, or spoil its memory.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd

from nfriction.io import sandbox as apart
from nfriction.io.formats.limits import refuse_size
from nfriction.io.formats.nested import signals_table

# Processor time of the reader [s]: to import what it needs, and for a byte.
STARTING, BY_BYTE = 20.0, 1e-7
TABLE = "table.npz"
_READER = "nfriction.io.formats.mdf_reader"


def read_mdf(path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Table of the channels asked for, with their units; `time` is their common time.

    Raises:
        ImportError: asammdf is not installed.
        ValueError: no MDF file, one that asammdf cannot bear, or channels that were not sampled
            together.
    """
    if find_spec("asammdf") is None:
        raise ImportError(
            "MDF files need asammdf: pip install nfriction[mdf]; or export them as .csv or .mat."
        )
    size = path.stat().st_size
    refuse_size(size)
    asked = {"path": str(path.absolute()), "sources": list(sources)}
    with tempfile.TemporaryDirectory() as folder:
        try:
            apart.run(_READER, asked, Path(folder), seconds=STARTING + BY_BYTE * size)
            return table_of(Path(folder))
        except (apart.PerishedError, OSError, EOFError, LookupError, TypeError) as error:
            raise ValueError(f"asammdf cannot read it ({error})") from None


def table_of(folder: Path) -> pd.DataFrame:
    """What the reader left in its folder."""
    with np.load(folder / TABLE, allow_pickle=False) as held:
        told = json.loads(str(held["told"]))
        columns = {name: held[f"c{k}"] for k, name in enumerate(told["names"])}
    found = signals_table(columns, told["channels"])
    found.attrs["units"] = told["units"]
    return found
