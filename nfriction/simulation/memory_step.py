"""One step of a mechanism whose friction has memory: friction implicit, the mechanism by RK4.

A contact in presliding is a spring, often so stiff that an explicit step of a millisecond is
unstable. Here the friction torque is held over a step and solved for: it is that of the law after
the step, at the velocity to which this torque leads. With the fraction theta of the step

    v = qd + theta h (qdd_0 - W tau_f),    tau_f = torque(z + theta (z' - z), v),
    z' = advance(z, v, h),

where qdd_0 is the acceleration without friction and W = M^-1. A Runge-Kutta step of the mechanism
with this torque follows.

With theta = (1 + x) / (2 + x) and x = h W_ii dtau_f/dv, the slope at rest, the step is stable at
any stiffness. Contacts that the step resolves have x << 1 and theta near 1/2, the implicit
midpoint, and the step is of second order in h; those much faster than the step have theta near 1,
backward Euler, and it is of first order, as the instant of a breakaway within the step is unknown.
Friction that is held limits the order to two however soft the contact is.

References:
    N. Newmark, J. Engineering Mechanics 85 (1959) 67-94 (theta and its damping of fast modes).
"""

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from nfriction.simulation.protocols import Friction, Plant
from nfriction.simulation.rk4 import runge_kutta

# Iterations of the velocity after the first guess. More of them change a motion by less than the
# step's own error; torque and state belong to one velocity after any number of them.
ITERATIONS = 2
# Velocity [rad/s] at which the slope at rest is measured: below that of any Stribeck curve.
SLOW = 1e-9


class LawMemory(Protocol):
    """Internal state of a friction law, see `nfriction.friction.memory`."""

    size: int
    transmitted: bool

    def advance(
        self, state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor,
        time_step: float | Tensor, /,
    ) -> Tensor: ...  # fmt: skip
    def torque(
        self, state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor, /
    ) -> Tensor: ...


def memory_of(friction: Friction) -> LawMemory | None:
    """The memory of a friction model's law, None without one."""
    memory: LawMemory | None = getattr(getattr(friction, "law", None), "memory", None)
    return memory


def memory_step(
    plant: Plant,
    friction: Friction,
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    coefficients: Tensor,
    step: Tensor | float,
    state: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """One step with coefficients, torque and friction held, as `rk4_step` for a law with memory.

    `state` is that of the law at the start, (*batch, joint, state); returned last at the end.
    """
    law = memory_of(friction)
    assert law is not None
    # Held like the torque: the error is of the order of the step's own.
    zero = torch.zeros_like(qd)
    load = tau + zero if law.transmitted else plant.load(q, qd)
    mobility = [list(row) for row in zip(*unit_responses(plant, q, zero), strict=True)]
    at_ease = torch.zeros_like(state)
    moved = law.advance(at_ease, zero + SLOW, load, coefficients, step)
    # A constant offset of the torque is not part of the slope.
    offset = law.torque(at_ease, zero, load, coefficients)
    # Friction that falls over the first displacement counts as flat: it would not stabilise.
    steepest = ((law.torque(moved, zero + SLOW, load, coefficients) - offset) / SLOW).clamp(min=0.0)
    stiffness = step * torch.stack([row[j] for j, row in enumerate(mobility)], -1) * steepest
    theta = (1.0 + stiffness) / (2.0 + stiffness)
    reach = theta * step

    def friction_at(v: Tensor) -> tuple[Tensor, Tensor]:
        after = law.advance(state, v, load, coefficients, step)
        between = state + theta.unsqueeze(-1) * (after - state)
        return law.torque(between, v, load, coefficients), after

    # The velocity without friction is the first guess. Torques between rest and a guess lie above
    # the chord of these two, so that guesses shrink towards the solution and none overshoots it.
    goal = qd + reach * plant.forward_dynamics(q, qd, tau)
    stuck, _ = friction_at(zero)
    free = goal - reach * _product(mobility, stuck)
    v = goal
    found, after = friction_at(v)
    for _ in range(ITERATIONS):
        # The slope of the torque from rest to the velocity. At a deflection against the motion it
        # is up to twice that of the contact at rest.
        same = v.abs() < SLOW
        chord = ((found - stuck) / torch.where(same, 1.0, v)).clamp(min=0.0)
        slope = torch.where(same, steepest, torch.minimum(chord, 2.0 * steepest))
        v = _solve(mobility, reach.unbind(-1), slope.unbind(-1), list(free.unbind(-1)))
        found, after = friction_at(v)

    # With the same torque in all stages, so that the mechanism loses the energy that the law takes.
    def rate(q: Tensor, qd: Tensor) -> Tensor:
        return plant.forward_dynamics(q, qd, tau - found)

    return (*runge_kutta(rate, q, qd, step), after)


def unit_responses(plant: Plant, q: Tensor, zero: Tensor) -> list[tuple[Tensor, ...]]:
    """Accelerations of all joints by a unit torque of each, one after the other."""
    unit = torch.eye(plant.joints, dtype=q.dtype, device=q.device)
    # Differences from the motion without torque, because plants have no mass matrix in common.
    rest = plant.forward_dynamics(q, zero, zero)
    return [
        (plant.forward_dynamics(q, zero, zero + unit[j]) - rest).unbind(-1)
        for j in range(plant.joints)
    ]


def _product(matrix: Sequence[Sequence[Tensor]], vector: Tensor) -> Tensor:
    x = vector.unbind(-1)
    rows = [sum((a * b for a, b in zip(row[1:], x[1:], strict=True)), row[0] * x[0])
            for row in matrix]  # fmt: skip
    return torch.stack(rows, -1)


def _solve(
    mobility: Sequence[Sequence[Tensor]],
    reach: Sequence[Tensor],
    slope: Sequence[Tensor],
    right: list[Tensor],
) -> Tensor:
    """Solution of (I + diag(reach) W diag(slope)) x = right by elimination.

    W is symmetric and positive definite, so that all leading minors exceed 1: no pivot is needed.
    """
    n = len(right)
    rows = [
        [reach[i] * mobility[i][j] * slope[j] + (1.0 if i == j else 0.0) for j in range(n)]
        for i in range(n)
    ]
    for i in range(n):
        for j in range(i + 1, n):
            factor = rows[j][i] / rows[i][i]
            for k in range(i + 1, n):
                rows[j][k] = rows[j][k] - factor * rows[i][k]
            right[j] = right[j] - factor * right[i]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            right[i] = right[i] - rows[i][k] * right[k]
        right[i] = right[i] / rows[i][i]
    return torch.stack(right, -1)
