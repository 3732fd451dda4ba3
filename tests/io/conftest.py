"""Readers that work in a process of their own, for tests of what they read in this one."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from nfriction.io.formats.signals import load_signals, save_signals


@pytest.fixture
def without_worker(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], None]:
    """A function that makes a module read files here, which takes no second for its imports."""

    def apply(module: Any) -> None:
        def read(_: str, __: str, path: Path, sources: Sequence[str] = ()) -> pd.DataFrame:
            with tempfile.TemporaryDirectory() as folder:
                save_signals(module.read_signals(path, sources), Path(folder))
                return load_signals(Path(folder)).table()

        monkeypatch.setattr(module, "read_in_worker", read)

    return apply
