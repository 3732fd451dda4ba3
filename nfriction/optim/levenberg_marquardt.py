"""Levenberg-Marquardt on a local quadratic model, with bounds and a reason for termination.

Near a point x, a sum of squares 1/2 |r|^2 is almost the quadratic of its gradient g = J^T r and its
Gauss-Newton Hessian H = J^T J. One iteration

1. minimises g^T p + 1/2 p^T (H + damping D) p within the bounds, with D the largest diagonal of H
   so far: strong damping keeps the step p short;
2. evaluates the cost at x + p, and accepts the step only if the cost falls;
3. lowers the damping if the decrease exceeds 3/4 of the predicted one, and raises it below 1/4.

The solver needs cost, gradient and Hessian, but not the Jacobian of the residuals, so callers can
sum over 40,000 samples in chunks without storing it. The next step is `nfriction.evaluation.score`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import torch
from torch import Tensor

from nfriction.optim import bounded_qp
from nfriction.optim.bounded_qp import solve_free
from nfriction.optim.least_squares import (
    LeastSquaresResult,
    Quadratic,
    Status,
    Step,
    positive_diagonal,
)

Model = Callable[[Tensor], Quadratic]
Cost = Callable[[Tensor], Tensor]
# (x, its quadratic, the step to x) -> a status that ends the search, or None.
Callback = Callable[[Tensor, Quadratic, Step], Status | None]

# Damping is relative to the (unit) scaled diagonal. Below the smallest value it no longer prevents
# drift by round-off along a singular direction; a rejected step raises it at least to the level at
# which it matters; above the largest value a step is lost in round-off.
LEAST_DAMPING, FELT_DAMPING, LARGEST_DAMPING = 1e-16, 1e-8, 1e16
# Up to this damping a short step indicates a minimum; above it, only that the damping is strong.
WEAK_DAMPING = 1.0
# Factor after a rejected or poor step, divisor after a good one.
RAISE, LOWER = 4.0, 6.0


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Damped Gauss-Newton minimiser of 1/2 sum r^2 within bounds.

    All tests use units of D, so that a fit does not depend on the units of its parameters.

    Args:
        gradient_tolerance: largest cosine between the residual and a free Jacobian column.
        cost_tolerance: relative decrease of the cost (predicted and actual) that counts as zero.
        step_tolerance: ratio of step to parameters, both scaled, that counts as zero.
        initial_damping: relative to D; 0 tries a pure Gauss-Newton step first.
    References:
        D. W. Marquardt, SIAM J. Appl. Math. 11 (1963); J. J. Moré, LNM 630 (1978) for the running
        maximum and the convergence tests.
    """

    max_steps: int = 100
    gradient_tolerance: float = 1e-10
    cost_tolerance: float = 1e-14
    step_tolerance: float = 1e-12
    initial_damping: float = 1e-3

    def __post_init__(self) -> None:
        if not (self.initial_damping >= 0 and self.max_steps >= 0):
            raise ValueError(
                "`initial_damping` and `max_steps` must not be negative, got "
                f"{self.initial_damping} and {self.max_steps}."
            )

    def minimise(
        self,
        model: Model,
        x0: Tensor,
        *,
        cost: Cost | None = None,
        lower: Tensor | float | None = None,
        upper: Tensor | float | None = None,
        callback: Callback | None = None,
    ) -> LeastSquaresResult:
        """Minimise from `x0`; does not raise for a bad region, an interrupt or non-convergence.

        A trial whose cost or derivatives are not finite is a rejected step.

        Args:
            model: local quadratic at x.
            x0: start, shape (p,); projected onto the bounds.
            cost: only half the sum of squares, for trial steps, if cheaper than `model`.
            lower, upper: bounds, shape (p,) or a number; infinite entries are unbounded.
            callback: called after each accepted step; may end the search with a status.
        Returns:
            The best point reached and the reason why the search ended.
        Raises:
            ValueError: if shapes or bounds do not fit, or `cost` and `model` disagree at x0.
        """
        if x0.ndim != 1 or not x0.is_floating_point():
            raise ValueError(
                f"`x0` must be a vector of floats, got {x0.dtype} of shape {tuple(x0.shape)}."
            )
        low, high = bounded_qp.as_bounds(x0, lower, upper)
        state = _State(x0.detach().clamp(low, high), low, high, self.initial_damping)
        try:
            state.local = model(state.x).checked(len(state.x))
            status = self._iterate(state, model, cost, callback)
        except KeyboardInterrupt:
            status = "stopped"
        return state.result(status)

    def _iterate(
        self, state: _State, model: Model, cost: Cost | None, callback: Callback | None
    ) -> Status:
        if not state.local.finite:
            return "not_finite"
        if cost is not None:
            cheap, own = float(cost(state.x)), state.cost
            if abs(cheap - own) > 1e-6 * max(abs(cheap), abs(own)):
                raise ValueError(
                    f"`cost(x0)` is {cheap:.9g} but `model(x0).cost` is {own:.9g}; "
                    "both must be half the sum of squared residuals."
                )
        # The square of the relative round-off of the residuals.
        vanished = state.cost * torch.finfo(state.x.dtype).eps ** 2
        while True:
            # The running maximum keeps a parameter's scale even if its influence vanishes along the
            # way.
            state.scale = torch.maximum(state.scale, state.local.hessian.diagonal())
            if state.cost <= vanished or state.gradient_cosine() <= self.gradient_tolerance:
                return "converged_gradient"
            if len(state.history) >= self.max_steps:
                return "max_steps"
            ended = self._advance(state, model, cost)
            if ended is None and callback is not None:
                ended = callback(state.x.clone(), state.local, state.history[-1])
            if ended is not None:
                return ended

    def _advance(self, state: _State, model: Model, cost: Cost | None) -> Status | None:
        """Take one step that lowers the cost, raising the damping until one does."""
        root = positive_diagonal(state.scale).sqrt()
        while True:
            step = state.damped_step(root)
            local = state.local
            predicted = -float(local.gradient @ step + 0.5 * step @ (local.hessian @ step))
            length, negligible = float((root * step).norm()), self.cost_tolerance * state.cost
            weak = state.damping <= WEAK_DAMPING
            short = weak and length <= self.step_tolerance * float((root * state.x).norm())
            decrease = state.attempt(step, length, model, cost)
            # The prediction also counts: at a kink the cost may change little far from a minimum.
            flat = weak and max(abs(decrease), predicted) <= negligible
            if decrease > 0:
                gain = decrease / max(predicted, 1e-300)
                if gain > 0.75 and state.damping > LEAST_DAMPING:
                    state.damping /= LOWER
                elif gain < 0.25:
                    state.raise_damping()
                return "converged_cost" if flat else "converged_step" if short else None
            # A step into a region without finite cost proves nothing, however short.
            if short and math.isfinite(decrease):
                return "converged_step"
            if flat:
                return "converged_cost"
            state.raise_damping()
            if state.damping > LARGEST_DAMPING:
                return "stalled" if math.isfinite(decrease) else "not_finite"


@dataclass
class _State:
    """The best point of a search, its quadratic, and the damping of the next step."""

    x: Tensor
    lower: Tensor
    upper: Tensor
    damping: float
    evaluations: int = 1
    history: list[Step] = field(default_factory=list)

    def __post_init__(self) -> None:
        # Unknown until the first evaluation; an interrupt during it must still return a result.
        unknown = self.x.new_full((len(self.x), len(self.x)), torch.nan)
        self.local = Quadratic(math.inf, self.x.new_full(self.x.shape, torch.nan), unknown)
        self.scale = torch.zeros_like(self.x)

    @property
    def cost(self) -> float:
        return float(self.local.cost)

    def raise_damping(self) -> None:
        self.damping = max(self.damping * RAISE, FELT_DAMPING)

    def frozen(self) -> Tensor:
        """Parameters that the descent direction pushes against their bound, bool (p,)."""
        slope = self.local.gradient
        return ((self.x <= self.lower) & (slope > 0)) | ((self.x >= self.upper) & (slope < 0))

    def gradient_cosine(self) -> float:
        """Largest |J_i^T r| / (|J_i| |r|) over the free parameters."""
        columns = (2 * self.cost * self.local.hessian.diagonal()).clamp(min=0).sqrt()
        cosines = torch.where(columns > 0, self.local.gradient.abs() / columns, 0.0)
        cosines = torch.where(self.frozen(), 0.0, cosines)
        return float(cosines.max()) if len(cosines) else 0.0

    def damped_step(self, root: Tensor) -> Tensor:
        """Minimiser of the damped quadratic within the bounds, solved in units of `root`."""
        system = self.local.hessian / (root[:, None] * root)
        system.diagonal().add_(self.damping)
        low, high = (self.lower - self.x) * root, (self.upper - self.x) * root
        slope = self.local.gradient / root
        solve = partial(solve_free, blocks=self.local.blocks)
        return bounded_qp.minimise(system, slope, low, high, ~self.frozen(), solve) / root

    def attempt(self, step: Tensor, length: float, model: Model, cost: Cost | None) -> float:
        """Move if the cost decreases and everything is finite; return the decrease, or -inf."""
        # A parameter within round-off of its bound would never count as frozen.
        trial = bounded_qp.snap_to_bounds(self.x + step, self.lower, self.upper, self.x)
        self.evaluations += 1
        if cost is not None:
            value = float(cost(trial))
            if not value < self.cost:
                return self.cost - value if math.isfinite(value) else -math.inf
        there = model(trial).checked(len(trial))
        if cost is None:
            value = float(there.cost)
        if not (math.isfinite(value) and there.finite):
            return -math.inf
        decrease = self.cost - value
        if decrease > 0:
            self.x, self.local = trial, there
            self.history.append(Step(value, self.damping, length))
        return decrease

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
