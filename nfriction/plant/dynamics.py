"""Equations of motion of links hinged in one plane, in absolute angles from upright.

    sum_j a_ij cos(phi_i - phi_j) phi_j'' + sum_j a_ij sin(phi_i - phi_j) phi_j'^2
        - g b_i sin phi_i = Q_i

Pure functions on lists of scalars, one tensor of shape (*batch) per link or joint. Unrolled this
way a batch of 3x3 systems needs no small-matrix kernels, traces to plain arithmetic and
differentiates in both modes. Only the upper triangle of `coupling` (a_ij) is read.

Joint coordinates q (relative angles) and absolute angles u are related by u = S q; generalised
forces go back as S^T Q and matrices as S^T M S. The first `first` entries (the arm's angle, if
there is a free arm) are the same in both.
"""

from collections.abc import Sequence
from itertools import accumulate
from operator import add
from typing import NamedTuple

import torch
from torch import Tensor

Matrix = list[list[Tensor]]
Pairs = dict[tuple[int, int], Tensor]


def entries(matrix: Tensor) -> Matrix:
    """The entries of `matrix`, shape (*batch, n, n), as n x n tensors of shape (*batch)."""
    return [list(row.unbind(-1)) for row in matrix.unbind(-2)]


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
    """
    lower: list[list[Tensor]] = []
    pivots: list[Tensor] = []
    x: list[Tensor] = []
    for i in range(len(rhs)):
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
    for i in reversed(range(len(rhs))):
        value = x[i] / pivots[i]
        for k in range(i + 1, len(rhs)):
            value = value - lower[k][i] * x[k]
        x[i] = value
    return x


def absolute(joint: Sequence[Tensor], first: int) -> list[Tensor]:
    """Absolute angles, rates or accelerations of joint ones: u = S q, a running sum."""
    return [*joint[:first], *accumulate(joint[first:], add)]


def relative(link: Sequence[Tensor], first: int) -> list[Tensor]:
    """Joint angles, rates or accelerations of absolute ones: q = S^-1 u, differences."""
    # The first link hangs on no other: its joint angle is its absolute one.
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
    # The two triangles are summed in different orders, so one of them is used for both.
    return [[joint[max(i, j)][min(i, j)] for j in range(len(joint))] for i in range(len(joint))]


class Pose(NamedTuple):
    """Trigonometry of a pose, shared by the mass matrix and the bias.

    Attributes:
        angle: absolute link angles phi_i from upright [rad].
        sin: sin phi_i.
        cos_between, sin_between: of phi_j - phi_i for i < j.
    """

    angle: list[Tensor]
    sin: list[Tensor]
    cos_between: Pairs
    sin_between: Pairs


def pose_of(joint_angle: Sequence[Tensor]) -> Pose:
    """Evaluate the geometry once for joint angles [rad]; the first one is from upright."""
    between: Pairs = {}
    for i in range(len(joint_angle)):
        # Sums of joint angles, not differences of absolute ones: no cancellation after many turns.
        for j in range(i + 1, len(joint_angle)):
            step = joint_angle[j]
            between[i, j] = step if j == i + 1 else between[i, j - 1] + step
    angle = absolute(joint_angle, 0)
    return Pose(
        angle,
        [x.sin() for x in angle],
        {pair: x.cos() for pair, x in between.items()},
        {pair: x.sin() for pair, x in between.items()},
    )


def planar_mass(pose: Pose, coupling: Matrix) -> Matrix:
    """Mass matrix a_ij cos(phi_i - phi_j) [kg m^2]."""
    mass = [list(row) for row in coupling]
    for (i, j), cos in pose.cos_between.items():
        mass[i][j] = mass[j][i] = coupling[i][j] * cos
    return mass


def add_rotors(mass: Matrix, rotors: Sequence[Tensor], first: int) -> None:
    """Add rotor inertias, one per joint, to a mass matrix over absolute angles in place."""
    for i, rotor in enumerate(rotors):
        mass[i][i] = mass[i][i] + rotor
        # The rotor of a joint after `first` turns at the difference of two absolute rates.
        if i > first:
            mass[i - 1][i - 1] = mass[i - 1][i - 1] + rotor
            mass[i - 1][i] = mass[i][i - 1] = mass[i][i - 1] - rotor


def gravity_forces(pose: Pose, moment: Sequence[Tensor]) -> list[Tensor]:
    """Gravity part of the bias, -g b_i sin phi_i [N m]."""
    return [-(m * s) for m, s in zip(moment, pose.sin, strict=True)]


def add_centrifugal(
    bias: list[Tensor], pose: Pose, coupling: Matrix, rate_squared: Sequence[Tensor]
) -> None:
    """Add a_ij sin(phi_i - phi_j) phi_j'^2 to `bias` in place [N m]."""
    for (i, j), sin in pose.sin_between.items():
        strength = coupling[i][j] * sin
        bias[i] = bias[i] - strength * rate_squared[j]
        bias[j] = bias[j] + strength * rate_squared[i]


def coupling_constants(mass: Tensor, length: Tensor, com: Tensor, inertia: Tensor) -> Tensor:
    """Constants a_ij = L_i b_j (i < j), a_ii = m_i l_i^2 + (later masses) L_i^2 + Izz_i [kg m^2].

    Per link: m `mass`, L `length` joint to joint, l `com` joint to mass centre, Izz `inertia`.
    """
    off_diagonal = torch.outer(length, static_moment(mass, length, com)).triu(1)
    diagonal = mass * com**2 + _mass_beyond(mass) * length**2 + inertia
    return off_diagonal + off_diagonal.T + diagonal.diag()


def static_moment(mass: Tensor, length: Tensor, com: Tensor) -> Tensor:
    """First moments b_i = m_i l_i + (sum of later masses) L_i, shape (links,) [kg m]."""
    return mass * com + _mass_beyond(mass) * length


def _mass_beyond(mass: Tensor) -> Tensor:
    """Mass of all links after each link, shape (links,) [kg]."""
    return mass.sum() - mass.cumsum(0)
