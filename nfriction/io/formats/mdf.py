"""ASAM MDF measurement files (.mf4), read by asammdf in a worker process."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nfriction.io.formats.selection import OURS
from nfriction.io.formats.signals import Signals, asked_names, read_in_worker, read_main

if TYPE_CHECKING:
    import pandas as pd


def read_mdf(path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Table of the channels asked for, with their units; `time` is their common time."""
    if find_spec("asammdf") is None:
        raise ImportError(
            "MDF files need asammdf: pip install nfriction[mdf]; or export them as .csv or .mat."
        )
    return read_in_worker(__name__, "asammdf", path, sources)


def main() -> None:
    """Read a file in a worker process."""
    read_main(read_signals)


def read_signals(path: Path, sources: Sequence[str]) -> Signals:
    """Signals of a file; asammdf's own errors on damage pass."""
    from asammdf import MDF

    with MDF(path) as file:
        return choose_channels(file, sources)


def choose_channels(file: Any, sources: Sequence[str]) -> Signals:
    """Channels of an open file that were sampled together."""
    places = dict(file.channels_db)
    columns: dict[str, Any] = {}
    units: dict[str, str] = {}
    stamps: Any = None
    # Each group has a channel of stamps, often called "time"; they come with every signal, too.
    ours = {name for name in places if OURS.fullmatch(name) and name != "time"}
    for name in sorted(ours | asked_names(set(places), sources)):
        # Several groups may log one signal at different rates.
        if len(places[name]) > 1:
            raise ValueError(f"channel {name} is there more than once")
        signal = file.get(name)
        if stamps is not None and not np.array_equal(stamps, signal.timestamps):
            raise ValueError(
                f"channel {name} was not sampled together with {next(iter(columns))}; export the "
                "measurement on one raster, such as by asammdf's `MDF.resample`"
            )
        if np.ndim(signal.samples) != 1:
            raise ValueError(f"channel {name} holds arrays instead of numbers")
        stamps, columns[name] = signal.timestamps, signal.samples
        if signal.unit:
            units[name] = str(signal.unit)
    if stamps is not None:
        columns.setdefault("time", stamps)
    return Signals(columns, sorted(places), units)
