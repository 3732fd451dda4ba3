"""Fixtures of the command-line tests."""

import contextlib
import io
from collections.abc import Callable
from pathlib import Path

import pytest

from nfriction import cli, rigs
from tests.cli.benches import compare, pendulum, swing


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a rig, a training and a test recording."""
    folder = tmp_path_factory.mktemp("bench")
    rigs.write(pendulum(), folder / "bench.json")
    swing("a", 2.0).write(folder / "a.csv.gz")
    swing("b", 1.5).write(folder / "b.csv")
    return folder


@pytest.fixture(scope="session")
def compared(bench: Path) -> Path:
    """Folder of a comparison of two models."""
    out = bench / "out"
    assert compare(bench, out, models="NCFM,LFM") == 0
    return out


@pytest.fixture(scope="session")
def again(bench: Path) -> tuple[Path, str]:
    """Folder and output of the same comparison, with plain file names and without figures."""
    out, printed = bench / "again", io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert compare(bench, out, "--no-figures", models="viscous,load-coulomb") == 0
    return out, printed.getvalue()


@pytest.fixture
def failing(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command that must fail with status 2 and one line, which is returned."""

    def run(*words: object) -> str:
        assert cli.main([str(w) for w in words]) == 2
        printed = capsys.readouterr()
        assert printed.err.startswith("nfriction: error: ")
        assert printed.err.count("\n") == 1
        return printed.err

    return run
