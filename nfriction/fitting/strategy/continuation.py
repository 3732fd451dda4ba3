"""Horizon continuation: shooting windows of growing length, each started from the previous."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import integration_substeps
from nfriction.fitting.data.windows import Windows, cut_windows
from nfriction.fitting.options import FitOptions
from nfriction.fitting.result.identifiability import (
    NORMAL_95,
    covariance_root,
    information,
    standard_deviations,
)
from nfriction.fitting.result.paired_test import student_quantile, total_gain
from nfriction.fitting.shooting.autocorrelation import bandwidth, effective_noise, hac_sd
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.shooting.uncertainty import explained, gathered_information, torque_noise
from nfriction.fitting.shooting.variables import Parts, model_at
from nfriction.fitting.strategy.extrapolation_prior import ExtrapolationPrior
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import LeastSquaresResult, Quadratic, Status, Step
from nfriction.optim.levenberg_marquardt import WEAK_DAMPING, LevenbergMarquardt
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

# Coefficients (joint, coefficient) that torques imply for a plant: the best, then the best for each
# of the law's initial values.
EquationError = Callable[[Plant], Iterable[Tensor]]
# Why longer windows were skipped.
Reason = Literal["", "too long", "lossy", "noisy"]


@dataclass(frozen=True, eq=False)
class HorizonResult:
    """The end of a search with windows of one length."""

    problem: ShootingProblem
    result: LeastSquaresResult

    @cached_property
    def residuals(self) -> Tensor:
        """Position errors weighted by the loss [rad; m], (window, step + 1, joint)."""
        return self.problem.counted_errors(self.result.x)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals [rad; m]."""
        return float(self.residuals.square().mean().sqrt())

    @cached_property
    def parts(self) -> Parts:
        """Parameters of friction and plant, window states and encoder offsets."""
        return self.problem.variables.split(self.result.x)

    @property
    def stopped(self) -> bool:
        """True if the caller stopped the search."""
        return self.result.status == "stopped"

    @cached_property
    def noise(self) -> float:
        """Standard deviation of a residual, inflated for autocorrelation."""
        return effective_noise(self.residuals)

    @cached_property
    def explained(self) -> bool:
        """True if the noise of encoders and torques explains the residuals."""
        return explained(self.problem, self.result.x, self.rms)

    @cached_property
    def log_volume(self) -> float:
        """Logarithm of the volume of the friction's uncertainty; NaN if it is infinite."""
        problem, options = self.problem, self.problem.options
        lower, upper = problem.variables.bounds()
        fitted = (lower < upper)[: problem.variables.shared_count].nonzero().flatten()
        sd = hac_sd(self.residuals, bandwidth(problem.windows.q, options), options)
        known = gathered_information(problem, self.result.x, sd).subset(fitted)
        root = covariance_root(known)[fitted < problem.variables.friction_count]
        return float(torch.linalg.slogdet(root @ root.T)[1])

    def lost_motion(self, before: "HorizonResult", options: FitOptions) -> bool:
        """True if the longer windows show only that the motion is chaotic within them."""
        longer = self.problem.windows.length / before.problem.windows.length
        # A constant error of the torque causes one that grows with the square of time.
        return not self.rms <= max(options.max_growth, longer**2) * before.rms

    def as_stopped(self) -> "HorizonResult":
        """The same stage, reported as stopped by the caller."""
        return replace(self, result=replace(self.result, status="stopped"))


@dataclass(frozen=True, eq=False)
class ShootingFitter:
    """Poses and solves shooting problems of one friction model, plant and set of recordings.

    The recordings are in joint coordinates; `callback` is called with a stage name after every
    step and stops the search by returning True; for other attributes see `ShootingProblem`.
    """

    jacobian: StepJacobian
    friction: FrictionModel
    recordings: Sequence[Recording]
    measurement: Tensor
    options: FitOptions
    callback: Callable[[str, Step], bool | None] | None = None
    friction_prior: tuple[Tensor, Tensor] | None = None
    plant_prior: tuple[Tensor, Tensor] | None = None
    offset_sd: Tensor | None = None
    extrapolation: ExtrapolationPrior | None = None

    def cut(
        self, motions: Sequence[Motion], length: float, smoothed: Sequence[Motion] | None = None
    ) -> Windows:
        """Windows of recordings, each from the state of its motion; see `cut_windows`."""
        # Encoders zeroed in a pose that stiction holds were zeroed at rest.
        # The torque before the first sample is not known, and a delay moves it into the window.
        at_rest = self.offset_sd is not None and self.jacobian.delay_index is None
        rest_speed = self.options.rest_speed if at_rest else None
        return cut_windows(
            self.recordings, motions, length, smoothed=smoothed, rest_speed=rest_speed
        )

    def problem(
        self, windows: Windows, noise: float, friction: Tensor, *, stride: int = 1
    ) -> ShootingProblem:
        """The shooting problem of windows, started from these friction parameters."""
        model, plant = model_at(self.friction, friction), self.jacobian.plant
        longest_step = max(r.longest_step for r in self.recordings)
        return ShootingProblem(
            self.jacobian, model, windows.with_states(plant, model), noise, self.measurement,
            substeps=integration_substeps(plant, model, longest_step, self.options),
            stride=stride, friction_prior=self.friction_prior, plant_prior=self.plant_prior,
            offset_sd=self.offset_sd, extrapolation=self.extrapolation, options=self.options,
        )  # fmt: skip

    def search(
        self,
        problem: ShootingProblem,
        start: Tensor,
        tolerance: float,
        name: str,
        least: float = 0.0,
    ) -> HorizonResult:
        """Minimise a problem of this fitter.

        Decreases of the cost below `least`, or below `tolerance` relative to it, count as zero;
        `name` is passed to the callback. A robust loss without a scale finally gets the scale of
        the errors.
        """
        options, x = self.options, start
        solver = LevenbergMarquardt(
            max_steps=options.max_steps, gradient_tolerance=options.gradient_tolerance,
            cost_tolerance=tolerance, step_tolerance=options.step_tolerance,
        )  # fmt: skip
        lower, upper = problem.variables.bounds()

        def report(x: Tensor, local: Quadratic, step: Step) -> Status | None:
            if self.callback is not None and self.callback(name, step):
                return "stopped"
            return monitor(x, local, step)

        scaled = options.loss == problem.loss.name
        problem = problem if scaled else problem.rescaled(x)
        for _ in range(1 if scaled else options.most_scales):
            monitor = StallMonitor(problem, tolerance, options, least)
            result = solver.minimise(
                problem.linearise, x, cost=problem.cost, lower=lower, upper=upper, callback=report
            )
            found, x = HorizonResult(problem, result), result.x
            if scaled or found.stopped:
                break
            problem = problem.rescaled(x)
            change = problem.loss.scale / found.problem.loss.scale - 1
            if change.abs().max() <= options.scale_tolerance:
                break
        return found


class StallMonitor:
    """Ends a search whose steps creep, or whose shared variables have converged."""

    def __init__(
        self, problem: ShootingProblem, tolerance: float, options: FitOptions, least: float = 0.0
    ) -> None:
        self.problem, self.options = problem, options
        self.tolerance, self.least = tolerance, least
        self.costs: list[float] = []
        self.before: Tensor | None = None
        self.still = 0

    def __call__(self, x: Tensor, local: Quadratic, step: Step) -> Status | None:
        patience = self.options.patience
        self.costs.append(step.cost)
        rests = self._move(x, local, step) <= self.options.settled_move
        self.still = self.still + 1 if rests else 0
        if not patience:
            return None
        if self.still >= patience:
            return "converged_step"
        weak = len(self.costs) > 1 and step.damping <= WEAK_DAMPING
        if weak and self.costs[-2] - step.cost < self.least:
            return "converged_cost"
        if len(self.costs) <= patience:
            return None
        before = self.costs[-1 - patience]
        return "creeping" if before - step.cost <= patience * self.tolerance * before else None

    def _move(self, x: Tensor, local: Quadratic, step: Step) -> float:
        """Largest change of a shared variable in a full step, in standard deviations."""
        if self.problem.friction.schedule.follows_motion:
            return torch.inf
        count = self.problem.variables.shared_count
        before, self.before = self.before, x
        # A step shortened by damping does not indicate convergence.
        if before is None or step.damping > WEAK_DAMPING:
            return torch.inf
        precision, _ = self.problem.variables.prior()
        sd = standard_deviations(information(local.hessian, precision, count))
        # The curvature of chaotic windows is round-off; measured by it, nothing would move.
        if torch.isinf(sd).all():
            return torch.inf
        # The noise of a first stage is a guess; if it is too large, changes look small.
        samples = float(self.problem.windows.weight.sum()) * self.problem.windows.q.shape[-1]
        noise = min(1.0, math.sqrt(2.0 * float(local.cost) / samples))
        return float(((x - before)[:count] / sd).abs().max()) / max(noise, 1e-9)


@dataclass(frozen=True, eq=False)
class Continuation:
    """The stages of a search, each with longer windows than the previous one."""

    stages: tuple[HorizonResult, ...]  # those that were kept, at least one
    skipped: tuple[float, ...] = ()  # lengths of the windows that were skipped [s]
    reason: Reason = ""  # of the first; empty if stopped

    @property
    def end(self) -> HorizonResult:
        """The last stage that was kept."""
        return self.stages[-1]

    def ending(self, end: HorizonResult) -> "Continuation":
        """The continuation with a different last stage."""
        return replace(self, stages=(*self.stages[:-1], end))


def horizon_continuation(
    fitter: ShootingFitter,
    friction: Tensor,
    plant: Tensor,
    motions: tuple[Motion, ...],
    equation_error: EquationError | None = None,
    of: str = "",
) -> Continuation:
    """Search windows of growing length, each from the states and the noise of the previous stage.

    A horizon that fails, or whose parameters are worse on shorter horizons (`loses`), is skipped,
    and so are all longer ones.

    Args:
        fitter: of the model; `options.windows` gives the lengths.
        friction, plant: parameters to start from.
        motions: smoothed, in joint coordinates.
        equation_error: gives coefficients that torques imply on the fitted plant, from which the
            first and the last stage are repeated, because a nonlinear law has several minima and
            the torques lead to a worse one if the inertia is slightly wrong.
        of: suffix of the stages' names.
    """
    options = fitter.options
    stages: list[HorizonResult] = []
    offsets: Tensor | None = None
    noise, simulated = options.first_noise, motions
    skipped: tuple[float, ...] = ()
    reason: Reason = ""
    for place, length in enumerate(options.windows):
        rest, last = tuple(options.windows[place:]), place + 1 == len(options.windows)
        problem = fitter.problem(fitter.cut(simulated, length, motions), noise, friction)
        start = problem.variables.start(plant, offsets)
        if stages:
            # Simulations from the states of shorter windows diverge over longer ones. Correcting
            # states and parameters together, the first step would move the parameters far away.
            start, stopped = settle_states(problem, start)
            if stopped:
                return Continuation((*stages[:-1], stages[-1].as_stopped()), rest)
        tolerance = options.loose_tolerance
        if last:
            # The cost at the minimum is estimated from the last stage, as the start is far from it.
            near = weighted_cost(stages[-1].residuals, noise) if stages else None
            tolerance = loglik_tolerance(near or float(problem.cost(start)), options)
        name = f"{problem.windows.length:g} s windows{of}"
        found = fitter.search(problem, start, tolerance, name)
        ends = [found]
        if equation_error is not None and not found.stopped and (last or not stages):
            other = restart_from_equation_error(
                fitter, found, start, tolerance, name, equation_error
            )
            ends = [other, found] if other is not found else ends
        if stages and ends[0].lost_motion(stages[-1], options):
            if found.stopped:
                return Continuation((*stages[:-1], stages[-1].as_stopped()), rest)
            skipped, reason = rest, "too long"
            break
        kept = [end for end in ends if not stages or end.stopped or not loses(stages, end)]
        if not kept:
            # Errors that noise hides are no reason to doubt law or plant.
            noisy = all(end.explained or knows_less(end, stages[-1]) for end in ends)
            skipped, reason = rest, "noisy" if noisy else "lossy"
            break
        found = kept[0]
        if fitter.friction.law.memory and not (found.stopped or found.result.converged):
            # Sensitive contacts at the start raise the damping, which then keeps steps short.
            found = fitter.search(found.problem, found.result.x, tolerance, name)
        stages.append(found)
        noise = max(found.noise, options.min_noise)
        friction, plant, _, offsets = found.parts
        if found.stopped:
            break
        simulated = found.problem.simulated_motions(found.result.x, simulated)
    end = stages[-1]
    # A guessed noise that is too large gives the priors too much weight.
    guessed = len(stages) == 1 and noise < end.problem.noise_sd
    if not end.stopped and (guessed or (skipped and end.result.status == "max_steps")):
        # The step limit may have ended a stage that was only to start the next one.
        problem = replace(end.problem, noise_sd=noise) if guessed else end.problem
        tolerance = loglik_tolerance(float(problem.cost(end.result.x)), options)
        name = f"{problem.windows.length:g} s windows{of}, continued"
        stages[-1] = fitter.search(problem, end.result.x, tolerance, name)
    return Continuation(tuple(stages), skipped, reason)


def settle_states(problem: ShootingProblem, x: Tensor) -> tuple[Tensor, bool]:
    """Decision variables with the best states and encoder offsets for fixed shared variables.

    The second value is True if the search was interrupted.
    """
    options, count = problem.options, problem.variables.shared_count
    shared = x[:count]

    def at(states: Tensor) -> Tensor:
        return torch.cat([shared, states])

    solver = LevenbergMarquardt(
        max_steps=options.settling_steps, cost_tolerance=options.settling_tolerance
    )
    result = solver.minimise(
        lambda states: problem.linearise(at(states), states=True),
        x[count:],
        cost=lambda states: problem.cost(at(states)),
    )
    return at(result.x), result.status == "stopped"


def loses(stages: Sequence[HorizonResult], found: HorizonResult) -> bool:
    """True if a stage's parameters are significantly worse on the windows of earlier stages.

    If the encoder's rounding explains the residuals of shorter windows, law and plant are correct,
    and the stage loses if the likelihood there falls by more than parameter uncertainty explains.
    Otherwise law or plant is wrong, and accuracy at short horizons may be traded for long ones: on
    free swings without limit, but errors of a measured torque accumulate over a long window and
    bias its parameters. Even with a correct law and plant, torque noise accumulates, so longer
    windows may determine friction less well (`knows_less`). As the noise of each horizon is
    unknown, the logarithms of the errors are compared; a stage loses if its parameters are worse at
    a shorter horizon by more than the scatter, and over all horizons by more than that of the sum.
    """
    from scipy.special import chdtri  # slow to import

    before, chance = stages[-1], found.problem.options.loss_level
    lower, upper = found.problem.variables.bounds()
    fitted = int((lower < upper)[: found.problem.variables.shared_count].sum())
    if knows_less(found, before):
        return True
    total, variance, worse = 0.0, 0.0, False
    for at in (*stages, found):
        new = _squares(at, found)
        if at is not found and at.explained:
            noise = max(at.noise, found.problem.options.min_noise)
            lost = float(new.sum() - at.residuals.square().sum()) / noise**2
            if not lost <= float(chdtri(fitted, chance)):
                return True
        elif not new.isfinite().all():
            return True
        elif found.problem.windows.tau.any():
            gain, spread = total_gain(new, _squares(at, before))
            total += gain
            # A single window has no scatter.
            variance += spread**2 if math.isfinite(spread) else 0.0
            sure = spread * student_quantile(len(new) - 1, 1 - chance)
            worse |= at is not found and -gain > sure
    return worse and total < -math.sqrt(variance) * NORMAL_95


def knows_less(found: HorizonResult, before: HorizonResult) -> bool:
    """True if torque noise makes a stage's friction less certain than that of an earlier one.

    That is, if noise explains the residuals of the shorter windows and the volume of the friction's
    uncertainty grows. False for windows of equal length, or if either stage does not determine the
    friction at all.
    """
    same = found.problem.windows.spans == before.problem.windows.spans
    noisy = any(sd.any() for sd in torque_noise(found.problem.windows))
    if same or not noisy or not before.explained:
        return False
    return found.log_volume > before.log_volume


def _squares(at: HorizonResult, of: HorizonResult) -> Tensor:
    """Squared residuals of each window of a stage with another stage's parameters, (window,)."""
    if at is of:
        return of.residuals.square().sum((1, 2))
    count = at.problem.variables.shared_count
    x, _ = settle_states(at.problem, torch.cat([of.result.x[:count], at.result.x[count:]]))
    return at.problem.counted_errors(x).square().sum((1, 2))


def restart_from_equation_error(
    fitter: ShootingFitter,
    found: HorizonResult,
    start: Tensor,
    tolerance: float,
    name: str,
    equation_error: EquationError,
) -> HorizonResult:
    """A stage, or a better one started from coefficients that torques imply on its plant.

    The stage's own start is not tried again. The starts after the first, from the law's grid of
    initial values, are tried only if the encoder's rounding does not explain the residual; if it
    does, there is no lower minimum.
    """
    problem, plant, best = found.problem, found.parts.plant, found
    for place, friction in enumerate(equation_error(problem.plant_at(plant))):
        if place and best.explained:
            break
        begun = replace(problem, friction=model_at(problem.friction, friction.reshape(-1)))
        x = begun.variables.start(plant, found.parts.offsets)
        # As for the first windows if the plant is not fitted.
        if torch.equal(x, start):
            continue
        count = begun.variables.shared_count
        x = torch.cat([x[:count], found.result.x[count:]]) if place else x
        other = fitter.search(begun, x, tolerance, name)
        if other.stopped:
            return best.as_stopped() if place else other
        if other.result.cost < best.result.cost * (1 - tolerance if place else 1):
            best = other
    return best


def weighted_cost(residuals: Tensor, noise: float) -> float:
    """Half the sum of squares of residuals over their noise."""
    return float(0.5 * (residuals / noise).square().sum())


def loglik_tolerance(cost: float, options: FitOptions) -> float:
    """Relative decrease of a cost that no longer matters to the log likelihood."""
    return options.loglik_tolerance / max(cost, 1.0)
