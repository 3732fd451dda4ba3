"""Runge-Kutta steps in torch, and the largest friction slope over velocity that they integrate."""

from collections.abc import Callable

import torch
from torch import Tensor
from tqdm import tqdm

from nfriction.simulation.protocols import Friction, Plant, RolloutInputs, as_stateful

# RK4 is stable on the negative real axis down to h * lambda = -2.785.
RK4_STABILITY = 2.785


def required_substeps(plant: Plant, friction: Friction, sample_time: float) -> int:
    """Integration steps per sample that keep friction stable where it is steepest, at rest.

    Linearised there, friction damps each joint: M(q) d(qd)/dt = -D qd. Its fastest mode decays at
    the largest eigenvalue of M^-1 D, over all poses, which a step must resolve.
    """
    rate = plant.decay_rate(friction.zero_velocity_damping())
    return max(1, int(torch.ceil(rate.max() * (sample_time / RK4_STABILITY * (1 - 1e-9)))))


def acceleration(
    plant: Plant,
    friction: Friction | None,
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    coefficients: Tensor | None,
) -> Tensor:
    """Joint acceleration with friction whose coefficients are given [rad/s^2], (*batch, joint)."""
    if friction is not None and coefficients is not None:
        tau = tau - friction.torque(qd, plant.load(q, qd), coefficients)
    return plant.forward_dynamics(q, qd, tau)


def runge_kutta(
    rate: Callable[[Tensor, Tensor], Tensor], q: Tensor, qd: Tensor, step: Tensor | float
) -> tuple[Tensor, Tensor, Tensor]:
    """One classical Runge-Kutta step of q'' = rate(q, q'): q and qd after it, q'' at its start."""
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
        coefficients: held over the step, (*batch, joint, coefficient); None without friction.
        step: step length [s], a number or (*batch, 1).

    Returns:
        q and qd at the end of the step, qdd at its start.
    """
    return runge_kutta(
        lambda q, qd: acceleration(plant, friction, q, qd, tau, coefficients), q, qd, step
    )


StepFunction = Callable[..., tuple[Tensor, Tensor, Tensor]]
"""Of the arguments of `rk4_step`, in that order."""


def simulate_eager(
    plant: Plant,
    friction: Friction | None,
    inputs: RolloutInputs,
    progress: bool = False,
    step_function: StepFunction = rk4_step,
) -> tuple[Tensor, ...]:
    """States at every sample in eager torch: q, qd, qdd, each (*batch, steps + 1, joint)."""
    q, qd, tau = inputs.q0, inputs.qd0, inputs.tau
    inner = inputs.step / inputs.substeps
    # Nothing is known of friction before the first step, so that acceleration leaves it out.
    qdd = plant.forward_dynamics(q, qd, tau[..., 0, :])
    states = [(q, qd, qdd)]
    stateful = as_stateful(friction)
    hidden: Tensor | None = None
    held: Tensor | None = None
    for k in tqdm(range(inner.shape[-1]), disable=not progress, unit="step", leave=False):
        measured = None
        if inputs.measured is not None:
            measured = inputs.measured[0][..., k, :], inputs.measured[1][..., k, :]
        if stateful is not None:
            driven = measured or (qd, qdd)
            if hidden is not None:
                hidden = stateful.advance(*driven, hidden)
            elif inputs.hidden_state is not None:
                hidden = inputs.hidden_state
            else:
                hidden = stateful.initial_state(*driven)
            held = stateful.coefficients_from(*driven, hidden)
        for _ in range(inputs.substeps):
            if friction is not None and stateful is None:
                held = friction.coefficients(*(measured or (qd, qdd)))
            given = (q, qd, tau[..., k, :], held, inner[..., k, None])
            q, qd, qdd = step_function(plant, friction, *given)
        states.append((q, qd, qdd))
    shape = states[-1][0].shape
    return tuple(
        torch.stack([x.expand(shape) for x in one], -2) for one in zip(*states, strict=True)
    )
