"""Readers that work in a process of their own, for tests of what they read in this one."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd
import pytest

from nfriction.io.formats import measurements


@pytest.fixture
def without_worker(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """A function that has files read here, which takes no second for imports."""

    def read(library: str, path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
        with tempfile.TemporaryDirectory() as folder:
            found = measurements.SIGNALS_OF[library](path, sources)
            measurements.save_signals(found, Path(folder))
            return measurements.load_signals(Path(folder)).table()

    return lambda: monkeypatch.setattr(measurements, "read_in_worker", read)
