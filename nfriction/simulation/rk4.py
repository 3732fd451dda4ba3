"""One Runge-Kutta step of a mechanism with friction, and the steps over a whole motion in torch.

A step integrates

    qdd = M(q)^-1 (tau - tau_f - bias(q, qd)),    tau_f = f(qd, load(q, qd), c),

which the plant solves for qdd (`forward_dynamics`), with the coefficients c of the friction law f
and the torque tau held over the step. Near rest friction is steep, with a slope F_c / v_smooth,
which limits the length of a step. The next step is `nfriction.simulation.rollout`, which checks the
inputs and chooses between these steps and compiled ones.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from nfriction.codegen.rollout import SPEED_LIMIT
from nfriction.simulation.protocols import Friction, Plant, RolloutInputs, StepFunction, as_stateful


def acceleration(
    plant: Plant, friction: Friction, q: Tensor, qd: Tensor, tau: Tensor, coefficients: Tensor
) -> Tensor:
    """Joint acceleration for given coefficients of friction [rad/s^2], (*batch, joint)."""
    tau_f = friction.torque(qd, plant.load(q, qd), coefficients)
    return plant.forward_dynamics(q, qd, tau - tau_f)


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
    after = q + sixth * (qd + 2.0 * (v2 + v3) + v4)
    return after, qd + sixth * (a1 + 2.0 * (a2 + a3) + a4), a1


def rk4_step(
    plant: Plant,
    friction: Friction,
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    coefficients: Tensor,
    step: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor]:
    """One Runge-Kutta step of fourth order with coefficients and torque held.

    Args:
        q, qd: state at the start of the step, (*batch, joint).
        tau: torque over the step, (*batch, joint).
        coefficients: held over the step, (*batch, joint, coefficient).
        step: step length [s], a number or (*batch, 1).

    Returns:
        q and qd at the end of the step, qdd at its start.
    """

    def rate(q: Tensor, qd: Tensor) -> Tensor:
        return acceleration(plant, friction, q, qd, tau, coefficients)

    return runge_kutta(rate, q, qd, step)


def simulate_eager(
    plant: Plant, friction: Friction, inputs: RolloutInputs, step_function: StepFunction = rk4_step
) -> tuple[Tensor, ...]:
    """States at every sample in eager torch: q, qd, qdd, each (*batch, steps + 1, joint).

    For a law with memory also its state, (*batch, steps + 1, joint, state).
    """
    q, qd, tau = inputs.q0, inputs.qd0, inputs.tau
    step = inputs.step / inputs.substeps
    # Before the first step friction is unknown, so this acceleration omits it.
    qdd = plant.forward_dynamics(q, qd, tau[..., 0, :])
    internal = [] if inputs.law_state is None else [inputs.law_state]
    states = [(q, qd, qdd, *internal)]
    stateful, hidden = as_stateful(friction), inputs.hidden_state
    for k in range(step.shape[-1]):
        measured = None
        if inputs.measured is not None:
            measured = inputs.measured[0][..., k, :], inputs.measured[1][..., k, :]
        if stateful is not None:
            # A hidden state advances with the samples, as in a controller, not with the substeps.
            # It follows the simulated motion or, as in the papers, the measured one.
            drive = measured or (qd, qdd)
            if hidden is None:
                hidden = stateful.initial_state(*drive)
            elif k:
                hidden = stateful.advance(*drive, hidden)
            held = stateful.coefficients_from(*drive, hidden)
        for _ in range(inputs.substeps):
            if stateful is None:
                held = friction.coefficients(*(measured or (qd, qdd)))
            q, qd, qdd, *internal = step_function(
                plant, friction, q, qd, tau[..., k, :], held, step[..., k, None], *internal
            )
        states.append((q, qd, qdd, *internal))
    shape = states[-1][0].shape
    dims = len(shape)
    q, qd, qdd, *internal = (
        torch.stack([x.expand(*shape, *x.shape[dims:]) for x in one], dims - 1)
        for one in zip(*states, strict=True)
    )
    # NaN from the divergence of a motion to its end, as in compiled code.
    fine = (torch.isfinite(q) & (qd.abs() < SPEED_LIMIT)).all(-1, keepdim=True)
    lost = ~fine.cumprod(-2).bool()
    internal = [x.masked_fill(lost[..., None], torch.nan) for x in internal]
    return (*(x.masked_fill(lost, torch.nan) for x in (q, qd, qdd)), *internal)
