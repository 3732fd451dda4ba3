"""Parameters of a neuro-fuzzy schedule in the form that flat code wants them."""

import math

import torch
from torch import Tensor

from nfriction.friction import NeuroFuzzy


def constants(schedule: NeuroFuzzy, *, centred: bool) -> dict[str, Tensor]:
    """Scales folded into slopes, shifts and weights.

    Sets and units are those of raw inputs, with exponents -(slope x + shift)^2. Reference and bias
    are part of the consequents, half the coefficients' scale of all weights; the units of the head
    see its inputs in that scale.

    Args:
        schedule: as many sets of velocity as of acceleration.
        centred: inputs count from the middle of their range, and what all rules share, `shared`
            (joint, column, coefficient), is taken out of `planes`.
    """
    anfis, head = schedule.network.anfis, schedule.network.head
    joints, sets = schedule.joints, schedule.terms[0]
    # Inputs as the network sees them are (x - lower) / span.
    lower = torch.stack([torch.zeros_like(schedule.velocity_range), schedule.acceleration_lower], 1)
    upper = torch.stack([schedule.velocity_range, schedule.acceleration_upper], 1)
    span = upper - lower
    middle = 0.5 * (lower + upper) if centred else torch.zeros_like(lower)
    lowest = lower - middle
    offset = lowest / span
    half = 0.5 * schedule.scale
    constant = schedule.reference + head.output_bias

    centres, widths = (s.view(joints, 2, sets) for s in anfis.sets())
    widths = math.sqrt(2.0) * widths
    set_slope = 1.0 / (span.unsqueeze(2) * widths)
    set_shift = -(centres + offset.unsqueeze(2)) / widths

    slopes = anfis.consequents[..., :2] / span[:, None, None]
    constants = anfis.consequents[..., 2] - (slopes * lowest[:, None, None]).sum(-1)
    columns = torch.cat([slopes, (constants + constant.unsqueeze(2)).unsqueeze(3)], 3)
    columns = columns * half[:, :, None, None]
    # (joint, coefficient, set of velocity, set of acceleration, column) to columns by acceleration.
    shared = columns.mean(2)  # (joint, coefficient, column)
    if centred:
        columns = columns - shared.unsqueeze(2)
    planes = columns.unflatten(2, (sets, sets)).permute(0, 4, 1, 2, 3).reshape(joints, -1, sets)

    unit_widths = math.sqrt(2.0) * torch.exp(head.log_widths)
    seen = torch.cat([offset, constant], 1).unsqueeze(1)
    scale = torch.cat([span, half], 1).unsqueeze(1)
    return {
        "rate": 1.0 / (schedule.velocity_range * schedule.turn),
        "lower": lower,
        "upper": upper,
        "middle": middle,
        "shared": shared.mT,
        "set_slope": set_slope.mT,
        "set_shift": set_shift.mT,
        "planes": planes,
        "unit_slope": 1.0 / (scale * unit_widths),
        "unit_shift": -(head.centres + seen) / unit_widths,
        "weights": (head.output_weight * half.unsqueeze(2)).mT,
        "roundness": (schedule.scale * schedule.roundness).square(),
        "positive": schedule.positive,
    }
