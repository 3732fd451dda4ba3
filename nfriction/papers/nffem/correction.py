"""Fits of the papers' networks to trajectories, as far as windows held out gain by them.

A network starts as what it corrects: an adaptive model, or a constant law.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Protocol

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import (
    apply_encoder_offsets,
    integration_substeps,
    require_motion,
)
from nfriction.fitting.equation_error import coefficient_scale
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.of_search import result_from_shooting
from nfriction.fitting.shooting.autocorrelation import decimation, effective_noise
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.constant import constant_start
from nfriction.fitting.strategy.continuation import ShootingFitter
from nfriction.fitting.strategy.holdout import StoppedError, cut_for_folds
from nfriction.fitting.strategy.neurofuzzy import input_range
from nfriction.fitting.task import FitTask
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import LEAST_RATIO, PRIOR_SD
from nfriction.fuzzy import RBFNetwork
from nfriction.optim.least_squares import LeastSquaresResult
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.afem.fit_adaptive import fit_by_class
from nfriction.papers.nffem.adaptive_neurofuzzy import AdaptiveNeuroFuzzy
from nfriction.papers.nffem.rbf_coefficients import RBFCoefficients
from nfriction.signals import Motion

# Relative decrease of the cost that ends a search: a correction need not be more accurate.
LOOSE = 1e-3
FOLDS = 3
# Candidate shares of a correction.
SHARES = (0.0, 0.25, 0.5, 1.0)
# Standard errors by which a gain must be significant: 95 % of a normal distribution.
SIGNIFICANCE = 2.0
# Coefficients of a radial basis network may grow to so many of their scales.
LARGEST = 4.0
# Its units are placed by one sample of this many.
THINNED = 10


def fit_class_correction(task: FitTask) -> FitResult:
    """Fit a network that corrects coefficients by class, from an adaptive fit of the same law.

    That is the task's start, or else comes first; the plant stays as it left it.

    References:
        TLRIP paper, neuro-fuzzy friction estimation (NFFEM), which starts from AFEM's models.
    """
    model, start = task.model, task.start
    schedule = model.schedule
    assert isinstance(schedule, AdaptiveNeuroFuzzy)
    fits = start is not None and isinstance(start.model.schedule, Adaptive)
    if start is None or not fits or start.model.law != model.law:
        adaptive = Adaptive(model.law, model.joints, **schedule.adaptive.options())
        own = FrictionModel(model.law, adaptive, model.v_smooth)
        start = fit_by_class(replace(task, model=own))
    reference, aligned = start.model.schedule, _aligned(task, start)
    assert isinstance(reference, Adaptive)
    recordings, motions = aligned.recordings, aligned.motions
    schedule.set_adaptive(reference, coefficient_scale(model, start.plant, recordings, motions))
    schedule.set_range(*input_range(motions, schedule.deviation.along_motion))
    return _corrected(task, aligned, start)


def fit_rbf(task: FitTask) -> FitResult:
    """Fit the output layer of the papers' network from the constant fit of its law.

    The units are placed along the smoothed motion; the output layer starts at the constant law and
    is pulled toward it.
    """
    require_motion(task.plant, task.recordings)
    schedule = task.model.schedule
    assert isinstance(schedule, RBFCoefficients)
    start = constant_start(task)
    aligned = _aligned(task, start)
    values = start.model.schedule.coefficient_sets()["always"]
    natural = coefficient_scale(task.model, start.plant, aligned.recordings, aligned.motions)
    scale = torch.maximum(values.abs(), natural)
    scale = torch.where(scale > 0, scale, torch.ones_like(scale))
    schedule.set_sample_time(aligned.recordings[0].sample_time)
    place_units(schedule, values, scale, aligned.motions)
    sd = (PRIOR_SD * scale)[..., None].expand(-1, -1, schedule.head_units + 1).reshape(-1)
    return _corrected(task, aligned, start, (schedule.parameter_vector(), sd))


def _aligned(task: FitTask, start: FitResult) -> FitTask:
    """The task without the encoder offsets that its start found."""
    recordings, motions = apply_encoder_offsets(
        start.encoder_offsets, task.plant, task.recordings, task.motions
    )
    return replace(task, recordings=recordings, motions=motions)


def _corrected(
    given: FitTask,
    task: FitTask,
    start: FitResult,
    friction_prior: tuple[Tensor, Tensor] | None = None,
) -> FitResult:
    """The fit of a network that begins as `start`, or that start where it gains nothing.

    Three corrections are learned, each from two windows of three, and their hold-out windows decide
    the share of it that every joint takes. The model takes these shares of a correction learned
    from all windows, starting at the mean of the three.

    Args:
        given, task: as recorded, and without encoder offsets.
        start: the fit that the network corrects.
        friction_prior: of the network's parameters; by default the schedule's own.

    References:
        L. Breiman, Machine Learning 24 (1996) 49, on shares from hold-out data (stacking).
    """
    recordings, motions, plant = task.recordings, task.motions, start.plant
    model, schedule = task.model.requires_grad_(False), task.model.schedule
    assert isinstance(schedule, AdaptiveNeuroFuzzy | RBFCoefficients)
    base = schedule.parameter_vector()
    length = start.longest_usable_horizon(task.options.windows)
    cut = cut_for_folds(recordings, motions, length, FOLDS)
    memory = None
    if schedule.state_size:
        known = [schedule.states(torch.as_tensor(m.qd), torch.as_tensor(m.qdd)) for m in motions]
        memory = torch.stack([known[place][first] for place, first, _ in cut.spans])
    substeps = integration_substeps(plant, model, max(r.longest_step for r in recordings))
    whole = ShootingProblem(
        StepJacobian(plant, model, []), model, cut, effective_noise(start.residuals),
        task.measurement, substeps, stride=decimation(start.residuals),
        friction_prior=friction_prior, memory=memory,
    )  # fmt: skip
    fitter = ShootingFitter(
        whole.jacobian, model, recordings, task.measurement, replace(task.options, patience=0),
        task.callback,
    )  # fmt: skip
    # The memory advances with every step of the integration while the search lasts.
    schedule.set_sample_time(recordings[0].sample_time / substeps)
    kept, stopped = "The network is no better than its start, which is kept.", False
    try:
        result, shares = kept_correction(
            schedule, whole, fitter, base, f"{length:g} s windows, network"
        )
    except StoppedError:
        result, stopped = None, True
        kept = "Stopped before the network was judged: its start is kept."
    if result is None:
        schedule.set_parameter_vector(base)
        found = replace(
            start, model=model, status=f"{start.status} {kept}",
            converged=start.converged and not stopped,
        )  # fmt: skip
    else:
        found = result_from_shooting(model, whole, result, motions)
        # The plant is that of the start, and so are the terms reported.
        found = replace(
            found, plant_terms=start.plant_terms, encoder_offsets=start.encoder_offsets,
            skipped_horizons=start.skipped_horizons, motions=given.motions,
            status=f"{found.status} {taken(shares, plant.joint_names)}",
        )  # fmt: skip
    schedule.set_sample_time(recordings[0].sample_time)
    return found.with_warnings(start.data_warnings)


@torch.no_grad()
def place_units(
    schedule: RBFCoefficients, values: Tensor, scale: Tensor, motions: Sequence[Motion]
) -> None:
    """Set a network to constant coefficients, its units by k-means along motions.

    Args:
        schedule: changed in place.
        values: coefficients, (joint, coefficient).
        scale: size of each, (joint, coefficient), by which its universe is chosen.
        motions: in joint coordinates.
    """
    qd, qdd, state = [], [], []
    for motion in motions:
        qd.append(torch.as_tensor(motion.qd))
        qdd.append(torch.as_tensor(motion.qdd))
        state.append(schedule.states(qd[-1], qdd[-1]))
    moved = torch.cat(qd), torch.cat(qdd), torch.cat(state)
    # Without a universe yet, which would clamp the motion.
    schedule.input_lower.fill_(-torch.inf)
    schedule.input_upper.copy_(moved[0].abs().amax(0)[:, None].expand_as(schedule.input_upper))
    schedule.input_upper[:, 1:] = torch.inf
    x = schedule.inputs(*moved)
    joints, inputs = schedule.input_lower.shape
    network = RBFNetwork(joints, inputs, schedule.head_units, values.shape[1])
    network.init_kmeans(x[::THINNED])
    network.output_weight.zero_()
    # From its bound a coefficient could not rise.
    start = torch.where(schedule.positive, torch.maximum(values, LEAST_RATIO * scale), values)
    network.output_bias.copy_(start)
    lower = torch.where(schedule.positive, torch.zeros_like(scale), -LARGEST * scale)
    ends = torch.stack([x.amin(0), x.amax(0)])
    ends[0, :, 0] = 0.0
    schedule.set_network(network, ends, torch.stack([lower, LARGEST * scale]))


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

    Raises:
        StoppedError: if the caller stopped before the shares were found.
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
        if found.stopped:
            raise StoppedError
        learned.append(found.parts.friction - base)
        unseen.append(rest)
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
