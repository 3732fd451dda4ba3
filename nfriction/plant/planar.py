"""Equations of motion of links hinged in one plane, in absolute angles from upright.

    sum_j a_ij cos(phi_i - phi_j) phi_j'' + sum_j a_ij sin(phi_i - phi_j) phi_j'^2
        - g b_i sin phi_i = Q_i

Pure functions on lists of scalars, one tensor per link. Only the upper triangle of `coupling`
(a_ij) is read.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from nfriction.plant.coordinates import absolute
from nfriction.plant.linear import Matrix

Pairs = dict[tuple[int, int], Tensor]


class Pose(NamedTuple):
    """Trigonometry of a pose: what both the mass matrix and the bias need.

    Attributes:
        angle: absolute link angles phi_i from upright [rad].
        sin: sin phi_i.
        cos_between: cos(phi_j - phi_i) for i < j.
        sin_between: sin(phi_j - phi_i) for i < j.
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
    """Add rotor inertias, one per joint, to a mass matrix over absolute angles in place.

    The rotor of a joint after `first` turns at the difference of two absolute rates.
    """
    for i, rotor in enumerate(rotors):
        mass[i][i] = mass[i][i] + rotor
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
    """The constants a_ij of the links, shape (links, links) [kg m^2].

    Args:
        mass, length, com: per link [kg, m, m]; `length` joint to joint, `com` joint to mass centre.
        inertia: about the mass centre and the joint axis [kg m^2].
    Returns:
        a_ij = L_i b_j for i < j and a_ii = m_i l_i^2 + (sum of later masses) L_i^2 + Izz_i.
    """
    off_diagonal = torch.outer(length, static_moment(mass, length, com)).triu(1)
    diagonal = mass * com**2 + mass_beyond(mass) * length**2 + inertia
    return off_diagonal + off_diagonal.T + diagonal.diag()


def static_moment(mass: Tensor, length: Tensor, com: Tensor) -> Tensor:
    """First moments b_i = m_i l_i + (sum of later masses) L_i, shape (links,) [kg m]."""
    return mass * com + mass_beyond(mass) * length


def mass_beyond(mass: Tensor) -> Tensor:
    """Mass of all links after each link, shape (links,) [kg]."""
    return mass.sum() - mass.cumsum(0)
