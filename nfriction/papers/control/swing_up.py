"""Swing-up of links by the arm alone: a torque over time, found by multiple shooting."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from nfriction.friction.models import FrictionModel
from nfriction.plant import PendulumChain
from nfriction.simulation.rollout import rollout
from nfriction.simulation.validate import required_substeps

Array = NDArray[np.float64]

# A gap of the planned motion costs this much more than a torque of the same size relative to its
# scale, so that what remains of the gaps is far below an encoder count.
GAP, TORQUE = 300.0, 0.02
RATE_SCALE, TORQUE_SCALE = 5.0, 10.0  # [rad/s, N m]
CLOSED = 5e-4  # largest gap of a found plan, below the papers' encoder count [rad; 5 rad/s]


@dataclass(frozen=True, eq=False)
class Plan:
    """A motion from hanging to upright.

    Attributes:
        q, qd: at every sample but the last, which is upright and at rest [rad, rad/s],
            (sample, joint).
        tau: of the first joint, held over each sample [N m], (sample,).
    """

    q: Array
    qd: Array
    tau: Array


def plan_swing_up(
    plant: PendulumChain,
    friction: FrictionModel | None,
    *,
    seconds: float = 5.0,
    windows: int = 25,
    torque_limit: float = 14.0,
    sample_time: float = 1e-3,
    max_steps: int = 400,
) -> Plan:
    """Find a torque of the arm that lifts all links from hanging to rest upright.

    Multiple shooting: the states between windows and the torque, linear over each window, are the
    unknowns of a nonlinear least-squares problem whose residuals are the gaps between windows and,
    with a small weight, the torque. The search starts from a straight line between the two poses.

    Args:
        plant: a chain on a free arm, which alone has a drive.
        friction: of the plan; None for none.
        seconds: length of the motion.
        windows: it is divided into.
        torque_limit: of the plan [N m]; feedback needs the rest of what the drive has.
        sample_time: over which a torque is held [s].
        max_steps: of the solver.

    Raises:
        ValueError: if no such motion was found.

    References:
        T. Gluck, A. Eder and A. Kugi, Automatica 49 (2013) 801; `scipy.optimize.least_squares`.
    """
    from scipy.optimize import least_squares  # slow to import

    joints, size = plant.joints, 2 * plant.joints
    steps = round(seconds / sample_time / windows)
    hanging, upright = np.zeros(size), np.zeros(size)
    hanging[1] = math.pi
    scale = np.repeat([1.0, RATE_SCALE], joints)
    inner = (windows - 1) * size
    middle = (np.arange(steps) + 0.5) / steps
    effort = TORQUE * math.sqrt(seconds / windows)
    substeps = 1 if friction is None else required_substeps(plant, friction, sample_time)

    def moved(states: Array, first: Array, last: Array) -> tuple[Array, Array]:
        """States of windows (window, step + 1, state), and their torques (window, step)."""
        tau = first[:, None] * (1.0 - middle) + last[:, None] * middle
        driven = torch.zeros(*tau.shape, joints, dtype=torch.float64)
        driven[..., 0] = torch.as_tensor(tau)
        q0, qd0 = torch.as_tensor(states).split(joints, -1)
        run = rollout(plant, friction, q0, qd0, driven, sample_time=sample_time, substeps=substeps)
        return torch.cat([run.q, run.qd], -1).numpy(), tau

    def split(x: Array) -> tuple[Array, Array]:
        nodes = np.vstack([hanging, x[:inner].reshape(-1, size) * scale, upright])
        return nodes, TORQUE_SCALE * x[inner:]

    def residuals(x: Array) -> Array:
        nodes, torque = split(x)
        ends = moved(nodes[:-1], torque[:-1], torque[1:])[0][:, -1]
        # A window that diverges is a large gap.
        gaps = np.nan_to_num((nodes[1:] - ends) / scale, nan=1e3)
        return np.concatenate([GAP * gaps.ravel(), effort * x[inner:]])

    def slopes(x: Array) -> Array:
        nodes, _ = split(x)
        given = np.concatenate([nodes[:-1] / scale, x[inner:-1, None], x[inner + 1 :, None]], -1)
        units = np.concatenate([scale, [TORQUE_SCALE, TORQUE_SCALE]])
        # Central differences of every window by all that it depends on, in one batch.
        shift = 1e-6 * np.concatenate([np.eye(size + 2), -np.eye(size + 2)])
        near = (given + shift[:, None]).reshape(-1, size + 2) * units
        ends = moved(near[:, :size], near[:, size], near[:, size + 1])[0][:, -1] / scale
        ahead, behind = np.nan_to_num(ends).reshape(2, size + 2, windows, size)
        change = ((ahead - behind) / 2e-6).transpose(1, 2, 0)
        found = np.zeros((windows * size + windows + 1, len(x)))
        for k in range(windows):
            rows = slice(k * size, (k + 1) * size)
            if k > 0:
                found[rows, (k - 1) * size : k * size] = -GAP * change[k, :, :size]
            if k < windows - 1:
                found[rows, k * size : (k + 1) * size] = GAP * np.eye(size)
            found[rows, inner + k : inner + k + 2] = -GAP * change[k, :, size:]
        found[windows * size :, inner:] = effort * np.eye(windows + 1)
        return found

    line = np.linspace(0.0, 1.0, windows + 1)[1:-1, None]
    states = (1.0 - line) * hanging / scale
    most = torque_limit / TORQUE_SCALE
    end = least_squares(
        residuals, np.concatenate([states.ravel(), np.zeros(windows + 1)]), slopes,
        bounds=(np.repeat([-np.inf, -most], [inner, windows + 1]),
                np.repeat([np.inf, most], [inner, windows + 1])),
        max_nfev=max_steps,
    )  # fmt: skip
    gap = np.abs(end.fun[: windows * size]).max() / GAP
    if gap > CLOSED:
        raise ValueError(
            f"no swing-up within {seconds:g} s and {torque_limit:g} N m was found: a gap of "
            f"{gap:.2g} remained; take more time or torque."
        )
    nodes, torque = split(end.x)
    motion, tau = moved(nodes[:-1], torque[:-1], torque[1:])
    q, qd = np.split(motion[:, :-1].reshape(-1, size), 2, -1)
    return Plan(q, qd, tau.ravel())
