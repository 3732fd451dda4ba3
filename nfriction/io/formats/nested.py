"""Signals in nested data, as MATLAB and HDF5 files hold them: every array by its path.

`data.Y.q1` is a field of a field, `data.Y[2]` an element, `q[0]` a column of a matrix (samples run
along its longer side). Records as dSPACE ControlDesk writes them (`X` and `Y`, arrays of structs
with `Name` and `Data`) also give each signal by its `Name`, and the time axis as `time`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from nfriction.io.formats.selection import OURS, parse_source

Signals = dict[str, NDArray[Any]]

# A struct deeper or wider than this is no record of signals.
DEEPEST, MOST = 32, 100_000
MOST_COLUMNS = 1000


def nested_table(
    content: dict[str, Any], sources: Sequence[str], *, slashes: bool = False
) -> pd.DataFrame:
    """Table of the signals asked for, and of those that bear our own names.

    Args:
        content: dicts, lists and arrays within each other.
        sources: names, perhaps with a unit after a colon.
        slashes: paths may also be written `data/Y/q1` and `/data/Y/q1`.
    Raises:
        ValueError: signals of different lengths, or too many of them.
    """
    signals: Signals = {}
    for path, values in _walk(content, "", 0):
        signals[path] = values
        if len(signals) > MOST:
            raise ValueError(f"it holds more than {MOST} signals")
    named = _controldesk(content)
    signals |= {name: values for name, values in named.items() if name not in signals}
    for key in ("q", "qd", "tau"):
        for k in range(MOST_COLUMNS):
            if f"{key}[{k}]" not in signals:
                break
            signals.setdefault(f"{key}{k + 1}", signals[f"{key}[{k}]"])
    found = list(signals)
    if slashes:
        for name in found:
            for other in (name.replace(".", "/"), "/" + name.replace(".", "/")):
                signals.setdefault(other, signals[name])
    names = set(signals)
    wanted = {s.column for spec in sources if (s := parse_source(spec, names))}
    wanted |= {name for name in names if OURS.fullmatch(name)}
    return signals_table({name: signals[name] for name in sorted(wanted)}, found)


def signals_table(chosen: Signals, found: Sequence[str]) -> pd.DataFrame:
    """Table of signals that share their samples; `attrs["found"]` names all there were.

    Raises:
        ValueError: signals of different lengths.
    """
    lengths = {name: len(values) for name, values in chosen.items()}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} {count}" for name, count in list(lengths.items())[:10])
        raise ValueError(f"its signals have different numbers of samples: {told}")
    table = pd.DataFrame(chosen)
    table.attrs["found"] = list(found)
    return table


def _walk(item: Any, path: str, depth: int) -> Iterator[tuple[str, NDArray[Any]]]:
    if depth > DEEPEST:
        raise ValueError("it is nested too deeply")
    if isinstance(item, dict):
        for key, value in item.items():
            yield from _walk(value, f"{path}.{key}" if path else str(key), depth + 1)
    elif isinstance(item, list):
        for k, value in enumerate(item):
            yield from _walk(value, f"{path}[{k}]", depth + 1)
    elif isinstance(item, np.ndarray) and item.dtype.kind in "fiub":
        yield from _vectors(item, path)


def _vectors(values: NDArray[Any], path: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """An array as one vector, or a matrix as several along its longer side."""
    long = np.squeeze(values)
    if long.ndim == 1:
        yield path, long
    elif long.ndim == 2:
        # Only of a square matrix it cannot be told which way time runs: rows, as in a table.
        columns = long.T if long.shape[0] >= long.shape[1] else long
        if len(columns) <= MOST_COLUMNS:
            yield from ((f"{path}[{k}]", column) for k, column in enumerate(columns))


def _controldesk(content: dict[str, Any]) -> Signals:
    """Signals by name of every record that ControlDesk wrote; names that repeat are left out."""
    found: Signals = {}
    repeated: set[str] = set()
    for name, record in content.items():
        if not (isinstance(record, dict) and {"X", "Y"} <= record.keys()):
            continue
        axes, signals = _data(record["X"]), _data(record["Y"])
        if len(axes) == 1:
            signals.append(("time", axes[0][1]))
        for label, values in signals:
            for key in (label, f"{name}.Y.{label}"):
                repeated |= {key} & found.keys()
                found[key] = values
    return {key: values for key, values in found.items() if key and key not in repeated}


def _data(entries: Any) -> list[tuple[str, NDArray[Any]]]:
    """Name and samples of every element of an X or Y."""
    entries = [entries] if isinstance(entries, dict) else entries
    pairs = []
    for entry in entries if isinstance(entries, list) else []:
        values = entry.get("Data") if isinstance(entry, dict) else None
        if isinstance(values, np.ndarray) and values.dtype.kind in "fiub":
            vector = np.squeeze(values)
            if vector.ndim == 1:
                pairs.append((str(entry.get("Name", "")).strip().strip("\"'"), vector))
    return pairs
