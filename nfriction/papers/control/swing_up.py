"""Swing-up of links using only the arm: a torque over time, found by multiple shooting."""

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

# Weights of gaps in the planned motion and of the torque, both relative to their scales, such that
# the remaining gaps are far below an encoder count.
GAP, TORQUE = 300.0, 0.02
RATE_SCALE, TORQUE_SCALE = 5.0, 10.0  # [rad/s, N m]
CLOSED = 5e-4  # largest gap of an accepted plan, below the papers' encoder count [rad; 5 rad/s]


@dataclass(frozen=True, eq=False)
class Plan:
    """A motion from hanging to upright."""

    q: Array  # at every sample except the last, which is upright and at rest [rad], (sample, joint)
    qd: Array  # at the same samples [rad/s]
    tau: Array  # of the first joint, held over each sample [N m], (sample,)


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
    """Find an arm torque that swings all links up from hanging to rest upright.

    Multiple shooting: the states between windows and the torque, linear over each window, are the
    unknowns of a nonlinear least-squares problem whose residuals are the gaps between windows and,
    with a small weight, the torque. The search starts from a straight line between the two poses.

    Args:
        plant: a chain on a free arm; only the arm has a drive.
        friction: assumed in the plan; None for none.
        torque_limit: of the plan [N m]; feedback needs the remaining torque of the drive.
        sample_time: time over which a torque is held [s].

    Raises:
        ValueError: if no such motion was found.

    References:
        T. Gluck, A. Eder and A. Kugi, Automatica 49 (2013) 801; `scipy.optimize.least_squares`.
    """
    from scipy.optimize import least_squares  # slow to import

    substeps = 1 if friction is None else required_substeps(plant, friction, sample_time)
    problem = _Shooting(plant, friction, windows, seconds, sample_time, substeps)
    line = np.linspace(0.0, 1.0, windows + 1)[1:-1, None]
    states = (1.0 - line) * problem.hanging / problem.scale
    most = torque_limit / TORQUE_SCALE
    sizes = [problem.inner, windows + 1]
    end = least_squares(
        problem.residuals, np.concatenate([states.ravel(), np.zeros(windows + 1)]), problem.slopes,
        bounds=(np.repeat([-np.inf, -most], sizes), np.repeat([np.inf, most], sizes)),
        max_nfev=max_steps,
    )  # fmt: skip
    gap = np.abs(end.fun[: windows * problem.size]).max() / GAP
    if gap > CLOSED:
        raise ValueError(
            f"no swing-up within {seconds:g} s and {torque_limit:g} N m was found: a gap of "
            f"{gap:.2g} remained; take more time or torque."
        )
    nodes, torque = problem.split(end.x)
    motion, tau = problem.moved(nodes[:-1], torque[:-1], torque[1:])
    q, qd = np.split(motion[:, :-1].reshape(-1, problem.size), 2, -1)
    return Plan(q, qd, tau.ravel())


@dataclass(frozen=True, eq=False)
class _Shooting:
    """Residuals of a plan and their derivatives by x: states between windows, then torques."""

    plant: PendulumChain
    friction: FrictionModel | None
    windows: int
    seconds: float
    sample_time: float
    substeps: int

    @property
    def size(self) -> int:
        return 2 * self.plant.joints

    @property
    def inner(self) -> int:
        """Number of entries of x that are states."""
        return (self.windows - 1) * self.size

    @property
    def scale(self) -> Array:
        return np.repeat([1.0, RATE_SCALE], self.plant.joints)

    @property
    def hanging(self) -> Array:
        return math.pi * np.eye(self.size)[1]

    @property
    def effort(self) -> float:
        return TORQUE * math.sqrt(self.seconds / self.windows)

    def split(self, x: Array) -> tuple[Array, Array]:
        """States at both ends of every window, and torques there."""
        nodes = x[: self.inner].reshape(-1, self.size) * self.scale
        return np.vstack([self.hanging, nodes, np.zeros(self.size)]), TORQUE_SCALE * x[self.inner :]

    def moved(self, states: Array, first: Array, last: Array) -> tuple[Array, Array]:
        """States of windows (window, step + 1, state), and their torques (window, step)."""
        joints, steps = self.plant.joints, round(self.seconds / self.sample_time / self.windows)
        middle = (np.arange(steps) + 0.5) / steps
        tau = first[:, None] * (1.0 - middle) + last[:, None] * middle
        driven = torch.zeros(*tau.shape, joints, dtype=torch.float64)
        driven[..., 0] = torch.as_tensor(tau)
        q0, qd0 = torch.as_tensor(states).split(joints, -1)
        run = rollout(
            self.plant, self.friction, q0, qd0, driven,
            sample_time=self.sample_time, substeps=self.substeps,
        )  # fmt: skip
        return torch.cat([run.q, run.qd], -1).numpy(), tau

    def residuals(self, x: Array) -> Array:
        """Gaps between windows, and torques."""
        nodes, torque = self.split(x)
        ends = self.moved(nodes[:-1], torque[:-1], torque[1:])[0][:, -1]
        # A window that diverges is a large gap.
        gaps = np.nan_to_num((nodes[1:] - ends) / self.scale, nan=1e3)
        return np.concatenate([GAP * gaps.ravel(), self.effort * x[self.inner :]])

    def slopes(self, x: Array) -> Array:
        """Derivatives of the residuals by x, one row per residual."""
        size, windows, inner = self.size, self.windows, self.inner
        nodes, tau = self.split(x)[0][:-1] / self.scale, x[inner:, None]
        given = np.concatenate([nodes, tau[:-1], tau[1:]], -1)
        units = np.concatenate([self.scale, [TORQUE_SCALE, TORQUE_SCALE]])
        # Central differences of every window by all of its variables, in one batch.
        shift = 1e-6 * np.concatenate([np.eye(size + 2), -np.eye(size + 2)])
        near = (given + shift[:, None]).reshape(-1, size + 2) * units
        ends = self.moved(near[:, :size], near[:, size], near[:, size + 1])[0][:, -1] / self.scale
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
        found[windows * size :, inner:] = self.effort * np.eye(windows + 1)
        return found
