"""State feedback for pendulums on a driven arm: LQR, Kalman filter, swing-up, compensation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.plant import PendulumChain

Array = NDArray[np.float64]
Compensation = Callable[[Array, Array, Array], Array]
"""Friction torque of every joint [N m] at qd, qdd and load, all (*batch, joint)."""


@dataclass(frozen=True, eq=False)
class LinearPlant:
    """A plant near an equilibrium, sampled: x[k + 1] = A x[k] + B tau[k], x = (q - q0, qd).

    Attributes:
        a: (2 joint, 2 joint).
        b: (2 joint, joint).
        q0: the equilibrium [rad], (joint,).
        acceleration: slopes of qdd by x and by tau, (joint, 2 joint) and (joint, joint).
    """

    a: Array
    b: Array
    q0: Array
    acceleration: tuple[Array, Array]


def linearise(plant: PendulumChain, q0: Tensor, sample_time: float) -> LinearPlant:
    """The plant without friction near an equilibrium, exactly discretised with the torque held.

    Args:
        plant: the mechanism.
        q0: equilibrium [rad], (joint,).
        sample_time: [s].

    Raises:
        ValueError: if the plant does not stay there at rest.
    """
    from scipy.linalg import expm  # slow to import

    n, still = plant.joints, torch.zeros_like(q0)
    if plant.forward_dynamics(q0, still, still).abs().max() > 1e-9:
        raise ValueError(f"the plant is not in equilibrium at {q0.tolist()} rad.")
    by_q, by_qd, by_tau = torch.autograd.functional.jacobian(
        lambda *given: plant.forward_dynamics(*given), (q0, still, still)
    )
    by_state = torch.cat([by_q, by_qd], -1).numpy()
    flow = np.zeros((3 * n, 3 * n))
    flow[:n, n : 2 * n] = np.eye(n)
    flow[n : 2 * n, : 2 * n] = by_state
    flow[n : 2 * n, 2 * n :] = by_tau.numpy()
    sampled = expm(sample_time * flow)
    return LinearPlant(
        sampled[: 2 * n, : 2 * n],
        sampled[: 2 * n, 2 * n :],
        q0.numpy(),
        (by_state, by_tau.numpy()),
    )


def lqr(plant: LinearPlant, state_weight: Array, torque_weight: float) -> Array:
    """Gain K of tau_1 = -K x, the only torque, that minimises sum x'Qx + r tau_1^2.

    Args:
        plant: sampled.
        state_weight: diagonal of Q, (2 joint,).
        torque_weight: r.

    References:
        Discrete algebraic Riccati equation (`scipy.linalg.solve_discrete_are`).
    """
    from scipy.linalg import solve_discrete_are

    b = plant.b[:, :1]
    p = solve_discrete_are(plant.a, b, np.diag(state_weight), np.array([[torque_weight]]))
    gain = np.linalg.solve(b.T @ p @ b + torque_weight, b.T @ p @ plant.a)
    return np.asarray(gain[0], dtype=np.float64)


def kalman_gain(plant: LinearPlant, torque_noise: float, position_noise: float) -> Array:
    """Steady gain L of x += L (q_measured - q_predicted), (2 joint, joint).

    Args:
        plant: sampled.
        torque_noise: standard deviation of unknown torques at every joint, a sample each [N m].
        position_noise: of the encoders [rad].
    """
    from scipy.linalg import solve_discrete_are

    n = len(plant.q0)
    c = np.hstack([np.eye(n), np.zeros((n, n))])
    process = torque_noise**2 * plant.b @ plant.b.T + 1e-18 * np.eye(2 * n)
    noise = position_noise**2 * np.eye(n)
    p = solve_discrete_are(plant.a.T, c.T, process, noise)
    return np.asarray(np.linalg.solve(c @ p @ c.T + noise, c @ p).T, dtype=np.float64)


class Balance:
    """Linear-quadratic balance about an equilibrium, with friction compensation at the driven arm.

    A Kalman filter estimates the state from encoder positions; the arm follows a reference. The
    torque is tau_1 = -K (x - x_ref) + g tau_f, with the friction torque tau_f that a model gives
    at the estimated motion. Joints after the first have no drive, so their friction stays.

    Args:
        plant: the mechanism, its first joint driven.
        linear: the same near the equilibrium.
        gain: K, see `lqr`.
        observer: L, see `kalman_gain`.
        reference: angle of the arm and its rate over time [rad, rad/s].
        compensation: gives the friction torque; None for none.
        share: g, a number or (*batch,).
    """

    def __init__(
        self,
        plant: PendulumChain,
        linear: LinearPlant,
        gain: Array,
        observer: Array,
        reference: Callable[[float], tuple[float, float]] = lambda _: (0.0, 0.0),
        compensation: Compensation | None = None,
        share: float | Array = 1.0,
    ) -> None:
        self.plant, self.linear, self.gain, self.observer = plant, linear, gain, observer
        self.reference, self.compensation = reference, compensation
        self.share = np.asarray(share, dtype=np.float64)
        self.state: Array | None = None
        self.net: Array = np.zeros(0)

    def __call__(self, time: float, q: Array) -> Array:
        linear, joints = self.linear, self.plant.joints
        if self.state is None:
            self.state = np.concatenate([q - linear.q0, np.zeros_like(q)], -1)
            self.net = np.zeros(q.shape)
        else:
            self.state = self.state @ linear.a.T + self.net @ linear.b.T
            error = q - linear.q0 - self.state[..., :joints]
            self.state = self.state + error @ self.observer.T
        angle, rate = self.reference(time)
        wanted = np.zeros(2 * joints)
        wanted[0], wanted[joints] = angle, rate
        feedback = -(self.state - wanted) @ self.gain
        friction = np.zeros(q.shape[:-1])
        if self.compensation is not None:
            qd = self.state[..., joints:]
            by_state, by_tau = linear.acceleration
            qdd = self.state @ by_state.T + self.net @ by_tau.T
            load = self.plant.load(torch.as_tensor(q), torch.as_tensor(qd)).numpy()
            friction = self.compensation(qd, qdd, load)[..., 0]
        torque = np.zeros(q.shape)
        torque[..., 0] = feedback + self.share * friction
        # Compensation is there to cancel friction: the filter predicts what is left.
        self.net = torque.copy()
        self.net[..., 0] = feedback + (self.share - 1.0) * friction
        return torque


class SwingUp:
    """Energy swing-up of a single link on a driven arm, then balance.

    The arm's acceleration pumps energy into the link, k (E_top - E) along the sign of the pumping
    rate, and pulls the arm back to its middle; the torque follows from the equation of motion.
    Within `catch` of the top and slow enough it is `Balance`'s, for good.

    Args:
        balance: takes over at the top; its friction compensation is used below as well.
        pump: k [rad/s^2/J].
        most: largest acceleration of the arm [rad/s^2].
        catch: distance from the top [rad] at which `balance` takes over.
        sample_time: [s].

    References:
        K. J. Astrom and K. Furuta, Automatica 36 (2000) 287.
    """

    def __init__(
        self,
        balance: Balance,
        *,
        pump: float = 100.0,
        most: float = 12.0,
        catch: float = 0.3,
        sample_time: float = 1e-3,
    ) -> None:
        if balance.plant.joints != 2:
            raise ValueError(f"one link on an arm is swung up, got {balance.plant.joints} joints.")
        self.balance, self.pump, self.most, self.catch = balance, pump, most, catch
        self.sample_time = sample_time
        self.caught = False
        self.before: Array | None = None
        self.qd = np.zeros(2)

    def __call__(self, time: float, q: Array) -> Array:
        if self.before is not None:
            # A low pass of 20 samples over the encoders' differences.
            self.qd = self.qd + 0.05 * ((q - self.before) / self.sample_time - self.qd)
        self.before = q
        from_top = np.angle(np.exp(1j * q[1]))
        if self.caught or (abs(from_top) < self.catch and abs(self.qd[1]) < 3.0):
            if not self.caught:
                self.caught = True
                turned = np.array([0.0, q[1] - from_top])
                self.turned = turned
                start = q - turned
                self.balance.state = np.concatenate([start, self.qd])
                self.balance.net = np.zeros(2)
            return self.balance(time, q - self.turned)
        return self._pumped(q)

    def _pumped(self, q: Array) -> Array:
        plant, qd = self.balance.plant, self.qd
        given, rate = torch.as_tensor(q), torch.as_tensor(qd)
        mass = plant.mass_matrix(given).numpy()
        bias = plant.bias(given, rate).numpy()
        still = torch.zeros_like(rate)
        top = float(plant.energy(still, still)[1])
        # Energy of the link about its joint alone: the arm's is not what lifts it.
        energy = 0.5 * mass[1, 1] * qd[1] ** 2 + float(plant.energy(given, still)[1])
        rise = -mass[0, 1] * qd[1]  # of the energy by the arm's acceleration
        # At rest at the bottom nothing would ever move.
        along = np.sign(rise) if abs(rise) > 1e-6 else 1.0
        wanted = np.clip(self.pump * (top - energy), 0.0, self.most) * along
        wanted = np.clip(wanted - 4.0 * q[0] - 2.0 * qd[0], -self.most, self.most)
        link = -(bias[1] + mass[1, 0] * wanted) / mass[1, 1]
        torque = np.zeros(2)
        torque[0] = mass[0, 0] * wanted + mass[0, 1] * link + bias[0]
        if self.balance.compensation is not None:
            load = plant.load(given, rate).numpy()
            friction = self.balance.compensation(qd, np.array([wanted, link]), load)
            torque[0] += float(self.balance.share) * friction[0]
        return torque
