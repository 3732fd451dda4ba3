"""Readers in a worker process, for libraries that a damaged file may crash or hang."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nfriction.io import sandbox
from nfriction.io.formats.files import LARGEST, refuse_size
from nfriction.io.formats.nested import Signals

if TYPE_CHECKING:
    import pandas as pd

# Processor time of the worker [s]: for imports, and for a byte of the file.
STARTING, BY_BYTE = 20.0, 1e-7
# Address space for libraries and several copies of a file [bytes].
MEMORY = 16 * LARGEST
_SIGNALS = "signals.npz"


def read_in_worker(
    module: str, library: str, path: Path, sources: Sequence[str] = ()
) -> pd.DataFrame:
    """Table of signals that a module's `main` reads in a process of its own.

    Raises:
        ValueError: the file is too large, the worker refused it or died of it, or its signals make
            no table.
    """
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
