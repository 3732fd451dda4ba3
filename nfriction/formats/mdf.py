"""ASAM MDF measurement files (.mf4) through asammdf."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nfriction.formats.limits import refuse_size
from nfriction.formats.nested import signals_table
from nfriction.formats.selection import OURS, parse_source


def read_mdf(path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Table of the channels asked for, with their units; `time` is their common time.

    asammdf may end the process on a damaged file, so read only files whose origin you know.

    Raises:
        ImportError: asammdf is not installed.
        ValueError: no MDF file, or channels that were not sampled together.
    """
    try:
        from asammdf import MDF
        from asammdf.blocks.utils import MdfException
    except ImportError as error:
        raise ImportError(
            "MDF files need asammdf: pip install nfriction[mdf]; or export them as .csv or .mat."
        ) from error
    refuse_size(path.stat().st_size)
    try:
        with MDF(path) as file:
            return _table(file, sources)
    except (
        MdfException, OSError, LookupError, TypeError, AttributeError, struct.error, MemoryError,
        RuntimeError,
    ) as error:  # fmt: skip
        raise ValueError(f"asammdf cannot read it: {error}") from error


def _table(file: Any, sources: Sequence[str]) -> pd.DataFrame:
    places = dict(file.channels_db)
    names = set(places)
    wanted = {s.column for spec in sources if (s := parse_source(spec, names))}
    wanted |= {name for name in names if OURS.fullmatch(name) and name != "time"}
    repeated = [name for name in sorted(wanted) if len(places[name]) > 1]
    if repeated:
        raise ValueError(f"channel {repeated[0]} is there more than once")
    columns: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    time: np.ndarray | None = None
    for name in sorted(wanted):
        signal = file.get(name)
        if time is not None and not np.array_equal(time, signal.timestamps):
            raise ValueError(
                f"channel {name} was not sampled together with {next(iter(columns))}; export the "
                "measurement on one raster, such as by asammdf's `MDF.resample`"
            )
        time = np.asarray(signal.timestamps)
        columns[name] = np.asarray(signal.samples)
        if signal.unit:
            units[name] = str(signal.unit)
    if time is not None:
        columns.setdefault("time", time)
    table = signals_table(columns, sorted(names))
    table.attrs["units"] = units
    return table
