"""What a drive's torque becomes behind its gear: a gain, and a loss that opposes the motion.

Of a torque tau, friction subtracted, gain (tau - loss |tau| sgn(qd)) reaches the joint: less where
the drive moves the joint, more where the joint moves the drive.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

# Over which the sense of the loss turns [rad/s]: slower motion is dry friction's, and a sharper
# turn would ask for shorter integration steps.
TURN = 0.1


def delivered(tau: Tensor, qd: Tensor, gain: Tensor, loss: Tensor) -> Tensor:
    """Torque at the joints [N m], (*batch, joint)."""
    return gain * (tau - loss * tau.abs() * torch.tanh(qd / TURN))


def demanded(torque: Tensor, qd: Tensor, gain: Tensor, loss: Tensor) -> Tensor:
    """Torque of the drives that gives one at the joints; undoes `delivered`."""
    return torque / passed_on(torque, qd, gain, loss)


def passed_on(torque: Tensor, qd: Tensor, gain: Tensor, loss: Tensor) -> Tensor:
    """Share of the drives' torque that reaches the joints, (*batch, joint)."""
    return gain * (1.0 - loss * torque.sign() * torch.tanh(qd / TURN))


def refuse_powered(buffers: Mapping[str, Tensor]) -> None:
    """Refuse gears that would give power, or turn a torque round.

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
