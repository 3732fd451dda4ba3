"""The unrolled solve compared with LAPACK; joint and absolute coordinates are inverse maps."""

import pytest
import torch

from nfriction.plant.dynamics import (
    absolute,
    dot,
    entries,
    joint_forces,
    joint_matrix,
    link_forces,
    multiply,
    relative,
    solve,
    stack,
    stack_matrix,
)


@pytest.mark.parametrize("size", [1, 2, 3, 4, 6])
def test_unrolled_solve_and_product_equal_lapack(size: int) -> None:
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


@pytest.mark.parametrize(("size", "first"), [(1, 0), (3, 0), (2, 1), (4, 1)])
def test_coordinate_changes_are_inverse(size: int, first: int) -> None:
    generator = torch.Generator().manual_seed(0)
    motion, force = torch.randn(2, size, dtype=torch.float64, generator=generator)
    q, tau = list(motion.unbind()), list(force.unbind())
    u = absolute(q, first)
    torch.testing.assert_close(torch.stack(relative(u, first)), motion)
    torch.testing.assert_close(torch.stack(joint_forces(link_forces(tau, first), first)), force)
    torch.testing.assert_close(dot(link_forces(tau, first), u), dot(tau, q))
    matrix = torch.randn(size, size, dtype=torch.float64, generator=generator)
    matrix = matrix + matrix.T
    columns = [absolute(list(unit.unbind()), first) for unit in torch.eye(size).double()]
    change = torch.stack([torch.stack(column) for column in columns], -1)
    joint = stack_matrix(joint_matrix(entries(matrix), first))
    torch.testing.assert_close(joint, change.T @ matrix @ change)
