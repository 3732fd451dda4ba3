"""Parameters of a neuro-fuzzy schedule in the form that flat code wants them."""

import math

import torch
from torch import Tensor

from nfriction.friction.neurofuzzy import NeuroFuzzy


def constants(schedule: NeuroFuzzy) -> dict[str, Tensor]:
    """Scales folded into slopes, shifts and weights.

    Inputs are brought to [-1, 1] by `gain x + shift`; sets and units are those of such inputs, with
    exponents -(slope x + shift)^2. The head's bias is part of the consequents, half the
    coefficients' scale of all weights and of the reference; the units of the head see its inputs in
    that scale.

    Args:
        schedule: as many sets of velocity as of acceleration.
    """
    anfis, head = schedule.network.anfis, schedule.network.head
    joints, sets = schedule.joints, schedule.terms[0]
    lower = torch.stack([torch.zeros_like(schedule.velocity_range), schedule.acceleration_lower], 1)
    upper = torch.stack([schedule.velocity_range, schedule.acceleration_upper], 1)
    half_range = 0.5 * (upper - lower)
    half = 0.5 * schedule.scale
    bias = head.output_bias

    # The network's own inputs are (x + 1) / 2.
    centres, widths = (s.view(joints, 2, sets) for s in anfis.sets())
    widths = math.sqrt(2.0) * widths
    set_slope = 0.5 / widths
    set_shift = (0.5 - centres) / widths

    slopes = 0.5 * anfis.consequents[..., :2]
    constants = anfis.consequents[..., 2] + slopes.sum(-1) + bias.unsqueeze(2)
    columns = torch.cat([slopes, constants.unsqueeze(3)], 3) * half[:, :, None, None]
    # (joint, coefficient, set of velocity, set of acceleration, column) to columns by acceleration.
    planes = columns.unflatten(2, (sets, sets)).permute(0, 4, 1, 2, 3).reshape(joints, -1, sets)

    unit_widths = math.sqrt(2.0) * torch.exp(head.log_widths)
    middle = torch.full_like(lower, 0.5)
    seen = torch.cat([middle, -bias], 1).unsqueeze(1)
    scale = torch.cat([middle, 1.0 / half], 1).unsqueeze(1)
    return {
        "rate": 1.0 / (schedule.velocity_range * schedule.turn),
        "gain": 1.0 / half_range,
        "shift": -0.5 * (lower + upper) / half_range,
        "reference": half * schedule.reference,
        "set_slope": set_slope.mT,
        "set_shift": set_shift.mT,
        "planes": planes,
        "unit_slope": scale / unit_widths,
        "unit_shift": (seen - head.centres) / unit_widths,
        "weights": (head.output_weight * half.unsqueeze(2)).mT,
        "roundness": (schedule.scale * schedule.roundness).square(),
        "positive": schedule.positive,
    }
