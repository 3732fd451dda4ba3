"""Levenberg-Marquardt on a local quadratic model, with bounds and a result that admits failure.

The solver asks for cost, gradient and Gauss-Newton Hessian rather than for a residual Jacobian:
callers that eliminate states block by block or accumulate 40,000 samples in chunks never hold one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from nfriction.optim.bounded_qp import bounds_of, minimise_within, on_bounds
from nfriction.optim.least_squares import (
    LeastSquaresResult,
    Quadratic,
    Status,
    Step,
    positive_diagonal,
)
from nfriction.optim.linear_algebra import solve_bordered, solve_semidefinite

# Fewer blocks than this are solved as fast in one piece.
MANY = 100
# Damping is relative to the (unit) scaled diagonal. Beyond LARGEST a step is lost in rounding;
# a rejection lifts it at least to SMALLEST, where it begins to matter at all. Below FLOOR it no
# longer keeps rounding from drifting along a singular direction. Only up to FULL is a short step
# evidence of a minimum rather than of the damping.
FLOOR, SMALLEST, FULL, LARGEST = 1e-16, 1e-8, 1.0, 1e16


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Damped Gauss-Newton minimiser of 1/2 sum r^2 within bounds.

    Each step minimises the local quadratic plus damping/2 * |D^(1/2) step|^2. With Marquardt's
    scaling D is the largest diagonal of the Hessian seen so far, and every test below is made in
    these units: a fit does not depend on the units of its parameters.

    Args:
        max_steps: limit of accepted steps.
        gradient_tolerance: largest cosine between the residual and a free Jacobian column.
        cost_tolerance: relative fall of the cost, predicted and actual, that counts as none.
        step_tolerance: step over parameters, both scaled, that counts as none.
        initial_damping: relative to D; 0 tries a pure Gauss-Newton step first.
        damping_up: factor after a rejected or poor step, above 1.
        damping_down: divisor after a good step, above 1.
        scaling: "marquardt", or "identity" for D = max diag(H at x0) * I.
    References:
        D. W. Marquardt, SIAM J. Appl. Math. 11 (1963); J. J. Moré, LNM 630 (1978) for the running
        maximum and the convergence tests.
    """

    max_steps: int = 100
    gradient_tolerance: float = 1e-10
    cost_tolerance: float = 1e-14
    step_tolerance: float = 1e-12
    initial_damping: float = 1e-3
    damping_up: float = 4.0
    damping_down: float = 6.0
    scaling: Literal["marquardt", "identity"] = "marquardt"

    def __post_init__(self) -> None:
        if not (self.damping_up > 1 and self.damping_down > 1):
            raise ValueError(
                "`damping_up` and `damping_down` must be above 1, got "
                f"{self.damping_up} and {self.damping_down}."
            )
        if not (self.initial_damping >= 0 and self.max_steps >= 0):
            raise ValueError(
                "`initial_damping` and `max_steps` must not be negative, got "
                f"{self.initial_damping} and {self.max_steps}."
            )
        if self.scaling not in ("marquardt", "identity"):
            raise ValueError(f'`scaling` is "marquardt" or "identity", got {self.scaling!r}.')

    def minimise(
        self,
        model: Callable[[Tensor], Quadratic],
        x0: Tensor,
        *,
        cost: Callable[[Tensor], Tensor] | None = None,
        lower: Tensor | float | None = None,
        upper: Tensor | float | None = None,
        callback: Callable[[Tensor, Step], bool | None] | None = None,
    ) -> LeastSquaresResult:
        """Minimise from `x0`; never raises for a bad region, an interrupt or non-convergence.

        A trial whose cost or derivatives are not finite is a rejected step.

        Args:
            model: local quadratic at x.
            x0: start, shape (p,); projected into the bounds.
            cost: half the sum of squares alone, where that is cheaper than `model`; tries steps.
            lower, upper: bounds, shape (p,) or a number; infinite entries are free.
            callback: called after each accepted step with x and its `Step`; True stops.
        Returns:
            The best point reached and why the search ended there.
        Raises:
            ValueError: if shapes or bounds do not fit, or `cost` and `model` disagree at x0.
        """
        if x0.ndim != 1 or not x0.is_floating_point():
            raise ValueError(
                f"`x0` must be a vector of floats, got {x0.dtype} of shape {tuple(x0.shape)}."
            )
        low, high = bounds_of(x0, lower, upper)
        search = _Search(model, cost, x0.detach().clamp(low, high), low, high)
        try:
            status = self._run(search, callback)
        except KeyboardInterrupt:
            status = "stopped"
        return search.result(status)

    def _run(
        self, search: _Search, callback: Callable[[Tensor, Step], bool | None] | None
    ) -> Status:
        search.start(self.initial_damping)
        if not search.local.finite:
            return "not_finite"
        vanished = search.cost * torch.finfo(search.x.dtype).eps ** 2
        diagonal = search.local.hessian.diagonal()
        search.scale = diagonal
        if self.scaling == "identity" and len(diagonal):
            search.scale = diagonal.max().expand_as(diagonal)
        while True:
            if self.scaling == "marquardt":
                search.scale = torch.maximum(search.scale, diagonal)
            if search.cost <= vanished or search.gradient_cosine() <= self.gradient_tolerance:
                return "converged_gradient"
            if len(search.history) >= self.max_steps:
                return "max_steps"
            ended = self._advance(search)
            if ended is not None:
                return ended
            diagonal = search.local.hessian.diagonal()
            if callback is not None and callback(search.x.clone(), search.history[-1]):
                return "stopped"

    def _advance(self, search: _Search) -> Status | None:
        """Take one step that lowers the cost, raising the damping until there is one."""
        root = positive_diagonal(search.scale).sqrt()
        while True:
            step = search.bounded_step(root)
            predicted = search.predicted_fall(step)
            norm = float((root * step).norm())
            # With the damping out of the way, a step too short to matter means a minimum.
            settled = search.damping <= FULL and norm <= self.step_tolerance * float(
                (root * search.x).norm()
            )
            tolerated = self.cost_tolerance * search.cost
            fall = search.attempt(step, norm)
            if fall > 0:
                gain = fall / max(predicted, 1e-300)
                flat = search.damping <= FULL and max(fall, predicted) <= tolerated
                if gain > 0.75 and search.damping > FLOOR:
                    search.damping /= self.damping_down
                elif gain < 0.25:
                    search.damping = max(search.damping * self.damping_up, SMALLEST)
                return "converged_cost" if flat else "converged_step" if settled else None
            if settled and math.isfinite(fall):
                return "converged_step"
            if search.damping <= FULL and max(-fall, predicted) <= tolerated:
                return "converged_cost"
            search.damping = max(search.damping * self.damping_up, SMALLEST)
            if search.damping > LARGEST:
                return "stalled" if math.isfinite(fall) else "not_finite"


@dataclass
class _Search:
    """Where a minimisation stands; `LevenbergMarquardt` decides what to do with it."""

    model: Callable[[Tensor], Quadratic]
    trial_cost: Callable[[Tensor], Tensor] | None
    x: Tensor
    lower: Tensor
    upper: Tensor
    damping: float = 0.0
    evaluations: int = 0
    history: list[Step] = field(default_factory=list)

    def __post_init__(self) -> None:
        # Until the first evaluation nothing is known; an interrupt in it must still find a result.
        unknown = self.x.new_full((len(self.x), len(self.x)), torch.nan)
        self.local = Quadratic(math.inf, self.x.new_full(self.x.shape, torch.nan), unknown)
        self.scale = torch.ones_like(self.x)

    @property
    def cost(self) -> float:
        return float(self.local.cost)

    def start(self, damping: float) -> None:
        self.damping = damping
        self.local = self._checked(self.model(self.x))
        self.evaluations += 1
        if self.trial_cost is not None and self.local.finite:
            cheap = float(self.trial_cost(self.x))
            if abs(cheap - self.cost) > 1e-6 * max(abs(cheap), abs(self.cost)):
                raise ValueError(
                    f"`cost(x0)` is {cheap:.9g} but `model(x0).cost` is {self.cost:.9g}; "
                    "both must be half the sum of squared residuals."
                )

    def frozen(self) -> Tensor:
        """Parameters on a bound that the gradient pushes against it, bool (p,)."""
        slope = self.local.gradient
        return ((self.x <= self.lower) & (slope > 0)) | ((self.x >= self.upper) & (slope < 0))

    def gradient_cosine(self) -> float:
        """Largest |J_i^T r| / (|J_i| |r|) over the free parameters."""
        columns = (2 * self.cost * self.local.hessian.diagonal()).clamp(min=0).sqrt()
        cosines = torch.where(columns > 0, self.local.gradient.abs() / columns, 0.0)
        cosines = torch.where(self.frozen(), 0.0, cosines)
        return float(cosines.max()) if len(cosines) else 0.0

    def bounded_step(self, root: Tensor) -> Tensor:
        """Minimiser of the damped quadratic within the bounds."""
        system = self.local.hessian / (root[:, None] * root)
        system.diagonal().add_(self.damping)
        low, high = (self.lower - self.x) * root, (self.upper - self.x) * root
        step = minimise_within(
            system, self.local.gradient / root, low, high, ~self.frozen(), self._solved
        )
        return step / root

    def _solved(self, matrix: Tensor, right: Tensor, free: Tensor) -> Tensor:
        """Solution for the free parameters, block by block where the model has blocks."""
        if self.local.blocks is not None:
            first, size = self.local.blocks
            if len(free) - first >= MANY * size and free[first:].all():
                return solve_bordered(matrix, right, int(free[:first].sum()), size)
        return solve_semidefinite(matrix, right)

    def predicted_fall(self, step: Tensor) -> float:
        return -float(self.local.gradient @ step + 0.5 * step @ (self.local.hessian @ step))

    def attempt(self, step: Tensor, norm: float) -> float:
        """Move if the cost falls and all is finite; return the fall (-inf where not finite)."""
        trial = on_bounds(self.x + step, self.lower, self.upper, self.x)
        self.evaluations += 1
        if self.trial_cost is None:
            there = self._checked(self.model(trial))
            cost = float(there.cost)
        else:
            cost = float(self.trial_cost(trial))
            if not cost < self.cost:
                return self.cost - cost if math.isfinite(cost) else -math.inf
            there = self._checked(self.model(trial))
        if not (math.isfinite(cost) and there.finite):
            return -math.inf
        fall = self.cost - cost
        if fall > 0:
            self.x, self.local = trial, there
            self.history.append(Step(cost, self.damping, norm))
        return fall

    def result(self, status: Status) -> LeastSquaresResult:
        return LeastSquaresResult(
            x=self.x,
            cost=self.cost,
            gradient=self.local.gradient,
            hessian=self.local.hessian,
            status=status,
            steps=len(self.history),
            evaluations=self.evaluations,
            at_lower=self.x <= self.lower,
            at_upper=self.x >= self.upper,
            history=self.history,
        )

    def _checked(self, local: Quadratic) -> Quadratic:
        p = len(self.x)
        if local.gradient.shape != (p,) or local.hessian.shape != (p, p):
            raise ValueError(
                f"The model of {p} parameters must give a gradient of shape ({p},) and a Hessian "
                f"of shape ({p}, {p}), got {tuple(local.gradient.shape)} and "
                f"{tuple(local.hessian.shape)}."
            )
        cost, gradient, hessian = local.cost, local.gradient.detach(), local.hessian.detach()
        return Quadratic(float(cost), gradient, hessian, local.blocks)
