"""Between joint coordinates (relative angles) and absolute link angles, on lists of scalars.

The first `first` entries (the arm's angle, if there is a free arm) are the same in both. With
u = S q for motion, generalised forces go back as S^T Q and matrices as S^T M S.
"""

from collections.abc import Sequence
from itertools import accumulate
from operator import add

from torch import Tensor

from nfriction.plant.linear import Matrix


def absolute(joint: Sequence[Tensor], first: int) -> list[Tensor]:
    """Absolute angles, rates or accelerations of joint ones: u = S q, a running sum."""
    return [*joint[:first], *accumulate(joint[first:], add)]


def relative(link: Sequence[Tensor], first: int) -> list[Tensor]:
    """Joint angles, rates or accelerations of absolute ones: q = S^-1 u, differences."""
    later = [link[i] - link[i - 1] for i in range(first + 1, len(link))]
    return [*link[: first + 1], *later]


def joint_forces(link: Sequence[Tensor], first: int) -> list[Tensor]:
    """Joint torques of generalised forces on absolute angles: tau = S^T Q, a sum from the tip."""
    inward = list(accumulate(reversed(link[first:]), add))
    return [*link[:first], *reversed(inward)]


def link_forces(joint: Sequence[Tensor], first: int) -> list[Tensor]:
    """Generalised forces on absolute angles of joint torques: Q = S^-T tau, differences."""
    inner = [joint[i] - joint[i + 1] for i in range(first, len(joint) - 1)]
    return [*joint[:first], *inner, joint[-1]]


def joint_matrix(link: Matrix, first: int) -> Matrix:
    """A symmetric matrix over absolute angles in joint coordinates: S^T M S, symmetric exactly."""
    rows = [joint_forces(row, first) for row in link]
    joint = [joint_forces(column, first) for column in zip(*rows, strict=True)]
    # The two triangles are summed in different orders; one of them serves for both.
    return [[joint[max(i, j)][min(i, j)] for j in range(len(joint))] for i in range(len(joint))]
