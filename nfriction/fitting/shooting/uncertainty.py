"""Noise of encoders and torques, and the information that windows give despite it.

The residuals of a correct law on a correct plant are the encoder's rounding, and the deviation from
the true motion that noise in the recorded torque causes in a simulation. That noise is the part of
the record that changes from sample to sample; its effect is found by simulation. Noise that lasts
for many samples is not included, since it looks like an error of the law.
"""

import math
from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.fitting.data.windows import Windows
from nfriction.fitting.result.identifiability import Information, information, observed_count
from nfriction.fitting.robust_loss import SQUARES
from nfriction.fitting.shooting import normal_equations as normal
from nfriction.fitting.shooting.autocorrelation import white_noise
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.friction.inputs import has_input
from nfriction.optim.least_squares import LeastSquaresResult

# Counts per turn of a coarse encoder that is still in use.
USUAL_COUNTS = 4096
# Fraction of the noise at which simulations respond linearly.
SMALL = 1e-3
# Realisations of the torque's noise for intervals.
DRAWS = 30
# Steps per step of the fit with which the integration error no longer matters.
FINER = 4


def rounding(problem: ShootingProblem) -> float:
    """Root mean square rounding of the encoders [rad; m], from their count.

    A count that neither the plant states nor the positions show is taken to be a 4096th of the
    motion within a window.
    """
    count = encoder_count(problem)
    if not count:
        recorded = problem.windows.q @ problem.measurement.T
        moved = recorded.amax(1) - recorded.amin(1)
        count = float(moved.square().mean().sqrt()) / USUAL_COUNTS
    return count / math.sqrt(12)


def encoder_count(problem: ShootingProblem) -> float | None:
    """Count of the encoders that the plant states or the positions show [rad; m]."""
    recorded = problem.windows.q @ problem.measurement.T
    return problem.jacobian.plant.position_quantum or observed_count(recorded)


def explained(problem: ShootingProblem, x: Tensor, rms: float) -> bool:
    """True if the noise of encoders and torques explains residuals of this root mean square."""
    limit = problem.options.explained_ratio
    return rms <= limit * measurement_noise(problem, x, rms, limit)


def measurement_noise(
    problem: ShootingProblem, x: Tensor, residual: float, enough: float | None = None
) -> float:
    """Residual of a correct law [rad; m], given that of a solution, both root mean square.

    The torque's noise is simulated only if the residual exceeds `enough` times the rounding, by
    default the limit above which it counts as model error.
    """
    least = rounding(problem)
    if residual <= (enough or problem.options.model_error_ratio) * least:
        return least
    errors = problem.errors(x)
    noise = white_noise(errors, problem.windows.weight)
    encoder = float(noise.clamp(min=least).square().mean().sqrt())
    response = torque_response(problem, x, 1)
    by_torque = 0.0 if response is None else _once_fitted(problem, x, response[..., 0])
    return math.hypot(encoder, by_torque)


def _once_fitted(problem: ShootingProblem, x: Tensor, response: Tensor) -> float:
    """Root mean square of errors (window, sample, joint) that remains after a fit [rad; m]."""
    variables, off = problem.variables, response * problem.scale
    lower, upper = variables.bounds()
    free = (lower < upper).nonzero().flatten()
    rows = problem.rows(problem.simulate(x, with_hidden_states=True), problem.scale)
    gradient, hessian = normal.normal_equations(rows, off, variables.indices(), len(x))
    gradient, hessian = gradient[free], hessian[free][:, free]
    hessian.diagonal().add_(variables.prior()[0][free])
    step, failed = torch.linalg.solve_ex(hessian, gradient)
    left = float(off.square().sum() - gradient @ step)
    if failed or not math.isfinite(left):
        return 0.0
    return math.sqrt(max(left, 0.0) / _counted(problem))


def _counted(problem: ShootingProblem) -> float:
    """Sum of the weights of all errors."""
    return float(problem.scale.square().sum()) * problem.windows.q.shape[-1]


def gathered_information(
    problem: ShootingProblem, x: Tensor, sd: Tensor, count: float | None = None
) -> Information:
    """Information about the shared variables, given the sd of each error times its weight.

    `sd` is inflated for autocorrelation, (window, step + 1, joint). If the errors are the
    rounding of encoders to a `count` [rad; m], their covariance is that of rounding instead.
    Errors due to the torque's noise are added: they last longer than a window, whose free initial
    state absorbs most of them, so that residuals show too little of their autocorrelation.
    """
    variables, run = problem.variables, problem.simulate(x, with_hidden_states=True)
    shared, (precision, _) = variables.shared_count, variables.prior()
    of_states, of_offsets = variables.split(precision)[2:]
    kept = normal.Kept(variables.indices(), variables.state_count, len(x))
    scale = problem.scale * problem.loss.weight(problem.deviation(x, run)).sqrt()
    data, response = normal.marginalize_states(problem.rows(run, scale), kept, of_states)
    by_torque = torque_response(problem, x, DRAWS)
    if count and problem.loss is SQUARES:
        q = run.motion.q[:, :: problem.substeps] @ problem.measurement.T
        drawn = normal.rounding_of(q, count, problem.windows.spans) * problem.scale[..., None]
        score = kept.by_states(response, of_states)
        score += normal.drawn_score(problem.rows(run, scale), kept, response, drawn)
    else:
        share = 1.0
        if by_torque is not None:
            # The residuals already contain the errors that the noise of torques causes.
            squares = (problem.counted_errors(x) * problem.scale).square()
            power = float(squares.sum()) / _counted(problem)
            rest = power - _once_fitted(problem, x, by_torque[..., 0]) ** 2
            share = min(1.0, math.sqrt(max(rest, rounding(problem) ** 2) / power))
        rows = problem.rows(run, problem.scale * share * sd / problem.noise_sd)
        score = normal.score_covariance(rows, kept, response, of_states)
    if by_torque is not None:
        drawn = by_torque * problem.scale[..., None]
        score += normal.drawn_score(problem.rows(run, scale), kept, response, drawn)
    prior = torch.cat([precision[:shared], of_offsets.flatten()])
    return information(data + torch.diag(prior), prior, shared, score)


def torque_noise(windows: Windows) -> list[NDArray[np.float64]]:
    """Standard deviation of the noise of each recording's torques, (joint,) each [N m; N]."""
    places = torch.tensor([place for place, *_ in windows.spans])
    parts = [windows.subset(places == k) for k in range(len(windows.recordings))]
    return [white_noise(part.tau, part.weight[:, 1:]).numpy() for part in parts]


def torque_response(
    problem: ShootingProblem, x: Tensor, draws: int, seed: int = 0
) -> Tensor | None:
    """Position errors due to noise in the recorded torques, (window, sample, joint, draw).

    The noise is the part of a torque that changes from sample to sample, see `white_noise`; None
    without noise or recordings. An error in a torque changes all later samples, so these errors
    persist. Draws whose simulation diverges are left out.
    """
    recorded = problem.windows.recordings
    sds = torque_noise(problem.windows)
    if not any(sd.any() for sd in sds):
        return None
    random = np.random.default_rng(seed)
    exact, found = _positions(problem, x), []
    for _ in range(draws):
        recordings = tuple(
            r._replace(tau=r.torque_at(r.time) + SMALL * sd * random.standard_normal(r.q.shape))
            for r, sd in zip(recorded, sds, strict=True)
        )
        noisy = replace(problem.windows, recordings=recordings)
        noisy = replace(noisy, tau=noisy.torque_at(0.0)[0])
        found.append((_positions(replace(problem, windows=noisy), x) - exact) / SMALL)
    kept = [off for off in found if torch.isfinite(off).all()]
    return torch.stack(kept, -1) if kept else None


def integration_error(problem: ShootingProblem, result: LeastSquaresResult) -> Tensor:
    """Change of the minimum if simulations had finer steps, to first order, like `result.x`.

    If friction changes sign within a step, the integration error is less than an encoder count, but
    it is the same each time, so that averaging over samples does not remove it. On driven rigs,
    which rest and reverse often, and where the steps limit how steep the smoothed sign is, finer
    steps come with a steeper one: a real joint does not creep at rest, and reverses at once.
    """
    variables, x = problem.variables, result.x
    if problem.friction.schedule.state_size and not has_input(problem.friction.law, "heat"):
        # Its hidden state advances with samples, as in a controller: finer steps make another one.
        return torch.zeros_like(x)
    lower, upper = variables.bounds()
    finer = replace(problem, substeps=FINER * problem.substeps)
    # A free motion hardly rests, and may amplify so large a change beyond any linear response.
    if problem.windows.tau.any() or problem.substeps >= problem.options.max_substeps:
        finer = replace(finer, friction=deepcopy(problem.friction))
        finer.friction.v_smooth /= FINER
    off = _positions(finer, x) - _positions(problem, x)
    run = problem.simulate(x, with_hidden_states=True)
    weight = problem.loss.weight(problem.deviation(x, run))
    rows = problem.rows(run, problem.scale * weight.sqrt())
    scaled = off * problem.scale * weight.sqrt()
    gradient, _ = normal.normal_equations(rows, scaled, variables.indices(), len(x))
    return full_step(result.hessian, gradient, lower < upper).nan_to_num(0.0)


def full_step(hessian: Tensor, gradient: Tensor, free: Tensor) -> Tensor:
    """Undamped step to the minimum of a quadratic in its free variables; NaN if there is none."""
    at = free.nonzero().flatten()
    step, failed = torch.linalg.solve_ex(hessian[at][:, at], -gradient[at])
    moved = torch.zeros_like(gradient)
    moved[at] = step if not failed and step.isfinite().all() else torch.nan
    return moved


def _positions(problem: ShootingProblem, x: Tensor) -> Tensor:
    q = problem.simulate(x).motion.q[:, :: problem.substeps]
    return q @ problem.measurement.T * problem.windows.weight[..., None]
