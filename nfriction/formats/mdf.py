"""ASAM MDF measurement files (.mf4) through asammdf, read in a process of its own.

A damaged file can end the process that reads it, keep it busy for ever, or spoil its memory.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from multiprocessing.spawn import get_executable
from pathlib import Path

import numpy as np
import pandas as pd

from nfriction.formats.limits import refuse_size
from nfriction.formats.nested import signals_table

# Processor time of the reader [s]: to import what it needs, and to read a byte; then how much
# longer a busy machine may take.
STARTING, BY_BYTE, BUSY = 20.0, 1e-7, 10.0
# Python puts the folder where the user stands first in the path; what lies there is no module.
_READER = """import sys
sys.path[:] = [place for place in sys.path if place]
from nfriction.formats.mdf_reader import main
main()
"""
_ENDLESS = "asammdf does not come to an end with it"
_OUT_OF_TIME = getattr(signal, "SIGXCPU", 0) or math.nan


def read_mdf(path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
    """Table of the channels asked for, with their units; `time` is their common time.

    Raises:
        ImportError: asammdf is not installed.
        ValueError: no MDF file, one that asammdf cannot bear, or channels that were not sampled
            together.
    """
    if find_spec("asammdf") is None:
        raise ImportError(
            "MDF files need asammdf: pip install nfriction[mdf]; or export them as .csv or .mat."
        )
    size = path.stat().st_size
    refuse_size(size)
    seconds = STARTING + BY_BYTE * size
    with tempfile.TemporaryDirectory() as folder:
        table, refusal = Path(folder) / "table.npz", Path(folder) / "refusal.txt"
        asked = {"path": str(path.absolute()), "folder": folder, "seconds": seconds,
                 "sources": list(sources)}  # fmt: skip
        # What this process imports from, the other does, too.
        places = os.pathsep.join(place or os.getcwd() for place in sys.path)
        try:
            ended = subprocess.run(
                [get_executable(), "-c", _READER], input=json.dumps(asked).encode(),
                capture_output=True, env=os.environ | {"PYTHONPATH": places},
                timeout=BUSY * seconds, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise ValueError(_ENDLESS) from None
        if ended.returncode == -_OUT_OF_TIME:
            raise ValueError(_ENDLESS)
        if refusal.exists():
            raise ValueError(refusal.read_text(encoding="utf-8", errors="replace"))
        if ended.returncode != 0 or not table.exists():
            raise ValueError(f"asammdf cannot read it ({_end_of(ended)})")
        with np.load(table, allow_pickle=False) as held:
            told = json.loads(str(held["told"]))
            columns = {name: held[f"c{k}"] for k, name in enumerate(told["names"])}
    found = signals_table(columns, told["channels"])
    found.attrs["units"] = told["units"]
    return found


def _end_of(ended: subprocess.CompletedProcess[bytes]) -> str:
    """How a process ended: the signal, or its last words."""
    if ended.returncode < 0:
        return signal.Signals(-ended.returncode).name
    words = ended.stderr.decode(errors="replace").strip().splitlines()
    return words[-1][:200] if words else f"exit status {ended.returncode}"
