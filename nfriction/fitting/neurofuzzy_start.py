"""Where a neuro-fuzzy model starts: at the constant fit of its law."""

from collections.abc import Sequence
from typing import TypeGuard

import numpy as np
import torch

from nfriction.fitting.outcome import Continuity, Fit
from nfriction.fitting.preparation import constant_schedule
from nfriction.fitting.torque import fit_torque, natural_scale
from nfriction.friction import Constant, FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.recording import Recording
from nfriction.signals import Motion

# Of a coefficient's scale: far below what a simulation shows, far above rounding.
NOTHING = 1e-6


def is_constant_fit(
    start: Fit | None, model: FrictionModel, continuity: Continuity = "free"
) -> TypeGuard[Fit]:
    """Whether a fit is one of the model's law with constant coefficients, by such trajectories."""
    return (
        start is not None
        and start.model.law == model.law
        and isinstance(start.model.schedule, Constant)
        and start._residuals.numel() > 0
        and start.continuity == continuity
    )


def start_at(
    model: FrictionModel, constant: Fit, joint: Sequence[Recording], motions: Sequence[Motion]
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
    qd = torch.as_tensor(np.concatenate([m.qd for m in motions]))
    qdd = torch.as_tensor(np.concatenate([m.qdd for m in motions]))
    along = qdd * qd.sign() if schedule.along_motion else qdd
    schedule.set_range(
        qd.abs().amax(0),
        torch.stack([torch.quantile(along, 0.001, 0), torch.quantile(along, 0.999, 0)], -1),
    )
    torque = fit_torque(model.law, constant.plant, joint, motions, model.v_smooth)
    schedule.set_reference(values, natural_scale(model.law, torque, qd))
    schedule.set_parameter_vector(torch.zeros_like(schedule.parameter_vector()))


def settle_on(model: FrictionModel, constant: Fit) -> None:
    """Set a neuro-fuzzy model to a constant fit of its law for good: zeros stay as good as zero."""
    schedule = model.schedule
    assert isinstance(schedule, NeuroFuzzy)
    schedule.set_reference(constant_schedule(constant.model).values, schedule.scale, NOTHING)
    schedule.set_parameter_vector(torch.zeros_like(schedule.parameter_vector()))
