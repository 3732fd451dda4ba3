"""The result of a search or a regression: intervals, warnings, and the noise of its data.

A right law on a right plant leaves the encoder's rounding, and the motion by which a simulation
with the recorded torque departs from the true one. The noise of the torque is that part of the
record which changes from sample to sample; its effect is found by simulation. Noise that lasts for
many samples is not counted, since it looks like an error of the law.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.equation_error import TorqueFit, peak_dynamics_torque
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.identifiability import (
    CoefficientUncertainty,
    Information,
    Interval,
    confidence_intervals,
    covariance_root,
    exceeds_drive_torque,
    model_error_warning,
    null_directions,
    observed_count,
    standard_deviations,
    warnings_of,
    weakly_identified,
)
from nfriction.fitting.robust_loss import SQUARES, Outliers, named_outliers, outlier_warning
from nfriction.fitting.shooting.autocorrelation import (
    bandwidth,
    effective_noise,
    hac_sd,
    white_noise,
)
from nfriction.fitting.shooting.problem import SMALL, ShootingProblem
from nfriction.fitting.shooting.variables import model_at
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import LeastSquaresResult
from nfriction.optim.levenberg_marquardt import LevenbergMarquardt
from nfriction.plant import Plant
from nfriction.signals import Motion

BLURRED = (
    "The torque comes from a smoothed motion, which blurs friction at low speed and knows no error "
    'of the plant; `method="output_error"` gives a better answer, and intervals that cover both.'
)
# A lower bound no larger exists only for the logarithm of a positive coefficient, in SI.
NOTHING = 1e-9
# Counts of a coarse encoder that is still in use.
USUAL_COUNTS = 4096


def result_from_equation_error(
    model: FrictionModel,
    plant: Plant,
    start: FitResult | None,
    motions: tuple[Motion, ...],
    torque: TorqueFit,
) -> FitResult:
    """The result of a regression on torques, which is written into the model."""
    model.schedule.set_parameter_vector(torque.coefficients.reshape(-1))
    names = model.schedule.parameter_names(plant.joint_names)
    lower, upper = model.schedule.bounds()
    fitted = (lower < upper).nonzero().flatten()
    fitted_names = [names[i] for i in fitted.tolist()]
    values, lower, upper = (x[fitted] for x in (model.schedule.parameter_vector(), lower, upper))
    known = Information(torch.block_diag(*torque.information), torch.zeros(len(names)).double())
    known = known.subset(fitted)
    sd = standard_deviations(known)
    low, high = values <= lower + NOTHING, values >= upper
    at_bounds, at_zero = (
        tuple(fitted_names[i] for i in mask.nonzero().flatten().tolist())
        for mask in (low | high, low & (lower.abs() <= NOTHING))
    )
    unidentifiable = null_directions(fitted_names, known)
    unidentifiable += tuple(
        name
        for name in weakly_identified(fitted_names, values, known)
        if not any(name in direction for direction in unidentifiable)
    )
    found = warnings_of(
        converged=True, at_bounds=at_bounds, unidentifiable=unidentifiable, at_zero=at_zero
    )
    return FitResult(
        model=model.requires_grad_(False),
        plant=start.plant if start else plant,
        plant_terms=start.plant_terms if start else (),
        status="Converged: linear least squares of the torque.",
        converged=True,
        residual=float(torque.residual.square().mean().sqrt()),
        at_bounds=at_bounds,
        steps=0,
        motions=motions,
        residuals=torch.zeros(0, dtype=torch.float64),
        intervals=confidence_intervals(fitted_names, values, sd, lower, upper),
        unidentifiable=unidentifiable,
        warnings=(*((*found, BLURRED) if found else ()), *outlier_warning(torque.outliers)),
        outliers=torque.outliers,
    )


def result_from_shooting(
    model: FrictionModel,
    problem: ShootingProblem,
    result: LeastSquaresResult,
    motions: tuple[Motion, ...],
    ambiguous: Sequence[str] = (),
) -> FitResult:
    """The result of a search, whose end is written into the model.

    `ambiguous` are parameters for which quite other values explain the data as well.
    """
    plant, variables, x = problem.jacobian.plant, problem.variables, result.x
    friction, vector, _, offsets = variables.split(x)
    model.load_state_dict(model_at(problem.friction, friction).state_dict())
    count, terms = variables.shared_count, variables.terms
    names = [*model.schedule.parameter_names(plant.joint_names), *(t.name for t in terms)]
    lower, upper = (bound[:count] for bound in variables.bounds())
    # Equal bounds: not fitted.
    hit = (result.at_lower | result.at_upper)[:count] & (lower < upper)
    least = lower.abs() <= NOTHING
    least[count - len(terms) :] = torch.tensor([t.to_none for t in terms], dtype=torch.bool)
    at_bounds, at_zero = (
        tuple(names[i] for i in mask.nonzero().flatten().tolist())
        for mask in (hit, hit & result.at_lower[:count] & least)
    )
    residuals = problem.errors(x)
    weights, counted = problem.loss.weight(residuals), problem.loss.counted(residuals)
    residual = float(counted.square().mean().sqrt())
    outliers = tuple(outliers_of(problem, weights))
    noise = measurement_noise(problem, x, residual)
    intervals, unidentifiable, root = _identifiability(
        problem, result, names, residuals * weights, motions, ambiguous
    )
    return FitResult(
        model=model.requires_grad_(False),
        plant=problem.plant_at(vector),
        plant_terms=tuple(
            (t.name, float(v), t.upper) for t, v in zip(terms, vector, strict=True)
        ),
        status=result.message if result.converged else f"Not converged: {result.message}",
        converged=result.converged,
        residual=residual,
        at_bounds=at_bounds,
        steps=result.steps,
        motions=motions,
        residuals=residuals,
        intervals=intervals,
        unidentifiable=unidentifiable,
        encoder_offsets=tuple(map(tuple, offsets.tolist())),
        noise=noise,
        warnings=warnings_of(
            converged=result.converged, at_bounds=at_bounds, unidentifiable=unidentifiable,
            at_zero=at_zero,
        )
        + model_error_warning(
            residual, effective_noise(counted), noise, plant.unit, problem.options
        )
        + outlier_warning(outliers),
        outliers=outliers,
        uncertainty=None if root is None else CoefficientUncertainty(model.schedule, root),
    )  # fmt: skip


def outliers_of(problem: ShootingProblem, weights: Tensor) -> Iterator[Outliers]:
    """Samples that a robust loss counts less than half, by recording."""
    if problem.loss.name == "linear":
        return
    windows = problem.windows
    for place, recording in enumerate(windows.recordings):
        weight = np.ones_like(recording.q)
        for (of, first, last), row in zip(windows.spans, weights.numpy(), strict=True):
            if of == place:
                part = weight[first : last + 1]
                np.minimum(part, row[: last - first + 1], out=part)
        yield from named_outliers(recording, weight)


def _identifiability(
    problem: ShootingProblem,
    result: LeastSquaresResult,
    names: Sequence[str],
    residuals: Tensor,
    motions: Sequence[Motion],
    ambiguous: Sequence[str],
) -> tuple[tuple[Interval, ...], tuple[str, ...], Tensor | None]:
    """Confidence intervals, unidentifiable parameters, and a covariance root of the friction.

    Of a network only its plant terms have intervals, and no parameter counts as unidentifiable.
    """
    variables, options = problem.variables, problem.options
    count, friction_count = variables.shared_count, variables.friction_count
    constant = not problem.friction.schedule.follows_motion
    lower, upper = (bound[:count] for bound in variables.bounds())
    fitted = (lower < upper).nonzero().flatten()
    fitted_names = [names[i] for i in fitted.tolist()]
    # Residuals of exactly zero are those of joints that never moved.
    if not torch.isfinite(result.hessian).all() or not effective_noise(residuals) > 0:
        return (), tuple(fitted_names) if constant else (), None
    # Without the extrapolation prior: where that alone holds a network, the data do not.
    sd = hac_sd(residuals, bandwidth(problem.windows.q, options), options)
    # A contact below breakaway returns to its places, and the rounding there with it, at any lag.
    quantum = encoder_count(problem) if problem.friction.law.memory else None
    rms = float(residuals.square().mean().sqrt())
    rounded = quantum and rms <= options.explained_ratio * quantum / 12**0.5
    known = problem.information(result.x, sd, quantum if rounded else None).subset(fitted)
    root = torch.zeros(count, len(fitted), dtype=torch.float64)
    root[fitted] = covariance_root(known)
    root[[names.index(name) for name in ambiguous]] = torch.inf
    sd = root.norm(dim=1)
    shown = fitted if constant else fitted[fitted >= friction_count]
    intervals = confidence_intervals(
        [names[i] for i in shown.tolist()], result.x[shown], sd[shown], lower[shown], upper[shown]
    )
    unidentifiable: tuple[str, ...] = ()
    if constant:
        friction = fitted[fitted < friction_count]
        coefficients = fitted_names[: len(friction)]
        unidentifiable = (*null_directions(fitted_names, known, options), *ambiguous)
        slope, need = _torque_scale(problem, result, motions)
        weak = (
            *weakly_identified(coefficients, result.x[friction], known, options),
            *exceeds_drive_torque(coefficients, sd[friction], slope[friction], need[friction]),
        )
        unidentifiable += tuple(
            name for name in dict.fromkeys(weak) if not any(name in d for d in unidentifiable)
        )
    return intervals, unidentifiable, root[:friction_count].clone()


def _torque_scale(
    problem: ShootingProblem, result: LeastSquaresResult, motions: Sequence[Motion]
) -> tuple[Tensor, Tensor]:
    """Derivative of the friction torque by each constant coefficient at its joint's peak speed, and
    the largest torque that moves this joint, (friction parameter,) each.
    """
    friction, vector, _, _ = problem.variables.split(result.x)
    speed, moved = peak_dynamics_torque(problem.plant_at(vector), motions, problem.options)
    need = torch.maximum(moved, problem.windows.tau.abs().amax((0, 1)))
    table = friction.reshape(len(speed), -1).clone().requires_grad_()
    with torch.enable_grad():
        # A law is elementwise, so the sum's gradient is each coefficient's own slope.
        torque = problem.friction.steady_torque(speed, torch.ones_like(speed), table)
        (slope,) = torch.autograd.grad(torque.sum(), table)
    return slope.flatten(), need[:, None].expand_as(slope).flatten()


def rounding(problem: ShootingProblem) -> float:
    """Root mean square rounding of the encoders [rad; m], by their count.

    A count that neither the plant states nor the positions show is taken for a 4096th of the motion
    within a window.
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
    """Residual of a right law [rad; m], given that of a solution, both root mean square.

    The torque's noise is simulated only for residuals of more than `enough` times the rounding, by
    default those that count as errors of the model.
    """
    least = rounding(problem)
    if residual <= (enough or problem.options.model_error_ratio) * least:
        return least
    errors = problem.errors(x)
    encoder = float(white_noise(errors).clamp(min=least).square().mean().sqrt())
    return math.hypot(encoder, _by_torque(problem, x, errors))


def _by_torque(problem: ShootingProblem, x: Tensor, errors: Tensor) -> float:
    """Root mean square residual by one realisation of the torque's noise, once fitted [rad; m]."""
    response = problem.torque_response(x, 1)
    if response is None:
        return 0.0
    # Positions as if the noise alone made the errors, so small that simulations respond linearly,
    # and priors around this solution.
    off = SMALL * response[..., 0]
    windows, options = problem.windows, problem.options
    q = windows.q + torch.linalg.solve(problem.measurement, (errors - off).mT).mT
    friction, plant, states, _ = problem.variables.split(x)
    q0, qd0 = states[:, : 2 * windows.q0.shape[-1]].chunk(2, -1)
    of_friction, of_plant = problem.variables.split(problem.variables.prior()[0])[:2]
    pretended = replace(
        problem, windows=replace(windows, q=q, q0=q0, qd0=qd0), loss=SQUARES,
        friction_prior=(friction, of_friction.rsqrt()), plant_prior=(plant, of_plant.rsqrt()),
    )  # fmt: skip
    solver = LevenbergMarquardt(
        max_steps=options.settling_steps, cost_tolerance=options.settling_tolerance
    )
    lower, upper = pretended.variables.bounds()
    fitted = solver.minimise(
        pretended.linearise, x, cost=pretended.cost, lower=lower, upper=upper
    ).x
    found = float(pretended.errors(fitted).square().mean().sqrt()) / SMALL
    return found if math.isfinite(found) else 0.0
