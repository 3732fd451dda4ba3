"""Interfaces and inputs of a rollout: mechanism, friction, initial state and what drives it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, cast

import torch
from torch import Tensor, nn


class Plant(Protocol):
    """Mechanism as seen by a rollout; all shapes (*batch, joint)."""

    joints: int

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor: ...
    def load(self, q: Tensor, qd: Tensor) -> Tensor: ...
    def decay_rate(self, damping: Tensor) -> Tensor: ...


class Friction(Protocol):
    """Friction model as seen by a rollout; see `Schedule` for its hidden state, if it has one."""

    joints: int

    def coefficients(self, qd: Tensor, qdd: Tensor) -> Tensor: ...
    def torque(self, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor: ...
    def zero_velocity_damping(self) -> Tensor: ...


class StatefulFriction(Friction, Protocol):
    """Friction model whose coefficients have a hidden state; see `Schedule`."""

    state_size: int

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor: ...
    def advance(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor: ...
    def coefficients_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor: ...


class NoFriction(nn.Module):
    """A friction model without torque, so that a rollout without friction is no special case."""

    def __init__(self, joints: int) -> None:
        super().__init__()
        self.joints = joints

    def coefficients(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return torch.zeros_like(qd)[..., None]

    def torque(self, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
        return torch.zeros_like(qd)

    def zero_velocity_damping(self) -> Tensor:
        return torch.zeros(self.joints)


# One integration step, with the arguments and values of `nfriction.simulation.rk4.rk4_step`.
# Of a law with memory, of `nfriction.simulation.memory_step.memory_step`.
StepFunction = Callable[..., tuple[Tensor, ...]]


def as_stateful(friction: Friction) -> StatefulFriction | None:
    """The friction model if its coefficients have a hidden state, else None."""
    if getattr(friction, "state_size", 0) > 0:
        return cast(StatefulFriction, friction)
    return None


@dataclass(frozen=True)
class RolloutInputs:
    """Initial state and inputs of a rollout.

    Attributes:
        q0, qd0: initial state [rad, rad/s], (*batch, joint).
        tau: torque held over each step [N m], (steps, joint) or (*batch, steps, joint).
        step: sample times [s], (steps,) or (*batch, steps).
        substeps: integration steps to each sample.
        measured: velocity and acceleration that drive the coefficients in place of the simulated
            ones, each (*batch, steps, joint) or without batch; None for the simulated ones.
        hidden_state: of the coefficients after the first sample, (*batch, joint, state_size);
            None for that of the first sample alone.
        law_state: internal state of the friction law at the start, (*batch, joint, state); None of
            a law without.
    """

    q0: Tensor
    qd0: Tensor
    tau: Tensor
    step: Tensor
    substeps: int = 1
    measured: tuple[Tensor, Tensor] | None = None
    hidden_state: Tensor | None = None
    law_state: Tensor | None = None
