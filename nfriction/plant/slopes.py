"""How the equations of motion of a chain in a plane move with its state, in closed form.

Ten times cheaper than automatic differentiation: inverse dynamics are differentiated, which needs
no derivative of a solution. With M qdd + h(q, qd) = tau and r = M qdd + h at a given qdd,

    dqdd = M^-1 (dtau - dr/dq dq - dr/dqd dqd).
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from nfriction.plant.coordinates import absolute, joint_forces, link_forces, relative
from nfriction.plant.linear import Matrix, solve
from nfriction.plant.planar import Pose


class PlantSlopes(NamedTuple):
    """Derivatives at a state, joints first, so that every entry lies in one piece.

    Attributes:
        by_q, by_qd: of the inverse dynamics, the acceleration held, (joint, joint, *batch).
        inverse_mass: M^-1, (joint, joint, *batch) or, of a single link, what broadcasts.
        load_by_q: of the loads, (joint, joint, *batch).
        load_by_qd: of each joint's load by its own velocity, (joint, *batch).
    """

    by_q: Tensor
    by_qd: Tensor
    inverse_mass: Tensor
    load_by_q: Tensor
    load_by_qd: Tensor

    def geared(self, share: Tensor, by_velocity: Tensor) -> "PlantSlopes":
        """Behind gears.

        Args:
            share: of the drives' torque that reaches the joints, (*batch, joint).
            by_velocity: of the drives' torque by each joint's own velocity, (*batch, joint).
        """
        own = share.movedim(-1, 0)
        turning = torch.diag_embed(by_velocity).movedim((-2, -1), (0, 1))
        return self._replace(
            by_q=self.by_q / own.unsqueeze(1),
            by_qd=self.by_qd / own.unsqueeze(1) + turning,
            inverse_mass=self.inverse_mass * own,
        )


def planar_slopes(
    pose: Pose,
    coupling: Matrix,
    mass: Matrix,
    moment: Sequence[Tensor],
    lever: Sequence[Tensor],
    qd: Tensor,
    qdd: Tensor,
) -> PlantSlopes:
    """Derivatives for links in a plane on a fixed pivot, without drag.

    Args:
        pose, coupling, moment: see `planar`.
        mass: over absolute angles, with rotors.
        lever: of the loads, see `PendulumChain`.
        qd, qdd: joint velocities and accelerations, (*batch, joint).
    """
    own = qd.unbind(-1)
    rate, acceleration = absolute(own, 0), absolute(qdd.unbind(-1), 0)
    by_angle, by_rate = _force_slopes(pose, coupling, moment, rate, acceleration)
    joints, ones = len(own), (1,) * own[0].ndim
    unit = torch.eye(joints).to(qd)
    forces = link_forces([row.view(-1, *ones) for row in unit], 0)
    inverse = torch.broadcast_tensors(*relative(solve(mass, forces), 0))
    pulls = [k * x for k, x in zip(lever, own, strict=True)]
    loads = [k * x - a.cos() for k, x, a in zip(pulls, own, pose.angle, strict=True)]
    sign = torch.stack(loads).sign()
    # A joint moves the angles of its own link and of all beyond it.
    by_own = (sign * torch.stack(pose.sin)).unsqueeze(1)
    return PlantSlopes(
        by_q=_in_joints(by_angle),
        by_qd=_in_joints(by_rate),
        inverse_mass=torch.stack(inverse),
        load_by_q=by_own * unit.new_ones(joints, joints).tril().view(joints, joints, *ones),
        load_by_qd=2.0 * sign * torch.stack(pulls),
    )


def _force_slopes(
    pose: Pose,
    coupling: Matrix,
    moment: Sequence[Tensor],
    rate: Sequence[Tensor],
    acceleration: Sequence[Tensor],
) -> tuple[Matrix, Matrix]:
    """Of inertial, centrifugal and gravity forces by absolute angles and rates, row by row."""
    zero = torch.zeros_like(rate[0])
    by_angle, by_rate = ([[zero] * len(rate) for _ in rate] for _ in range(2))
    squared = [x * x for x in rate]
    for i, (weight, angle) in enumerate(zip(moment, pose.angle, strict=True)):
        by_angle[i][i] = -weight * angle.cos()
    for (i, j), sin in pose.sin_between.items():
        sine, cosine = coupling[i][j] * sin, coupling[i][j] * pose.cos_between[i, j]
        on_first = sine * acceleration[j] + cosine * squared[j]
        on_later = sine * acceleration[i] - cosine * squared[i]
        by_angle[i][j], by_angle[j][i] = -on_first, on_later
        by_angle[i][i] = by_angle[i][i] + on_first
        by_angle[j][j] = by_angle[j][j] - on_later
        twice = 2.0 * sine
        by_rate[i][j], by_rate[j][i] = -twice * rate[j], twice * rate[i]
    return by_angle, by_rate


def _in_joints(forces: Matrix) -> Tensor:
    """Derivatives of forces by absolute motion, as those of joint torques by joint motion."""
    # Torques sum the forces from the tip; a joint moves all links beyond it: the same sum again.
    rows = [joint_forces(row, 0) for row in forces]
    columns = [joint_forces(column, 0) for column in zip(*rows, strict=True)]
    flat = torch.broadcast_tensors(*(entry for row in zip(*columns, strict=True) for entry in row))
    return torch.stack(flat).unflatten(0, (len(forces), len(forces)))
