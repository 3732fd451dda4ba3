"""Horizon continuation: shooting windows of growing length, each started at the last end."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import integration_substeps
from nfriction.fitting.data.windows import Windows, cut_windows
from nfriction.fitting.options import FitOptions
from nfriction.fitting.shooting.autocorrelation import effective_noise
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.shooting.variables import Parts, model_at
from nfriction.fitting.strategy.extrapolation_prior import ExtrapolationPrior
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import LeastSquaresResult, Quadratic, Status, Step
from nfriction.optim.levenberg_marquardt import WEAK_DAMPING, LevenbergMarquardt
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

# Coefficients (joint, coefficient) that torques imply on a plant.
EquationError = Callable[[Plant], Tensor]


@dataclass(frozen=True, eq=False)
class HorizonResult:
    """The end of a search with windows of one length."""

    problem: ShootingProblem
    result: LeastSquaresResult

    @cached_property
    def residuals(self) -> Tensor:
        """Position errors [rad; m], (window, step + 1, joint)."""
        return self.problem.errors(self.result.x)

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

    def lost_motion(self, before: "HorizonResult", options: FitOptions) -> bool:
        """True if the longer windows only show that the motion forgets its start within them."""
        rms = [float(found.residuals.square().mean().sqrt()) for found in (before, self)]
        return not rms[1] <= options.max_growth * rms[0] and not self.result.converged

    def as_stopped(self) -> "HorizonResult":
        """The same, reported as stopped by the caller."""
        return replace(self, result=replace(self.result, status="stopped"))


@dataclass(frozen=True, eq=False)
class ShootingFitter:
    """Poses and solves shooting problems of one friction model, plant and set of recordings.

    The recordings are in joint coordinates; `callback` is called with a stage name after every
    step, True stops; for the other attributes see `ShootingProblem`.
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
    defect_sd: tuple[float, float] | None = None
    extrapolation: ExtrapolationPrior | None = None

    def cut(self, motions: Sequence[Motion], length: float) -> Windows:
        """Windows of the recordings, each from the state that a motion has there."""
        # Encoders that were zeroed where stiction held the links were zeroed at rest.
        rest_speed = None if self.offset_sd is None else self.options.rest_speed
        return cut_windows(self.recordings, motions, length, rest_speed=rest_speed)

    def problem(
        self,
        windows: Windows,
        noise: float,
        friction: Tensor,
        *,
        stride: int = 1,
        far: bool = False,
    ) -> ShootingProblem:
        """The problem of windows that starts at these friction parameters.

        Where the start is `far` away, defects are at most penalised.
        """
        model = model_at(self.friction, friction)
        longest_step = max(r.longest_step for r in self.recordings)
        return ShootingProblem(
            self.jacobian, model, windows, noise, self.measurement,
            substeps=integration_substeps(
                self.jacobian.plant, model, longest_step, self.options
            ),
            stride=stride, friction_prior=self.friction_prior, plant_prior=self.plant_prior,
            offset_sd=self.offset_sd, extrapolation=self.extrapolation, options=self.options,
            defect_sd=self.options.penalty_sd if far and self.defect_sd else self.defect_sd,
        )  # fmt: skip

    def search(
        self, problem: ShootingProblem, start: Tensor, tolerance: float, name: str
    ) -> HorizonResult:
        """Minimise a problem of this fitter.

        `tolerance` is the relative decrease of the cost that counts as none, `name` the stage's for
        the callback.
        """
        solver = LevenbergMarquardt(
            max_steps=self.options.max_steps,
            gradient_tolerance=self.options.gradient_tolerance,
            cost_tolerance=tolerance,
            step_tolerance=self.options.step_tolerance,
        )
        lower, upper = problem.variables.bounds()
        monitor = StallMonitor(problem, tolerance, self.options)

        def report(x: Tensor, local: Quadratic, step: Step) -> Status | None:
            if self.callback is not None and self.callback(name, step):
                return "stopped"
            return monitor(x, local, step)

        result = solver.minimise(
            problem.linearise, start, cost=problem.cost, lower=lower, upper=upper, callback=report
        )
        return HorizonResult(problem, result)


class StallMonitor:
    """Ends a search whose steps creep, or whose shared variables have converged."""

    def __init__(self, problem: ShootingProblem, tolerance: float, options: FitOptions) -> None:
        self.problem, self.tolerance, self.options = problem, tolerance, options
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
        if len(self.costs) <= patience:
            return None
        before = self.costs[-1 - patience]
        return "creeping" if before - step.cost <= patience * self.tolerance * before else None

    def _move(self, x: Tensor, local: Quadratic, step: Step) -> float:
        """Largest move of a shared variable in a full step, in standard deviations."""
        if self.problem.friction.schedule.follows_motion:
            return torch.inf
        count = self.problem.variables.shared_count
        before, self.before = self.before, x
        # A step that damping cut short shows no convergence.
        if before is None or step.damping > WEAK_DAMPING:
            return torch.inf
        sd = self.problem.posterior_sd(local.hessian)
        # Of chaotic windows the curvature is round-off, by which nothing would ever move.
        if torch.isinf(sd).all():
            return torch.inf
        return float(((x - before)[:count] / sd).abs().max())


def horizon_continuation(
    fitter: ShootingFitter,
    friction: Tensor,
    plant: Tensor,
    motions: tuple[Motion, ...],
    equation_error: EquationError | None = None,
    of: str = "",
) -> tuple[HorizonResult, tuple[float, ...]]:
    """Search windows of growing length, each from the states and with the noise of the last.

    If a horizon fails, return the previous stage and the skipped horizons.

    Args:
        fitter: of the model; `options.windows` are the lengths.
        friction, plant: parameters to start from.
        motions: smoothed, in joint coordinates.
        equation_error: repeats the first stage from the coefficients that torques imply on the
            plant that it found: a nonlinear law has several minima, and on a slightly wrong
            inertia the torques lead to a worse one.
        of: ending of the stages' names.
    """
    options = fitter.options
    reached: HorizonResult | None = None
    offsets: Tensor | None = None
    noise, simulated = options.first_noise, motions
    for place, length in enumerate(options.windows):
        far = reached is None and len(options.windows) > 1
        problem = fitter.problem(fitter.cut(simulated, length), noise, friction, far=far)
        start = problem.variables.start(plant, offsets)
        tolerance = options.loose_tolerance
        if length == options.windows[-1]:
            # The cost far from the minimum says nothing about its value; the last stage's does.
            near = reached and weighted_cost(reached.residuals, noise)
            tolerance = loglik_tolerance(near or float(problem.cost(start)), options)
        name = f"{length:g} s windows{of}"
        found = fitter.search(problem, start, tolerance, name)
        if reached is None and equation_error is not None and not found.stopped:
            found = restart_from_equation_error(fitter, found, tolerance, name, equation_error)
        if reached is not None and found.lost_motion(reached, options):
            return reached, tuple(options.windows[place:])
        reached, noise = found, max(found.noise, options.min_noise)
        friction, plant, _, offsets = found.parts
        if found.stopped:
            break
        simulated = problem.simulated_motions(found.result.x, simulated)
    assert reached is not None
    return reached, ()


def restart_from_equation_error(
    fitter: ShootingFitter,
    found: HorizonResult,
    tolerance: float,
    name: str,
    equation_error: EquationError,
) -> HorizonResult:
    """A stage, or the same from the coefficients that torques imply on its plant, if lower."""
    problem, plant = found.problem, found.parts.plant
    friction = equation_error(problem.plant_at(plant)).reshape(-1)
    problem = replace(problem, friction=model_at(problem.friction, friction))
    start = problem.variables.start(plant, found.parts.offsets)
    other = fitter.search(problem, start, tolerance, name)
    return other if other.stopped or other.result.cost < found.result.cost else found


def weighted_cost(residuals: Tensor, noise: float) -> float:
    """Half the sum of squares of residuals over their noise."""
    return float(0.5 * (residuals / noise).square().sum())


def loglik_tolerance(cost: float, options: FitOptions) -> float:
    """Relative decrease of a cost that no longer matters to the log likelihood."""
    return options.loglik_tolerance / max(cost, 1.0)
