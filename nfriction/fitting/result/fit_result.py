"""A fitted model with its verdict: whether the search converged, and what the data tell."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.equation_error import TorqueFit, largest_moved
from nfriction.fitting.result.identifiability import (
    Interval,
    beyond_need,
    covariance_root,
    intervals,
    lost_directions,
    open_values,
    warnings_of,
)
from nfriction.fitting.result.uncertainty import CoefficientUncertainty
from nfriction.fitting.shooting.autocorrelation import band_of, effective_noise, local_noise
from nfriction.fitting.shooting.problem import TrajectoryProblem
from nfriction.friction.coefficients import Constant
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import LeastSquaresResult
from nfriction.plant import Plant
from nfriction.signals import Motion, count_seen

# Whether the windows of a recording make one motion.
Continuity = Literal["free", "soft", "hard"]

# A lower bound no larger is there for the logarithm of what cannot be negative, in SI.
NOTHING = 1e-9


@dataclass(frozen=True)
class FitResult:
    """A fitted model and what is known of the fit.

    Attributes:
        model: the friction model, trained in place; without gradients, so that rollouts take the
            compiled way. To train it further: `model.requires_grad_(True)`.
        plant: the plant with its adjusted terms.
        plant_terms: name, value and bound of each adjusted term.
        status: `"converged: ..."` or `"not converged: ..."`, and why, in words.
        converged: whether the search ended at a minimum.
        residual: root mean square of what the fit left over, in `residual_unit`: of the position
            error over the training windows, or of the torque where only torques were fitted.
        at_bounds: names of what ended at a bound.
        steps: accepted steps of the last stage.
        motions: smoothed motion of each recording, in joint coordinates.
        intervals: 95 % intervals of constant coefficients and of the plant's terms; residuals
            that last in time count for as few as they are worth. None for a torque fit.
        lost: what the data cannot tell, parameters or combinations of them, in words.
        warnings: what to be wary of, a sentence each.
        zeros: of encoders that were zeroed anew at the start of each recording, what they fall
            short of the true positions, in joint coordinates [rad or m]; a row for each recording.
        uncertainty: standard deviation of the coefficients at any motion; None for a torque fit.
        continuity: of the windows that were fitted, see `fit`.
        told: those of the warnings that are of recordings and windows; a fit that starts here says
            them, too.
        left_out: lengths of windows that the constant law could not follow [s].
    """

    model: FrictionModel
    plant: Plant
    plant_terms: tuple[tuple[str, float, float], ...]
    status: str
    converged: bool
    residual: float
    at_bounds: tuple[str, ...]
    steps: int
    motions: tuple[Motion, ...]
    _residuals: Tensor
    intervals: tuple[Interval, ...] = ()
    lost: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    zeros: tuple[tuple[float, ...], ...] = ()
    uncertainty: CoefficientUncertainty | None = None
    continuity: Continuity = "free"
    told: tuple[str, ...] = ()
    left_out: tuple[float, ...] = ()

    def longest(self, windows: Sequence[float]) -> float:
        """The last of some windows of growing length that the constant law could follow [s]."""
        followed = [w for w in windows if w < min(self.left_out, default=math.inf)]
        return followed[-1] if followed else windows[0]

    def with_warnings(self, told: Sequence[str]) -> "FitResult":
        """The same, which tells this of recordings and windows first, and once."""
        whole = tuple(dict.fromkeys((*told, *self.told)))
        others = (w for w in self.warnings if w not in whole)
        return replace(self, told=whole, warnings=(*whole, *others))

    @property
    def residual_unit(self) -> str:
        """Unit of `residual`: of positions (rad, m), or of torques (N m, N) of a torque fit."""
        if self._residuals.numel():
            return self.plant.unit
        return "N" if self.plant.unit == "m" else "N m"

    def to_dict(self) -> dict[str, Any]:
        return {
            "status": self.status,
            "converged": self.converged,
            "residual": self.residual,
            "residual_unit": self.residual_unit,
            "at_bounds": list(self.at_bounds),
            "plant": {name: value for name, value, _ in self.plant_terms},
            "intervals": {
                i.name: [x if math.isfinite(x) else None for x in (i.low, i.high)]
                for i in self.intervals
            },
            "lost": list(self.lost),
            "warnings": list(self.warnings),
            **({} if self.continuity == "free" else {"continuity": self.continuity}),
            **({"zeros": [list(zero) for zero in self.zeros]} if self.zeros else {}),
        }


def torque_outcome(
    model: FrictionModel,
    start: FitResult | None,
    plant: Plant,
    motions: tuple[Motion, ...],
    torque: TorqueFit,
) -> FitResult:
    """The fit of a model whose coefficients come from torques alone."""
    return FitResult(
        model.requires_grad_(False),
        start.plant if start else plant,
        start.plant_terms if start else (),
        "converged: linear least squares of the torque",
        True,
        float(torque.residual.square().mean().sqrt()),
        (),
        0,
        motions,
        torch.zeros(0, dtype=torch.float64),
    )


def trajectory_outcome(
    problem: TrajectoryProblem,
    result: LeastSquaresResult,
    residuals: Tensor,
    motions: tuple[Motion, ...],
) -> FitResult:
    """A fit with its verdict, from where the search ended."""
    plant, unknowns = problem.plant, problem.unknowns
    vector, count = unknowns.split(result.x)[1], unknowns.shared_count
    names = problem.friction.schedule.parameter_names(plant.joint_names)
    names += [t.name for t in unknowns.terms]
    lower, upper = (bound[:count] for bound in unknowns.bounds())
    # What was not to be fitted has equal bounds.
    fitted = lower < upper
    hit = (result.at_lower | result.at_upper)[:count] & fitted
    at_bounds = tuple(names[i] for i in hit.nonzero().flatten().tolist())
    least = lower.abs() <= NOTHING
    least[count - len(unknowns.terms) :] = torch.tensor([t.to_none for t in unknowns.terms])
    none = hit & result.at_lower[:count] & least
    noise = effective_noise(residuals)
    told, lost, uncertainty = _told_by_data(problem, result, names, fitted, residuals, motions)
    residual = float(residuals.square().mean().sqrt())
    return FitResult(
        model=problem.friction.requires_grad_(False),
        plant=problem.plant_at(vector),
        plant_terms=tuple(
            (t.name, float(v), t.upper) for t, v in zip(unknowns.terms, vector, strict=True)
        ),
        status=("converged: " if result.converged else "not converged: ") + result.message,
        converged=result.converged,
        residual=residual,
        at_bounds=at_bounds,
        steps=result.steps,
        motions=motions,
        _residuals=residuals,
        intervals=told,
        lost=lost,
        zeros=tuple(map(tuple, unknowns.split_zeros(result.x).reshape(-1, plant.joints).tolist())),
        warnings=warnings_of(
            converged=result.converged, at_bounds=at_bounds, lost=lost, residual=residual,
            effective_sd=noise, quantum=plant.position_quantum or _count_seen(problem),
            unit=plant.unit, largest_jump=problem.largest_jump(result.x),
            at_zero=[names[i] for i in none.nonzero().flatten().tolist()],
        ),
        uncertainty=uncertainty,
    )  # fmt: skip


def _told_by_data(
    problem: TrajectoryProblem,
    result: LeastSquaresResult,
    names: Sequence[str],
    fitted: Tensor,
    residuals: Tensor,
    motions: Sequence[Motion],
) -> tuple[tuple[Interval, ...], tuple[str, ...], CoefficientUncertainty | None]:
    """Intervals, and what the data cannot tell; of a network, only of the plant's terms.

    What they leave open of the coefficients comes last.
    """
    count, noise = problem.unknowns.shared_count, effective_noise(residuals)
    constant = isinstance(problem.friction.schedule, Constant)
    # Errors of nothing at all are those of joints that never moved.
    if not torch.isfinite(result.hessian).all() or not noise > 0:
        every = fitted.nonzero().flatten().tolist() if constant else []
        return (), tuple(names[i] for i in every), None
    # Where a network is only held to its law, the data leave it open: that is not among them.
    known = problem.told(result.x, local_noise(residuals, band_of(problem.windows.q)))
    shown = fitted.clone()
    if not constant:
        shown[: problem.unknowns.friction_count] = False
    index = shown.nonzero().flatten()
    lower, upper = (bound[index] for bound in problem.unknowns.bounds())
    chosen = [names[i] for i in index.tolist()]
    fixed = fitted.nonzero().flatten()
    part = known.subset(fixed)
    root = torch.zeros(count, len(fixed), dtype=torch.float64)
    root[fixed] = covariance_root(part)
    sd = root.norm(dim=1)
    lost: tuple[str, ...] = ()
    if constant:
        friction = fixed[fixed < problem.unknowns.friction_count]
        coefficients = [names[i] for i in friction.tolist()]
        lost = lost_directions([names[i] for i in fixed.tolist()], part)
        slope, need = _needs(problem, result, motions)
        open_ = (
            *open_values(coefficients, result.x[friction], part),
            *beyond_need(coefficients, sd[friction], slope[friction], need[friction]),
        )
        lost += tuple(n for n in dict.fromkeys(open_) if not any(n in told for told in lost))
    uncertainty = CoefficientUncertainty(
        problem.friction.schedule, root[: problem.unknowns.friction_count].clone()
    )
    return intervals(chosen, result.x[index], sd[index], lower, upper), lost, uncertainty


def _count_seen(problem: TrajectoryProblem) -> float | None:
    """Largest of the encoders' counts that the positions show; None where none does."""
    read = problem.windows.q @ problem.mixing.T
    seen = float(np.fmax.reduce(count_seen(read.numpy())))
    return None if math.isnan(seen) else seen


def _needs(
    problem: TrajectoryProblem, result: LeastSquaresResult, motions: Sequence[Motion]
) -> tuple[Tensor, Tensor]:
    """Slope of the friction torque by every constant coefficient at its joint's largest speed, and
    the largest torque that moves this joint, (friction parameter,) each.
    """
    friction, vector = problem.unknowns.split(result.x)[:2]
    speed, moved = largest_moved(problem.plant_at(vector), motions)
    need = torch.maximum(moved, problem.windows.tau.abs().amax((0, 1)))
    table = friction.reshape(len(speed), -1).clone().requires_grad_()
    with torch.enable_grad():
        # A law is elementwise, so the sum's gradient is each coefficient's own slope.
        torque = problem.friction.torque(speed, torch.ones_like(speed), table)
        (slope,) = torch.autograd.grad(torque.sum(), table)
    return slope.flatten(), need[:, None].expand_as(slope).flatten()
