"""Signals in nested data, as MATLAB and HDF5 files hold them: every array by its path.

`data.Y.q1` is a field of a field, `data.Y[2]` an element, `q[0]` a column of a matrix (samples run
along its longer side). Records of dSPACE ControlDesk (`X` and `Y`, arrays of structs with `Name`
and `Data`) also give each signal by its `Name`, and the time axis as `time`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nfriction.io.formats.selection import OURS, parse_source

if TYPE_CHECKING:
    import pandas as pd

Columns = dict[str, NDArray[Any]]

# A deeper or wider structure holds no recording.
DEEPEST, MOST = 32, 100_000
MOST_COLUMNS = 1000


class Signals(NamedTuple):
    """Signals chosen from a file.

    Attributes:
        columns: vectors by name.
        found: names of all signals in the file.
        units: of the columns, where the file has any.
    """

    columns: Columns
    found: list[str]
    units: dict[str, str]

    def table(self) -> pd.DataFrame:
        """The columns as a table.

        Raises:
            ValueError: signals of different lengths.
        """
        import pandas as pd

        lengths = {name: len(values) for name, values in self.columns.items()}
        if len(set(lengths.values())) > 1:
            shown = ", ".join(f"{name} {count}" for name, count in list(lengths.items())[:10])
            raise ValueError(f"its signals have different numbers of samples: {shown}")
        table = pd.DataFrame(self.columns)
        table.attrs.update(found=self.found, units=self.units)
        return table


def choose_signals(
    content: dict[str, Any], sources: Sequence[str], *, slashes: bool = False
) -> Signals:
    """Choose the signals asked for, and those with names of ours.

    Args:
        content: dicts, lists and arrays within each other.
        sources: names, perhaps with a unit after a colon.
        slashes: paths may also be written `data/Y/q1` and `/data/Y/q1`.
    Raises:
        ValueError: too many signals, or nested too deeply.
    """
    signals: Columns = {}
    for path, values in _walk(content, "", 0):
        signals[path] = values
        if len(signals) > MOST:
            raise ValueError(f"it holds more than {MOST} signals")
    # Paths win over names, for names in a file are arbitrary.
    signals = _controldesk(content) | signals
    # A matrix called q holds a joint in each column.
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
    chosen = asked_names(names, sources) | {name for name in names if OURS.fullmatch(name)}
    return Signals({name: signals[name] for name in sorted(chosen)}, found, {})


def asked_names(names: set[str], sources: Sequence[str]) -> set[str]:
    """The names in a file that sources ask for."""
    return {s.column for spec in sources if (s := parse_source(spec, names))}


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
    values = np.squeeze(values)
    if values.ndim == 1:
        yield path, values
    elif values.ndim == 2:
        # A square matrix does not show which way time runs: down, as in a table.
        columns = values.T if values.shape[0] >= values.shape[1] else values
        if len(columns) <= MOST_COLUMNS:
            yield from ((f"{path}[{k}]", column) for k, column in enumerate(columns))


def _controldesk(content: dict[str, Any]) -> Columns:
    """Signals of all ControlDesk records by name; repeated names are left out."""
    found: Columns = {}
    repeated: set[str] = set()
    for name, record in content.items():
        if not (isinstance(record, dict) and {"X", "Y"} <= record.keys()):
            continue
        axes, signals = _named_data(record["X"]), _named_data(record["Y"])
        # With several time axes none of them is the common one.
        if len(axes) == 1:
            signals.append(("time", axes[0][1]))
        for label, values in signals:
            for key in (label, f"{name}.Y.{label}"):
                repeated |= {key} & found.keys()
                found[key] = values
    return {key: values for key, values in found.items() if key and key not in repeated}


def _named_data(entries: Any) -> list[tuple[str, NDArray[Any]]]:
    """Name and samples of every element of an X or Y."""
    entries = [entries] if isinstance(entries, dict) else entries
    pairs = []
    for entry in entries if isinstance(entries, list) else []:
        values = entry.get("Data") if isinstance(entry, dict) else None
        if isinstance(values, np.ndarray) and values.dtype.kind in "fiub":
            vector, name = np.squeeze(values), entry.get("Name")
            if vector.ndim == 1:
                pairs.append((name.strip().strip("\"'") if isinstance(name, str) else "", vector))
    return pairs
