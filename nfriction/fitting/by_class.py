"""Neuro-fuzzy corrections of an adaptive model, kept as far as they help on what they never saw."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.holdback import FOLDS, HEAD_START
from nfriction.fitting.outcome import Fit, trajectory_outcome
from nfriction.fitting.preparation import (
    in_joint_coordinates,
    mixing_of,
    substeps_of,
    told_of,
)
from nfriction.fitting.residuals import effective_noise, stride_of
from nfriction.fitting.sensitivity import StepJacobian
from nfriction.fitting.torque import fit_torque, natural_scale
from nfriction.fitting.trajectory import TrajectoryProblem, solve_trajectory
from nfriction.fitting.windows import Windows, cut_windows
from nfriction.friction import Adaptive, FrictionModel
from nfriction.friction.adaptive_neurofuzzy import AdaptiveNeuroFuzzy
from nfriction.recording import Recording
from nfriction.solve.levenberg import LevenbergMarquardt, Step

# Relative fall of the cost that ends the search: only its neighbourhood matters to a correction.
LOOSE = 1e-3
# How much of a correction is tried, until one serves.
SHARES = (1.0, 0.5, 0.25)
# Of the search for the starts of windows held back.
START_STEPS = 4


def refine_adaptive(
    model: FrictionModel,
    adaptive: Fit,
    recordings: Sequence[Recording],
    *,
    length: float = 2.0,
    max_steps: int = 30,
    callback: Callable[[str, Step], bool | None] | None = None,
) -> Fit:
    """Fit a network that corrects an adaptive model's coefficients.

    It learns from two windows of three. The third ones decide how much of the correction is
    taken: all of it, and then it learns from these too; a half or a quarter, as much as simulates
    them not clearly worse on any joint; or nothing, and the model is the adaptive one.

    Args:
        model: its schedule an `AdaptiveNeuroFuzzy`; changed in place.
        adaptive: fit of the same law by class of acceleration; the plant stays as it left it.
        recordings: those fitted there.
        length: of the windows [s].
        max_steps: of the search.
        callback: called with a stage name after every step; True stops.

    Raises:
        ValueError: if the models are of other kinds or laws, or recordings and plant do not match.

    References:
        TLRIP paper, neuro-fuzzy friction estimation (NFFEM), which starts from AFEM's models.
    """
    schedule, reference = model.schedule, adaptive.model.schedule
    fits = isinstance(reference, Adaptive) and adaptive.model.law is model.law
    if not (isinstance(schedule, AdaptiveNeuroFuzzy) and fits):
        raise ValueError(
            f"an adaptive fit of the model's law, {model.law.name!r}, and a model made with "
            f'network="by_class" are needed, got {type(adaptive.model).__name__} and '
            f"{type(model).__name__}."
        )
    assert isinstance(reference, Adaptive)
    plant, motions = adaptive.plant, adaptive.motions
    joint = in_joint_coordinates(plant, model, list(recordings))
    qd = [torch.as_tensor(m.qd) for m in motions]
    qdd = [torch.as_tensor(m.qdd) for m in motions]
    torque = fit_torque(model.law, plant, joint, motions, model.v_smooth)
    schedule.set_adaptive(reference, natural_scale(model.law, torque, torch.cat(qd)))
    _set_range(schedule, torch.cat(qd), torch.cat(qdd))
    model.requires_grad_(False)
    known = [schedule.states(v, a) for v, a in zip(qd, qdd, strict=True)]
    cut = cut_windows(joint, motions, length)
    back = torch.arange(len(cut)) % FOLDS == FOLDS - 1
    substeps = substeps_of(plant, model, joint)
    stride = stride_of(adaptive._residuals)

    def problem(windows: Windows) -> TrajectoryProblem:
        return TrajectoryProblem(
            StepJacobian(plant, model, []), windows, effective_noise(adaptive._residuals),
            mixing_of(plant, recordings[0].convention_on(plant)), substeps, stride=stride,
            memory=torch.stack([known[place][first] for place, first, _ in windows.spans]),
        )  # fmt: skip

    seen, judged = problem(cut.subset(~back)), problem(cut.subset(back))
    told = told_of(callback, f"{length:g} s windows, correction by class")
    # The memory advances with every step of the integration while the search lasts.
    sample_time = schedule.adaptive.sample_time
    schedule.adaptive.set_sample_time(sample_time / substeps)
    result = solve_trajectory(
        seen, seen.start(), max_steps=max_steps, cost_tolerance=LOOSE, callback=told
    )
    vector = seen.split(result.x)[0].clone()
    limit = HEAD_START**2 * _by_joint(judged, torch.zeros_like(vector))
    taken = 0.0
    for share in SHARES:
        if bool((_by_joint(judged, share * vector) <= limit).all()):
            taken = share
            break
    schedule.set_parameter_vector(taken * vector)
    fitted = seen
    if taken == 1:
        # What has proved itself may learn from all windows.
        fitted = problem(cut)
        result = solve_trajectory(
            fitted, fitted.start(), max_steps=max_steps, cost_tolerance=LOOSE, callback=told
        )
    schedule.adaptive.set_sample_time(sample_time)
    if taken == 0:
        note = "The correction serves no better on windows held back: the adaptive model is kept."
        return replace(adaptive, model=model, status=f"{adaptive.status} {note}")
    if taken < 1:
        result.x[: len(vector)] *= taken
    found = trajectory_outcome(fitted, result, fitted.errors(result.x), motions)
    part = "" if taken == 1 else f" {taken:g} of the correction is taken."
    return replace(found, status=found.status + part, plant_terms=adaptive.plant_terms)


def _set_range(schedule: AdaptiveNeuroFuzzy, qd: Tensor, qdd: Tensor) -> None:
    """The range of the motion for the network's inputs, wild accelerations aside."""
    along = qdd * qd.sign() if schedule.deviation.along_motion else qdd
    low, high = np.quantile(along.numpy(), [0.001, 0.999], axis=0)
    schedule.set_range(
        qd.abs().amax(0), torch.stack([torch.as_tensor(low), torch.as_tensor(high)], -1)
    )


def _by_joint(problem: TrajectoryProblem, vector: Tensor) -> Tensor:
    """Mean square error of windows by joint, the network's parameters given.

    Each window's start is fitted: off by what an encoder does not tell, it would soon matter more
    than friction.
    """
    problem.friction.schedule.set_parameter_vector(vector)
    start = problem.start()
    lower, upper = problem.bounds()
    shared = problem.shared_count
    fixed = [torch.cat([start[:shared], ends[shared:]]) for ends in (lower, upper)]
    solver = LevenbergMarquardt(max_steps=START_STEPS, cost_tolerance=LOOSE)
    found = solver.minimise(
        problem.quadratic, start, cost=problem.cost, lower=fixed[0], upper=fixed[1]
    )
    return problem.errors(found.x).square().mean((0, 1)).nan_to_num(torch.inf)
