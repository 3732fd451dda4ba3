"""The process that reads an MDF file for `read_mdf`, and may perish of it."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfriction.formats.limits import LARGEST
from nfriction.formats.selection import OURS, parse_source

# Address space that libraries and a file in several copies take, in sizes of the largest.
ROOM = 16


def main(arguments: Sequence[str]) -> None:
    """Write the channels asked for, or why they make no recording, into a folder.

    What asammdf stumbles over ends this process, and its last words tell of it.

    Args:
        arguments: path of the file, the folder, seconds of processor time, sources of columns.
    """
    path, folder, seconds, *sources = arguments
    try:
        from asammdf import MDF

        _limit(float(seconds))
        with MDF(path) as file:
            columns, told = _channels(file, sources)
    except _UnfitError as error:
        why = str(error)[:1000]
        (Path(folder) / "refusal.txt").write_text(why, encoding="utf-8", errors="replace")
    else:
        arrays: dict[str, Any] = {f"c{k}": values for k, values in enumerate(columns.values())}
        np.savez(Path(folder) / "table.npz", told=np.array(json.dumps(told)), **arrays)


class _UnfitError(ValueError):
    """Sound channels that make no recording."""


def _limit(seconds: float) -> None:
    """Bound processor time and memory, where the system can."""
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1,) * 2)
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        room = ROOM * LARGEST
        if hard == resource.RLIM_INFINITY or hard > room:
            resource.setrlimit(resource.RLIMIT_AS, (room, hard))


def _channels(file: Any, sources: Sequence[str]) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Samples by name, and all else that a table needs to know."""
    places = dict(file.channels_db)
    names = set(places)
    try:
        wanted = {s.column for spec in sources if (s := parse_source(spec, names))}
    except ValueError as error:
        raise _UnfitError(str(error)) from error
    wanted |= {name for name in names if OURS.fullmatch(name) and name != "time"}
    repeated = [name for name in sorted(wanted) if len(places[name]) > 1]
    if repeated:
        raise _UnfitError(f"channel {repeated[0]} is there more than once")
    columns: dict[str, NDArray] = {}
    units: dict[str, str] = {}
    time: NDArray | None = None
    for name in sorted(wanted):
        signal = file.get(name)
        if time is not None and not np.array_equal(time, signal.timestamps):
            raise _UnfitError(
                f"channel {name} was not sampled together with {next(iter(columns))}; export the "
                "measurement on one raster, such as by asammdf's `MDF.resample`"
            )
        time = _plain(signal.timestamps)
        columns[name] = _plain(signal.samples)
        if signal.unit:
            units[name] = str(signal.unit)
    if time is not None:
        columns.setdefault("time", time)
    told = {"names": list(columns), "channels": sorted(names), "units": units}
    return columns, told


def _plain(samples: Any) -> NDArray:
    """Numbers as they are, of a size that every program knows; all else as text."""
    found = np.asarray(samples)
    if found.dtype.kind in "biu":
        return found
    return found.astype(np.float64 if found.dtype.kind == "f" else str)
