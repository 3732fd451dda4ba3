"""Neuro-fuzzy coefficients of one sample in as few operations as they need.

A schedule is written for thousands of samples side by side, with parameters in a form that trains
well. A controller calls it with one sample, where every operation costs its overhead: here all
that is known is computed beforehand, scales are folded into weights, and what remains is the same
function.
"""

import copy
import math
from typing import Final, TypeVar

import torch
from torch import Tensor, nn

from nfriction.export.controller import FilteredController
from nfriction.friction import FrictionModel, NeuroFuzzy
from nfriction.friction.schedules import Schedule

# Everywhere in its range some set is within this exponent of full membership: strengths are far
# from underflow, and need no maximum to be taken out of them.
_DEEP = 40.0


def flattened(model: FrictionModel, *, number_by_number: bool = False) -> FrictionModel:
    """A model whose neuro-fuzzy schedule takes the short way for one sample of shape (joint,).

    Coefficients agree to rounding. Any other model, and one that has not as many sets of velocity
    as of acceleration, is handed back as it is.

    Args:
        model: a friction model.
        number_by_number: for targets that compute with numbers rather than tensors: fewer
            arithmetic operations in place of fewer tensor operations.
    """
    schedule = model.schedule
    if type(schedule) is not NeuroFuzzy or len(set(schedule.terms)) > 1:
        return model
    short = copy.copy(model)
    short._modules = {**model._modules, "schedule": ShortWay(schedule, number_by_number)}
    return short


_Controller = TypeVar("_Controller", bound=nn.Module)


def shortened(controller: _Controller, *, number_by_number: bool = False) -> _Controller:
    """A controller around the flattened model."""
    short = copy.copy(controller)
    own: dict[str, nn.Module] = {}
    if isinstance(controller, FilteredController):
        own["inner"] = shortened(controller.inner, number_by_number=number_by_number)
    else:
        assert isinstance(controller.model, FrictionModel)
        own["model"] = flattened(controller.model, number_by_number=number_by_number)
    short._modules = {**controller._modules, **own}
    return short


class ShortWay(nn.Module):
    """A schedule for batches, its flat form for one sample."""

    def __init__(self, schedule: Schedule, number_by_number: bool) -> None:
        super().__init__()
        assert isinstance(schedule, NeuroFuzzy)
        self.batched = schedule
        self.single = FlatNeuroFuzzy(schedule, number_by_number)

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        if qd.dim() == 1:
            return self.single(qd, qdd)
        return self.batched(qd, qdd)


class FlatNeuroFuzzy(nn.Module):
    """Coefficients of `NeuroFuzzy` for one sample of all joints.

    Inputs are clamped in SI, and sets and units are those of raw inputs. The rules' strengths
    p_i q_j are never formed: consequents are blended by q, then by p. Reference and bias are part
    of the consequents, half the coefficients' scale of all weights; the units of the head see its
    inputs in that scale.

    Args:
        schedule: as many sets of velocity as of acceleration.

    Shape:
        qd, qdd: (joint,); coefficients (joint, coefficient).
    """

    rate: Tensor
    zero: Tensor
    lower: Tensor
    upper: Tensor
    set_slope: Tensor
    set_shift: Tensor
    planes: Tensor
    unit_slope: Tensor
    unit_shift: Tensor
    weights: Tensor
    roundness: Tensor
    positive: Tensor

    number_by_number: Final[bool]
    shallow: Final[bool]
    along_motion: Final[bool]
    all_positive: Final[bool]

    def __init__(self, schedule: NeuroFuzzy, number_by_number: bool = False) -> None:
        super().__init__()
        self.along_motion = schedule.along_motion
        self.all_positive = bool(schedule.positive.all())
        self.least_exponent = float(schedule.network.head.least_exponent)
        self.joints, self.sets = schedule.joints, schedule.terms[0]
        self.outputs = schedule.network.outputs
        with torch.no_grad():
            constants = _constants(schedule)
        for name, value in constants.items():
            self.register_buffer(name, value.contiguous())
        self.number_by_number = number_by_number
        deepest = _deepest(self.set_slope.mT, self.set_shift.mT, self.lower, self.upper)
        self.shallow = deepest < _DEEP

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        if self.along_motion:
            qdd = qdd * torch.tanh(qd * self.rate)
        x = torch.clamp(torch.stack([qd.abs(), qdd], 1), self.lower, self.upper).unsqueeze(1)
        z = torch.addcmul(self.set_shift, x, self.set_slope)
        blended = self._blended_by_number(z) if self.number_by_number else self._blended(z)
        y = torch.baddbmm(blended.narrow(1, 2, 1), x, blended.narrow(1, 0, 2))
        d = torch.addcmul(self.unit_shift, torch.cat([x, y], 2), self.unit_slope)
        if self.number_by_number:
            exponent = (d * -d).sum(2).clamp(self.least_exponent)
        else:
            exponent = torch.addcmul(self.zero, d, d, value=-1.0).sum(2)
        u = torch.baddbmm(y, exponent.exp().unsqueeze(1), self.weights).squeeze(1)
        rounded = u + torch.sqrt(torch.addcmul(self.roundness, u, u))
        if self.all_positive:
            return rounded
        return torch.where(self.positive, rounded, 2.0 * u)

    def _blended(self, z: Tensor) -> Tensor:
        """The rules' planes, (joint, 3, coefficient), blended by sets of exponents -z^2.

        Shape of z: (joint, set, 2).
        """
        shares = torch.addcmul(self.zero, z, z, value=-1.0).softmax(1)
        blended = torch.bmm(self.planes, shares.narrow(2, 1, 1))
        blended = blended.view(self.joints, 3 * self.outputs, self.sets)
        blended = torch.bmm(blended, shares.narrow(2, 0, 1))
        return blended.view(self.joints, 3, self.outputs)

    def _blended_by_number(self, z: Tensor) -> Tensor:
        """The same, normalised last, and with numbers in the order that loops in C run through."""
        exponents = z * -z
        strengths = exponents.exp() if self.shallow else exponents.softmax(1)
        total = strengths.sum(1).prod(1)
        by_velocity, by_acceleration = strengths.unbind(2)
        planes = self.planes.view(self.joints, -1, self.sets, self.sets).transpose(1, 2)
        blended = (planes * by_acceleration[:, None, None]).sum(3)
        blended = (by_velocity.unsqueeze(2) * blended).sum(1)
        return (blended * total.reciprocal().unsqueeze(1)).view(self.joints, 3, self.outputs)


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


def _constants(schedule: NeuroFuzzy) -> dict[str, Tensor]:
    """The buffers of the flat form."""
    anfis, head = schedule.network.anfis, schedule.network.head
    joints, sets = schedule.joints, schedule.terms[0]
    # Inputs as the network sees them are (x - lower) / span.
    lower = torch.stack([torch.zeros_like(schedule.velocity_range), schedule.acceleration_lower], 1)
    upper = torch.stack([schedule.velocity_range, schedule.acceleration_upper], 1)
    span = upper - lower
    offset = lower / span
    half = 0.5 * schedule.scale
    constant = schedule.reference + head.output_bias

    # Exponents of sets and units are -(slope x + shift)^2.
    centres, widths = (s.view(joints, 2, sets) for s in anfis.sets())
    widths = math.sqrt(2.0) * widths
    set_slope = 1.0 / (span.unsqueeze(2) * widths)
    set_shift = -(centres + offset.unsqueeze(2)) / widths

    slopes = anfis.consequents[..., :2] / span[:, None, None]
    constants = anfis.consequents[..., 2] - (slopes * lower[:, None, None]).sum(-1)
    columns = torch.cat([slopes, (constants + constant.unsqueeze(2)).unsqueeze(3)], 3)
    columns = columns * half[:, :, None, None]
    # (joint, coefficient, set of velocity, set of acceleration, column) to columns by acceleration.
    planes = columns.unflatten(2, (sets, sets)).permute(0, 4, 1, 2, 3).reshape(joints, -1, sets)

    unit_widths = math.sqrt(2.0) * torch.exp(head.log_widths)
    seen = torch.cat([offset, constant], 1).unsqueeze(1)
    scale = torch.cat([span, half], 1).unsqueeze(1)
    return {
        "rate": 1.0 / (schedule.velocity_range * schedule.turn),
        "lower": lower,
        "upper": upper,
        "zero": torch.zeros_like(span[0, 0]),
        "set_slope": set_slope.mT,
        "set_shift": set_shift.mT,
        "planes": planes,
        "unit_slope": 1.0 / (scale * unit_widths),
        "unit_shift": -(head.centres + seen) / unit_widths,
        "weights": (head.output_weight * half.unsqueeze(2)).mT,
        "roundness": (schedule.scale * schedule.roundness).square(),
        "positive": schedule.positive,
    }
