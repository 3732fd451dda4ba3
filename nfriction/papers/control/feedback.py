"""Control of pendulums by a driven arm: swing-up, LQR, Kalman filter, friction compensation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.friction.models import FrictionModel
from nfriction.plant import PendulumChain
from nfriction.simulation.rollout import rollout
from nfriction.simulation.validate import required_substeps

Array = NDArray[np.float64]
Compensation = Callable[[Array, Array, Array], Array]
"""Friction torque of every joint [N m] as a function of qd, qdd and load, all (*batch, joint)."""
# Weights of gaps in the planned motion and of the torque, both relative to their scales, such that
# the remaining gaps are far below an encoder count.
GAP, TORQUE = 300.0, 0.02
RATE_SCALE, TORQUE_SCALE = 5.0, 10.0  # [rad/s, N m]
CLOSED = 5e-4  # largest gap of an accepted plan, below the papers' encoder count [rad; 5 rad/s]


@dataclass(frozen=True, eq=False)
class LinearPlant:
    """A discrete-time plant near a motion: x[k + 1] = A x[k] + B dtau[k], x = (q - q0, qd - qd0).

    `acceleration` is that of the motion, (*batch, joint), and its derivatives by x and by tau,
    (*batch, joint, 2 joint) and (*batch, joint, joint).
    """

    a: Array  # (*batch, 2 joint, 2 joint)
    b: Array  # (*batch, 2 joint, joint)
    q0: Array  # of the motion [rad], (*batch, joint)
    qd0: Array  # [rad/s]
    acceleration: tuple[Array, Array, Array]

    def __getitem__(self, k: int) -> LinearPlant:
        qdd, by_state, by_tau = self.acceleration
        return LinearPlant(
            self.a[k], self.b[k], self.q0[k], self.qd0[k], (qdd[k], by_state[k], by_tau[k])
        )


def linearise(
    plant: PendulumChain, q: Tensor, qd: Tensor, tau: Tensor, sample_time: float
) -> LinearPlant:
    """The frictionless plant near a motion (*batch, joint), exactly discretised, torque held."""
    from scipy.linalg import expm  # slow to import

    n = plant.joints
    with torch.enable_grad():
        given = [x.detach().clone().requires_grad_() for x in (q, qd, tau)]
        qdd = plant.forward_dynamics(*given)
        rows = [torch.autograd.grad(qdd[..., k].sum(), given, retain_graph=True) for k in range(n)]
    by_q, by_qd, by_tau = (torch.stack(by, -2).numpy() for by in zip(*rows, strict=True))
    by_state = np.concatenate([by_q, by_qd], -1)
    flow = np.zeros((*q.shape[:-1], 3 * n, 3 * n))
    flow[..., :n, n : 2 * n] = np.eye(n)
    flow[..., n : 2 * n, : 2 * n] = by_state
    flow[..., n : 2 * n, 2 * n :] = by_tau
    sampled = expm(sample_time * flow)[..., : 2 * n, :]
    a, b = sampled[..., : 2 * n], sampled[..., 2 * n :]
    accelerations = qdd.detach().numpy(), by_state, by_tau
    return LinearPlant(a, b, q.numpy(), qd.numpy(), accelerations)


@dataclass(frozen=True, eq=False)
class Weights:
    """Weights of a linear-quadratic regulator and of its Kalman filter."""

    state: Array  # diagonal of Q in the cost sum x'Qx + tau_1^2, (2 joint,)
    torque_noise: float  # standard deviation per sample of unknown torques at every joint [N m]
    position_noise: float  # standard deviation of the encoders [rad]


@dataclass(frozen=True, eq=False)
class Gains:
    """Gains of feedback and of the Kalman filter at one sample."""

    linear: LinearPlant
    feedback: Array  # K of dtau_1 = -K x, (2 joint,)
    observer: Array  # L of x += L (q_measured - q_predicted), (2 joint, joint)
    torque: float = 0.0  # of the first joint without feedback [N m]


def balance_gains(linear: LinearPlant, weights: Weights) -> Gains:
    """Steady-state gains at an equilibrium, else ValueError; only the first joint has a drive."""
    from scipy.linalg import solve_discrete_are

    if np.abs(linear.acceleration[0]).max() > 1e-9:
        raise ValueError(f"the plant is not in equilibrium at {linear.q0.tolist()} rad.")
    n, b = len(linear.q0), linear.b[:, :1]
    p = solve_discrete_are(linear.a, b, np.diag(weights.state), np.eye(1))
    process, noise, c = _noise(linear, weights)
    # The small term keeps the equation regular.
    e = solve_discrete_are(linear.a.T, c.T, process + 1e-18 * np.eye(2 * n), noise)
    return Gains(linear, _feedback(linear, p), _observer(e, c, noise))


def gains_along(way: LinearPlant, torque: Array, top: LinearPlant, weights: Weights) -> list[Gains]:
    """Gains at every sample of a motion that starts at rest and ends at the equilibrium `top`.

    Riccati recursions, backward for the feedback, forward for the Kalman filter. `torque` is that
    of the first joint [N m], (sample,).
    """
    from scipy.linalg import solve_discrete_are

    p = solve_discrete_are(top.a, top.b[:, :1], np.diag(weights.state), np.eye(1))
    feedback, observer = [], []
    for k in reversed(range(len(torque))):
        at = way[k]
        feedback.append(_feedback(at, p))
        p = np.diag(weights.state) + at.a.T @ p @ (at.a - np.outer(at.b[:, 0], feedback[-1]))
        # Asymmetry from round-off would grow over thousands of samples.
        p = 0.5 * (p + p.T)
    e = weights.position_noise**2 * np.eye(len(p))
    for k in range(len(torque)):
        at = way[k]
        process, noise, c = _noise(at, weights)
        e = at.a @ e @ at.a.T + process
        observer.append(_observer(e, c, noise))
        e = e - observer[-1] @ c @ e
        e = 0.5 * (e + e.T)
    rows = zip(reversed(feedback), observer, torque.tolist(), strict=True)
    return [Gains(way[k], *row) for k, row in enumerate(rows)]


def _feedback(linear: LinearPlant, cost_to_go: NDArray[Any]) -> Array:
    b = linear.b[:, 0]
    return np.asarray(b @ cost_to_go @ linear.a / (b @ cost_to_go @ b + 1.0))


def _observer(covariance: NDArray[Any], c: Array, noise: Array) -> Array:
    of_error = c @ covariance @ c.T + noise
    return np.asarray(np.linalg.solve(of_error, c @ covariance).T)


def _noise(linear: LinearPlant, weights: Weights) -> tuple[Array, Array, Array]:
    """Covariances of process and encoder noise, and the measurement matrix."""
    n = len(linear.q0)
    process = weights.torque_noise**2 * linear.b @ linear.b.T
    return process, weights.position_noise**2 * np.eye(n), np.eye(n, 2 * n)


def still(_: float) -> tuple[float, float]:
    """Reference for an arm that should stay where it is."""
    return 0.0, 0.0


@dataclass(eq=False)
class Feedback:
    """Linear-quadratic feedback to an equilibrium, from a distance along a planned motion.

    A Kalman filter estimates the state from encoder positions; at the equilibrium the arm follows a
    reference. The torque is tau_1 = tau_plan - K (x - x_ref) + g tau_f, where tau_f is a model's
    friction torque at the estimated motion. Joints after the first have no drive, so their
    friction remains.

    Args:
        plant: the mechanism, whose first joint is driven.
        top: gains at the equilibrium.
        way: gains along the motion to it, one per sample; if empty, it starts at the equilibrium.
        reference: angle and velocity of the arm over time [rad, rad/s].
        compensation: gives the friction torque; None for no compensation.
        share: g, compensated fraction.
    """

    plant: PendulumChain
    top: Gains
    way: Sequence[Gains] = ()
    _: KW_ONLY
    reference: Callable[[float], tuple[float, float]] = still
    compensation: Compensation | None = None
    share: float = 1.0

    def __post_init__(self) -> None:
        self.sample = 0
        self.before: Gains | None = None
        self.state: Array = np.zeros(0)
        self.net: Array = np.zeros(0)

    def __call__(self, time: float, q: Array) -> Array:
        joints = self.plant.joints
        now = self.way[self.sample] if self.sample < len(self.way) else self.top
        linear = now.linear
        if self.before is None:
            self.state = np.concatenate([q - linear.q0, np.zeros_like(q)], -1)
        else:
            known = self.before.linear
            self.state = self.state @ known.a.T + self.net @ known.b.T
            error = q - linear.q0 - self.state[..., :joints]
            self.state = self.state + error @ now.observer.T
        self.sample, self.before = self.sample + 1, now
        wanted = np.zeros(2 * joints)
        wanted[0], wanted[joints] = self.reference(time)
        torque, self.net = np.zeros(q.shape), np.zeros(q.shape)
        feedback = -(self.state - wanted) @ now.feedback
        friction = np.zeros(q.shape[:-1])
        if self.compensation is not None:
            qd = linear.qd0 + self.state[..., joints:]
            planned, by_state, by_tau = linear.acceleration
            qdd = planned + self.state @ by_state.T + self.net @ by_tau.T
            load = self.plant.load(torch.as_tensor(q), torch.as_tensor(qd)).numpy()
            friction = self.compensation(qd, qdd, load)[..., 0]
        torque[..., 0] = now.torque + feedback + self.share * friction
        # Compensation cancels friction, so the filter predicts with the remainder.
        self.net[..., 0] = feedback + (self.share - 1.0) * friction
        return torque


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
