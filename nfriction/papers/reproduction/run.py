"""Run the stages of a reproduction, several at a time, and resume what an earlier run left."""

import os
import signal
import threading
from collections.abc import Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any

from tqdm import tqdm

from nfriction.papers.reproduction.stages import Stage, run_stage, stages
from nfriction.papers.reproduction.workspace import FULL, Settings, Workspace


def reproduce(
    folder: str | Path,
    settings: Settings = FULL,
    *,
    jobs: int = 2,
    progress: bool = False,
) -> Workspace:
    """Run every stage that is not finished.

    Each stage runs in a worker process and writes its result last, whole or not at all, so a run
    that was ended by Ctrl-C or by force resumes with what is not finished.

    Args:
        folder: where all files go; made where it is missing.
        settings: how thorough. Results made with others are replaced.
        jobs: stages at a time.
        progress: show a bar of stages.

    Returns:
        The workspace, every stage finished.

    Raises:
        ValueError: if `jobs` is not positive.
    """
    if jobs < 1:
        raise ValueError(f"`jobs` must be at least 1, got {jobs}.")
    workspace = Workspace(Path(folder), settings)
    waiting = {n: s for n, s in stages().items() if workspace.result(n) is None}
    total = len(stages())
    with tqdm(total=total, initial=total - len(waiting), unit="stage", disable=not progress) as bar:
        if waiting:
            _run_all(workspace, waiting, jobs, bar)
    return workspace


def _run_all(workspace: Workspace, waiting: dict[str, Stage], jobs: int, bar: "tqdm[Any]") -> None:
    running: dict[Future[None], str] = {}
    finished = False
    pool = ProcessPoolExecutor(
        jobs, mp_context=get_context("spawn"), initializer=_end_with_the_caller
    )
    try:
        while waiting or running:
            for name in _ready(waiting, running.values()):
                if len(running) == jobs:
                    break
                running[pool.submit(run_stage, workspace, name)] = name
                del waiting[name]
            bar.set_postfix_str(", ".join(running.values()))
            # The timeout keeps the bar's clock running.
            done, _ = wait(running, timeout=1.0, return_when=FIRST_COMPLETED)
            for future in done:
                del running[future]
                future.result()
                bar.update()
            bar.refresh()
        finished = True
    finally:
        if not finished:
            # An error or an interrupt. Only an interrupt of the keyboard reaches the workers, and
            # one of them may have been started just before, so it is not among `running` yet.
            for worker in list((pool._processes or {}).values()):
                worker.terminate()
        pool.shutdown(cancel_futures=True)


def _ready(waiting: Mapping[str, Stage], running: Iterable[str]) -> list[str]:
    """Stages whose needs are finished, in their order."""
    blocked = {*waiting, *running}
    return [name for name, stage in waiting.items() if not blocked & set(stage.needs)]


def _end_with_the_caller() -> None:
    # A solver keeps its best point on Ctrl-C; such a fit would pass for a finished one.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    caller = parent_process()
    assert caller is not None

    def watch() -> None:
        caller.join()
        os._exit(1)

    # A caller that is killed cannot end its workers, which would wait for work for ever.
    threading.Thread(target=watch, daemon=True).start()
