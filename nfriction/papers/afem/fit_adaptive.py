"""Adaptive models: coefficients by class of acceleration (AFEM)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import torch

from nfriction.fitting.data.inputs import (
    adjustable_terms,
    apply_encoder_offsets,
    integration_substeps,
)
from nfriction.fitting.data.windows import cut_windows
from nfriction.fitting.fit import FitTask, prepare_task
from nfriction.fitting.options import EncoderReference, FitOptions
from nfriction.fitting.result.fit_result import FitResult, result_from_shooting
from nfriction.fitting.shooting.autocorrelation import effective_noise
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.constant import constant_start, known_terms
from nfriction.fitting.strategy.continuation import ShootingFitter
from nfriction.friction.model import FrictionModel
from nfriction.optim.least_squares import Step
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.afem.classes import AccelerationClasses
from nfriction.papers.afem.fit_by_search import fit_by_search
from nfriction.papers.afem.labelled import LabelledProblem, driving_classes, labelled_model
from nfriction.papers.afem.settling import PRIOR_SD, adopt_classes, settled
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

AdaptiveMethod = Literal["gauss-newton", "pattern", "sqp"]
# Relative decrease of the cost that ends the search by class.
TOLERANCE = 1e-6


def fit_adaptive(
    model: FrictionModel,
    plant: Plant,
    recordings: Recording | Sequence[Recording],
    *,
    method: AdaptiveMethod = "gauss-newton",
    classes: AccelerationClasses | None = None,
    windows: Sequence[float] = (0.5, 2.0),
    fit_plant: bool = True,
    drag: bool | None = None,
    start: FitResult | None = None,
    motions: Sequence[Motion] | None = None,
    max_steps: int = 30,
    prior_sd: float = PRIOR_SD,
    callback: Callable[[str, Step], bool | None] | None = None,
    **search_settings: Any,
) -> FitResult:
    """Fit a model whose coefficients depend on the class of acceleration.

    The constant law is fitted first. Every class starts there and is pulled toward it, so a
    class of which the recordings say little stays; and where the result simulates the training
    windows no better, with the class following the simulation, the constant coefficients stay.

    Args:
        model: the model to fit; changed in place.
        plant: the mechanism as given.
        recordings: one or several.
        method: `"gauss-newton"` (trajectories, with exact sensitivities and the plant's terms),
            or the papers' `"pattern"` search or `"sqp"` of the position error.
        classes: from `find_classes`; found here by default.
        windows: lengths of the windows [s]; the last serves for the classes.
        fit_plant, drag, start, motions, max_steps, callback: see `fit`.
        prior_sd: how far a class may deviate from the constant law, in units of what explains a
            third of the friction (or of the coefficient, if larger).
        search_settings: of `fit_by_search`, for its methods.

    Returns:
        The fit; read `converged` and `status`.

    Raises:
        ValueError: if recordings and plant do not match, the motion has no classes, or the model
            is not adaptive.

    References:
        TLRIP paper, AFEM.
    """
    if method not in get_args(AdaptiveMethod):
        raise ValueError(f"`method` must be one of {get_args(AdaptiveMethod)}, got {method!r}.")
    if not isinstance(model.schedule, Adaptive):
        raise ValueError(f"{type(model).__name__} is no adaptive model; use `fit`.")
    if not prior_sd > 0:
        raise ValueError(f"`prior_sd` must be positive, got {prior_sd}.")
    # A start is taken with the encoder offsets that it found, or none.
    reference: EncoderReference = "auto"
    if start is not None:
        reference = "per_recording" if start.encoder_offsets else "shared"
    options = FitOptions(
        windows=windows, fit_plant=fit_plant, drag=drag, encoder_reference=reference,
        max_steps=max_steps,
    )  # fmt: skip
    task = prepare_task(model, plant, recordings, options, start, motions, callback)
    constant = constant_start(task)
    if method != "gauss-newton":
        given, moved = apply_encoder_offsets(
            constant.encoder_offsets, plant, task.recordings, task.motions
        )
        settings = {
            "horizon": constant.longest_usable_horizon(options.windows), "prior_sd": prior_sd,
            **search_settings,
        }  # fmt: skip
        found = fit_by_search(
            model, plant, given, method=method, start=replace(constant, encoder_offsets=()),
            motions=moved, classes=classes, **settings,
        )  # fmt: skip
        return _as_recorded(found, task, constant)
    if search_settings:
        raise ValueError(f"{sorted(search_settings)} are settings of a search, not of {method!r}.")
    return _by_class(task, constant, classes, prior_sd)


def fit_task(task: FitTask) -> FitResult:
    """Fit an adaptive model as `nfriction.fit` does: no eccentricity, and windows apart."""
    options = replace(task.options, eccentricity="off", continuity="none")
    task = replace(task, options=options)
    return _by_class(task, constant_start(task), None, PRIOR_SD)


def _by_class(
    task: FitTask, constant: FitResult, classes: AccelerationClasses | None, prior_sd: float
) -> FitResult:
    """Coefficients by class by output error, from a constant fit."""
    model, plant, options = task.model, task.plant, task.options
    assert isinstance(model.schedule, Adaptive)
    length = constant.longest_usable_horizon(options.windows)
    joint, moved = apply_encoder_offsets(
        constant.encoder_offsets, plant, task.recordings, task.motions
    )
    classes = adopt_classes(model.schedule, classes, joint, moved, plant)
    terms = adjustable_terms(plant, joint, options, per_recording=bool(constant.encoder_offsets))
    vector = known_terms(constant, terms)
    sd = torch.tensor([t.prior_sd for t in terms], dtype=torch.float64)
    labelled = labelled_model(model, constant, joint, moved, prior_sd)
    cut = cut_windows(joint, moved, length)
    problem = LabelledProblem(
        StepJacobian(plant, labelled, terms), labelled, cut, effective_noise(constant.residuals),
        task.measurement,
        substeps=integration_substeps(plant, labelled, max(r.longest_step for r in joint)),
        plant_prior=(vector, sd), classes=driving_classes(classes, cut),
    )  # fmt: skip
    fitter = ShootingFitter(
        problem.jacobian, labelled, joint, task.measurement, replace(options, patience=0),
        task.callback,
    )  # fmt: skip
    name = f"{length:g} s windows, by class"
    result = fitter.search(problem, problem.variables.start(vector), TOLERANCE, name).result
    found = result_from_shooting(labelled, problem, result, moved)
    states = problem.variables.split(result.x).states.chunk(2, -1)
    found = settled(
        model, labelled, classes, constant, found, replace(cut, q0=states[0], qd0=states[1]),
        problem.measurement, problem.substeps, constant.residual,
    )  # fmt: skip
    return _as_recorded(found, task, constant)


def _as_recorded(found: FitResult, task: FitTask, constant: FitResult) -> FitResult:
    """A fit with the motions as recorded and what the constant fit found of encoders."""
    return replace(
        found, motions=task.motions, encoder_offsets=constant.encoder_offsets,
        skipped_horizons=constant.skipped_horizons,
    )  # fmt: skip
