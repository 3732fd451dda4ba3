"""Readers that run in this process, for tests of what they read."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd
import pytest

from nfriction.io.formats import measurements


@pytest.fixture
def without_worker(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Make file readers run in this process, which saves the imports of a worker."""

    def read(library: str, path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
        with tempfile.TemporaryDirectory() as folder:
            found = measurements.SIGNALS_OF[library](path, sources)
            measurements.save_signals(found, Path(folder))
            return measurements.load_signals(Path(folder)).table()

    return lambda: monkeypatch.setattr(measurements, "read_in_worker", read)
