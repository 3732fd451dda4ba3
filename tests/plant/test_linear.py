"""The unrolled solve against LAPACK."""

import pytest
import torch

from nfriction.plant.dynamics import entries, multiply, solve, stack, stack_matrix


@pytest.mark.parametrize("size", [1, 2, 3, 4, 6])
def test_solve_and_multiply(size: int) -> None:
    generator = torch.Generator().manual_seed(size)
    root = torch.randn(8, size, size, dtype=torch.float64, generator=generator)
    matrix = root @ root.mT + 0.1 * torch.eye(size)
    rhs = torch.randn(8, size, dtype=torch.float64, generator=generator)
    x = solve(entries(matrix), rhs.unbind(-1))
    torch.testing.assert_close(stack(x), torch.linalg.solve(matrix, rhs), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(stack(multiply(entries(matrix), x)), rhs, rtol=1e-9, atol=1e-9)
    assert torch.equal(stack_matrix(entries(matrix)), matrix)


def test_entries_of_different_shapes_broadcast() -> None:
    matrix = [[torch.tensor(2.0), torch.zeros(3, 1)], [torch.zeros(3, 1), torch.ones(4)]]
    x = stack(solve(matrix, [torch.ones(4), torch.tensor(5.0)]))
    assert x.shape == (3, 4, 2)
    torch.testing.assert_close(x, torch.tensor([0.5, 5.0]).expand(3, 4, 2))
