"""Equations of motion of hinged links, as pure functions: planar links, arm, drag, gears, encoders.

Links hinged in one plane have, in absolute angles phi_i from upright,

    sum_j a_ij cos(phi_i - phi_j) phi_j'' + sum_j a_ij sin(phi_i - phi_j) phi_j'^2
        - g b_i sin phi_i = Q_i.

The functions take lists of scalars, one tensor of shape (*batch) per link or joint. Unrolled this
way a batch of 3x3 systems needs no small-matrix kernels, traces to plain arithmetic and
differentiates in both modes. Only the upper triangle of `coupling` (a_ij) is read.

Joint coordinates q (relative angles) and absolute angles u are related by u = S q; generalised
forces go back as S^T Q and matrices as S^T M S. The first `first` entries (the arm's angle, if
there is a free arm) are the same in both.

A free arm at the angle th1 about the vertical adds its own row and the links' share of its motion:

    M11 = J0 + sum_i Ixx_i + sum_ij k_ij s_i s_j - 2 sum_i Ixy_i s_i c_i
    M1i = -L1 b_i c_i + Ixz_i c_i - Iyz_i s_i
    e_i = 1/2 dM11/dphi_i = c_i sum_j k_ij s_j - Ixy_i (c_i^2 - s_i^2)
    h1 = 2 th1' sum_i e_i phi_i' + sum_i (L1 b_i s_i - Ixz_i s_i - Iyz_i c_i) phi_i'^2
    h_i gains -e_i th1'^2

where J0 is the arm with the links' masses at its end, and k_ij = a_ij except k_ii = a_ii -
(Izz_i + Ixx_i - Iyy_i), a difference that vanishes for slender rods.
"""

from collections.abc import Sequence
from itertools import accumulate
from operator import add
from typing import NamedTuple

import torch
from torch import Tensor

Matrix = list[list[Tensor]]
Pairs = dict[tuple[int, int], Tensor]

# Keeps 0/0 away where a whole link is at rest: the drag's numerators are cubic in the velocity.
_TINY = 1e-30
# Velocity over which a gear's loss changes sign [rad/s]: at lower ones dry friction dominates, and
# a sharper change would require shorter integration steps.
SIGN_WIDTH = 0.1


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

    `matrix` is symmetric positive definite; only its lower triangle is read.
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
    """Trigonometry of a pose, shared by the mass matrix and the bias."""

    angle: list[Tensor]  # absolute link angles phi_i from upright [rad]
    sin: list[Tensor]
    cos_between: Pairs  # of phi_j - phi_i for i < j
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


def bearing_lever(mass: Tensor, length: Tensor, com: Tensor) -> Tensor:
    """Lever [m] by which each link's rotation accelerates the load of a joint, (joint, link)."""
    carried = mass.flip(0).cumsum(0).flip(0)
    own = (static_moment(mass, length, com) / carried[:, None]).triu()
    return own + length.expand_as(own).tril(-1)


def bearing_load(
    pose: Pose, rate: Sequence[Tensor], acceleration: Sequence[Tensor], lever: Matrix
) -> Tensor:
    """Force at each joint over the weight beyond it [-], (*batch, joint).

    By absolute rates and accelerations; `lever` is `bearing_lever` over gravity [s^2].
    """
    cos = [angle.cos() for angle in pose.angle]
    motion = list(zip(rate, acceleration, pose.sin, cos, strict=True))
    across = [a * c - r * r * s for r, a, s, c in motion]
    along = [-(a * s + r * r * c) for r, a, s, c in motion]
    # The root has no slope at zero, where a joint falls freely.
    squares = [dot(row, across) ** 2 + (1.0 + dot(row, along)) ** 2 + _TINY for row in lever]
    return stack([square.sqrt() for square in squares])


class ArmTerms(NamedTuple):
    """Mass entries M11, M1i, gradient e_i and factors of phi_i'^2 in h1 of an arm [kg m^2]."""

    own: Tensor
    cross: list[Tensor]
    slope: list[Tensor]
    lever: list[Tensor]


def arm_terms(
    pose: Pose, coupling: Matrix, own_inertia: Tensor, lever: Sequence[Tensor],
    tensor: Matrix | None,
) -> ArmTerms:  # fmt: skip
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
    links: Sequence[Tensor], terms: ArmTerms, arm_rate: Tensor, rate: Sequence[Tensor],
    rate_squared: Sequence[Tensor],
) -> list[Tensor]:  # fmt: skip
    """The links' bias with the arm's rotation in it, preceded by the arm's own bias."""
    own = 2 * arm_rate * dot(terms.slope, rate) + dot(terms.lever, rate_squared)
    spin = arm_rate * arm_rate
    return [own, *(h - e * spin for h, e in zip(links, terms.slope, strict=True))]


def drag_forces(
    pose: Pose, rate: Sequence[Tensor], length: Sequence[Tensor], linear: Sequence[Tensor],
    quadratic: Sequence[Tensor],
) -> list[Tensor]:  # fmt: skip
    """Torques of air drag on the absolute angles, int f(v) dv/dphi_j' ds along the links [N m].

    A point at distance s from the joint of link i moves at v = s phi_i' + sum_{j<i} L_j phi_j'
    cos(phi_i - phi_j) across the link and meets the force f = k1 v + k2 v |v| per length. As v is
    linear in s, f and its moment have closed forms even where v changes sign: no quadrature, no
    branch. The product with the absolute rates phi_i' is the power lost, never negative for
    k1, k2 >= 0 (`linear`, `quadratic`).
    """
    torque: list[Tensor] = []
    for i, (size, k1, k2) in enumerate(zip(length, linear, quadratic, strict=True)):
        reach = [length[j] * pose.cos_between[j, i] for j in range(i)]
        sweep = size * rate[i]
        if i == 0:  # its joint is fixed, so that v grows from 0
            torque.append(size * size * sweep * (k1 / 3 + k2 / 4 * sweep.abs()))
            continue
        start = dot(reach, rate[:i])
        end = start + sweep
        mean, first = square_moments(start, end)
        push = size * (k1 / 2 * (start + end) + k2 * mean)
        torque = [t + lever * push for t, lever in zip(torque, reach, strict=True)]
        torque.append(size * size * (k1 / 6 * (start + 2 * end) + k2 * first))
    return torque


def square_moments(start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """Integrals over t in [0, 1] of v |v| and of t v |v| for v = start + t (end - start).

    Exact for either sign of both ends: with w = start * end, the second is half the first plus
    the moment about the middle; |w| - w is zero unless v changes sign on the way.
    """
    w = start * end
    both = w.abs()
    total = start.abs() + end.abs() + _TINY
    squares = start * start + end * end + both
    mean = (start + end) / total * squares / 3
    crossing = both / total * ((both - w) / total)
    about_middle = (end - start) / total * (squares + w - crossing) / 12
    return mean, mean / 2 + about_middle


def joint_torque(tau: Tensor, qd: Tensor, gain: Tensor, loss: Tensor) -> Tensor:
    """Torque at the joints after gears, gain (tau - loss |tau| sgn(qd)) [N m], (*batch, joint).

    `tau` is the motors' torque with friction subtracted: less of it arrives if the motor drives the
    joint, more if the joint drives the motor.
    """
    return gain * (tau - loss * tau.abs() * torch.tanh(qd / SIGN_WIDTH))


def motor_torque(torque: Tensor, qd: Tensor, gain: Tensor, loss: Tensor) -> Tensor:
    """Motor torque that gives `torque` at the joints; inverse of `joint_torque`."""
    # The efficiency is positive, so the joint torque has the sign of the motor torque.
    efficiency = 1.0 - loss * torque.sign() * torch.tanh(qd / SIGN_WIDTH)
    return torque / (gain * efficiency)


def check_gear(gain: Tensor, loss: Tensor) -> None:
    """Refuse gears that would generate power or reverse a torque."""
    if not (gain > 0).all():
        raise ValueError(f"`torque_gain` must be positive, got {gain.tolist()}.")
    if not ((loss >= 0) & (loss < 1)).all():
        raise ValueError(
            "`gear_loss`, the share of a torque that is lost, must be from 0 to less than 1, "
            f"got {loss.tolist()}."
        )


class EncoderCorrection(NamedTuple):
    """True angle for an encoder's readings, and its first two derivatives in them."""

    angle: Tensor
    slope: Tensor
    curvature: Tensor


def correct_encoder(q: Tensor, zero: Tensor, cosine: Tensor, sine: Tensor) -> EncoderCorrection:
    """True angles from readings of eccentric encoders.

    A disc off-centre by e in the direction delta reads q + e sin(q + delta). With u the reading
    from hanging, that is q + c (cos u - 1) + s sin u, zero at hanging, so that it is not confounded
    with the encoder's zero. Computing u from the reading instead of q changes only terms of second
    order in e, and gives q in closed form.

    Args:
        q: readings [rad], (*batch, joint).
        zero: cosine of each joint's coordinate when the mechanism hangs: -1 for a first link
            measured from upright, 1 for the others, (joint,).
        cosine, sine: c and s [rad], (joint,); the eccentricity is e = sqrt(c^2 + s^2).
    """
    cos, sin = zero * q.cos(), zero * q.sin()
    angle = q - cosine * (cos - 1) - sine * sin
    slope = 1 + cosine * sin - sine * cos
    return EncoderCorrection(angle, slope, cosine * cos + sine * sin)
