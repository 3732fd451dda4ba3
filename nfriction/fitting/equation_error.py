"""Equation error: constant coefficients from the friction torque that a motion implies."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.friction.laws import Law
from nfriction.friction.models import V_SMOOTH, FrictionModel
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

# Smoothers know less at the ends of a record; that much of each end is left out [s].
EDGE = 0.02
# Precision of each coefficient around zero over that of the data: nothing where they tell, and
# where they do not (an offset and a sign that never turns, say) no runaway.
RIDGE = 1e-6
# Share of a torque that is taken for friction even where no law explains any of it.
LEAST_TOLD = 0.01


@dataclass(frozen=True)
class TorqueFit:
    """Constant coefficients found from torques.

    Attributes:
        coefficients: (joint, coefficient), in SI.
        residual: root mean square of the torque left over, (joint,) [N m].
        torque: root mean square of the friction torque, (joint,) [N m].
    """

    coefficients: Tensor
    residual: Tensor
    torque: Tensor


def friction_torque(
    plant: Plant, recording: Recording, motion: Motion
) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity, load and friction torque along a recording, each (sample, joint).

    `tau_f = tau - inverse_dynamics(q, qd, qdd)`, the ends of the record left out.

    Args:
        plant: the mechanism.
        recording: in joint coordinates.
        motion: its smoothed motion.
    """
    inside = _inside(motion.time)
    q, qd, qdd = (torch.as_tensor(x[inside]) for x in (motion.q, motion.qd, motion.qdd))
    tau = np.zeros_like(recording.q) if recording.tau is None else recording.tau
    left = torch.as_tensor(tau[inside]) - plant.inverse_dynamics(q, qd, qdd)
    return qd, plant.load(q, qd), left


def largest_moved(plant: Plant, motions: Sequence[Motion]) -> tuple[Tensor, Tensor]:
    """Largest speed of each joint, and largest torque of gravity or of inertia there, (joint,).

    Of a free swing they all but cancel; each by itself tells what moves the joint.
    """
    speeds, torques = [], []
    for motion in motions:
        inside = _inside(motion.time)
        q, qd, qdd = (torch.as_tensor(x[inside]) for x in (motion.q, motion.qd, motion.qdd))
        weight = plant.gravity(q)
        speeds.append(qd)
        rest = plant.inverse_dynamics(q, torch.zeros_like(q), torch.zeros_like(q))
        torques += [weight, plant.inverse_dynamics(q, qd, qdd) - rest]
    return torch.cat(speeds).abs().amax(0), torch.cat(torques).abs().amax(0)


def _inside(time: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Samples away from a record's ends, (time,)."""
    return (time >= time[0] + EDGE) & (time <= time[-1] - EDGE)


def fit_torque(
    law: Law,
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    v_smooth: float = V_SMOOTH,
) -> TorqueFit:
    """Least squares of the friction torque, joint by joint.

    Linear least squares within bounds where the torque is linear in the coefficients; the others
    are searched over the law's candidates.

    Args:
        law: the law to fit.
        plant: the mechanism.
        recordings: in joint coordinates.
        motions: smoothed motion of each recording.
        v_smooth: velocity over which the sign turns [rad/s].

    Returns:
        Coefficients with what they leave unexplained.

    Raises:
        ValueError: if there are too few samples, or the law's torque is not finite along the
            motion.
    """
    parts = [friction_torque(plant, r, m) for r, m in zip(recordings, motions, strict=True)]
    qd, load, torque = (torch.cat(x) for x in zip(*parts, strict=True))
    if len(qd) <= len(law.coefficients):
        names = ", ".join(r.name or "a recording" for r in recordings)
        raise ValueError(
            f"{names}: too few samples, {len(qd)} are left {EDGE:g} s away from the ends for "
            f"{len(law.coefficients)} coefficients a joint; record for longer."
        )
    searched = [c.initial_grid for c in law.coefficients if not c.linear]
    candidates = [_linear_fit(law, qd, load, torque, v_smooth, dict(zip(
        (i for i, c in enumerate(law.coefficients) if not c.linear), values, strict=True)))
        for values in itertools.product(*searched)]  # fmt: skip
    residuals = torch.stack([c[1] for c in candidates])
    best = residuals.argmin(0)
    joints = range(qd.shape[1])
    return TorqueFit(
        torch.stack([candidates[int(best[j])][0][j] for j in joints]),
        residuals.amin(0),
        torque.square().mean(0).sqrt(),
    )


def natural_scale(
    model: FrictionModel,
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
) -> Tensor:
    """Size of each coefficient that alone would explain a third of the friction torque.

    Args:
        model: whose law's coefficients they are.
        plant, recordings, motions: see `fit_torque`.

    Returns:
        In SI, (joint, coefficient); zero where the torque is not linear in the coefficient.
    """
    torque = fit_torque(model.law, plant, recordings, motions, model.v_smooth).torque
    rms = torch.as_tensor(np.concatenate([m.qd for m in motions])).square().mean(0).sqrt()
    columns = []
    for c in model.law.coefficients:
        if not c.linear:
            columns.append(torch.zeros_like(rms))
        elif c.unit.endswith("s/rad"):
            columns.append(torque / rms / 3)
        else:
            columns.append(torque / 3)
    return torch.stack(columns, -1)


def prior_sd(law: Law, torque: TorqueFit) -> Tensor:
    """What a fit expects of each coefficient, as its law says: sd around zero, in SI.

    Args:
        law: whose coefficients they are.
        torque: its fit to the motion.

    Returns:
        (joint, coefficient); infinite where the law expects nothing.
    """
    shares = torque.torque.new_tensor([c.prior_scale for c in law.coefficients])
    # Of a light mechanism's torque most is what inertia terms and smoothing leave over.
    left = torque.torque.square() - torque.residual.square()
    told = torch.maximum(left.clamp_min(0.0).sqrt(), LEAST_TOLD * torque.torque).clamp_min(1e-9)
    return told[:, None] * shares


def _linear_fit(
    law: Law,
    qd: Tensor,
    load: Tensor,
    torque: Tensor,
    v_smooth: float,
    fixed: dict[int, float],
) -> tuple[Tensor, Tensor]:
    """Coefficients (joint, coefficient) and residual (joint,) with the nonlinear ones given."""
    from scipy.optimize import lsq_linear  # slow to import

    columns = []
    linear = [i for i, c in enumerate(law.coefficients) if c.linear]
    for i in linear:
        unit = torch.zeros(*qd.shape, len(law.coefficients), dtype=qd.dtype)
        unit[..., i] = 1.0
        for k, value in fixed.items():
            unit[..., k] = value
        columns.append(law.torque(qd, load, unit, v_smooth))
    design = torch.stack(columns, -1)
    for sample, joint, k in (~torch.isfinite(design)).nonzero()[:1].tolist():
        raise ValueError(
            f"law {law.name!r} gives {float(design[sample, joint, k]):g} where "
            f"{law.coefficients[linear[k]].name} is 1, at joint {joint + 1}, velocity "
            f"{float(qd[sample, joint]):g} and load {float(load[sample, joint]):g}; its torque "
            "must be a finite number."
        )
    lower = [0.0 if law.coefficients[i].positive else -np.inf for i in linear]
    coefficients = torch.zeros(qd.shape[1], len(law.coefficients), dtype=qd.dtype)
    for k, value in fixed.items():
        coefficients[:, k] = value
    residual = torch.zeros(qd.shape[1], dtype=qd.dtype)
    for joint in range(qd.shape[1]):
        a, y = design[:, joint].numpy(), torque[:, joint].numpy()
        # Columns of unit length: coefficients differ by orders of magnitude.
        scale = np.linalg.norm(a, axis=0)
        scale[scale == 0] = 1.0
        rows = np.concatenate([a / scale, RIDGE * np.eye(len(linear))])
        aim = np.concatenate([y, np.zeros(len(linear))])
        solution = lsq_linear(rows, aim, bounds=(lower, np.inf), tol=1e-12).x / scale
        coefficients[joint, linear] = torch.as_tensor(solution)
        residual[joint] = float(np.sqrt(np.mean((a @ solution - y) ** 2)))
    return coefficients, residual
