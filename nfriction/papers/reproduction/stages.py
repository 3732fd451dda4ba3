"""What a reproduction consists of: stages, each finished for itself from those before it."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from nfriction.evaluation.compare import coefficient_summary
from nfriction.evaluation.results import model_info
from nfriction.export import ExportError, torchscript
from nfriction.fitting.fit import fit
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.models import FrictionModel
from nfriction.friction.registry import model_by_name
from nfriction.io.model_file import load, load_info, save
from nfriction.io.model_info import ModelInfo
from nfriction.papers import twin
from nfriction.papers.afem.adaptive import CLASSES, Adaptive
from nfriction.papers.afem.fit_adaptive import fit_adaptive
from nfriction.papers.afem.fit_by_search import fit_by_search
from nfriction.papers.afem.search import SearchMethod
from nfriction.papers.nffem.refine_adaptive import refine_adaptive
from nfriction.papers.reproduction.fitfile import load_fit, save_fit
from nfriction.papers.reproduction.judging import judge
from nfriction.papers.reproduction.procedure import papers_neuro_fuzzy
from nfriction.papers.reproduction.workspace import Array, Bench, Workspace
from nfriction.signals import kalman_smoother

logger = logging.getLogger(__name__)

LAWS = {"NCFM": "viscous", "LFM": "linear", "NLFM": "nonlinear"}
"""The papers' laws by the name of their constant model."""
CONSTANT = (*LAWS, "Stribeck")
ADAPTIVE = tuple(f"A{law}" for law in LAWS)
NEURO_FUZZY = tuple(f"NF{law}" for law in LAWS)
PAPERS_WAY = tuple(f"{name}-papers" for name in NEURO_FUZZY)
SECOND_PAPER = tuple(f"rtip-{law}" for law in LAWS)
SEARCH: dict[str, SearchMethod] = {"NCFM": "sqp", "LFM": "pattern", "NLFM": "pattern"}
"""How the second paper estimates each model."""


@dataclass(frozen=True)
class Stage:
    """One step of a reproduction.

    Attributes:
        name: of its files.
        needs: stages that come before it.
        run: does it, given the workspace; returns what was found, as plain JSON.
    """

    name: str
    needs: tuple[str, ...]
    run: Callable[[Workspace], dict[str, Any]]


def stages() -> dict[str, Stage]:
    """All stages by name; those that take longest, and what they wait for, come first."""
    found = [Stage(f"twin-{name}", (), partial(make_twin, name=name)) for name in twin.names()]
    for law in reversed(LAWS):
        found += [
            Stage(law, ("twin-tlrip",), partial(constant, name=law)),
            Stage(f"A{law}", (law,), partial(adaptive, law=law)),
            Stage(f"NF{law}", (f"A{law}",), partial(neuro_fuzzy, law=law)),
            Stage(f"NF{law}-papers", (f"A{law}",), partial(papers_way, law=law)),
            Stage(f"rtip-{law}", ("twin-rtip",), partial(second_paper, law=law)),
        ]
    found.append(Stage("Stribeck", ("twin-tlrip",), partial(constant, name="Stribeck")))
    return {stage.name: stage for stage in found}


def run_stage(workspace: Workspace, name: str) -> None:
    """Run a stage whose needs are finished, and mark it as finished."""
    # Several threads make small tensors up to 100 times slower.
    torch.set_num_threads(1)
    start = time.perf_counter()
    result = stages()[name].run(workspace)
    workspace.finish(name, result | {"seconds": time.perf_counter() - start})


def make_twin(workspace: Workspace, name: str) -> dict[str, Any]:
    """Simulate a twin's recordings, and smooth them once for all fits."""
    settings = workspace.settings
    duration = {"tlrip": settings.tlrip_seconds, "rtip": settings.rtip_seconds}[name]
    made = twin.build(name, workspace.folder / "twin" / name, seed=settings.seed, duration=duration)
    arrays: dict[str, Array] = {}
    for label, recording in made.recordings.items():
        joint = recording.joint_coordinates(made.plant)
        motion = kalman_smoother(joint.time, joint.q)
        arrays |= {f"{label}_{key}": getattr(motion, key) for key in ("q", "qd", "qdd")}
    workspace.write_arrays(f"twin-{name}", arrays)
    return {"recordings": {label: r.digest() for label, r in made.recordings.items()}}


def constant(workspace: Workspace, name: str) -> dict[str, Any]:
    """Fit a model with constant coefficients on trajectories."""
    bench, settings = workspace.bench("tlrip"), workspace.settings
    found = fit(
        model_by_name(name)(bench.plant.joints), bench.plant, bench.train,
        windows=settings.windows, max_steps=settings.max_steps, fit_plant=False,
        motions=bench.train_motions,
    )  # fmt: skip
    save_fit(found, _fit_file(workspace, name), bench.train)
    return _finish(workspace, name, bench, found)


def adaptive(workspace: Workspace, law: str) -> dict[str, Any]:
    """Fit a model with coefficients by class of acceleration, starting at its constant fit."""
    bench, settings = workspace.bench("tlrip"), workspace.settings
    name = f"A{law}"
    found = fit_adaptive(
        model_by_name(name)(bench.plant.joints), bench.plant, bench.train,
        windows=settings.windows, max_steps=settings.max_steps, fit_plant=False,
        start=_kept_fit(workspace, law, bench), motions=bench.train_motions,
    )  # fmt: skip
    save_fit(found, _fit_file(workspace, name), bench.train)
    return _finish(workspace, name, bench, found)


def neuro_fuzzy(workspace: Workspace, law: str) -> dict[str, Any]:
    """Fit a neuro-fuzzy model our way: a network corrects the adaptive model, on trajectories."""
    bench, settings = workspace.bench("tlrip"), workspace.settings
    name = f"NF{law}"
    options: dict[str, Any] = {
        "network": "by_class",
        "terms": settings.terms,
        "head_units": settings.head_units,
    }
    model = model_by_name(name)(bench.plant.joints, **options)
    found = refine_adaptive(
        model, _kept_fit(workspace, f"A{law}", bench), bench.train,
        length=settings.windows[-1], max_steps=settings.network_steps,
    )  # fmt: skip
    return _finish(workspace, name, bench, found)


def papers_way(workspace: Workspace, law: str) -> dict[str, Any]:
    """Make a neuro-fuzzy model the papers' way, from the coefficients by class."""
    bench, settings = workspace.bench("tlrip"), workspace.settings
    model = papers_neuro_fuzzy(
        load(workspace.model(f"A{law}")),
        bench.train_motions,
        samples=settings.controller_samples,
        seed=settings.seed,
    )
    way = {"procedure": "classes, fuzzy controller, network by Bayesian regularisation"}
    info = replace(load_info(workspace.model(f"A{law}")), fit=way)
    return _keep(workspace, f"NF{law}-papers", bench, model, info)


def second_paper(workspace: Workspace, law: str) -> dict[str, Any]:
    """Estimate a model on the second paper's rig by a search on the simulated position."""
    bench, settings = workspace.bench("rtip"), workspace.settings
    found = fit_by_search(
        model_by_name(law)(bench.plant.joints), bench.plant, bench.train, method=SEARCH[law],
        horizon=settings.search_horizon, max_evaluations=settings.search_evaluations,
        seed=settings.seed, threads=1, motions=bench.train_motions,
    )  # fmt: skip
    return _finish(workspace, f"rtip-{law}", bench, found)


def _finish(workspace: Workspace, stage: str, bench: Bench, found: FitResult) -> dict[str, Any]:
    """Keep a fitted model; see `_keep`."""
    info = model_info(found, bench.train)
    return {"fit": found.to_dict()} | _keep(workspace, stage, bench, found.model, info)


def _keep(
    workspace: Workspace, stage: str, bench: Bench, model: FrictionModel, info: ModelInfo
) -> dict[str, Any]:
    """Write a model and its TorchScript, judge it, and say what it is."""
    save(model, workspace.model(stage), info)
    if workspace.settings.torchscript:
        script = workspace.model(stage).with_suffix(".pt")
        try:
            torchscript(model, script, info)
        except ExportError as error:
            script.unlink(missing_ok=True)  # an earlier run's would pass for this one's
            logger.warning("%s was not exported: %s", stage, " ".join(str(error).split()))
    scores, simulated = judge(bench, bench.plant, model)
    workspace.write_arrays(stage, simulated)
    return {"scores": scores, "coefficients": coefficient_summary(model)} | _classes(model)


def _classes(model: FrictionModel) -> dict[str, Any]:
    """Coefficients of an adaptive model by class, joint and name."""
    if not isinstance(model.schedule, Adaptive):
        return {}
    names, values = model.schedule.coefficient_names, model.schedule.values
    return {
        "classes": {
            known: {n: values[:, c, k].tolist() for k, n in enumerate(names)}
            for c, known in enumerate(CLASSES)
        },
        "thresholds": model.schedule.thresholds.tolist(),
    }


def _kept_fit(workspace: Workspace, stage: str, bench: Bench) -> FitResult:
    """The finished fit of a stage, as a start for the models that build on it."""
    return load_fit(_fit_file(workspace, stage), bench.train_motions)


def _fit_file(workspace: Workspace, stage: str) -> Path:
    return workspace.folder / "stages" / f"{stage}-fit.json"
