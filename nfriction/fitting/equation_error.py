"""Equation error: constant coefficients by regression on the torque that a motion implies."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.friction.laws import Law
from nfriction.friction.models import V_SMOOTH, FrictionModel
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion


@dataclass(frozen=True)
class TorqueFit:
    """Constant coefficients from a regression on torques.

    Attributes:
        coefficients: (joint, coefficient), in SI.
        residual: root mean square of the unexplained torque, (joint,) [N m].
        torque: root mean square of the friction torque, (joint,) [N m].
    """

    coefficients: Tensor
    residual: Tensor
    torque: Tensor


def friction_torque(
    plant: Plant, recording: Recording, motion: Motion, options: FitOptions = DEFAULTS
) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity, load and friction torque along a recording, each (sample, joint).

    `tau_f = tau - inverse_dynamics(q, qd, qdd)` in joint coordinates, without the ends of the
    record.
    """
    inside = _inside(motion.time, options.edge)
    q, qd, qdd = (torch.as_tensor(x[inside]) for x in (motion.q, motion.qd, motion.qdd))
    tau = np.zeros_like(recording.q) if recording.tau is None else recording.tau
    friction = torch.as_tensor(tau[inside]) - plant.inverse_dynamics(q, qd, qdd)
    return qd, plant.load(q, qd), friction


def peak_dynamics_torque(
    plant: Plant, motions: Sequence[Motion], options: FitOptions = DEFAULTS
) -> tuple[Tensor, Tensor]:
    """Largest speed of each joint, and its largest torque of gravity or of inertia, (joint,).

    Each of the two alone, as in a free swing they all but cancel.
    """
    speeds, torques = [], []
    for motion in motions:
        inside = _inside(motion.time, options.edge)
        q, qd, qdd = (torch.as_tensor(x[inside]) for x in (motion.q, motion.qd, motion.qdd))
        rest = plant.inverse_dynamics(q, torch.zeros_like(q), torch.zeros_like(q))
        speeds.append(qd)
        torques += [plant.gravity(q), plant.inverse_dynamics(q, qd, qdd) - rest]
    return torch.cat(speeds).abs().amax(0), torch.cat(torques).abs().amax(0)


def _inside(time: NDArray[np.float64], edge: float) -> NDArray[np.bool_]:
    return (time >= time[0] + edge) & (time <= time[-1] - edge)


def fit_torque(
    law: Law,
    plant: Plant,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    v_smooth: float = V_SMOOTH,
    options: FitOptions = DEFAULTS,
) -> TorqueFit:
    """Least squares of the friction torque, joint by joint.

    Linear least squares within bounds where the torque is linear in the coefficients, for every
    combination of the law's initial values of the others. Recordings and motions are in joint
    coordinates.

    Raises:
        ValueError: if there are too few samples, or the law's torque is not finite along the
        motion.
    """
    parts = [
        friction_torque(plant, r, m, options) for r, m in zip(recordings, motions, strict=True)
    ]
    qd, load, torque = (torch.cat(x) for x in zip(*parts, strict=True))
    if len(qd) <= len(law.coefficients):
        names = ", ".join(r.name or "a recording" for r in recordings)
        raise ValueError(
            f"{names}: too few samples, {len(qd)} are left {options.edge:g} s away from the ends "
            f"for {len(law.coefficients)} coefficients a joint; record for longer."
        )
    nonlinear = {i: c.initial_grid for i, c in enumerate(law.coefficients) if not c.linear}
    candidates = []
    for values in itertools.product(*nonlinear.values()):
        fixed = dict(zip(nonlinear, values, strict=True))
        design = _design(law, qd, load, v_smooth, fixed)
        candidates.append(_linear_fit(law, design, torque, fixed, options.ridge))
    coefficients, residuals = (torch.stack(x) for x in zip(*candidates, strict=True))
    best = residuals.argmin(0)
    return TorqueFit(
        coefficients[best, torch.arange(len(best))],
        residuals.amin(0),
        torque.square().mean(0).sqrt(),
    )


def _design(law: Law, qd: Tensor, load: Tensor, v_smooth: float, fixed: dict[int, float]) -> Tensor:
    """Torque per unit of each linear coefficient, (sample, joint, coefficient)."""
    linear = [i for i, c in enumerate(law.coefficients) if c.linear]
    columns = []
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
    return design


def _linear_fit(
    law: Law, design: Tensor, torque: Tensor, fixed: dict[int, float], ridge: float
) -> tuple[Tensor, Tensor]:
    """Coefficients (joint, coefficient) and residual (joint,), the nonlinear ones given."""
    from scipy.optimize import lsq_linear  # slow to import

    linear = [i for i, c in enumerate(law.coefficients) if c.linear]
    lower = [0.0 if law.coefficients[i].positive else -np.inf for i in linear]
    joints = torque.shape[1]
    coefficients = torch.zeros(joints, len(law.coefficients), dtype=torque.dtype)
    for k, value in fixed.items():
        coefficients[:, k] = value
    residual = torch.zeros(joints, dtype=torque.dtype)
    for joint in range(joints):
        a, y = design[:, joint].numpy(), torque[:, joint].numpy()
        # Columns of unit length, as coefficients differ by orders of magnitude.
        scale = np.linalg.norm(a, axis=0)
        scale[scale == 0] = 1.0
        rows = np.concatenate([a / scale, ridge * np.eye(len(linear))])
        target = np.concatenate([y, np.zeros(len(linear))])
        solution = lsq_linear(rows, target, bounds=(lower, np.inf), tol=1e-12).x / scale
        coefficients[joint, linear] = torch.as_tensor(solution)
        residual[joint] = float(np.sqrt(np.mean((a @ solution - y) ** 2)))
    return coefficients, residual


def coefficient_scale(
    model: FrictionModel, plant: Plant, recordings: Sequence[Recording], motions: Sequence[Motion]
) -> Tensor:
    """Size of each coefficient that alone would explain a third of the friction torque, in SI.

    Shape (joint, coefficient); zero where the torque is not linear in the coefficient.
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


def prior_sd(law: Law, torque: TorqueFit, options: FitOptions = DEFAULTS) -> Tensor:
    """Standard deviation of the law's zero-mean priors in SI, (joint, coefficient).

    Infinite without a prior; the torque that the law explains is the scale.
    """
    shares = torch.tensor([c.prior_scale for c in law.coefficients], dtype=torque.torque.dtype)
    # On a light mechanism most of the torque is an error of inertia terms and smoothing.
    explained = (torque.torque.square() - torque.residual.square()).clamp_min(0.0).sqrt()
    explained = torch.maximum(explained, options.min_explained * torque.torque)
    return explained.clamp_min(1e-9)[:, None] * shares
