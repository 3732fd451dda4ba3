"""Small symmetric positive definite systems, solved scalar by scalar.

A matrix is a nested list of tensors that broadcast against each other. Unrolled this way a batch
of 3x3 systems needs no small-matrix kernels, traces to plain arithmetic and differentiates in
both modes.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

Matrix = list[list[Tensor]]


def entries(matrix: Tensor) -> Matrix:
    """The entries of `matrix`, shape (*batch, n, n), as n x n tensors of shape (*batch)."""
    size = matrix.shape[-1]
    flat = matrix.flatten(-2).unbind(-1)
    return [list(flat[row * size : (row + 1) * size]) for row in range(size)]


def stack(scalars: Sequence[Tensor]) -> Tensor:
    """Scalars of broadcastable shapes along a new last axis."""
    return torch.stack(torch.broadcast_tensors(*scalars), -1)


def stack_matrix(matrix: Matrix) -> Tensor:
    """A matrix of scalars as one tensor of shape (*batch, n, n)."""
    size = len(matrix)
    return stack([entry for row in matrix for entry in row]).unflatten(-1, (size, size))


def multiply(matrix: Matrix, vector: Sequence[Tensor]) -> list[Tensor]:
    """The product of a matrix and a vector of scalars."""
    return [dot(row, vector) for row in matrix]


def dot(left: Sequence[Tensor], right: Sequence[Tensor]) -> Tensor:
    """The scalar product of two non-empty vectors of scalars."""
    total = left[0] * right[0]
    for x, y in zip(left[1:], right[1:], strict=True):
        total = total + x * y
    return total


def solve(matrix: Matrix, rhs: Sequence[Tensor]) -> list[Tensor]:
    """Solve `matrix @ x = rhs` by an LDL^T factorisation without square roots or pivoting.

    Args:
        matrix: symmetric positive definite; only the lower triangle is read.
        rhs: right-hand side, as long as the matrix.
    Returns:
        The solution, one tensor per unknown.
    """
    size = len(rhs)
    lower: list[list[Tensor]] = []
    pivots: list[Tensor] = []
    x: list[Tensor] = []
    for i in range(size):
        # scaled[j] = lower[i][j] * pivots[j], so that each division happens once.
        scaled: list[Tensor] = []
        for j in range(i):
            entry = matrix[i][j]
            for k in range(j):
                entry = entry - scaled[k] * lower[j][k]
            scaled.append(entry)
        row = [entry / pivot for entry, pivot in zip(scaled, pivots, strict=True)]
        pivot, value = matrix[i][i], rhs[i]
        for k in range(i):
            pivot = pivot - row[k] * scaled[k]
            value = value - row[k] * x[k]
        lower.append(row)
        pivots.append(pivot)
        x.append(value)
    for i in reversed(range(size)):
        value = x[i] / pivots[i]
        for k in range(i + 1, size):
            value = value - lower[k][i] * x[k]
        x[i] = value
    return x
