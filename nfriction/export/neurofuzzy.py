"""Parameters of a neuro-fuzzy schedule in the form that code for one sample wants them."""

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

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
        "roundness": (schedule.scale * schedule.roundness).square(),
        "positive": schedule.positive,
    }
