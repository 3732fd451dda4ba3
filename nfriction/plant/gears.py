"""Gears and eccentric encoders: from a motor's torque to the joint's, from a reading to its angle.

Of a motor's torque tau, friction subtracted, gain (tau - loss |tau| sgn(qd)) reaches the joint:
less where the motor drives the joint, more where the joint drives the motor.

An encoder disc that is off-centre by e in the direction delta reads q + e sin(q + delta). Written
relative to hanging, `reading = q + c (cos u - 1) + s sin u` with u the reading from hanging, the
error is zero there, so that it does not mix with the encoder's zero. That u is of the reading and
not of q matters to second order in e only, and gives q in closed form.
"""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

# Velocity over which the loss changes sign [rad/s]: at lower ones dry friction dominates, and a
# sharper change would require shorter integration steps.
SIGN_WIDTH = 0.1


def joint_torque(tau: Tensor, qd: Tensor, gain: Tensor, loss: Tensor) -> Tensor:
    """Torque at the joints of the motors' torque `tau` [N m], (*batch, joint)."""
    return gain * (tau - loss * tau.abs() * torch.tanh(qd / SIGN_WIDTH))


def motor_torque(torque: Tensor, qd: Tensor, gain: Tensor, loss: Tensor) -> Tensor:
    """Torque of the motors that gives `torque` at the joints; inverse of `joint_torque`."""
    # The efficiency is positive, so the joint torque has the sign of the motor torque.
    efficiency = 1.0 - loss * torque.sign() * torch.tanh(qd / SIGN_WIDTH)
    return torque / (gain * efficiency)


def check_gear(buffers: Mapping[str, Tensor]) -> None:
    """Refuse gears that would generate power or reverse a torque.

    Raises:
        ValueError: for a `torque_gain` that is not positive, or a `gear_loss` outside [0, 1).
    """
    gain, loss = buffers.get("torque_gain"), buffers.get("gear_loss")
    if gain is not None and not (gain > 0).all():
        raise ValueError(f"`torque_gain` must be positive, got {gain.tolist()}.")
    if loss is not None and not ((loss >= 0) & (loss < 1)).all():
        raise ValueError(
            "`gear_loss`, the share of a torque that is lost, must be from 0 to less than 1, "
            f"got {loss.tolist()}."
        )


class EncoderCorrection(NamedTuple):
    """True angle of readings, its first and second derivative by them, each (*batch, joint)."""

    angle: Tensor
    slope: Tensor
    curvature: Tensor

    def true_acceleration(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """True acceleration of a reading's rate and acceleration."""
        return self.slope * qdd + self.curvature * qd * qd

    def read_acceleration(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """The reading's acceleration, of its rate and the true acceleration."""
        return (qdd - self.curvature * qd * qd) / self.slope


def correct_encoder(q: Tensor, zero: Tensor, cosine: Tensor, sine: Tensor) -> EncoderCorrection:
    """True angles of readings of eccentric encoders.

    Args:
        q: readings [rad], (*batch, joint).
        zero: cosine of each joint's coordinate where the mechanism hangs: -1 for a first link
            measured from upright, 1 for the others, (joint,).
        cosine, sine: c and s [rad], (joint,); the eccentricity is sqrt(c^2 + s^2).
    """
    cos, sin = zero * q.cos(), zero * q.sin()
    angle = q - cosine * (cos - 1) - sine * sin
    slope = 1 + cosine * sin - sine * cos
    return EncoderCorrection(angle, slope, cosine * cos + sine * sin)
