"""Adaptive models: coefficients by class of acceleration (AFEM)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import torch

from nfriction.fitting.data.inputs import (
    adjustable_terms,
    at_zeros,
    in_joint_coordinates,
    listed,
    mixing_of,
    motions_of,
    substeps_of,
    told_of,
)
from nfriction.fitting.data.windows import checked_lengths, cut_windows
from nfriction.fitting.result.fit_result import FitResult, trajectory_outcome
from nfriction.fitting.shooting.autocorrelation import effective_noise
from nfriction.fitting.shooting.problem import solve_trajectory
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.constant import Settings
from nfriction.fitting.strategy.constant_start import constant_start
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import Step
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.afem.classes import AccelerationClasses
from nfriction.papers.afem.fit_by_search import fit_by_search
from nfriction.papers.afem.labelled import LabelledProblem, driving_classes, labelled_model
from nfriction.papers.afem.search import SearchOptions
from nfriction.papers.afem.settling import PRIOR_SD, adopt_classes, settled
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

AdaptiveMethod = Literal["gauss-newton", "pattern", "sqp"]


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
    given = listed(model, plant, recordings)
    if method not in get_args(AdaptiveMethod):
        raise ValueError(f"`method` must be one of {get_args(AdaptiveMethod)}, got {method!r}.")
    if not isinstance(model.schedule, Adaptive):
        raise ValueError(f"{type(model).__name__} is no adaptive model; use `fit`.")
    if not prior_sd > 0:
        raise ValueError(f"`prior_sd` must be positive, got {prior_sd}.")
    windows = checked_lengths(windows)
    joint = in_joint_coordinates(plant, model, given)
    moved = motions_of(joint, motions)
    asked = Settings(windows, fit_plant, drag, max_steps=max_steps, callback=callback)
    constant = constant_start(model, plant, given, moved, start, asked)
    raw, length = moved, constant.longest(windows)
    given, moved = at_zeros(constant.zeros, plant, given, moved)
    joint = in_joint_coordinates(plant, model, given)
    if method != "gauss-newton":
        settings = {"horizon": length, "prior_sd": prior_sd, **search_settings}
        found = fit_by_search(
            model, plant, given, options=SearchOptions(method, **settings), motions=moved,
            start=replace(constant, zeros=()), classes=classes,
        )  # fmt: skip
        return replace(found, motions=raw, zeros=constant.zeros, left_out=constant.left_out)
    if search_settings:
        raise ValueError(f"{sorted(search_settings)} are settings of a search, not of {method!r}.")
    classes = adopt_classes(model.schedule, classes, joint, moved, plant)
    terms = adjustable_terms(plant, joint, fit_plant, drag, zeroed_once=not constant.zeros)
    known = {name: value for name, value, _ in constant.plant_terms}
    vector = torch.tensor([known.get(t.name, 0.0) for t in terms], dtype=torch.float64)
    labelled = labelled_model(model, constant, joint, moved, prior_sd)
    cut = cut_windows(joint, moved, length)
    problem = LabelledProblem(
        StepJacobian(plant, labelled, terms), cut, effective_noise(constant._residuals),
        mixing_of(plant, given[0].resolve_convention(plant)),
        substeps=substeps_of(plant, labelled, joint), plant_mean=vector,
        classes=driving_classes(classes, cut),
    )  # fmt: skip
    told = told_of(callback, f"{length:g} s windows, by class")
    result = solve_trajectory(
        problem, problem.unknowns.start(vector), max_steps=max_steps, callback=told
    )
    residuals = problem.errors(result.x)
    found = trajectory_outcome(problem, result, residuals, moved)
    states = problem.unknowns.split(result.x)[2].chunk(2, -1)
    found = settled(
        model, labelled, classes, constant, found, replace(cut, q0=states[0], qd0=states[1]),
        problem.mixing, problem.substeps, constant.residual,
    )  # fmt: skip
    return replace(found, motions=raw, zeros=constant.zeros, left_out=constant.left_out)
