"""State feedback for pendulums on a driven arm: LQR, Kalman filter, friction compensation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.plant import PendulumChain

Array = NDArray[np.float64]
Compensation = Callable[[Array, Array, Array], Array]
"""Friction torque of every joint [N m] as a function of qd, qdd and load, all (*batch, joint)."""


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
