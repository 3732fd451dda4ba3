"""Positive semidefinite systems, also those of many parts that share a few unknowns."""

import torch
from torch import Tensor


def solve_semidefinite(matrix: Tensor, vector: Tensor) -> Tensor:
    """Solve a positive semidefinite system; in singular ones the shortest solution."""
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if not failed:
        solution = torch.cholesky_solve(vector[:, None], factor)[:, 0]
        if torch.isfinite(solution).all():
            return solution
    values, vectors = torch.linalg.eigh(matrix)
    cut = torch.finfo(matrix.dtype).eps * len(values) * values.abs().max()
    inverse = torch.where(values > cut, 1 / values, 0.0)
    return vectors @ (inverse * (vectors.T @ vector))


def solve_bordered(matrix: Tensor, vector: Tensor, first: int, size: int) -> Tensor:
    """The same of a matrix that is block diagonal from some row on, block by block.

    The blocks' unknowns are eliminated (Schur complement), so that the cost grows with the number
    of blocks instead of its cube.

    Args:
        matrix: symmetric, (p, p).
        vector: (p,).
        first: row from which on the matrix is block diagonal.
        size: of each block.
    """
    count = (len(vector) - first) // size
    at = torch.arange(count)
    own = matrix[first:, first:].reshape(count, size, count, size)[at, :, at]
    across = matrix[first:, :first].reshape(count, size, first)
    factor, failed = torch.linalg.cholesky_ex(own)
    if failed.any():
        return solve_semidefinite(matrix, vector)
    right = torch.cat([across, vector[first:].reshape(count, size, 1)], -1)
    solved = torch.cholesky_solve(right, factor)
    # Of the shared rows: what the blocks take of matrix and vector.
    taken = across.flatten(0, 1).T @ solved.flatten(0, 1)
    shared = solve_semidefinite(
        matrix[:first, :first] - taken[:, :first], vector[:first] - taken[:, first]
    )
    return torch.cat([shared, (solved[..., first] - solved[..., :first] @ shared).reshape(-1)])
