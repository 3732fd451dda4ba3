"""Residual of a right law: noise of the encoders, and noise of the torque added up by the motion.

A right law on a right plant leaves the encoder's rounding, and the motion by which a simulation
with the recorded torque departs from the true one. The noise of the torque is that part of the
record which changes from sample to sample; its effect is found by simulation. Noise that lasts for
many samples is not counted, since it looks like an error of the law.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.result.identifiability import observed_count
from nfriction.fitting.robust_loss import SQUARES
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.optim.levenberg_marquardt import LevenbergMarquardt

# Counts of a coarse encoder that is still in use.
USUAL_COUNTS = 4096
# Weights of a third difference: smooth motion cancels, white noise of sd 1 has an sd of √20.
GAIN = 20**0.5
# Median of the absolute value of a normal variable of sd 1.
NORMAL_MEDIAN = 0.674490


class Noise(NamedTuple):
    """Root mean square of the encoders' rounding, and residual of a right law [rad; m]."""

    rounding: float
    residual: float


def white_noise(values: Tensor) -> Tensor:
    """Standard deviation of the noise in signals (window, sample, joint) by joint, (joint,).

    By the median of third differences, which neither steps nor jumps of the signal's slope raise;
    zero of a signal that is held over several samples.
    """
    if values.shape[1] < 4:
        return torch.zeros_like(values[0, 0])
    size = torch.diff(values, n=3, dim=1).abs().flatten(0, 1)
    return size.median(0).values / (NORMAL_MEDIAN * GAIN)


def rounding(problem: ShootingProblem) -> float:
    """Root mean square rounding of the encoders [rad; m], by their count.

    A count that neither the plant states nor the positions show is taken for a 4096th of the motion
    within a window.
    """
    windows, plant = problem.windows, problem.jacobian.plant
    recorded = windows.q @ problem.measurement.T
    count = plant.position_quantum or observed_count(recorded)
    if not count:
        moved = recorded.amax(1) - recorded.amin(1)
        count = float(moved.square().mean().sqrt()) / USUAL_COUNTS
    return count / math.sqrt(12)


def measurement_noise(problem: ShootingProblem, x: Tensor, residual: float) -> Noise:
    """Noise of a solution with this root mean square residual.

    Only a residual far above the rounding is worth the simulation of the torque's noise.
    """
    least = rounding(problem)
    if residual <= problem.options.model_error_ratio * least:
        return Noise(least, least)
    errors = problem.errors(x)
    encoder = float(white_noise(errors).clamp(min=least).square().mean().sqrt())
    return Noise(least, math.hypot(encoder, _by_torque(problem, x, errors)))


def _by_torque(problem: ShootingProblem, x: Tensor, errors: Tensor, seed: int = 0) -> float:
    """Root mean square residual by one realisation of the torque's noise, once fitted [rad; m]."""
    windows, options = problem.windows, problem.options
    sd = white_noise(windows.tau)
    if not sd.any():
        return 0.0
    random = np.random.default_rng(seed)
    recordings = tuple(
        r._replace(tau=r.torque_at(r.time) + sd.numpy() * random.standard_normal(r.q.shape))
        for r in windows.recordings
    )
    # Positions as simulated without the noise, and priors around this solution, so that the noise
    # alone makes the errors.
    exact = windows.q + torch.linalg.solve(problem.measurement, errors.mT).mT
    friction, plant, states, _ = problem.variables.split(x)
    q0, qd0 = states.chunk(2, -1)
    noisy = replace(windows, q=exact, q0=q0, qd0=qd0, recordings=recordings)
    noisy = replace(noisy, tau=noisy.torque_at(0.0)[0])
    of_friction, of_plant = problem.variables.split(problem.variables.prior()[0])[:2]
    pretended = replace(
        problem, windows=noisy, loss=SQUARES,
        friction_prior=(friction, of_friction.rsqrt()), plant_prior=(plant, of_plant.rsqrt()),
    )  # fmt: skip
    solver = LevenbergMarquardt(
        max_steps=options.settling_steps, cost_tolerance=options.settling_tolerance
    )
    lower, upper = pretended.variables.bounds()
    fitted = solver.minimise(
        pretended.linearise, x, cost=pretended.cost, lower=lower, upper=upper
    ).x
    found = float(pretended.errors(fitted).square().mean().sqrt())
    return found if math.isfinite(found) else 0.0
