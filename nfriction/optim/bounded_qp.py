"""Convex quadratic minimisation within bounds."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from nfriction.optim.linear_algebra import solve_semidefinite

# Limit of rounds, times the number of variables; each round activates or releases one bound.
ROUNDS = 3
# From so many unbounded variables on it pays to eliminate them once.
APART = 400
# A parameter nearer to a bound than so many roundings is on it.
NEAR = 4

# (matrix, right sides, which variables these are) -> solutions.
Solve = Callable[[Tensor, Tensor, Tensor], Tensor]


def as_bounds(
    x0: Tensor, lower: Tensor | float | None, upper: Tensor | float | None
) -> tuple[Tensor, Tensor]:
    """Both bounds in the shape of `x0`; infinite where there is none.

    Raises:
        ValueError: if a shape does not fit, or a lower bound exceeds the upper one.
    """
    low = torch.as_tensor(-math.inf if lower is None else lower, dtype=x0.dtype, device=x0.device)
    high = torch.as_tensor(math.inf if upper is None else upper, dtype=x0.dtype, device=x0.device)
    for name, bound in (("lower", low), ("upper", high)):
        if bound.shape not in ((), x0.shape):
            raise ValueError(
                f"`{name}` must be a number or have the shape of `x0`, {tuple(x0.shape)}, got "
                f"{tuple(bound.shape)}."
            )
    if not (low <= high).all():
        raise ValueError("`lower` must not exceed `upper`, and neither may be NaN.")
    return low.expand_as(x0), high.expand_as(x0)


def snap_to_bounds(x: Tensor, lower: Tensor, upper: Tensor, before: Tensor) -> Tensor:
    """Within bounds, and on them where only round-off of the step from `before` is between."""
    near = NEAR * torch.finfo(x.dtype).eps
    for bound, inside in ((lower, x - lower), (upper, upper - x)):
        there = bound.isfinite() & (inside <= near * torch.maximum(bound.abs(), before.abs()))
        x = torch.where(there, bound, x)
    return x


def minimise(
    system: Tensor, slope: Tensor, low: Tensor, high: Tensor, free: Tensor, solve: Solve
) -> Tensor:
    """Minimiser of `slope @ x + x @ system @ x / 2` within `low <= 0 <= high`, by an active set.

    From zero it moves toward the minimiser over the free variables up to the first bound, which
    becomes active; at a minimum, the active bound with the most negative multiplier is released.
    Activating all violated bounds at once can stop short of the minimum when variables are
    correlated.

    Args:
        system: positive semidefinite, (p, p).
        slope, low, high: (p,); bounds may be infinite.
        free: initially free variables, bool (p,); the rest is at a bound.
        solve: (matrix, right sides, free) -> solutions over the free ones; one or several.

    References:
        J. Nocedal, S. J. Wright, Numerical Optimization (2006), algorithm 16.3.
    """
    if len(free) and free.all():
        x, hit = _towards(torch.zeros_like(slope), -solve(system, slope, free), low, high)
        if not hit.any():
            return x
    loose = low.isinf() & high.isinf()
    if loose.all() or int(loose.sum()) < APART:
        return _active_set(system, slope, low, high, free, solve)
    # Unbounded variables follow the others, and are eliminated once.
    tight = ~loose
    right = torch.cat([system[loose][:, tight], slope[loose, None]], 1)
    following = solve(system[loose][:, loose], right, loose)
    taken = system[tight][:, loose] @ following
    x = torch.zeros_like(slope)
    x[tight] = _active_set(
        system[tight][:, tight] - taken[:, :-1], slope[tight] - taken[:, -1],
        low[tight], high[tight], free[tight], lambda part, sides, _: solve_semidefinite(part, sides)
    )  # fmt: skip
    x[loose] = -(following[:, -1] + following[:, :-1] @ x[tight])
    return x


def _active_set(
    system: Tensor, slope: Tensor, low: Tensor, high: Tensor, free: Tensor, solve: Solve
) -> Tensor:
    x, free = torch.zeros_like(slope), free.clone()
    # A multiplier within rounding would release and activate the same bound for ever.
    rounding = 10 * len(slope) * torch.finfo(slope.dtype).eps
    for _ in range(ROUNDS * len(x)):
        if free.any():
            given = slope[free] + system[free][:, ~free] @ x[~free]
            target = x.masked_scatter(free, -solve(system[free][:, free], given, free))
            x, hit = _towards(x, target, low, high)
            if hit.any():
                free = free & ~hit
                continue
        pull = slope + system @ x
        inward = ((x <= low) & (pull < 0)) | ((x >= high) & (pull > 0))
        inward &= ~free & (low < high)
        inward &= pull.abs() > rounding * (slope.abs() + system.abs() @ x.abs())
        if not inward.any():
            break
        # One at a time: after it the others may no longer pull inward.
        free[torch.where(inward, pull.abs(), -1.0).argmax()] = True
    return x


def _towards(x: Tensor, target: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """As far towards a target as the bounds allow, and the bounds that stop it, bool."""
    move = target - x
    share = torch.where(move > 0, high - x, low - x) / move
    share = torch.where(move == 0, torch.inf, share)
    least = float(share.min())
    if not least < 1:
        return target, torch.zeros_like(move, dtype=torch.bool)
    hit = share <= least
    reached = torch.where(hit, torch.where(move > 0, high, low), x + least * move)
    # Rounding may pass a bound that was not the nearest.
    return reached.clamp(low, high), hit
