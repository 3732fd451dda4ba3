"""Neuro-fuzzy coefficients of one sample in few arithmetic operations, for targets of numbers."""

from typing import Final

import torch
from torch import Tensor, nn

from nfriction.export.flat_constants import constants
from nfriction.friction.neurofuzzy import NeuroFuzzy

# Everywhere in its range some set is within this exponent of full membership: strengths are far
# from underflow, and need no maximum to be taken out of them.
_DEEP = 40.0


class NumberByNumber(nn.Module):
    """Coefficients of `NeuroFuzzy` for one sample of all joints.

    The rules' strengths p_i q_j are never formed: consequents are blended by q, then by p. The
    reference is left out of the blend: small numbers round less, which counts in single precision.

    Args:
        schedule: as many sets of velocity as of acceleration.

    Shape:
        qd, qdd: (joint,); coefficients (joint, coefficient).
    """

    rate: Tensor
    gain: Tensor
    shift: Tensor
    reference: Tensor
    set_slope: Tensor
    set_shift: Tensor
    planes: Tensor
    unit_slope: Tensor
    unit_shift: Tensor
    weights: Tensor
    roundness: Tensor
    positive: Tensor

    shallow: Final[bool]
    along_motion: Final[bool]
    all_positive: Final[bool]

    def __init__(self, schedule: NeuroFuzzy) -> None:
        super().__init__()
        self.along_motion = schedule.along_motion
        self.all_positive = bool(schedule.positive.all())
        self.least_exponent = float(schedule.network.head.least_exponent)
        self.per_reach = 0.5 / schedule.reach
        self.joints, self.sets = schedule.joints, schedule.terms[0]
        self.outputs = schedule.network.outputs
        with torch.no_grad():
            made = constants(schedule)
        for name, value in made.items():
            self.register_buffer(name, value.contiguous())
        ends = -torch.ones_like(self.gain), torch.ones_like(self.gain)
        deepest = _deepest(self.set_slope.mT, self.set_shift.mT, *ends)
        self.shallow = deepest < _DEEP

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        if self.along_motion:
            qdd = qdd * torch.tanh(qd * self.rate)
        given = torch.addcmul(self.shift, torch.stack([qd.abs(), qdd], 1), self.gain)
        x = given.clamp(-1.0, 1.0)
        beyond = self.per_reach * (given - x)
        weight = (1.0 - (beyond * beyond).sum(1)).clamp_min(0.0).square()
        x = x.unsqueeze(1)
        planes = self._blended(x)
        y = torch.baddbmm(planes.narrow(1, 2, 1), x, planes.narrow(1, 0, 2))
        d = torch.addcmul(self.unit_shift, torch.cat([x, y], 2), self.unit_slope)
        exponent = (d * -d).sum(2).clamp(self.least_exponent)
        u = torch.baddbmm(y, exponent.exp().unsqueeze(1), self.weights).squeeze(1)
        u = torch.addcmul(self.reference, weight.unsqueeze(1), u)
        rounded = u + torch.sqrt(torch.addcmul(self.roundness, u, u))
        if self.all_positive:
            return rounded
        return torch.where(self.positive, rounded, 2.0 * u)

    def _blended(self, x: Tensor) -> Tensor:
        """The rules' planes blended, (joint, 3, coefficient): two slopes and a constant.

        It is normalised last, and numbers come in the order that loops in C run through.
        """
        z = torch.addcmul(self.set_shift, x, self.set_slope)
        exponents = z * -z
        strengths = exponents.exp() if self.shallow else exponents.softmax(1)
        total = strengths.sum(1).prod(1)
        by_velocity, by_acceleration = strengths.unbind(2)
        planes = self.planes.view(self.joints, -1, self.sets, self.sets).transpose(1, 2)
        blended = (planes * by_acceleration[:, None, None]).sum(3)
        blended = (by_velocity.unsqueeze(2) * blended).sum(1) * total.reciprocal().unsqueeze(1)
        return blended.view(self.joints, 3, self.outputs)


def _deepest(slope: Tensor, shift: Tensor, lower: Tensor, upper: Tensor) -> float:
    """Largest exponent (slope x + shift)^2 of the nearest set, over an input's range.

    It lies at an end of the range, or where two sets are alike.
    """
    ends = torch.stack([lower, upper], -1)
    meetings = [
        (sign * shift[..., :, None] - shift[..., None, :])
        / (slope[..., None, :] - sign * slope[..., :, None])
        for sign in (1.0, -1.0)
    ]
    points = torch.cat([ends, *(m.flatten(-2) for m in meetings)], -1).nan_to_num(0.0, 0.0, 0.0)
    points = points.clamp(lower.unsqueeze(-1), upper.unsqueeze(-1))
    z = slope.unsqueeze(-1) * points.unsqueeze(-2) + shift.unsqueeze(-1)
    return float(z.square().amin(-2).max())
