"""Neuro-fuzzy corrections of an adaptive model, kept as far as they help on hold-out windows."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Protocol

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import (
    in_joint_coordinates,
    integration_substeps,
    measurement_matrix,
)
from nfriction.fitting.equation_error import coefficient_scale
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.of_search import result_from_shooting
from nfriction.fitting.shooting.autocorrelation import decimation, effective_noise
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.continuation import ShootingFitter
from nfriction.fitting.strategy.holdout import cut_for_folds
from nfriction.fitting.strategy.neurofuzzy import input_range
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import LeastSquaresResult, Step
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.nffem.adaptive_neurofuzzy import AdaptiveNeuroFuzzy
from nfriction.recording import Recording

# Relative decrease of the cost that ends a search: a correction need not be more accurate.
LOOSE = 1e-3
FOLDS = 3
# Candidate shares of a correction.
SHARES = (0.0, 0.25, 0.5, 1.0)
# Standard errors by which a gain must be significant: 95 % of a normal distribution.
SIGNIFICANCE = 2.0


def refine_adaptive(
    model: FrictionModel,
    adaptive: FitResult,
    recordings: Sequence[Recording],
    *,
    length: float = 2.0,
    max_steps: int = 30,
    callback: Callable[[str, Step], bool | None] | None = None,
) -> FitResult:
    """Fit a network that corrects an adaptive model's coefficients.

    Three corrections are learned, each from two windows of three, and their hold-out windows decide
    the share of it that every joint takes. The model takes these shares of a correction learned
    from all windows, starting at the mean of the three; without any share it is the adaptive one.

    Args:
        model: its schedule an `AdaptiveNeuroFuzzy`; changed in place.
        adaptive: fit of the same law by class of acceleration; the plant stays as it left it.
        recordings: those fitted there.
        length: of the windows [s].
        max_steps: of each search.
        callback: called with a stage name after every step; True stops.

    Raises:
        ValueError: if the models are of other kinds or laws, or recordings and plant do not match.

    References:
        TLRIP paper, neuro-fuzzy friction estimation (NFFEM), which starts from AFEM's models.
        L. Breiman, Machine Learning 24 (1996) 49, on shares from hold-out data (stacking).
    """
    schedule, reference = _schedules_of(model, adaptive)
    plant, motions = adaptive.plant, adaptive.motions
    joint = in_joint_coordinates(plant, list(recordings), model.joints)
    scale = coefficient_scale(model, plant, joint, motions)
    schedule.set_adaptive(reference, scale)
    schedule.set_range(*input_range(motions, schedule.deviation.along_motion))
    model.requires_grad_(False)
    known = [schedule.states(torch.as_tensor(m.qd), torch.as_tensor(m.qdd)) for m in motions]
    substeps = integration_substeps(plant, model, max(r.longest_step for r in joint))
    cut = cut_for_folds(joint, motions, length, FOLDS)
    whole = ShootingProblem(
        StepJacobian(plant, model, []), model, cut, effective_noise(adaptive.residuals),
        measurement_matrix(plant, recordings[0].resolve_convention(plant)), substeps,
        stride=decimation(adaptive.residuals),
        memory=torch.stack([known[place][first] for place, first, _ in cut.spans]),
    )  # fmt: skip
    # The memory advances with every step of the integration while the search lasts.
    sample_time = schedule.adaptive.sample_time
    schedule.adaptive.set_sample_time(sample_time / substeps)
    fitter = ShootingFitter(
        whole.jacobian, model, joint, whole.measurement,
        FitOptions(max_steps=max_steps, patience=0), callback,
    )  # fmt: skip
    name = f"{length:g} s windows, correction by class"
    base = torch.zeros_like(schedule.parameter_vector())
    result, shares = kept_correction(schedule, whole, fitter, base, name)
    if result is None:
        schedule.adaptive.set_sample_time(sample_time)
        note = "The correction is no better: the adaptive model is kept."
        return replace(adaptive, model=model, status=f"{adaptive.status} {note}")
    found = result_from_shooting(model, whole, result, motions)
    schedule.adaptive.set_sample_time(sample_time)
    status = f"{found.status} {taken(shares, plant.joint_names)}"
    # The plant is that of the adaptive fit, and so are the terms reported.
    return replace(found, status=status, plant_terms=adaptive.plant_terms)


def _schedules_of(model: FrictionModel, adaptive: FitResult) -> tuple[AdaptiveNeuroFuzzy, Adaptive]:
    """The model's schedule, and that of the fit from which it must be able to start."""
    schedule, reference = model.schedule, adaptive.model.schedule
    if (
        adaptive.model.law != model.law
        or not isinstance(schedule, AdaptiveNeuroFuzzy)
        or not isinstance(reference, Adaptive)
    ):
        raise ValueError(
            f"an adaptive fit of the model's law, {model.law.name!r}, and a model made with "
            f'network="by_class" are needed, got {type(adaptive.model).__name__} and '
            f"{type(model).__name__}."
        )
    return schedule, reference


class Corrected(Protocol):
    """A schedule whose parameters each move one joint's coefficients."""

    joints: int

    def joint_of_parameters(self) -> Tensor:
        """The joint that each entry of the parameter vector moves, (parameter,)."""


def kept_correction(
    schedule: Corrected, whole: ShootingProblem, fitter: ShootingFitter, base: Tensor, name: str
) -> tuple[LeastSquaresResult | None, Tensor]:
    """A correction learned from all windows, as far as hold-out windows found it useful.

    Args:
        schedule: of the problem's model.
        whole: all windows.
        fitter: searches.
        base: parameter vector without a correction.
        name: of the stage.

    Returns:
        The search's result with the shares taken, None where none is; the shares, (joint,).
    """
    begun, shares = _cross_fitted(schedule, whole, fitter, base, name)
    # Parameters of a joint whose share is zero stay as they were.
    part = shares[schedule.joint_of_parameters()]
    if not part.any():
        return None, shares
    start = whole.variables.start(friction=begun)
    result = fitter.search(whole, start, LOOSE, name).result
    vector = result.x[: len(base)]
    vector.copy_(base + part * (vector - base))
    # The shares were chosen for the corrections of the parts, and may not suit this one.
    ratio = _errors(whole, vector) / _errors(whole, base)
    return (result if bool((ratio.log().mean(0) <= 0).all()) else None), shares


def taken(shares: Tensor, joint_names: Sequence[str]) -> str:
    """The shares of a correction in words."""
    parts = zip(shares.tolist(), joint_names, strict=True)
    words = ", ".join(f"{share:g} of {name}'s" for share, name in parts)
    return f"Taken of the correction: {words}."


def _cross_fitted(
    schedule: Corrected, whole: ShootingProblem, fitter: ShootingFitter, base: Tensor, name: str
) -> tuple[Tensor, Tensor]:
    """The mean of corrections learned from parts, and the share of them for each joint."""
    windows, memory = whole.windows, whole.memory
    fold = torch.arange(len(windows)) % FOLDS
    learned, unseen = [], []
    for k in range(FOLDS):
        seen, rest = (
            replace(
                whole,
                windows=windows.subset(chosen),
                memory=None if memory is None else memory[chosen],
            )
            for chosen in (fold != k, fold == k)
        )
        found = fitter.search(seen, seen.variables.start(friction=base), LOOSE, name)
        learned.append(found.parts.friction - base)
        unseen.append(rest)
        if found.stopped:
            break
    of_joint = schedule.joint_of_parameters()

    def errors(shares: Tensor) -> Tensor:
        parts = [
            _errors(p, base + shares[of_joint] * v) for p, v in zip(unseen, learned, strict=True)
        ]
        return torch.cat(parts)

    shares = stacking_weights(errors, schedule.joints)
    return base + torch.stack(learned).mean(0), shares


def _errors(problem: ShootingProblem, vector: Tensor) -> Tensor:
    """Root mean square error of windows from their smoothed starts, (window, joint)."""
    start = problem.variables.start(friction=vector)
    return problem.errors(start).square().mean(1).sqrt()


def stacking_weights(errors: Callable[[Tensor], Tensor], joints: int) -> Tensor:
    """Share of a correction that each joint takes, by hold-out windows.

    The criterion is the mean over windows of the log ratio of errors with to those without the
    correction, so that a single diverging window does not outvote the others. The best shares make
    no joint worse and lower the mean over joints most, at the upper end of its confidence
    interval; an insignificant gain is none. First the same share is tried for all joints, then
    each joint's own until none changes.

    Args:
        errors: root mean square errors at given shares (joint,), shape (window, joint).
        joints: their number.

    Returns:
        Shares between 0 and 1, (joint,).
    """

    def log_errors(shares: tuple[float, ...]) -> Tensor:
        # Errors below rounding would make their logarithms decide.
        found = errors(torch.tensor(shares, dtype=torch.float64))
        return found.clamp_min(DEFAULTS.min_noise).log().nan_to_num(torch.inf, torch.inf)

    without = log_errors((0.0,) * joints)

    @cache
    def change(shares: tuple[float, ...]) -> float:
        ratio = log_errors(shares) - without
        own = ratio.mean(1)
        found = own.mean() + SIGNIFICANCE * own.std() / len(own) ** 0.5
        return float(found) if bool((ratio.mean(0) <= 0).all()) else math.inf

    # Joints are coupled: shares searched one by one from zero could stay there.
    best = min(((share,) * joints for share in SHARES), key=change)
    before = None
    while best != before:
        before = best
        for j in range(joints):
            trials = ((*best[:j], share, *best[j + 1 :]) for share in SHARES)
            best = min(trials, key=change)
    return torch.tensor(best, dtype=torch.float64)
