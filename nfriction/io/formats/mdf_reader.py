"""The process that reads an MDF file for `read_mdf`, and may perish of it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfriction.io import sandbox as apart
from nfriction.io.formats.limits import LARGEST
from nfriction.io.formats.mdf import TABLE
from nfriction.io.formats.selection import OURS, parse_source

# Address space that libraries and a file in several copies take, in sizes of the largest.
ROOM = 16


def main() -> None:
    """Write the channels asked for, or why they make no recording, into a folder."""
    apart.serve(read, refusals=(UnfitError,), room=ROOM * LARGEST)


def read(asked: Mapping[str, Any], folder: Path) -> None:
    """The channels of a file as arrays; what asammdf stumbles over is raised as it is.

    Args:
        asked: `path`, and the `sources` of a recording's columns.
        folder: where the table goes.

    Raises:
        UnfitError: sound channels that make no recording.
    """
    from asammdf import MDF

    with MDF(Path(asked["path"])) as file:
        columns, told = _channels(file, asked["sources"])
    arrays: dict[str, Any] = {f"c{k}": values for k, values in enumerate(columns.values())}
    np.savez(folder / TABLE, told=np.array(json.dumps(told)), **arrays)


class UnfitError(ValueError):
    """Sound channels that make no recording."""


def _channels(file: Any, sources: Sequence[str]) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Samples by name, and all else that a table needs to know."""
    places = dict(file.channels_db)
    names = set(places)
    try:
        wanted = {s.column for spec in sources if (s := parse_source(spec, names))}
    except ValueError as error:
        raise UnfitError(str(error)) from error
    wanted |= {name for name in names if OURS.fullmatch(name) and name != "time"}
    repeated = [name for name in sorted(wanted) if len(places[name]) > 1]
    if repeated:
        raise UnfitError(f"channel {repeated[0]} is there more than once")
    columns: dict[str, NDArray] = {}
    units: dict[str, str] = {}
    stamps: NDArray | None = None
    for name in sorted(wanted):
        signal = file.get(name)
        if stamps is not None and not np.array_equal(stamps, signal.timestamps):
            raise UnfitError(
                f"channel {name} was not sampled together with {next(iter(columns))}; export the "
                "measurement on one raster, such as by asammdf's `MDF.resample`"
            )
        if np.ndim(signal.samples) != 1:
            raise UnfitError(f"channel {name} holds arrays instead of numbers")
        stamps = _plain(signal.timestamps)
        columns[name] = _plain(signal.samples)
        if signal.unit:
            units[name] = str(signal.unit)
    if stamps is not None:
        columns.setdefault("time", stamps)
    told = {"names": list(columns), "channels": sorted(names), "units": units}
    return columns, told


def _plain(samples: Any) -> NDArray:
    """Numbers as they are, of a size that every program knows; all else as text."""
    found = np.asarray(samples)
    if found.dtype.kind in "biu":
        return found
    if found.dtype.kind == "S":
        return np.char.decode(found, "utf-8", "replace")
    return found.astype(np.float64 if found.dtype.kind == "f" else str)
