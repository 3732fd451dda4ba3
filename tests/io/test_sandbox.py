"""Work in a separate process: results, error messages, crashes and limits."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from nfriction.io import sandbox

WORK = """
import os, pathlib, sys, tempfile, time
from nfriction.io import sandbox

def work(task, folder):
    {body}

def main():
    sandbox.worker_main(work, memory=2**33)
"""
Run = Callable[..., Path]
posix = pytest.mark.skipif(sys.platform == "win32", reason="signals and limits of POSIX")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run a module with the given body and return the folder of its results."""
    monkeypatch.syspath_prepend(tmp_path)
    folder = tmp_path / "results"
    folder.mkdir()

    def start(body: str, seconds: float = 60.0, **task: object) -> Path:
        (tmp_path / "works_apart.py").write_text(WORK.format(body=body))
        sandbox.run_isolated("works_apart", task, folder, seconds=seconds)
        return folder

    return start


def test_results_are_in_the_folder(run: Run) -> None:
    folder = run('(folder / "out").write_text(task["what"])', what="Lösung")
    assert (folder / "out").read_text() == "Lösung"


def test_temporary_files_are_in_the_folder_too(run: Run) -> None:
    folder = run('open(tempfile.mkstemp()[1], "w").write("left behind")')
    assert len(list(folder.iterdir())) == 1


def test_errors_are_passed_on(run: Run) -> None:
    with pytest.raises(sandbox.InvalidFile, match="no such channel"):
        run('raise ValueError("no such channel")')


@posix
@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("os.abort()", "SIGABRT"),
        ("os.kill(os.getpid(), 11)", "SIGSEGV"),
        ("sys.exit(3)", "exit status 3"),
        ("raise RuntimeError('lost')", "RuntimeError: lost"),
        ("bytearray(2**34)", "MemoryError"),
    ],
)
def test_cause_of_a_crash_is_reported(run: Run, body: str, message: str) -> None:
    with pytest.raises(sandbox.WorkerDied, match=message):
        run(body)


@posix
def test_processor_time_is_limited(run: Run) -> None:
    with pytest.raises(sandbox.WorkerDied, match="does not come to an end"):
        run("while True: pass", seconds=1.0)


def test_waiting_time_is_limited(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sandbox, "BUSY", 3.0)
    with pytest.raises(sandbox.WorkerDied, match="does not come to an end"):
        run("time.sleep(600)", seconds=1.0)
