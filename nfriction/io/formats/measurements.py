"""Measurement files with much other content: MATLAB and HDF5, and ASAM MDF (.mf4).

SciPy reads MATLAB's version 5 and asammdf reads MDF, both in a worker process; MATLAB's version 7.3
is HDF5.

In nested data every array is named by its path: `data.Y.q1` is a field of a field, `data.Y[2]` an
element, `q[0]` a column of a matrix (samples run along its longer side). In records of dSPACE
ControlDesk (`X` and `Y`, arrays of structs with `Name` and `Data`) each signal is also available by
its `Name`, and the time axis as `time`.

References:
    MathWorks, MAT-File Format (level 5).
"""

from __future__ import annotations

import json
import struct
import tempfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nfriction.io import sandbox
from nfriction.io.formats import LARGEST, most_unpacked, refuse_bomb, refuse_size
from nfriction.io.formats.selection import OURS, parse_source

if TYPE_CHECKING:
    import pandas as pd

Columns = dict[str, NDArray[Any]]

# A deeper or wider structure is not a recording.
DEEPEST, MOST = 32, 100_000
MOST_COLUMNS = 1000


class Signals(NamedTuple):
    """Signals chosen from a file."""

    columns: Columns  # vectors by name
    found: list[str]  # names of all signals in the file
    units: dict[str, str]  # of the columns, if the file has any

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
    """Choose the requested signals, and those with our names, in dicts, lists and arrays.

    With `slashes`, paths may also be written `data/Y/q1` and `/data/Y/q1`.
    """
    signals: Columns = {}
    for path, values in _walk(content, "", 0):
        signals[path] = values
        if len(signals) > MOST:
            raise ValueError(f"it has more than {MOST} signals")
    # Paths take precedence over names, because names in a file are arbitrary.
    signals = _controldesk(content) | signals
    # A matrix called q has one column for each joint.
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
    """The names in a file that sources request."""
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
        # A square matrix does not show the direction of time: then down, as in a table.
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
        # With several time axes there is no common one.
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


# Processor time of the worker [s]: for imports, and per byte of the file.
STARTING, BY_BYTE = 20.0, 1e-7
# Address space for libraries and several copies of a file [bytes].
MEMORY = 16 * LARGEST
_SIGNALS = "signals.npz"
SIGNATURE = b"\x89HDF\r\n\x1a\n"
_HEADER, _COMPRESSED = 128, 15


def read_mat(path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Table of the requested signals, named by the paths of variables and fields."""
    with path.open("rb") as file:
        start = file.read(1024)
    if SIGNATURE in start:
        return read_hdf5(path, sources)
    if len(start) < _HEADER or start[126:128] not in (b"IM", b"MI"):
        raise ValueError("it is not a MATLAB file of version 5 or 7.3")
    refuse_size(path.stat().st_size)
    content = path.read_bytes()
    order = "<" if start[126:128] == b"IM" else ">"
    at, unpacked = _HEADER, 0
    # Refuse compression bombs: SciPy inflates without a limit.
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        # Elements at the top level are not padded.
        at += 8 + size
        if kind == _COMPRESSED:
            limit = most_unpacked(len(content)) - unpacked + 1
            unpacked += len(zlib.decompressobj().decompress(content[at - size : at], limit))
            refuse_bomb(unpacked, len(content))
    return read_in_worker("SciPy", path, sources)


def _mat_signals(path: Path, sources: Sequence[str]) -> Signals:
    """Signals of a MATLAB file of version 5; SciPy's own errors on damage pass."""
    from scipy.io import loadmat

    content = {name: _nested(value) for name, value in loadmat(path).items()}
    return choose_signals(content, sources)


def _nested(value: Any) -> Any:
    """SciPy's records as dicts, or lists of them, its cells as lists, its text as str."""
    # Subclasses represent MATLAB's objects and functions, which are not signals.
    if type(value) is not np.ndarray:
        return value
    if value.dtype.names:
        fields = value.dtype.names
        records = [{f: _nested(record[f]) for f in fields} for record in value.ravel(order="F")]
        return records[0] if len(records) == 1 else records
    if value.dtype.kind == "O":
        return [_nested(cell) for cell in value.ravel(order="F")]
    return str(value.item()) if value.dtype.kind == "U" and value.size == 1 else value


def read_hdf5(path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Table of the requested signals, named by the paths of groups and data sets."""
    try:
        import h5py
    except ImportError as error:
        raise ImportError(
            "HDF5 files and MATLAB's version 7.3 need h5py: pip install nfriction[hdf5]; or save "
            "with `save('run.mat', '-v7')`."
        ) from error
    try:
        with h5py.File(path, "r") as file:
            content = _Reader(file, path.stat().st_size).group(file, 0)
    except (OSError, RuntimeError, KeyError, TypeError, MemoryError) as error:
        raise ValueError(f"h5py cannot read it: {error}") from error
    return choose_signals(content, sources, slashes=True).table()


class _Reader:
    """Plain dicts, lists and arrays from an open file."""

    def __init__(self, file: Any, size: int) -> None:
        self.file = file
        self.size = size
        self.count = 0
        self.bytes = 0

    def group(self, group: Any, depth: int) -> dict[str, Any]:
        # MATLAB keeps the targets of references in "#refs#".
        names = [name for name in group if not name.startswith("#")]
        return {
            name: self.item(group[name], depth + 1)
            for name in names
            # Other links may point outside the file.
            if type(group.get(name, getlink=True)).__name__ == "HardLink"
        }

    def item(self, item: Any, depth: int) -> Any:
        self.count += 1
        if depth > DEEPEST or self.count > MOST:
            raise ValueError("it is nested too deeply, or in a loop")
        if not hasattr(item, "shape"):  # a group, or a named type
            content = self.group(item, depth) if hasattr(item, "keys") else {}
            lengths = {len(x) if isinstance(x, list) else -1 for x in content.values()}
            if len(lengths) != 1 or -1 in lengths:
                return content
            # Fields that are all lists of one length are an array of structs.
            return [{name: x[k] for name, x in content.items()} for k in range(lengths.pop())]
        self.bytes += int(item.size or 0) * item.dtype.itemsize
        # Before reading, because chunks that were never written take no space in the file.
        refuse_bomb(self.bytes, self.size)
        if item.dtype.kind == "O":
            import h5py

            # Of a cell, or of a field of an array of structs.
            if h5py.check_ref_dtype(item.dtype) is not h5py.Reference:
                return []
            return [
                self.item(self.file[reference], depth + 1) if reference else None
                for reference in np.asarray(item[()]).ravel()
            ]
        if item.dtype.kind not in "fiub" or item.shape is None:
            return None
        # Never read other files. An empty array stores its shape in place of samples.
        if item.external or item.is_virtual or item.attrs.get("MATLAB_empty"):
            return None
        values = np.asarray(item[()])
        kind = item.attrs.get("MATLAB_class")
        if kind == b"char":
            return "".join(map(chr, values.ravel().tolist()))
        # MATLAB stores column by column, so matrices appear transposed.
        return values if kind is None else values.T


def read_mdf(path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Table of the requested channels, with their units; `time` is their common time."""
    if find_spec("asammdf") is None:
        raise ImportError(
            "MDF files need asammdf: pip install nfriction[mdf]; or export them as .csv or .mat."
        )
    return read_in_worker("asammdf", path, sources)


def _mdf_signals(path: Path, sources: Sequence[str]) -> Signals:
    """Signals of an MDF file; asammdf's own errors on damage pass."""
    from asammdf import MDF

    with MDF(path) as file:
        return choose_channels(file, sources)


def choose_channels(file: Any, sources: Sequence[str]) -> Signals:
    """Channels of an open file that were sampled together."""
    places = dict(file.channels_db)
    columns: dict[str, Any] = {}
    units: dict[str, str] = {}
    stamps: Any = None
    # Each group has a channel of time stamps, often called "time"; every signal also has them.
    ours = {name for name in places if OURS.fullmatch(name) and name != "time"}
    for name in sorted(ours | asked_names(set(places), sources)):
        # Several groups may log one signal at different rates.
        if len(places[name]) > 1:
            raise ValueError(f"channel {name} occurs more than once")
        signal = file.get(name)
        if stamps is not None and not np.array_equal(stamps, signal.timestamps):
            raise ValueError(
                f"channel {name} was not sampled together with {next(iter(columns))}; export the "
                "measurement on one raster, for example with asammdf's `MDF.resample`"
            )
        if np.ndim(signal.samples) != 1:
            raise ValueError(f"channel {name} has arrays instead of numbers")
        stamps, columns[name] = signal.timestamps, signal.samples
        if signal.unit:
            units[name] = str(signal.unit)
    if stamps is not None:
        columns.setdefault("time", stamps)
    return Signals(columns, sorted(places), units)


def read_in_worker(library: str, path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Table of signals that a library reads in a separate process."""
    size = path.stat().st_size
    refuse_size(size)
    task = {"library": library, "path": str(path.absolute()), "sources": list(sources)}
    with tempfile.TemporaryDirectory() as folder:
        try:
            sandbox.run_isolated(__name__, task, Path(folder), seconds=STARTING + BY_BYTE * size)
            return load_signals(Path(folder)).table()
        # A corrupted worker may write anything, so reading its output may also fail.
        except (sandbox.WorkerDied, OSError, EOFError, LookupError, TypeError) as error:
            raise ValueError(f"{library} cannot read it ({error})") from None


def main() -> None:
    """Read a file in the worker; a ValueError of its reader refuses the file."""

    def work(task: Mapping[str, Any], folder: Path) -> None:
        read = SIGNALS_OF[task["library"]]
        save_signals(read(Path(task["path"]), task["sources"]), folder)

    sandbox.worker_main(work, memory=MEMORY)


# Readers in the worker, by library.
SIGNALS_OF = {"SciPy": _mat_signals, "asammdf": _mdf_signals}


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
    """Samples in this machine's byte order and a common size; non-numbers as text."""
    values = np.asarray(samples)
    if values.dtype.kind in "biu":
        return values.astype(values.dtype.newbyteorder("="))
    if values.dtype.kind == "S":
        return np.char.decode(values, "utf-8", "replace")
    return values.astype(np.float64 if values.dtype.kind == "f" else str)
