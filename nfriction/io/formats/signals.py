"""Signals chosen from files that hold much else, and readers in a worker process.

In nested data every array goes by its path: `data.Y.q1` is a field of a field, `data.Y[2]` an
element, `q[0]` a column of a matrix (samples run along its longer side). Records of dSPACE
ControlDesk (`X` and `Y`, arrays of structs with `Name` and `Data`) also give each signal by its
`Name`, and the time axis as `time`.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nfriction.io import sandbox
from nfriction.io.formats.files import LARGEST, refuse_size
from nfriction.io.formats.selection import OURS, parse_source

if TYPE_CHECKING:
    import pandas as pd

Columns = dict[str, NDArray[Any]]

# A deeper or wider structure holds no recording.
DEEPEST, MOST = 32, 100_000
MOST_COLUMNS = 1000

# Processor time of the worker [s]: for imports, and for a byte of the file.
STARTING, BY_BYTE = 20.0, 1e-7
# Address space for libraries and several copies of a file [bytes].
MEMORY = 16 * LARGEST
_SIGNALS = "signals.npz"


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
        """The columns as a table."""
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


def read_in_worker(
    module: str, library: str, path: Path, sources: Sequence[str] = ()
) -> pd.DataFrame:
    """Table of signals that a module's `main` reads in a process of its own."""
    size = path.stat().st_size
    refuse_size(size)
    task = {"path": str(path.absolute()), "sources": list(sources)}
    with tempfile.TemporaryDirectory() as folder:
        try:
            sandbox.run_isolated(module, task, Path(folder), seconds=STARTING + BY_BYTE * size)
            return load_signals(Path(folder)).table()
        # A corrupted worker may leave anything, so reading its output may fail, too.
        except (sandbox.WorkerDied, OSError, EOFError, LookupError, TypeError) as error:
            raise ValueError(f"{library} cannot read it ({error})") from None


def read_main(read: Callable[[Path, Sequence[str]], Signals]) -> None:
    """Read for `read_in_worker`, in the worker; a ValueError of `read` refuses the file."""

    def work(task: Mapping[str, Any], folder: Path) -> None:
        save_signals(read(Path(task["path"]), task["sources"]), folder)

    sandbox.worker_main(work, refusals=(ValueError,), memory=MEMORY)


def save_signals(signals: Signals, folder: Path) -> None:
    """Write signals where `load_signals` finds them."""
    # NPZ without pickles: the worker's output is as untrusted as the file.
    described = {"names": list(signals.columns), "found": signals.found, "units": signals.units}
    arrays = {f"c{k}": _plain(values) for k, values in enumerate(signals.columns.values())}
    np.savez(folder / _SIGNALS, allow_pickle=False, described=json.dumps(described), **arrays)


def load_signals(folder: Path) -> Signals:
    """Signals that the worker wrote."""
    with np.load(folder / _SIGNALS, allow_pickle=False) as held:
        described = json.loads(str(held["described"]))
        columns = {name: held[f"c{k}"] for k, name in enumerate(described["names"])}
    return Signals(columns, described["found"], described["units"])


def _plain(samples: Any) -> NDArray[Any]:
    """Samples in this machine's byte order and a common size; what is no number, as text."""
    values = np.asarray(samples)
    if values.dtype.kind in "biu":
        return values.astype(values.dtype.newbyteorder("="))
    if values.dtype.kind == "S":
        return np.char.decode(values, "utf-8", "replace")
    return values.astype(np.float64 if values.dtype.kind == "f" else str)
