"""Positive semidefinite systems, also of arrowhead form."""

import torch
from torch import Tensor

# Fewer blocks than this are solved as fast in one piece.
MANY_BLOCKS = 100


def solve_free(
    matrix: Tensor, right: Tensor, free: Tensor, blocks: tuple[int, int] | None
) -> Tensor:
    """Solve for the free variables of a positive semidefinite system, by blocks if it has many.

    Args:
        matrix: rows and columns of the free variables, (p, p).
        right: right sides, (p,) or (p, k).
        free: those among all variables, bool (variables,).
        blocks: of the matrix of all variables, see `least_squares.Quadratic`.
    """
    if blocks is not None:
        first, size = blocks
        # A block that has lost a variable would have another size.
        if len(free) - first >= MANY_BLOCKS * size and free[first:].all():
            return solve_arrowhead(matrix, right, int(free[:first].sum()), size)
    return solve_semidefinite(matrix, right)


def solve_semidefinite(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve a positive semidefinite system; the shortest solution of a singular one.

    Args:
        matrix: (p, p).
        right: right sides, (p,) or (p, k); the solutions have its shape.
    """
    sides = right if right.ndim == 2 else right[:, None]
    # Half the work of an LU factorisation, and no exception where it fails.
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if not failed:
        solution = torch.cholesky_solve(sides, factor)
        if torch.isfinite(solution).all():
            return solution.view_as(right)
    values, vectors = torch.linalg.eigh(matrix)
    # Smaller eigenvalues are rounding: their directions stay where they are.
    cut = torch.finfo(matrix.dtype).eps * len(values) * values.abs().max()
    inverse = torch.where(values > cut, 1 / values, 0.0)
    return (vectors @ (inverse[:, None] * (vectors.T @ sides))).view_as(right)


def solve_arrowhead(matrix: Tensor, right: Tensor, first: int, size: int) -> Tensor:
    """Solve a system that is block diagonal from some row on by its Schur complement.

    The cost grows with the number of blocks instead of its cube.

    Args:
        matrix: symmetric, (p, p).
        right: right sides, (p,) or (p, k).
        first: row from which on the matrix is block diagonal.
        size: of each block.
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
