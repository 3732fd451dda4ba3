"""Parallel work: equal results, messages in the parent, named errors, clean interruption."""

import json
import logging
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest
import torch

from nfriction.evaluation import parallel
from nfriction.evaluation.compare import compare
from tests.cli.benches import pendulum, swing

logger = logging.getLogger("nfriction.tests")


def whereabouts(number: float) -> tuple[float, int, int]:
    return 2 * number, os.getpid(), torch.get_num_threads()


def complain(what: str) -> None:
    logger.warning("%s is wrong", what)
    logger.debug("nobody asked for this")
    warnings.warn(f"{what} is odd", UserWarning, stacklevel=1)


def fail(what: str) -> None:
    raise ZeroDivisionError(what)


@pytest.fixture(params=[1, 2])
def jobs(request: pytest.FixtureRequest) -> int:
    if request.param > 1:
        pytest.importorskip("joblib")
    return request.param


def test_every_task_runs_on_one_thread(jobs: int) -> None:
    pieces = {f"piece {k}": (float(k),) for k in range(4)}
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        found = dict(parallel.as_completed(whereabouts, pieces, jobs=jobs))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert {label: value for label, (value, _, _) in found.items()} == {
        f"piece {k}": 2.0 * k for k in range(4)
    }
    assert {threads for _, _, threads in found.values()} == {1}
    processes = {process for _, process, _ in found.values()}
    assert (processes == {os.getpid()}) == (jobs == 1)


def test_caller_receives_progress(jobs: int) -> None:
    stages: list[str] = []
    progress = parallel.Progress()
    progress.stage = stages.append  # type: ignore[method-assign]
    pieces = {"a": (1.0,), "b": (2.0,)}
    list(parallel.as_completed(whereabouts, pieces, jobs=jobs, progress=progress))
    if jobs == 1:
        assert stages == ["a", "b"]
    else:
        assert stages[0] == "a | b"
        assert {line.split()[0] for line in stages[1:]} == {"a", "b"}
        assert stages[-1].endswith("done, 0 of 2 left")


def test_logs_and_warnings_reach_the_parent_process(
    jobs: int, caplog: pytest.LogCaptureFixture
) -> None:
    pieces = {"a": ("the first",), "b": ("the second",)}
    with caplog.at_level(logging.INFO, "nfriction"), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        list(parallel.as_completed(complain, pieces, jobs=jobs))
    assert sorted(caplog.messages) == ["the first is wrong", "the second is wrong"]
    assert sorted(str(w.message) for w in caught) == ["the first is odd", "the second is odd"]


def test_error_names_its_task_and_keeps_its_type(jobs: int) -> None:
    with pytest.raises(ZeroDivisionError, match=r"^fit LFM: by naught$"):
        list(parallel.as_completed(fail, {"fit LFM": ("by naught",)}, jobs=jobs))
    with pytest.raises(ZeroDivisionError, match=r"^[ab]: naught$"):
        list(parallel.as_completed(fail, {"a": ("naught",), "b": ("naught",)}, jobs=jobs))


def test_callers_joblib_backend_is_used() -> None:
    """Such as a Dask cluster's; threads of this process are equivalent."""
    joblib = pytest.importorskip("joblib")
    with joblib.parallel_config(backend="threading"):
        found = dict(parallel.as_completed(whereabouts, {"a": (1.0,), "b": (2.0,)}, jobs=2))
    assert {process for _, process, _ in found.values()} == {os.getpid()}


def test_invalid_arguments_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="at least 1, or -1"):
        parallel.check_jobs(0)
    monkeypatch.setitem(sys.modules, "joblib", None)
    parallel.check_jobs(1)
    with pytest.raises(ImportError, match=r"pip install nfriction\[parallel\]"):
        parallel.check_jobs(2)


class Interrupted(parallel.Progress):
    """A user who presses Ctrl-C at the end of a stage."""

    def __init__(self, stages: int) -> None:
        self.left, self.resumed = stages, 0

    def done(self) -> None:
        self.left -= 1
        if self.left == 0:
            raise KeyboardInterrupt

    def resume(self) -> None:
        self.resumed += 1


def test_finished_fits_survive_ctrl_c() -> None:
    settings = {"max_steps": 3, "windows": (0.5,), "fit_plant": False}
    user = Interrupted(2)
    found = compare(pendulum(), ["NCFM", "CVFM"], [swing("a", 1.5)], [swing("b", 1.2)],
                    progress=user, **settings)  # fmt: skip
    assert user.resumed == 1
    assert [*found.fits] == ["NCFM"]
    assert dict(found.failed) == {"CVFM": "interrupted"}
    assert [*found.test] == ["no friction", "NCFM"]
    with pytest.raises(KeyboardInterrupt):
        compare(pendulum(), ["NCFM"], [swing("a", 1.5)], progress=Interrupted(1), **settings)
    # While results are scored, there is nothing left to save.
    with pytest.raises(KeyboardInterrupt):
        compare(pendulum(), ["NCFM"], [swing("a", 1.5)], progress=Interrupted(2), **settings)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows sends no SIGINT to a group of processes")
def test_ctrl_c_ends_every_process_at_once(tmp_path: Path) -> None:
    """As from a terminal, the signal also reaches the workers, whose solvers would catch it."""
    pytest.importorskip("joblib")
    from nfriction import rigs

    rigs.write(pendulum(), tmp_path / "rig.json")
    swing("a", 1.5).write(tmp_path / "a.csv")
    words = ["compare", "a.csv", "--rig", "rig.json", "--models", "NCFM,NLFM,Stribeck", "--out",
             "out", "--max-steps", "100000", "--jobs", "2", "--log-file", "log"]  # fmt: skip
    process = subprocess.Popen(
        [sys.executable, "-m", "nfriction", *words], cwd=tmp_path, text=True,
        start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
    )  # fmt: skip
    log = tmp_path / "log"
    while not (log.exists() and "fit NLFM | fit Stribeck" in log.read_text()):
        assert process.poll() is None
        time.sleep(0.1)
    time.sleep(1.0)  # the workers start
    os.killpg(process.pid, signal.SIGINT)
    messages = process.communicate(timeout=60)[1]
    assert process.returncode == 130
    assert messages.startswith("nfriction: warning: interrupted: the finished fits are scored")
    # The finished model is not lost.
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [*results["models"]] == ["no friction", "NCFM"]
    assert results["failed"] == {"NLFM": "interrupted", "Stribeck": "interrupted"}
    # No process of the session is left.
    for _ in range(50):
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            break
        time.sleep(0.1)
    else:
        pytest.fail("a worker is still there")
    assert {path.stem for path in (tmp_path / "out" / "models").iterdir()} == {"NCFM"}
