"""Convex quadratic minimisation within bounds, and solvers of positive semidefinite systems."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

# With fewer blocks than this, a dense solution is as fast.
MANY_BLOCKS = 100


def solve_free(
    matrix: Tensor, right: Tensor, free: Tensor, blocks: tuple[int, int] | None
) -> Tensor:
    """Solve a positive semidefinite system for its free variables, by blocks if there are many.

    Args:
        matrix: rows and columns of the free variables, (p, p).
        right: right sides, (p,) or (p, k).
        free: mask of these among all variables, bool (variables,).
        blocks: of the matrix of all variables, see `least_squares.Quadratic`.
    """
    if blocks is not None:
        first, size = blocks
        # A block with a fixed variable would have a different size.
        if len(free) - first >= MANY_BLOCKS * size and free[first:].all():
            return solve_arrowhead(matrix, right, int(free[:first].sum()), size)
    return solve_semidefinite(matrix, right)


def solve_semidefinite(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve a positive semidefinite system; the minimum-norm solution if it is singular.

    Right sides are (p,) or (p, k); the solutions have their shape.
    """
    sides = right if right.ndim == 2 else right[:, None]
    # Half the work of an LU factorisation, and no exception if it fails.
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if not failed:
        solution = torch.cholesky_solve(sides, factor)
        if torch.isfinite(solution).all():
            return solution.view_as(right)
    values, vectors = torch.linalg.eigh(matrix)
    # Smaller eigenvalues are round-off; the solution is zero along their eigenvectors.
    cut = torch.finfo(matrix.dtype).eps * len(values) * values.abs().max()
    inverse = torch.where(values > cut, 1 / values, 0.0)
    return (vectors @ (inverse[:, None] * (vectors.T @ sides))).view_as(right)


def solve_arrowhead(matrix: Tensor, right: Tensor, first: int, size: int) -> Tensor:
    """Solve a symmetric system that is block diagonal from row `first` on, by its Schur complement.

    The cost grows linearly with the number of blocks instead of with its cube. `right` is (p,) or
    (p, k), `size` that of each block.
    """
    count = (len(matrix) - first) // size
    sides = right if right.ndim == 2 else right[:, None]
    at = torch.arange(count)
    own = matrix[first:, first:].reshape(count, size, count, size)[at, :, at]
    across = matrix[first:, :first].reshape(count, size, first)
    factor, failed = torch.linalg.cholesky_ex(own)
    if failed.any():
        return solve_semidefinite(matrix, right)
    solved = torch.cholesky_solve(
        torch.cat([across, sides[first:].reshape(count, size, -1)], -1), factor
    )
    # Contribution of the blocks to the shared rows and right sides.
    taken = across.flatten(0, 1).T @ solved.flatten(0, 1)
    shared = solve_semidefinite(
        matrix[:first, :first] - taken[:, :first], sides[:first] - taken[:, first:]
    )
    own = solved[..., first:] - solved[..., :first] @ shared
    return torch.cat([shared, own.flatten(0, 1)]).view_as(right)


# Limit of rounds, times the number of variables; each round activates or releases one bound.
ROUNDS = 3
# With at least this many unbounded variables it pays to eliminate them once.
APART = 400
# A parameter within this many round-off units of a bound is on it.
NEAR = 4

# (matrix, right sides, mask of these variables) -> solutions.
Solve = Callable[[Tensor, Tensor, Tensor], Tensor]


def as_bounds(
    x0: Tensor, lower: Tensor | float | None, upper: Tensor | float | None
) -> tuple[Tensor, Tensor]:
    """Both bounds in the shape of `x0`, in ascending order; infinite where there is none."""
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
    """Clamp to the bounds, and snap to a bound within round-off of the step from `before`."""
    near = NEAR * torch.finfo(x.dtype).eps
    for bound, inside in ((lower, x - lower), (upper, upper - x)):
        there = bound.isfinite() & (inside <= near * torch.maximum(bound.abs(), before.abs()))
        x = torch.where(there, bound, x)
    return x


def minimise(
    system: Tensor, slope: Tensor, low: Tensor, high: Tensor, free: Tensor, solve: Solve
) -> Tensor:
    """Minimiser of `slope @ x + x @ system @ x / 2` within `low <= 0 <= high`, by an active set.

    Each step goes toward the minimiser over the free variables, up to the first bound, which
    becomes active; at a minimum, the active bound with the most negative multiplier is released.
    Activating all violated bounds at once can stop short of the minimum when variables are
    correlated.

    Args:
        system: positive semidefinite, (p, p).
        slope, low, high: (p,); bounds may be infinite.
        free: initially free variables, bool (p,); the others are at a bound.
        solve: (matrix, right sides, free) -> solutions for the free variables; one or several.

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
    # Unbounded variables are functions of the others, so they are eliminated once.
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
    # A multiplier within round-off would release and activate the same bound forever.
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
        # One at a time, because the other gradients may no longer point inward afterwards.
        free[torch.where(inward, pull.abs(), -1.0).argmax()] = True
    return x


def _towards(x: Tensor, target: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """The point as far towards a target as the bounds allow, and the bounds it hits, bool."""
    move = target - x
    share = torch.where(move > 0, high - x, low - x) / move
    share = torch.where(move == 0, torch.inf, share)
    least = float(share.min())
    if not least < 1:
        return target, torch.zeros_like(move, dtype=torch.bool)
    hit = share <= least
    reached = torch.where(hit, torch.where(move > 0, high, low), x + least * move)
    # Because of round-off, the step may cross a bound that was not the nearest.
    return reached.clamp(low, high), hit
