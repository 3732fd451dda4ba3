"""Time-stepping with dry friction that truly sticks: joints stop instead of creeping.

A smoothed sign lets a joint that ought to rest creep at a fraction of its smoothing velocity. Here
friction is an impulse that at most stops its joint within the step; the torque that holds a joint
below breakaway is solved for, not modelled.
"""

from dataclasses import replace

import torch
from torch import Tensor

from nfriction.simulation.compiled import System, integrate_compiled
from nfriction.simulation.memory_step import memory_of, unit_responses
from nfriction.simulation.protocols import Friction, NoFriction, Plant, RolloutInputs
from nfriction.simulation.rk4 import simulate_eager

# Velocity, in units of the smoothing velocity, above which a joint slides with the law's friction.
SLIDING = 5.0
# Gauss-Seidel sweeps over the joints' impulses; a single joint takes one.
SWEEPS = 20


def moreau_step(
    plant: Plant,
    friction: Friction,
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    coefficients: Tensor,
    step: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """One semi-implicit Euler step with friction that stops a joint, then holds it.

    The impulse of friction brings each joint to rest, limited to that of the law in sliding. With
    several joints, impulses are found in turn (projected Gauss-Seidel).

    Arguments are those of `rk4_step`; the results are q and qd at the end, and the mean qdd.

    References:
        M. Duclusaud et al., Extended friction models for the physics simulation of servo
        actuators, ICRA 2025 (the stop torque of one joint).
        J. J. Moreau, in: Nonsmooth Mechanics and Applications, Springer (1988), 1-82.
    """
    load, slow = plant.load(q, qd), SLIDING * getattr(friction, "v_smooth", 0.0)
    sliding = torch.clamp(qd.abs(), min=slow)
    most = (step * friction.torque(sliding, load, coefficients)).unbind(-1)
    least = (step * friction.torque(-sliding, load, coefficients)).unbind(-1)
    zero = torch.zeros_like(qd)
    inverse = unit_responses(plant, q, zero)
    if getattr(plant, "has_gear", False):
        # A gear's loss is a share of the torque without friction, which the impulses add.
        drag = friction.torque(qd, load, coefficients)
        taken = sum(torch.stack(c, -1) * drag[..., j : j + 1] for j, c in enumerate(inverse))
        qdd = plant.forward_dynamics(q, qd, tau - drag) + taken
    else:
        qdd = plant.forward_dynamics(q, qd, tau)
    v = list((qd + step * qdd).unbind(-1))
    impulse = list(zero.unbind(-1))
    for _ in range(SWEEPS if plant.joints > 1 else 1):
        for j, column in enumerate(inverse):
            stopping = impulse[j] + v[j] / column[j]
            found = torch.minimum(torch.maximum(stopping, least[j]), most[j])
            change, impulse[j] = found - impulse[j], found
            v = [v[i] - column[i] * change for i in range(plant.joints)]
    after = torch.stack(v, -1)
    return q + step * after, after, (after - qd) / step


@torch.no_grad()
def simulate_stiction(
    plant: Plant, friction: Friction, inputs: RolloutInputs, gradients: bool | None
) -> tuple[Tensor, ...]:
    """States at every sample: q, qd, qdd, each (*batch, steps + 1, joint)."""
    if memory_of(friction) is not None:
        raise ValueError(
            "a friction law with memory holds a joint by itself, so it needs no `time_stepping`; "
            'use scheme="rk4".'
        )
    if gradients or inputs.measured is not None or isinstance(friction, NoFriction):
        raise ValueError(
            '`scheme="time_stepping"` needs a friction model, and has no gradients or measured '
            'drive; use scheme="rk4" for these.'
        )
    as_double = {name: getattr(inputs, name).double() for name in ("q0", "qd0", "tau", "step")}
    double = replace(inputs, **as_double)
    states = integrate_compiled(
        System.of(plant, friction), double, "auto", 1, step_function=moreau_step
    )
    if states is None:
        states = simulate_eager(plant, friction, double, moreau_step)
    return tuple(x.to(inputs.q0) for x in states)
