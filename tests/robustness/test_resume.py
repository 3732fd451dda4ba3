"""Runs that are killed or interrupted at any moment end with the result of an uninterrupted run."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random

import pytest

from nfriction.papers.afem.fit_by_search import SearchState

ROOT = Path(__file__).resolve().parents[2]
SEARCH = ["train_constant.py", "--twin", "rtip", "--seconds", "1", "--model", "LFM",
          "--method", "pattern", "--horizon", "0.5", "--max-evaluations", "300"]  # fmt: skip
STAGES = ["train_neurofuzzy.py", "--seconds", "1", "--windows", "0.5", "--max-steps", "2",
          "--model", "NFNCFM"]  # fmt: skip
REPRODUCE = """
import sys
from nfriction.papers.reproduction.stages import reproduce
from nfriction.papers.reproduction.workspace import Settings
if __name__ == "__main__":
    reproduce(sys.argv[1], Settings(
        tlrip_seconds=1.0, rtip_seconds=1.0, windows=(0.5,), max_steps=1,
        controller_samples=50, search_horizon=0.5, search_evaluations=20,
        control_models=("NCFM",), control_seconds=0.5,
    ), jobs=1)
"""
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1"}
Check = Callable[[Path], None]


def begin(words: list[str]) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        env=ENVIRONMENT, cwd=ROOT, start_new_session=True,
        # A shell in which the tests run in the background lets its children ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip


def end(process: "subprocess.Popen[str]", how: int) -> str:
    """Standard error of a process that is ended together with its children."""
    if how == signal.SIGKILL:
        os.killpg(process.pid, how)
        return process.communicate()[1]
    # A library's import may swallow a Ctrl-C; a user presses it again.
    for _ in range(10):
        process.send_signal(how)
        with suppress(subprocess.TimeoutExpired):
            return process.communicate(timeout=20)[1]
    os.killpg(process.pid, signal.SIGKILL)
    raise AssertionError("it does not end on Ctrl-C")


def broken_off(
    words: list[str], folder: Path, started: Path, seed: int, kills: int, check: Check
) -> None:
    """Run to the end with `kills` terminations at random moments from the seed.

    Args:
        started: a file that exists as soon as the work has started.
        check: condition that must be true of the folder after each termination.
    """
    rng = Random(seed)
    for kill in range(kills):
        how = signal.SIGKILL if kill % 2 == 0 else signal.SIGINT
        process = begin(words)
        deadline = time.monotonic() + 200
        while not started.exists() and process.poll() is None:
            assert time.monotonic() < deadline
            time.sleep(0.02)
        # In every run but the first, imports take most of the first seconds.
        time.sleep(rng.uniform(0.0, 1.5) + (0.0 if kill == 0 else rng.uniform(1.0, 4.0)))
        if process.poll() is None:
            messages = end(process, how)
            if how == signal.SIGINT and process.returncode:
                assert process.returncode in (130, -signal.SIGINT), messages
        check(folder)
    process = begin(words)
    messages = process.communicate(timeout=500)[1]
    assert process.returncode == 0, messages


def whole(words: list[str]) -> None:
    subprocess.run([sys.executable, *words], env=ENVIRONMENT, cwd=ROOT, check=True,
                   stdout=subprocess.DEVNULL, timeout=500)  # fmt: skip


class Kept:
    """Check that finished files do not change and a search never loses progress."""

    def __init__(self) -> None:
        self.finished: dict[Path, bytes] = {}
        self.evaluations = 0

    def __call__(self, folder: Path) -> None:
        files = [p for p in folder.rglob("*") if p.is_file() and not p.name.startswith(".")]
        for path, content in self.finished.items():
            assert path in files, f"{path.name} was lost"
            assert path.read_bytes() == content, f"{path.name} was made anew"
        for path in files:
            if path.suffix == ".json":
                json.loads(path.read_text())  # no partial file
            if path.name.endswith("-search.json"):
                state = SearchState(**json.loads(path.read_text())["result"])
                assert state.evaluations >= self.evaluations
                self.evaluations = state.evaluations
            # The result is written again by a run that only reads its stages.
            elif path.parent.name == "stages":
                model = path.with_suffix(".json")
                if model.exists():  # which is written last
                    self.finished[path] = path.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(("options", "seed"), [(SEARCH, 0), (SEARCH, 1), (STAGES, 2), (STAGES, 3)])
def test_repeatedly_killed_trainer_gives_the_same_result(
    tmp_path: Path, options: list[str], seed: int
) -> None:
    words = [str(ROOT / "trainers" / options[0]), *options[1:], "--out"]
    whole([*words, str(tmp_path / "whole")])
    folder = tmp_path / "ended"
    started = folder / "checkpoints" / "stages" / "options.json"
    broken_off([*words, str(folder), "--resume"], folder, started, seed, 4, Kept())
    model = f"{options[options.index('--model') + 1]}.json"
    assert (folder / model).read_bytes() == (tmp_path / "whole" / model).read_bytes()


@pytest.mark.slow
def test_repeatedly_killed_reproduction_gives_the_same_result(tmp_path: Path) -> None:
    script = tmp_path / "run.py"
    script.write_text(REPRODUCE)
    whole([str(script), str(tmp_path / "whole")])
    folder = tmp_path / "ended"
    broken_off([str(script), str(folder)], folder, folder / "twin", 5, 5, Kept())
    expected, found = (
        {p.relative_to(f): p.read_bytes() for p in (f / "models").glob("*.json")}
        for f in (tmp_path / "whole", folder)
    )
    assert expected == found
    for path in (tmp_path / "whole" / "stages").glob("*.json"):
        ours = json.loads((folder / "stages" / path.name).read_text())
        theirs = json.loads(path.read_text())
        for content in (ours, theirs):
            content.get("result", {}).pop("seconds", None)
        assert ours == theirs, path.name


@pytest.mark.slow
def test_ctrl_c_saves_the_progress_and_names_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    process = begin([str(ROOT / "trainers" / SEARCH[0]), *SEARCH[1:], "--out", str(folder)])
    state = folder / "checkpoints" / "stages" / "LFM-search.json"
    deadline = time.monotonic() + 200
    while not state.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    messages = end(process, signal.SIGINT)
    assert process.returncode == 130, messages
    assert f"progress is saved in {folder}" in messages
    assert "Traceback" not in messages
    assert state.exists()
    assert not [p for p in folder.rglob("*") if p.suffix == ".part"]
