"""The rotating arm that carries a chain: its parameters and its terms in the equations of motion.

With th1 the arm's angle about the vertical and phi_i the absolute link angles:

    M11 = J0 + sum_i Ixx_i + sum_ij k_ij s_i s_j - 2 sum_i Ixy_i s_i c_i
    M1i = -L1 b_i c_i + Ixz_i c_i - Iyz_i s_i
    e_i = 1/2 dM11/dphi_i = c_i sum_j k_ij s_j - Ixy_i (c_i^2 - s_i^2)
    h1 = 2 th1' sum_i e_i phi_i' + sum_i (L1 b_i s_i - Ixz_i s_i - Iyz_i c_i) phi_i'^2
    h_i gains -e_i th1'^2

where J0 is the arm with the links' masses at its end, and k_ij = a_ij except k_ii = a_ii -
(Izz_i + Ixx_i - Iyy_i), a difference that vanishes for slender rods.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from nfriction.plant.dynamics import Matrix, Pose, dot


@dataclass(frozen=True)
class Arm:
    """A rotating arm at whose end the chain hangs.

    Args:
        inertia: of the arm alone about the vertical axis [kg m^2] (m1 L1^2/4 + Izz1 for a link of
            mass m1 with its mass centre half way).
        length: from the vertical axis to the chain's first joint [m].
    """

    inertia: float
    length: float

    def __post_init__(self) -> None:
        # Without length the chain swings unmoved by the arm, and the mass matrix may be singular.
        if not (self.inertia > 0 and self.length > 0):
            raise ValueError(
                f"an arm's inertia [kg m^2] and length [m] must be positive, got {self}; "
                "leave `arm` out where the arm is fixed."
            )


class ArmTerms(NamedTuple):
    """Mass entries M11, M1i, gradient e_i and factors of phi_i'^2 in h1 of an arm [kg m^2]."""

    own: Tensor
    cross: list[Tensor]
    slope: list[Tensor]
    lever: list[Tensor]


def arm_terms(
    pose: Pose,
    coupling: Matrix,
    own_inertia: Tensor,
    lever: Sequence[Tensor],
    tensor: Matrix | None,
) -> ArmTerms:
    """Evaluate the arm's terms; `own_inertia` is J0 and `lever` L1 b_i [kg m^2].

    `tensor` has rows (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) per link [kg m^2]; None for slender rods.
    """
    sin, cos = pose.sin, [angle.cos() for angle in pose.angle]
    size = len(sin)
    # Only the upper triangle is fitted, so only it is read.
    upper = [[coupling[min(i, j)][max(i, j)] for j in range(size)] for i in range(size)]
    swept = [dot(row, sin) for row in upper]
    cross = [-(reach * c) for reach, c in zip(lever, cos, strict=True)]
    factor = [reach * s for reach, s in zip(lever, sin, strict=True)]
    own = own_inertia
    if tensor is not None:
        for i, (ixx, iyy, izz, _, ixz, iyz) in enumerate(tensor):
            swept[i] = swept[i] - (izz + ixx - iyy) * sin[i]
            cross[i] = cross[i] + ixz * cos[i] - iyz * sin[i]
            factor[i] = factor[i] - ixz * sin[i] - iyz * cos[i]
            own = own + ixx
    own = own + dot(swept, sin)
    slope = [c * k for c, k in zip(cos, swept, strict=True)]
    if tensor is not None:
        for i, (_, _, _, ixy, _, _) in enumerate(tensor):
            own = own - 2 * ixy * sin[i] * cos[i]
            slope[i] = slope[i] - ixy * (cos[i] * cos[i] - sin[i] * sin[i])
    return ArmTerms(own, cross, slope, factor)


def with_arm_mass(links: Matrix, terms: ArmTerms) -> Matrix:
    """The links' mass matrix preceded by the arm's row and column."""
    rows = [[side, *row] for side, row in zip(terms.cross, links, strict=True)]
    return [[terms.own, *terms.cross], *rows]


def with_arm_bias(
    links: Sequence[Tensor],
    terms: ArmTerms,
    arm_rate: Tensor,
    rate: Sequence[Tensor],
    rate_squared: Sequence[Tensor],
) -> list[Tensor]:
    """The links' bias with the arm's rotation in it, preceded by the arm's own bias."""
    own = 2 * arm_rate * dot(terms.slope, rate) + dot(terms.lever, rate_squared)
    spin = arm_rate * arm_rate
    return [own, *(h - e * spin for h, e in zip(links, terms.slope, strict=True))]
