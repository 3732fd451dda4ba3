"""Stages: their order, and the resumption of a killed run."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from graphlib import TopologicalSorter
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from nfriction import NFNCFM
from nfriction.fitting.strategy.inputs import seeing_plant
from nfriction.papers.reproduction import stages as stages_module
from nfriction.papers.reproduction import tables
from nfriction.papers.reproduction.stages import (
    _end_with_the_caller,
    reproduce,
    run_stage,
    stages,
)
from nfriction.papers.reproduction.workspace import Bench, Settings, Workspace

TINY = Settings(
    tlrip_seconds=2.0,
    rtip_seconds=1.0,
    windows=(0.5,),
    max_steps=1,
    controller_samples=200,
    search_horizon=0.5,
    search_evaluations=40,
    control_models=("NCFM",),
    control_seconds=0.5,
)


def test_every_stage_follows_its_dependencies() -> None:
    every = {name: stage.needs for name, stage in stages().items()}
    # Raises if a stage needs itself.
    assert set(TopologicalSorter(every).static_order()) == set(every)


def test_stage_waits_for_its_dependencies(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    done: set[str] = set()

    def run(workspace: Workspace, name: str) -> None:
        assert done >= set(stages()[name].needs)
        time.sleep(0.005)  # others may start meanwhile
        done.add(name)

    monkeypatch.setattr(stages_module, "run_stage", run)
    monkeypatch.setattr(
        stages_module, "ProcessPoolExecutor", lambda jobs, **_: ThreadPoolExecutor(jobs)
    )
    reproduce(tmp_path, TINY, jobs=3)
    assert done == set(stages())


def test_at_least_one_stage_at_a_time(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="jobs"):
        reproduce(tmp_path, TINY, jobs=0)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A run whose first twin is complete."""
    made = Workspace(tmp_path_factory.mktemp("run"), TINY)
    run_stage(made, "twin-tlrip")
    return made


def test_constant_model_is_fitted_scored_and_stored(workspace: Workspace) -> None:
    run_stage(workspace, "NCFM")
    found = workspace.found("NCFM")
    assert {s["split"] for s in found["scores"].values()} == {"train", "test"}
    for score in found["scores"].values():
        # Constant coefficients do not depend on the drive.
        assert score["measured_drive"] == score["free_run"]
        assert max(score["free_run"]["joints"]) < 0.5
    assert workspace.model("NCFM").exists()


def test_network_with_bearing_load_is_scored_on_a_plant_with_that_load(
    workspace: Workspace,
) -> None:
    def load_seen(workspace: Workspace, bench: Bench, name: str) -> Any:
        model = NFNCFM(3, [0.03] * 2, inputs=["load"]).requires_grad_(False)
        plant = seeing_plant(bench.plant, ["load"])
        return SimpleNamespace(model=model, plant=plant, to_dict=dict)

    found = stages_module.fitted(load_seen, workspace, "NFNCFM")
    assert all(score["free_run"]["all"] < 1.0 for score in found["scores"].values())


def _killed_caller(connection: Connection) -> None:
    """Report the process id of a worker, and die without stopping it."""
    # Forked, as another import of everything takes seconds; it ends in the same way.
    context = get_context("fork")
    pool = ProcessPoolExecutor(1, mp_context=context, initializer=_end_with_the_caller)
    connection.send(pool.submit(os.getpid).result())
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="processes are looked up in /proc")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_workers_end_with_a_killed_caller() -> None:
    ours, theirs = Pipe()
    caller = get_context("fork").Process(target=_killed_caller, args=(theirs,))
    caller.start()
    assert ours.poll(60)
    worker = ours.recv()
    caller.join(60)
    assert caller.exitcode == -signal.SIGKILL
    try:
        deadline = time.monotonic() + 60
        while _runs(worker):
            assert time.monotonic() < deadline
            time.sleep(0.05)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(worker, signal.SIGKILL)


def _runs(process: int) -> bool:
    try:
        status = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False
    return status.rpartition(")")[2].split()[0] != "Z"


@pytest.mark.slow
def test_killed_run_is_resumed(tmp_path: Path) -> None:
    script = tmp_path / "run.py"
    script.write_text(
        "import sys\n"
        "from nfriction.papers.reproduction.stages import reproduce\n"
        "from nfriction.papers.reproduction.workspace import Settings\n"
        f"if __name__ == '__main__':\n    reproduce(sys.argv[1], {TINY!r}, jobs=2)\n"
    )
    folder = tmp_path / "out"
    process = subprocess.Popen([sys.executable, str(script), str(folder)], start_new_session=True)
    deadline = time.monotonic() + 240
    while len(list(folder.glob("stages/NLFM.json"))) < 1:
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    workspace = Workspace(folder, TINY)
    done = {n: workspace.found(n) for n in stages() if workspace.result(n) is not None}
    assert 0 < len(done) < len(stages())
    subprocess.run([sys.executable, str(script), str(folder)], check=True)
    for name, result in done.items():
        assert workspace.found(name) == result  # its seconds too: it was not run again
    assert len(tables.table_10(workspace)) == 16
