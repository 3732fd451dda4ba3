"""Where a neuro-fuzzy model starts: at the constant fit of its law."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.data.inputs import constant_schedule
from nfriction.fitting.equation_error import natural_scale
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.recording import Recording
from nfriction.signals import Motion

# Of a coefficient's scale: far below what a simulation shows, far above rounding.
NOTHING = 1e-6


def range_of(motions: Sequence[Motion], along_motion: bool) -> tuple[Tensor, Tensor]:
    """Largest |velocity| of motions, (joint,), and ends of their acceleration, (joint, 2)."""
    qd, qdd = (np.concatenate([getattr(m, name) for m in motions]) for name in ("qd", "qdd"))
    along = qdd * np.sign(qd) if along_motion else qdd
    # Wild accelerations aside.
    ends = np.quantile(along, [0.001, 0.999], axis=0)
    return torch.as_tensor(np.abs(qd).max(0)), torch.as_tensor(ends.T)


def start_at(
    model: FrictionModel, constant: FitResult, joint: Sequence[Recording], motions: Sequence[Motion]
) -> None:
    """Set a neuro-fuzzy model to a constant fit of its law and to the range of the motion.

    Args:
        model: changed in place; its network starts at zero.
        constant: fit of the same law with constant coefficients.
        joint: recordings in joint coordinates.
        motions: the smoothed motion of each.
    """
    schedule = model.schedule
    assert isinstance(schedule, NeuroFuzzy)
    values = constant_schedule(constant.model).values
    schedule.set_range(*range_of(motions, schedule.along_motion))
    schedule.set_reference(values, natural_scale(model, constant.plant, joint, motions))
    schedule.set_parameter_vector(torch.zeros_like(schedule.parameter_vector()))


def settle_on(model: FrictionModel, constant: FitResult) -> None:
    """Set a neuro-fuzzy model to a constant fit of its law for good: zeros stay as good as zero."""
    schedule = model.schedule
    assert isinstance(schedule, NeuroFuzzy)
    schedule.set_reference(constant_schedule(constant.model).values, schedule.scale, NOTHING)
    schedule.set_parameter_vector(torch.zeros_like(schedule.parameter_vector()))
