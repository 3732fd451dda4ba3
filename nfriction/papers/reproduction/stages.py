"""Stages of a reproduction: fits and their scores, run in parallel and stored when finished."""

import os
import signal
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from graphlib import TopologicalSorter
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from nfriction.evaluation.compare import coefficient_summary
from nfriction.evaluation.score import RMSE, score
from nfriction.fitting.fit import fit
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction import model_by_name
from nfriction.friction.models import FrictionModel
from nfriction.io.model_file import load, load_info, save
from nfriction.papers import twin
from nfriction.papers.afem.adaptive import CLASSES, Adaptive
from nfriction.papers.afem.classes import class_intervals
from nfriction.papers.afem.fit_by_search import SearchMethod, SearchOptions, fit_by_search
from nfriction.papers.control import study
from nfriction.papers.nffem.train_network import TrainingOptions, recorded_losses
from nfriction.papers.reproduction.agreement import missed_torque
from nfriction.papers.reproduction.procedure import papers_neuro_fuzzy
from nfriction.papers.reproduction.workspace import (
    FULL,
    Array,
    Bench,
    Settings,
    Workspace,
    smoothed,
)
from nfriction.papers.twin.dataset import COUNTS, QUICK_DURATION, RATE, sample_count, specification
from nfriction.papers.twin.mechanics import Links, simulate
from nfriction.plant import Plant, rigs
from nfriction.recording import Recording
from nfriction.signals import causal_motion
from nfriction.simulation.rollout import rollout
from nfriction.simulation.validate import required_substeps

LAWS = {"NCFM": "viscous", "LFM": "linear", "NLFM": "nonlinear"}
"""The papers' laws, by the names of their constant models."""
CONSTANT = (*LAWS, "Stribeck")
ADAPTIVE = tuple(f"A{law}" for law in LAWS)
BY_PATTERN = tuple(f"{name}-pattern" for name in ADAPTIVE)
"""Adaptive models fitted by the TLRIP paper's pattern search."""
NEURO_FUZZY = tuple(f"NF{law}" for law in LAWS)
PAPERS_WAY = tuple(f"{name}-papers" for name in NEURO_FUZZY)
SECOND_PAPER = tuple(f"rtip-{law}" for law in LAWS)
SEARCH: dict[str, SearchMethod] = {"NCFM": "sqp", "LFM": "pattern", "NLFM": "pattern"}
"""The RTIP paper's method for each model."""
EXPERIMENT = "experiment"
"""Twin of the TLRIP paper's friction experiment, whose classes are given in its Table 6."""
# Fresh releases of the TLRIP twin rank the models, because its two recorded ones leave that to
# chance. Joint angles at rest [deg], drawn as in the family of twins, selected only by the truth:
# starting one encoder count off at every joint, they stay within 16 counts for 10 s.
POSES = (
    (147.7, 37.5, 50.8), (159.0, -3.5, 27.4), (116.4, 53.5, -7.8), (204.9, -1.4, 13.2),
    (107.0, -50.7, -1.2), (117.1, 5.4, 30.0), (248.2, -41.7, -42.6), (147.5, 34.2, 47.5),
    (135.6, 19.1, -28.2), (218.5, -22.4, 58.6),
)  # fmt: skip


class Stage(NamedTuple):
    """One step of a reproduction, after those that it `needs`.

    `run` takes the workspace and the stage's name, and returns the result as plain JSON.
    """

    needs: tuple[str, ...]
    run: Callable[[Workspace, str], dict[str, Any]]


def stages() -> dict[str, Stage]:
    """All stages by name; the longest ones and their prerequisites come first."""
    found = {f"twin-{name}": Stage((), make_twin) for name in twin.names()}
    constant = Stage(("twin-tlrip",), partial(fitted, fit_from_start))
    for law in reversed(LAWS):
        by_class = (law, f"twin-{EXPERIMENT}")
        found |= {
            law: constant,
            f"A{law}": Stage(by_class, partial(fitted, fit_by_class)),
            f"A{law}-pattern": Stage(by_class, partial(fitted, fit_by_pattern)),
            f"NF{law}": Stage((law,), partial(fitted, fit_network)),
            f"NF{law}-papers": Stage((f"A{law}",), papers_way),
            f"rtip-{law}": Stage(("twin-rtip",), second_paper),
        }
    return found | {"Stribeck": constant, "control": Stage((), controlled)}


def reproduce(
    folder: str | Path, settings: Settings = FULL, *, jobs: int = 2, progress: bool = False
) -> Workspace:
    """Run every stage that is not finished.

    Each stage runs in a worker process and writes its result last and atomically, so a run that was
    interrupted or killed resumes with the unfinished stages.

    Args:
        folder: where all files are written; created if missing.
        settings: effort. Results from different settings are replaced.

    Returns:
        The workspace, with every stage finished.

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
    order = TopologicalSorter({n: waiting.keys() & stage.needs for n, stage in waiting.items()})
    order.prepare()
    ready: set[str] = set()
    running: dict[Future[None], str] = {}
    with (
        ProcessPoolExecutor(
            jobs, mp_context=get_context("spawn"), initializer=_end_with_the_caller
        ) as pool,
        ExitStack() as on_error,
    ):
        on_error.callback(_terminate, pool)
        while order.is_active():
            ready |= {*order.get_ready()}
            for name in [n for n in waiting if n in ready][: jobs - len(running)]:
                ready.remove(name)
                running[pool.submit(run_stage, workspace, name)] = name
            bar.set_postfix_str(", ".join(running.values()))
            # The timeout keeps the clock of the progress bar running.
            done, _ = wait(running, timeout=1.0, return_when=FIRST_COMPLETED)
            for future in done:
                future.result()
                order.done(running.pop(future))
                bar.update()
            bar.refresh()
        on_error.pop_all()


def _terminate(pool: ProcessPoolExecutor) -> None:
    # Only a keyboard interrupt reaches the workers, and one may have been started just before, so
    # that it is not yet known to be running.
    for worker in list((pool._processes or {}).values()):
        worker.terminate()


def _end_with_the_caller() -> None:
    # A solver keeps its best point on Ctrl-C; that fit would be mistaken for a finished one.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    caller = parent_process()
    assert caller is not None

    def watch() -> None:
        caller.join()
        os._exit(1)

    # A caller that is killed cannot end its workers, which would wait for work forever.
    threading.Thread(target=watch, daemon=True).start()


def run_stage(workspace: Workspace, name: str) -> None:
    """Run a stage whose prerequisites are finished, and mark it as finished."""
    # Multithreading makes operations on small tensors up to 100 times slower.
    torch.set_num_threads(1)
    start = time.perf_counter()
    result = stages()[name].run(workspace, name)
    workspace.finish(name, result | {"seconds": time.perf_counter() - start})


def make_twin(workspace: Workspace, name: str) -> dict[str, Any]:
    """Simulate a twin's recordings, and smooth them once for all fits."""
    settings, rig = workspace.settings, name.removeprefix("twin-")
    duration = settings.rtip_seconds if rig == "rtip" else settings.tlrip_seconds
    made = twin.build(rig, workspace.folder / "twin" / rig, seed=settings.seed, duration=duration)
    motions = smoothed(made.plant, list(made.recordings.values()))
    arrays: dict[str, Array] = {}
    for label, motion in zip(made.recordings, motions, strict=True):
        arrays |= {f"{label}_{key}": getattr(motion, key) for key in ("q", "qd", "qdd")}
    if rig == "tlrip":
        arrays["fresh"] = true_positions(duration)
    workspace.write_arrays(name, arrays)
    found: dict[str, Any] = {
        "recordings": {label: r.digest() for label, r in made.recordings.items()}
    }
    if made.part("test"):
        found["missed_torque"] = missed_torque(made)
    return found


def fit_from_start(
    workspace: Workspace, bench: Bench, name: str, *, start: FitResult | None = None, **options: Any
) -> FitResult:
    """A model with these options, fitted to trajectories, from an earlier fit or none."""
    settings = workspace.settings
    model = model_by_name(name)(bench.plant.joints, **options)
    return workspace.fit(name, bench, lambda step: fit(
        model, bench.plant, bench.train, windows=settings.windows,
        max_steps=settings.max_steps, fit_plant=settings.fit_plant, start=start,
        motions=bench.train_motions, callback=step,
    ))  # fmt: skip


def fit_by_class(workspace: Workspace, bench: Bench, name: str) -> FitResult:
    """A model with coefficients by class of acceleration, from its constant fit."""
    start = fit_from_start(workspace, bench, name.removeprefix("A"))
    return fit_from_start(workspace, bench, name, start=start)


def fit_network(workspace: Workspace, bench: Bench, name: str) -> FitResult:
    """A neuro-fuzzy model by our method: a network corrects the constant law, on trajectories."""
    start, settings = fit_from_start(workspace, bench, name.removeprefix("NF")), workspace.settings
    return fit_from_start(
        workspace, bench, name, start=start, terms=settings.terms, head_units=settings.head_units
    )


def fit_searched(
    workspace: Workspace,
    bench: Bench,
    name: str,
    method: SearchMethod,
    horizon: float,
    *,
    start: FitResult | None = None,
    threads: int | None = None,
) -> FitResult:
    """A model fitted by a search on the simulated position, resumed after an interruption.

    The stage's name is that of the model with a prefix or suffix; for the rest see `SearchOptions`.
    """
    settings = workspace.settings
    model = model_by_name(name.removeprefix("rtip-").removesuffix("-pattern"))(bench.plant.joints)
    options = SearchOptions(
        method, horizon, max_evaluations=settings.search_evaluations,
        seed=settings.seed, threads=threads, state=workspace.search_state(name),
    )  # fmt: skip
    return workspace.fit(name, bench, lambda step: fit_by_search(
        model, bench.plant, bench.train, options=options,
        start=start, motions=bench.train_motions, callback=workspace.keep_search(name, step),
    ))  # fmt: skip


def fit_by_pattern(workspace: Workspace, bench: Bench, name: str) -> FitResult:
    """An adaptive model by the TLRIP paper's method, from its constant fit."""
    law = name.removeprefix("A").removesuffix("-pattern")
    return fit_searched(
        workspace, bench, name, "pattern", workspace.settings.windows[-1],
        start=fit_from_start(workspace, bench, law), threads=1,
    )  # fmt: skip


def network_by_controller(
    workspace: Workspace, bench: Bench, law: str, *, progress: bool = False
) -> tuple[FrictionModel, dict[str, Any]]:
    """A neuro-fuzzy model by the papers' method, from coefficients by class; and its fit status."""
    settings = workspace.settings
    losses, keep = recorded_losses(bench.plant.joint_names)
    model, fits = papers_neuro_fuzzy(
        load(workspace.model(f"A{law}")), bench.train_motions,
        samples=settings.controller_samples, units=settings.network_units,
        options=TrainingOptions(seed=settings.seed, progress=progress, callback=keep),
    )  # fmt: skip
    workspace.finish(f"NF{law}-losses", losses)
    unfinished = [fit.message for fit in fits if not fit.converged]
    status = f"Not converged: {len(unfinished)} of {len(fits)} networks. {' '.join(unfinished[:1])}"
    return model, {
        "procedure": "classes, fuzzy controller, network by Bayesian regularisation",
        "status": status if unfinished else "Converged.",
        "converged": not unfinished,
    }


def fitted(
    fit: Callable[[Workspace, Bench, str], FitResult], workspace: Workspace, name: str
) -> dict[str, Any]:
    """Result of a fit on the TLRIP twin."""
    bench = workspace.bench("tlrip")
    found = fit(workspace, bench, name)
    # If a network selected the load as an input, it is that of the bearings.
    bench = replace(bench, plant=found.plant)
    return _judged(workspace, name, bench, found.model, found.to_dict())


def second_paper(workspace: Workspace, name: str) -> dict[str, Any]:
    """Result of a search on the RTIP paper's rig."""
    bench, method = workspace.bench("rtip"), SEARCH[name.removeprefix("rtip-")]
    horizon = workspace.settings.search_horizon
    found = fit_searched(workspace, bench, name, method, horizon, threads=1)
    return _judged(workspace, name, bench, found.model, found.to_dict())


def papers_way(workspace: Workspace, name: str) -> dict[str, Any]:
    """Result of the papers' own neuro-fuzzy procedure."""
    bench, law = workspace.bench("tlrip"), name.removeprefix("NF").removesuffix("-papers")
    model, ended = network_by_controller(workspace, bench, law)
    info = replace(load_info(workspace.model(f"A{law}")), fit=ended)
    save(model, workspace.model(name), info)
    return _judged(workspace, name, bench, model, ended)


def controlled(workspace: Workspace, name: str) -> dict[str, Any]:
    """Result of the control study: the papers' future work."""
    settings = workspace.settings
    fitted: list[dict[str, FrictionModel]] = []
    for rig, plant in (("one", study.single_link()), ("three", rigs.rtip("free"))):
        recording = study.driven_recording(
            plant, study.true_friction(plant), seconds=12.0, seed=settings.seed
        )
        fitted.append({n: study.fitted_model(plant, recording, n) for n in settings.control_models})
        for label, model in fitted[-1].items():
            save(model, workspace.model(f"{name}-{rig}-{label}"))
    tables, motions = study.run_study(
        *fitted, seconds=settings.control_seconds, settled=0.375 * settings.control_seconds
    )
    workspace.write_arrays(name, motions)
    return {"tables": tables}


def _judged(
    workspace: Workspace, stage: str, bench: Bench, model: FrictionModel, ended: Mapping[str, Any]
) -> dict[str, Any]:
    """Status of a model's fit, its scores and coefficients, and its classes if it has any."""
    scores, simulated = judge(bench, model)
    workspace.write_arrays(stage, simulated)
    found: dict[str, Any] = {
        "fit": ended, "scores": scores, "coefficients": coefficient_summary(model)
    }  # fmt: skip
    if stage not in SECOND_PAPER:
        true = workspace.arrays("twin-tlrip")["fresh"]
        found["fresh"] = free_run_errors(bench.plant, model, true)
    schedule = model.schedule
    if not isinstance(schedule, Adaptive):
        return found
    (motion,) = workspace.bench(EXPERIMENT).motions
    labels = schedule.classes(torch.tensor(motion.qd), torch.tensor(motion.qdd)).T.numpy()
    return found | {
        "classes": {
            known: {n: schedule.values[:, c, k].tolist() for k, n in enumerate(model.law.names)}
            for c, known in enumerate(CLASSES)
        },
        "thresholds": schedule.thresholds.tolist(),
        "intervals": [class_intervals(motion.time, known) for known in labels],
    }


def judge(bench: Bench, model: FrictionModel) -> tuple[dict[str, Any], dict[str, Array]]:
    """Position errors on every recording by name, and simulated positions of the test recordings.

    The coefficients are driven by the simulated motion (a genuine prediction) and also by the
    measured motion, as in the papers; with constant coefficients both are the same.
    """
    scores: dict[str, Any] = {}
    simulated: dict[str, Array] = {}
    for split, recording in bench.parts():
        name, state = recording.name, bench.states[recording.name]
        found = score(bench.plant, model, recording, initial_state=state, limit=False)
        driven = found.simulated
        if model.schedule.follows_motion:
            driven = driven_by_measurement(bench, model, recording)
        error = RMSE.of(driven - recording.q).to_dict()
        scores[name] = found.to_dict() | {"split": split, "measured_drive": error}
        if split == "test":
            simulated |= {name: found.simulated, f"{name}_measured_drive": driven}
    return scores, simulated


def driven_by_measurement(bench: Bench, model: FrictionModel, recording: Recording) -> Array:
    """Positions of a free run whose coefficients follow the measured motion, as in the papers.

    Velocity and acceleration are those available to a controller: period counting and filters.

    Returns:
        Positions in the recording's convention, (sample, joint).

    References:
        TLRIP paper, friction experiment (2048 pulses, frequency counting, second-order filter).
    """
    plant, (q0, qd0) = bench.plant, bench.states[recording.name]
    convention, first = recording.resolve_convention(plant), plant.first_link
    joint = recording.joint_coordinates(plant)
    motion = causal_motion(joint.time, joint.q, COUNTS)
    step = np.diff(joint.time)
    start = convention.position_to_joint(q0, first), convention.rate_to_joint(qd0, first)
    with torch.no_grad():
        run = rollout(
            plant, model, *map(torch.tensor, start), sample_time=torch.tensor(step),
            substeps=required_substeps(plant, model, float(step.max())), drive="measured",
            measured=(torch.tensor(motion.qd[:-1]), torch.tensor(motion.qdd[:-1])),
        )  # fmt: skip
    return convention.position_from_joint(run.q.numpy(), first)


def true_positions(seconds: float) -> Array:
    """True positions along the releases [rad], at most 10 s, (release, sample, joint)."""
    specified, samples = specification("tlrip"), sample_count(min(seconds, QUICK_DURATION))
    links = Links.of(specified.rig())
    starts = np.deg2rad(POSES).tolist()
    return np.stack(
        [
            simulate(links, specified.friction, (a, b, c), samples=samples, rate=RATE).q
            for a, b, c in starts
        ]
    )


def free_run_errors(plant: Plant, model: FrictionModel, true: Array) -> list[list[float | None]]:
    """RMSE of free runs by release and joint [rad]; None if a simulation diverges."""
    start = torch.tensor(true[:, 0])
    run = rollout(
        plant, model, start, torch.zeros_like(start), sample_time=1 / RATE,
        steps=true.shape[1] - 1, substeps=required_substeps(plant, model, 1 / RATE),
        gradients=False,
    )  # fmt: skip
    return [RMSE.of(error).to_dict()["joints"] for error in run.q.numpy() - true]
