"""Minimum of a quadratic within bounds, by every solution path."""

import pytest
import torch

from nfriction.optim import bounded_qp as box
from nfriction.optim.bounded_qp import minimise, solve_semidefinite

F64 = torch.float64


def problem(loose: int, tight: int, seed: int, rank: int | None = None):
    """A quadratic with bounds on some unknowns, in mixed order."""
    g = torch.Generator().manual_seed(seed)
    size = loose + tight
    rows = torch.randn(rank or 2 * size, size, generator=g, dtype=F64)
    slope = rows.T @ torch.randn(len(rows), generator=g, dtype=F64)
    bounded = torch.randperm(size, generator=g) < tight
    low = torch.where(bounded, -0.1 * torch.rand(size, generator=g, dtype=F64), -torch.inf)
    high = torch.where(bounded, 0.1 * torch.rand(size, generator=g, dtype=F64), torch.inf)
    return rows.T @ rows, slope, low, high


def found(system, slope, low, high) -> torch.Tensor:
    free = torch.ones_like(slope, dtype=torch.bool)
    return minimise(system, slope, low, high, free, lambda a, b, _: solve_semidefinite(a, b))


def assert_minimum(x, system, slope, low, high) -> None:
    pull = slope + system @ x
    scale = (system.abs() @ x.abs() + slope.abs()).max()
    assert ((x >= low) & (x <= high)).all()
    assert (pull[x > low] < 1e-9 * scale).all()
    assert (pull[x < high] > -1e-9 * scale).all()


@pytest.mark.parametrize("seed", range(5))
def test_unbounded_unknowns_may_be_eliminated(seed, monkeypatch):
    given = problem(60, 20, seed)
    whole = found(*given)
    assert_minimum(whole, *given)
    assert 2 < ((whole == given[2]) | (whole == given[3])).sum() < 20
    monkeypatch.setattr(box, "APART", 10)
    torch.testing.assert_close(found(*given), whole, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("rank", [3, 8])
def test_singular_system_converges_quickly_to_a_minimum(rank, monkeypatch):
    asked = []

    def solve(matrix, right, _):
        asked.append(len(matrix))
        return solve_semidefinite(matrix, right)

    for seed in range(50):
        given = problem(2, 9, seed, rank)
        asked.clear()
        free = torch.ones(11, dtype=torch.bool)
        assert_minimum(minimise(*given, free, solve), *given)
        assert len(asked) < 25  # of at most 33 rounds


def test_equal_bounds_fix_a_value_and_empty_problems_are_solved():
    system, slope, low, high = problem(4, 4, 0)
    fixed = low.isfinite()
    low[fixed] = high[fixed] = 0.0
    x = found(system, slope, low, high)
    assert (x[fixed] == 0).all()
    expected = -torch.linalg.solve(system[~fixed][:, ~fixed], slope[~fixed])
    torch.testing.assert_close(x[~fixed], expected)
    assert found(*(t[:0] for t in (system[:0, :0], slope, low, high))).shape == (0,)
