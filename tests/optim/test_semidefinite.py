"""Positive semidefinite systems, dense and block by block."""

import pytest
import torch

from nfriction.optim.bounded_qp import solve_arrowhead, solve_semidefinite
from nfriction.optim.least_squares import Quadratic
from nfriction.optim.levenberg_marquardt import LevenbergMarquardt

F64 = torch.float64
SHARED, SIZE, COUNT = 3, 2, 50


def bordered(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """A Jacobian of windows with separate states, and residuals."""
    g = torch.Generator().manual_seed(seed)
    rows = torch.zeros(COUNT, 6, SHARED + COUNT * SIZE, dtype=F64)
    rows[..., :SHARED] = torch.randn(COUNT, 6, SHARED, generator=g, dtype=F64)
    for w in range(COUNT):
        at = SHARED + w * SIZE
        rows[w, :, at : at + SIZE] = torch.randn(6, SIZE, generator=g, dtype=F64)
    return rows.flatten(0, 1), torch.randn(COUNT * 6, generator=g, dtype=F64)


def test_blockwise_solution_equals_the_dense_one():
    jacobian, r = bordered()
    matrix, vector = jacobian.T @ jacobian, jacobian.T @ r
    found = solve_arrowhead(matrix, vector, SHARED, SIZE)
    torch.testing.assert_close(found, torch.linalg.solve(matrix, vector), rtol=0, atol=1e-10)
    torch.testing.assert_close(found, solve_semidefinite(matrix, vector), rtol=0, atol=1e-10)


@pytest.mark.parametrize("lost", [0, SHARED + 4])
def test_undetermined_unknowns_are_zero(lost):
    """A shared unknown, or one of a block, without any data: the minimum-norm solution."""
    jacobian, r = bordered()
    jacobian[:, lost] = 0.0
    matrix, vector = jacobian.T @ jacobian, jacobian.T @ r
    found = solve_arrowhead(matrix, vector, SHARED, SIZE)
    assert float(found[lost]) == pytest.approx(0.0, abs=1e-12)
    torch.testing.assert_close(matrix @ found, vector, rtol=0, atol=1e-9)


@pytest.mark.parametrize("bound", [float("inf"), 0.05])
def test_search_takes_the_same_steps_with_and_without_blocks(bound, monkeypatch):
    """Also if a shared unknown ends at a bound."""
    monkeypatch.setattr("nfriction.optim.bounded_qp.MANY_BLOCKS", COUNT)
    jacobian, r = bordered()
    upper = torch.full((jacobian.shape[1],), torch.inf, dtype=F64)
    upper[0] = bound

    def model(blocks):
        def at(x):
            left = jacobian @ x - r + 0.01 * torch.sin(jacobian @ x)
            slope = jacobian * (1 + 0.01 * torch.cos(jacobian @ x))[:, None]
            cost = 0.5 * left.square().sum()
            return Quadratic(cost, slope.T @ left, slope.T @ slope, blocks)

        return at

    solver, start = LevenbergMarquardt(), torch.zeros(jacobian.shape[1], dtype=F64)
    whole, parts = (solver.minimise(model(b), start, upper=upper) for b in (None, (SHARED, SIZE)))
    torch.testing.assert_close(parts.x, whole.x, rtol=0, atol=1e-9)
    assert parts.steps == whole.steps
    assert parts.converged


def test_indefinite_block_falls_back_to_the_dense_solver():
    jacobian, r = bordered()
    matrix, vector = jacobian.T @ jacobian, jacobian.T @ r
    at = slice(SHARED, SHARED + SIZE)
    matrix[at, at] = -torch.eye(SIZE, dtype=F64)
    found = solve_arrowhead(matrix, vector, SHARED, SIZE)
    torch.testing.assert_close(found, solve_semidefinite(matrix, vector))
