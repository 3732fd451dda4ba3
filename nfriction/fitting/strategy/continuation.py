"""Stages of a trajectory fit: windows of one length, searched from where the last stage ended."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import substeps_of
from nfriction.fitting.data.windows import Windows
from nfriction.fitting.plant_parameters import PlantParameter
from nfriction.fitting.result.fit_result import Continuity
from nfriction.fitting.shooting.autocorrelation import effective_noise
from nfriction.fitting.shooting.problem import TrajectoryProblem, solve_trajectory
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.extrapolation_prior import Anchors
from nfriction.friction.coefficients import Constant
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import LeastSquaresResult, Status, Step
from nfriction.optim.levenberg_marquardt import FULL
from nfriction.plant import Plant
from nfriction.recording import Recording

Callback = Callable[[str, Step], bool | None]

# By how much position and velocity may jump from the end of a window to the start of the next
# [rad, rad/s; m, m/s]. Beside the soft ones the positions of short windows count enough for a
# search from far away to find its way; along the hard ones it would creep.
JUMP_SD: dict[Continuity, tuple[float, float] | None] = {
    "free": None, "soft": (3e-4, 0.01), "hard": (1e-6, 3e-5),
}  # fmt: skip

# Errors that count for less would be rounding [rad or m].
LEAST_NOISE = 1e-9

# Residuals grow with the windows, but not so much unless the search went astray.
LOST_TRACK = 10.0
# Dry friction puts kinks into the cost, along which a search may creep: so many steps in a row
# that together lower it by no more than their tolerance end it.
PATIENCE = 3
# Windows that diverge from their neighbourhood's motion lower the cost long after what they share
# has settled: so many steps in a row that each move it by no more than this share of its standard
# deviation end a search, too.
SETTLED = 0.05


@dataclass(frozen=True)
class Stage:
    """Where the search ended with windows of one length.

    Attributes:
        problem: what was minimised; its model holds the best parameters.
        result: of the search.
        residuals: position errors there [rad or m], (window, step + 1, joint).
    """

    problem: TrajectoryProblem
    result: LeastSquaresResult
    residuals: Tensor

    @property
    def vector(self) -> Tensor:
        """Values of the plant's terms."""
        return self.problem.unknowns.split(self.result.x)[1].clone()

    @property
    def zeros(self) -> Tensor:
        """Zeros of the recordings in one row; none where they were not sought."""
        return self.problem.unknowns.split_zeros(self.result.x).clone()

    @property
    def noise(self) -> float:
        """Standard deviation that a residual counts with."""
        return effective_noise(self.residuals)

    def lost_since(self, before: "Stage") -> bool:
        """Whether longer windows only found that the motion forgets its start within them."""
        rms = [float(stage.residuals.square().mean().sqrt()) for stage in (before, self)]
        far = not rms[1] <= LOST_TRACK * rms[0]
        return far and not self.result.converged


@dataclass(frozen=True)
class Refinement:
    """Searches of one model and plant over windows of recordings.

    Args:
        plant: the mechanism as given.
        model: the friction model, varied in place.
        joint: recordings in joint coordinates.
        mixing: from joint coordinates to the recordings' own.
        terms: adjustable terms of the plant.
        max_steps: limit to each stage.
        callback: told every step with its stage; True stops.
        zero_sd, jump_sd, anchors: see `TrajectoryProblem`.
    """

    plant: Plant
    model: FrictionModel
    joint: Sequence[Recording]
    mixing: Tensor
    terms: list[PlantParameter]
    max_steps: int = 30
    callback: Callback | None = None
    zero_sd: Tensor | None = None
    jump_sd: tuple[float, float] | None = None
    anchors: Anchors | None = None
    jacobian: StepJacobian = field(init=False)

    def __post_init__(self) -> None:
        jacobian = StepJacobian(self.plant, self.model, self.terms)
        object.__setattr__(self, "jacobian", jacobian)

    def problem(
        self,
        windows: Windows,
        noise: float,
        mean: Tensor | None = None,
        stride: int = 1,
        far: bool = False,
    ) -> TrajectoryProblem:
        """The least-squares problem of windows; see `TrajectoryProblem`.

        From `far`, windows join softly at most.
        """
        jump_sd = JUMP_SD["soft"] if far and self.jump_sd else self.jump_sd
        return TrajectoryProblem(
            self.jacobian, windows, noise, self.mixing,
            substeps=substeps_of(self.plant, self.model, self.joint), plant_mean=mean,
            stride=stride, zero_sd=self.zero_sd, jump_sd=jump_sd,
            anchors=self.anchors,
        )  # fmt: skip

    def search(
        self,
        problem: TrajectoryProblem,
        vector: Tensor,
        tolerance: float,
        name: str,
        zeros: Tensor | None = None,
    ) -> Stage:
        """Minimise from the model's present parameters and plant terms at `vector`.

        Args:
            problem: of this refinement.
            vector: plant terms to start from.
            tolerance: relative fall of the cost that counts as none.
            name: of the stage, for the callback.
            zeros: of each recording, to start from; 0 by default.
        """
        watch = _Watch(name, tolerance, self.callback, problem)
        result = solve_trajectory(
            problem, problem.unknowns.start(vector, zeros), max_steps=self.max_steps,
            callback=watch, cost_tolerance=tolerance,
        )  # fmt: skip
        if result.status == "stopped" and (watch.settles or watch.creeps):
            status: Status = "converged_step" if watch.settles else "creeping"
            result = replace(result, status=status)
        return Stage(problem, result, problem.errors(result.x))


class _Watch:
    """Tells the caller every step, and ends a search that creeps or has settled."""

    def __init__(
        self, name: str, tolerance: float, callback: Callback | None, problem: TrajectoryProblem
    ) -> None:
        self.name, self.tolerance, self.callback, self.problem = name, tolerance, callback, problem
        self.costs: list[float] = []
        self.before: Tensor | None = None
        self.still = 0
        self.creeps = self.settles = False

    def __call__(self, x: Tensor, step: Step) -> bool:
        if self.callback is not None and self.callback(self.name, step):
            return True
        self.costs.append(step.cost)
        if len(self.costs) > PATIENCE:
            before = self.costs[-1 - PATIENCE]
            self.creeps = before - step.cost <= PATIENCE * self.tolerance * before
        self.still = self.still + 1 if self._moved(x, step) <= SETTLED else 0
        self.settles = self.still >= PATIENCE
        return self.creeps or self.settles

    def _moved(self, x: Tensor, step: Step) -> float:
        """By how many standard deviations a full step moved a shared parameter at most."""
        problem = self.problem
        if not isinstance(problem.friction.schedule, Constant):
            return torch.inf
        shared, self.before, before = x[: problem.unknowns.shared_count], x, self.before
        # A step that damping cut short is no sign of rest.
        if before is None or step.damping > FULL:
            return torch.inf
        spread = problem.spread()
        # Chaotic windows leave a curvature of rounding alone, by which nothing would ever move.
        if torch.isinf(spread).all():
            return torch.inf
        return float(((shared - before[: problem.unknowns.shared_count]) / spread).abs().max())


def least(residuals: Tensor, noise: float) -> float:
    """Cost of residuals counted in what they turned out to be."""
    return float(0.5 * (residuals / noise).square().sum())


def flat(cost: float) -> float:
    """Relative fall of the cost that changes the log likelihood by a tenth."""
    return 0.1 / max(cost, 1.0)
