"""The process that reads an MDF file for `read_mdf`, and may perish of it."""

from __future__ import annotations

import contextlib
import json
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nfriction.formats.limits import LARGEST
from nfriction.formats.selection import OURS, parse_source

# Address space that libraries and a file in several copies take, in sizes of the largest.
ROOM = 16


def main() -> None:
    """Write the channels asked for, or why they make no recording, into a folder.

    Standard input says of which file, where to, and within how much processor time. What asammdf
    stumbles over ends this process, and its last words tell of it.
    """
    asked = json.load(sys.stdin)
    folder = Path(asked["folder"])
    from asammdf import MDF

    _limit(asked["seconds"])
    try:
        with MDF(Path(asked["path"])) as file:
            columns, told = _channels(file, asked["sources"])
    except _UnfitError as error:
        why = str(error)[:1000]
        (folder / "refusal.txt").write_text(why, encoding="utf-8", errors="replace")
    else:
        arrays: dict[str, Any] = {f"c{k}": values for k, values in enumerate(columns.values())}
        np.savez(folder / "table.npz", told=np.array(json.dumps(told)), **arrays)


class _UnfitError(ValueError):
    """Sound channels that make no recording."""


def _limit(seconds: float) -> None:
    """Bound processor time and memory, where the system can; what is bounded closer stays so."""
    try:
        import resource
    except ImportError:
        return
    bounds = {
        resource.RLIMIT_CPU: math.ceil(time.process_time() + seconds),
        resource.RLIMIT_AS: ROOM * LARGEST,
        resource.RLIMIT_CORE: 0,
    }
    for what, bound in bounds.items():
        soft, hard = resource.getrlimit(what)
        known = [x for x in (soft, hard) if x != resource.RLIM_INFINITY]
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(what, (min([bound, *known]), hard))


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
    stamps: NDArray | None = None
    for name in sorted(wanted):
        signal = file.get(name)
        if stamps is not None and not np.array_equal(stamps, signal.timestamps):
            raise _UnfitError(
                f"channel {name} was not sampled together with {next(iter(columns))}; export the "
                "measurement on one raster, such as by asammdf's `MDF.resample`"
            )
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
