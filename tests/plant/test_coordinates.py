"""Joint and absolute coordinates: inverse to each other, and power stays the same."""

import pytest
import torch

from nfriction.plant.dynamics import (
    absolute,
    dot,
    entries,
    joint_forces,
    joint_matrix,
    link_forces,
    relative,
    stack_matrix,
)


@pytest.mark.parametrize(("size", "first"), [(1, 0), (3, 0), (2, 1), (4, 1)])
def test_coordinate_changes(size: int, first: int) -> None:
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
