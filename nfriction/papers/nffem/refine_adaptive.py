"""Neuro-fuzzy corrections of an adaptive model, kept as far as they help on what they never saw."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import in_joint_coordinates, mixing_of, substeps_of, told_of
from nfriction.fitting.equation_error import natural_scale
from nfriction.fitting.result.fit_result import FitResult, trajectory_outcome
from nfriction.fitting.shooting.autocorrelation import effective_noise, stride_of
from nfriction.fitting.shooting.problem import TrajectoryProblem, solve_trajectory
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.holdout import FOLDS, cut_for_folds, shares_by_joint
from nfriction.fitting.strategy.neurofuzzy_start import range_of
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import Step
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.nffem.adaptive_neurofuzzy import AdaptiveNeuroFuzzy
from nfriction.recording import Recording

# Relative fall of the cost that ends the search: only its neighbourhood matters to a correction.
LOOSE = 1e-3


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

    Three corrections are learned, each from two windows of three, and the windows that each has
    not seen decide which share of it every joint takes. The model takes these shares of one that
    is learned from all windows, begun at the mean of the three; where no share serves, it is the
    adaptive one.

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
        L. Breiman, Machine Learning 24 (1996) 49, on shares from data held back (stacking).
    """
    schedule = _schedule_of(model, adaptive)
    plant, motions = adaptive.plant, adaptive.motions
    joint = in_joint_coordinates(plant, model, list(recordings))
    _start_at(model, adaptive, joint)
    known = [schedule.states(torch.as_tensor(m.qd), torch.as_tensor(m.qdd)) for m in motions]
    substeps = substeps_of(plant, model, joint)
    cut = cut_for_folds(joint, motions, length)
    whole = TrajectoryProblem(
        StepJacobian(plant, model, []), cut, effective_noise(adaptive._residuals),
        mixing_of(plant, recordings[0].resolve_convention(plant)), substeps,
        stride=stride_of(adaptive._residuals),
        memory=torch.stack([known[place][first] for place, first, _ in cut.spans]),
    )  # fmt: skip
    # The memory advances with every step of the integration while the search lasts.
    sample_time = schedule.adaptive.sample_time
    schedule.adaptive.set_sample_time(sample_time / substeps)
    told = told_of(callback, f"{length:g} s windows, correction by class")
    begun, shares = _cross_fitted(whole, max_steps, told)
    part = shares[schedule.joint_of_parameters()]
    if part.any():
        schedule.set_parameter_vector(begun)
        result = solve_trajectory(
            whole, whole.unknowns.start(), max_steps=max_steps, cost_tolerance=LOOSE, callback=told
        )
        result.x[: len(begun)] *= part
    if not part.any() or not _serves(whole, result.x[: len(begun)]):
        schedule.set_parameter_vector(torch.zeros_like(begun))
        schedule.adaptive.set_sample_time(sample_time)
        note = "The correction serves no better: the adaptive model is kept."
        return replace(adaptive, model=model, status=f"{adaptive.status} {note}")
    found = trajectory_outcome(whole, result, whole.errors(result.x), motions)
    schedule.adaptive.set_sample_time(sample_time)
    parts = zip(shares.tolist(), plant.joint_names, strict=True)
    taken = ", ".join(f"{share:g} of {name}'s" for share, name in parts)
    status = f"{found.status} Taken of the correction: {taken}."
    return replace(found, status=status, plant_terms=adaptive.plant_terms)


def _schedule_of(model: FrictionModel, adaptive: FitResult) -> AdaptiveNeuroFuzzy:
    """The model's schedule, which must be able to start from the fit."""
    fits = isinstance(adaptive.model.schedule, Adaptive) and adaptive.model.law == model.law
    if not (isinstance(model.schedule, AdaptiveNeuroFuzzy) and fits):
        raise ValueError(
            f"an adaptive fit of the model's law, {model.law.name!r}, and a model made with "
            f'network="by_class" are needed, got {type(adaptive.model).__name__} and '
            f"{type(model).__name__}."
        )
    return model.schedule


def _start_at(model: FrictionModel, adaptive: FitResult, joint: Sequence[Recording]) -> None:
    """Set the model to the adaptive one, and its network's inputs to the range of the motion."""
    schedule, reference = model.schedule, adaptive.model.schedule
    assert isinstance(schedule, AdaptiveNeuroFuzzy)
    assert isinstance(reference, Adaptive)
    scale = natural_scale(model, adaptive.plant, joint, adaptive.motions)
    schedule.set_adaptive(reference, scale)
    schedule.set_range(*range_of(adaptive.motions, schedule.deviation.along_motion))
    model.requires_grad_(False)


def _cross_fitted(
    whole: TrajectoryProblem,
    max_steps: int,
    told: Callable[[Tensor, Step], bool | None] | None,
) -> tuple[Tensor, Tensor]:
    """The mean of corrections learned from parts, and what share of them each joint is to take."""
    schedule, windows, memory = whole.friction.schedule, whole.windows, whole.memory
    assert isinstance(schedule, AdaptiveNeuroFuzzy)
    assert memory is not None
    zero = torch.zeros_like(schedule.parameter_vector())
    fold = torch.arange(len(windows)) % FOLDS
    learned, unseen = [], []
    for k in range(FOLDS):
        seen, rest = (
            replace(whole, windows=windows.subset(chosen), memory=memory[chosen])
            for chosen in (fold != k, fold == k)
        )
        schedule.set_parameter_vector(zero)
        result = solve_trajectory(
            seen, seen.unknowns.start(), max_steps=max_steps, cost_tolerance=LOOSE, callback=told
        )
        learned.append(seen.unknowns.split(result.x)[0].clone())
        unseen.append(rest)
        if result.status == "stopped":
            break
    of_joint = schedule.joint_of_parameters()

    def errors(shares: Tensor) -> Tensor:
        parts = [_errors(p, shares[of_joint] * v) for p, v in zip(unseen, learned, strict=True)]
        return torch.cat(parts)

    shares = shares_by_joint(errors, schedule.joints)
    return torch.stack(learned).mean(0), shares


def _serves(whole: TrajectoryProblem, vector: Tensor) -> bool:
    """Whether a correction is no worse on any joint over the very windows it learned from.

    What shares of the parts' corrections do, the same shares of another need not do.
    """
    ratio = _errors(whole, vector) / _errors(whole, torch.zeros_like(vector))
    return bool((ratio.log().mean(0) <= 0).all())


def _errors(problem: TrajectoryProblem, vector: Tensor) -> Tensor:
    """Root mean square error of windows from their smoothed starts, (window, joint)."""
    problem.friction.schedule.set_parameter_vector(vector)
    return problem.errors(problem.unknowns.start()).square().mean(1).sqrt()
