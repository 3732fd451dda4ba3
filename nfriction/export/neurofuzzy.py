"""Neuro-fuzzy coefficients of one sample: tables for C, tensor operations for TorchScript."""

import copy
import math
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from nfriction.export.controller import Controller
from nfriction.friction.neurofuzzy import NeuroFuzzy

# Shift of a set that is there for its place alone: its membership is zero.
_NOWHERE = 1e3


def tables(schedule: NeuroFuzzy) -> dict[str, Tensor]:
    """Scales folded into slopes, shifts and weights.

    Inputs are brought to [-1, 1] by `gain x + shift`; sets and units are those of such inputs, with
    exponents -(slope x + shift)^2. The head's bias is part of the consequents, half the
    coefficients' scale of all weights and of the reference; the units of the head see its inputs in
    that scale.

    Returns:
        `rate` (joint,); `gain` and `shift` (joint, input); `set_slope` and `set_shift` (joint,
        set, input), with sets of no membership where one input has fewer; `planes` (joint,
        3 coefficient set, set), columns by set of velocity, then of acceleration; `unit_slope` and
        `unit_shift` (joint, unit, input and coefficient); `weights` (joint, unit, coefficient);
        `lean` (joint, coefficient), of the direction;
        `reference`, `roundness` (joint, coefficient); `positive` (coefficient,).
    """
    anfis, head = schedule.network.anfis, schedule.network.head
    joints, terms = schedule.joints, schedule.terms
    sets = max(terms)
    lower = torch.stack([torch.zeros_like(schedule.velocity_range), schedule.acceleration_lower], 1)
    upper = torch.stack([schedule.velocity_range, schedule.acceleration_upper], 1)
    half_range = 0.5 * (upper - lower)
    half = 0.5 * schedule.scale
    bias = head.output_bias

    # The network's own inputs are (x + 1) / 2.
    centres, widths = anfis.sets()
    slope = 0.5 / (math.sqrt(2.0) * widths)
    shift = (0.5 - centres) * 2.0 * slope
    set_slope, set_shift = (
        torch.stack(
            [pad(part, (0, sets - part.shape[1]), value=fill) for part in x.split(terms, 1)], 2
        )
        for x, fill in ((slope, 0.0), (shift, _NOWHERE))
    )

    slopes = 0.5 * anfis.consequents[..., :2]
    constants = anfis.consequents[..., 2] + slopes.sum(-1) + bias.unsqueeze(2)
    columns = torch.cat([slopes, constants.unsqueeze(3)], 3) * half[:, :, None, None]
    # (joint, coefficient, set of velocity, set of acceleration, column) to columns by acceleration.
    planes = columns.unflatten(2, terms).permute(0, 4, 1, 2, 3)
    planes = pad(planes, (0, sets - terms[1], 0, sets - terms[0])).reshape(joints, -1, sets)

    unit_widths = math.sqrt(2.0) * torch.exp(head.log_widths)
    middle = torch.full_like(lower, 0.5)
    seen = torch.cat([middle, -bias], 1).unsqueeze(1)
    scale = torch.cat([middle, 1.0 / half], 1).unsqueeze(1)
    return {
        "rate": 1.0 / (schedule.velocity_range * schedule.turn),
        "gain": 1.0 / half_range,
        "shift": -0.5 * (lower + upper) / half_range,
        "reference": half * schedule.reference,
        "set_slope": set_slope,
        "set_shift": set_shift,
        "planes": planes,
        "unit_slope": scale / unit_widths,
        "unit_shift": (seen - head.centres) / unit_widths,
        "weights": (head.output_weight * half.unsqueeze(2)).mT,
        "lean": half * schedule.leans(),
        "roundness": (schedule.scale * schedule.roundness).square(),
        "positive": schedule.positive,
    }


def with_single_sample(controller: Controller) -> Controller:
    """A controller whose neuro-fuzzy schedule has code of its own for one sample, (joint,).

    Coefficients agree to rounding. One with any other schedule is handed back as it is.
    """
    schedule = controller.model.schedule
    # As in C, only the class that names its form itself computes by it.
    if vars(type(schedule)).get("form") != "neurofuzzy":
        return controller
    fast = copy.deepcopy(controller)
    fast.model.schedule = _Either(schedule)  # type: ignore
    return fast


class _Either(nn.Module):
    """A schedule for batches, its form for one sample."""

    def __init__(self, schedule: NeuroFuzzy) -> None:
        super().__init__()
        self.batched = schedule
        self.single = SingleSample(schedule)

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        if qd.dim() == 1:
            return self.single(qd, qdd)
        return self.batched(qd, qdd)


class SingleSample(nn.Module):
    """Coefficients of `NeuroFuzzy` for one sample of all joints.

    Every step is a product of one matrix with a vector of all joints, with zeros where a joint
    looks at another: on such small numbers an operation costs its call, whatever it computes.
    Inputs are stacked by kind, velocities of all joints first; everything else by joint.

    Args:
        schedule: the neuro-fuzzy schedule.

    Shape:
        qd, qdd: (joint,), NaN taken for the lower end of the range; coefficients (joint,
        coefficient).
    """

    rate: Tensor
    gain: Tensor
    shift: Tensor
    one: Tensor
    reference: Tensor
    set_slope: Tensor
    set_shift: Tensor
    set_sums: Tensor
    rule_slope: Tensor
    rule_shift: Tensor
    unit_slope: Tensor
    unit_shift: Tensor
    unit_sums: Tensor
    weights: Tensor
    lean: Tensor
    roundness: Tensor
    positive: Tensor

    along_motion: Final[bool]
    all_positive: Final[bool]
    leans: Final[bool]

    def __init__(self, schedule: NeuroFuzzy) -> None:
        super().__init__()
        self.along_motion = schedule.along_motion
        self.all_positive = bool(schedule.positive.all())
        self.leans = bool(schedule.leans().any())
        sets = max(schedule.terms)
        self.joints, self.rules = schedule.joints, sets * sets
        self.outputs = schedule.network.outputs
        self.per_reach = 0.5 / schedule.reach
        with torch.no_grad():
            buffers = _matrices(tables(schedule), sets)
        for name, value in buffers.items():
            self.register_buffer(name, value.contiguous())

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        direction = qd
        if self.along_motion or self.leans:
            direction = torch.tanh(qd * self.rate)
        if self.along_motion:
            qdd = qdd * direction
        # They pass over NaN, which products of matrices would carry from joint to joint.
        given = torch.addcmul(self.shift, torch.cat([qd.abs(), qdd]), self.gain)
        x = torch.fmin(torch.fmax(given, -self.one), self.one)
        beyond = self.per_reach * (given - x)
        weight = (1.0 - (beyond * beyond).view(2, self.joints).sum(0)).clamp_min(0.0).square()
        z = torch.addmv(self.set_shift, self.set_slope, x)
        shares = torch.mv(self.set_sums, z * z).view(self.joints, self.rules, 1).softmax(1)
        rules = torch.addmv(self.rule_shift, self.rule_slope, x)
        y = torch.bmm(rules.view(self.joints, self.outputs, self.rules), shares).view(-1)
        d = torch.addmv(self.unit_shift, self.unit_slope, torch.cat([x, y]))
        u = torch.addmv(y, self.weights, torch.mv(self.unit_sums, d * d).exp())
        u = u.view(self.joints, self.outputs)
        if self.leans:
            u = torch.addcmul(u, self.lean, direction.unsqueeze(1))
        u = torch.addcmul(self.reference, weight.unsqueeze(1), u)
        rounded = u + torch.sqrt(torch.addcmul(self.roundness, u, u))
        if not self.all_positive:
            rounded = torch.where(self.positive, rounded, 2.0 * u)
        return rounded


def _matrices(given: dict[str, Tensor], sets: int) -> dict[str, Tensor]:
    """The buffers: blocks of each joint on the diagonal."""
    set_slope, set_shift = given["set_slope"], given["set_shift"]  # (joint, set, input)
    joints, outputs = len(set_slope), given["roundness"].shape[1]
    # Places in [velocities, accelerations] of each joint's inputs, and of outputs after them.
    own = torch.arange(2 * joints).view(2, joints).mT
    seen = torch.cat([own, 2 * joints + torch.arange(joints * outputs).view(joints, outputs)], 1)
    planes = given["planes"].view(joints, 3, outputs, sets * sets)
    one = torch.ones(sets, dtype=set_slope.dtype)
    eye = torch.eye(sets, dtype=set_slope.dtype)
    # Of each rule: its set of velocity and its set of acceleration.
    pairs = torch.cat([torch.kron(eye, one[:, None]), torch.kron(one[:, None], eye)], 1)
    unit_slope = given["unit_slope"]  # (joint, unit, input)
    units, inputs = unit_slope.shape[1:]
    joined = torch.kron(torch.eye(units, dtype=one.dtype), torch.ones(1, inputs, dtype=one.dtype))
    by_joint = torch.eye(joints, dtype=one.dtype)
    return {
        "rate": given["rate"],
        "gain": given["gain"].mT.flatten(),
        "shift": given["shift"].mT.flatten(),
        "one": torch.ones_like(given["gain"][0, 0]),
        "reference": given["reference"],
        "set_slope": _placed(_by_input(set_slope), own, 2 * joints),
        "set_shift": set_shift.mT.flatten(),
        "set_sums": -torch.kron(by_joint, pairs),
        "rule_slope": _placed(planes[:, :2].flatten(2).mT, own, 2 * joints),
        "rule_shift": planes[:, 2].flatten(),
        "unit_slope": _placed(
            torch.diag_embed(unit_slope).flatten(1, 2), seen, int(seen.max()) + 1
        ),
        "unit_shift": given["unit_shift"].flatten(),
        "unit_sums": -torch.kron(by_joint, joined),
        "weights": torch.block_diag(*given["weights"].mT),
        "lean": given["lean"],
        "roundness": given["roundness"],
        "positive": given["positive"],
    }


def _placed(blocks: Tensor, columns: Tensor, width: int) -> Tensor:
    """A matrix with the rows of every joint's block, (joint, row, input), at its own columns."""
    joints, rows, _ = blocks.shape
    matrix = blocks.new_zeros(joints, rows, width)
    matrix.scatter_(2, columns.unsqueeze(1).expand_as(blocks), blocks)
    return matrix.flatten(0, 1)


def _by_input(slopes: Tensor) -> Tensor:
    """Blocks (joint, input and set, input) of slopes (joint, set, input)."""
    return torch.diag_embed(slopes, dim1=1, dim2=3).flatten(1, 2)
