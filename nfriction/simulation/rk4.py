"""Runge-Kutta steps in eager torch, and how steep friction they can take."""

import torch
from torch import Tensor
from tqdm import tqdm

from nfriction.simulation.protocols import Friction, Plant, remembering

# RK4 is stable on the real axis down to h * lambda = -2.785.
RK4_STABILITY = 2.785


def stability_limit(plant: Plant, sample_time: float) -> Tensor:
    """Largest slope of friction over velocity that RK4 integrates stably [N m s/rad], (joint,).

    References:
        RK4's real stability bound over the plant's mobility.
    """
    return RK4_STABILITY / (sample_time * plant.max_inverse_inertia())


def required_substeps(plant: Plant, friction: Friction, sample_time: float) -> int:
    """Integration steps a sample that keep the friction's slope at rest stable."""
    excess = friction.zero_velocity_damping() / stability_limit(plant, sample_time)
    return max(1, int(torch.ceil(excess.max() * (1 - 1e-9))))


def acceleration(
    plant: Plant, friction: Friction, q: Tensor, qd: Tensor, tau: Tensor, coefficients: Tensor
) -> Tensor:
    """Joint acceleration with friction whose coefficients are given [rad/s^2], (*batch, joint)."""
    tau_f = friction.torque(qd, plant.load(q, qd), coefficients)
    return plant.forward_dynamics(q, qd, tau - tau_f)


def rk4_step(
    plant: Plant,
    friction: Friction | None,
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    coefficients: Tensor | None,
    step: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor]:
    """One Runge-Kutta step of fourth order with coefficients and torque held.

    Args:
        plant: the mechanism.
        friction: friction model, or None.
        q, qd: state at the start of the step, (*batch, joint).
        tau: torque over the step, (*batch, joint).
        coefficients: held coefficients (*batch, joint, coefficient); None re-evaluates nothing
            and needs `friction=None`.
        step: step length [s], a number or (*batch, 1).

    Returns:
        q and qd at the end of the step, qdd at its start.
    """

    def rate(q: Tensor, qd: Tensor) -> Tensor:
        if friction is None or coefficients is None:
            return plant.forward_dynamics(q, qd, tau)
        return acceleration(plant, friction, q, qd, tau, coefficients)

    half = 0.5 * step
    a1 = rate(q, qd)
    v2 = qd + half * a1
    a2 = rate(q + half * qd, v2)
    v3 = qd + half * a2
    a3 = rate(q + half * v2, v3)
    v4 = qd + step * a3
    a4 = rate(q + step * v3, v4)
    sixth = step / 6.0
    return (
        q + sixth * (qd + 2.0 * (v2 + v3) + v4),
        qd + sixth * (a1 + 2.0 * (a2 + a3) + a4),
        a1,
    )


def stepped(
    plant: Plant,
    friction: Friction | None,
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    step: Tensor,
    substeps: int,
    measured: tuple[Tensor, Tensor] | None,
    first: Tensor | None,
    progress: bool,
) -> tuple[Tensor, ...]:
    """States at every sample in eager torch: q, qd, qdd, each (*batch, steps + 1, joint)."""
    inner = step / substeps
    qdd = plant.forward_dynamics(q, qd, tau[..., 0, :])
    states = [(q, qd, qdd)]
    memorising = remembering(friction)
    memory: Tensor | None = None
    held: Tensor | None = None
    for k in tqdm(range(step.shape[-1]), disable=not progress, unit="step", leave=False):
        driven = None if measured is None else (measured[0][..., k, :], measured[1][..., k, :])
        if memorising is not None:
            seen = driven or (qd, qdd)
            if memory is not None:
                memory = memorising.advance(*seen, memory)
            else:
                memory = memorising.initial_state(*seen) if first is None else first
            held = memorising.coefficients_from(*seen, memory)
        for _ in range(substeps):
            if friction is not None and memorising is None:
                held = friction.coefficients(*(driven or (qd, qdd)))
            q, qd, qdd = rk4_step(plant, friction, q, qd, tau[..., k, :], held, inner[..., k, None])
        states.append((q, qd, qdd))
    shape = states[-1][0].shape
    return tuple(
        torch.stack([x.expand(shape) for x in one], -2) for one in zip(*states, strict=True)
    )
