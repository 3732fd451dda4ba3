"""Interfaces, inputs and result of a rollout: mechanism, friction, what drives it, the motion."""

import copy
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, cast

import torch
from torch import Tensor, nn

from nfriction.codegen import RolloutInputs

logger = logging.getLogger(__name__)


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


def at_sample_time(schedule: Any, sample_time: float) -> Any:
    """The schedule, or a copy with its parameters whose hidden state advances by this time [s]."""
    meant = getattr(schedule, "sample_time", None)
    # Clocks jitter, and time constants are known less exactly than to a thousandth.
    if meant is None or math.isclose(meant, sample_time, rel_tol=1e-3):
        return schedule
    moved = copy.deepcopy(schedule, {id(p): p for p in schedule.parameters()})
    moved.set_sample_time(sample_time)
    return moved


def with_sample_time(friction: Any, step: Tensor) -> Any:
    """The model, or a copy with its parameters whose hidden state advances by these steps [s]."""
    schedule = getattr(friction, "schedule", None)
    if getattr(schedule, "sample_time", None) is None or not step.numel():
        return friction
    rows = step.contiguous().median(-1).values  # NaN of an expanded tensor, in torch 2.13
    if rows.max() > 1.1 * rows.min():  # less is jitter
        raise ValueError(
            "a hidden state needs one `sample_time` for a batch, got "
            f"{float(rows.min()):g} to {float(rows.max()):g} s; simulate each rate separately."
        )
    moved = copy.copy(friction)
    moved._modules = {**moved._modules, "schedule": at_sample_time(schedule, float(rows.max()))}
    return moved


@dataclass(frozen=True)
class Rollout:
    """A simulated motion.

    Attributes:
        step: sample times [s], shape (steps,) or (*batch, steps).
        q: joint position [rad], shape (*batch, steps + 1, joint).
        qd: joint velocity [rad/s], same shape.
        qdd: joint acceleration known at each sample, that of the step before (at the start: without
            friction) [rad/s^2], same shape; with `qd` it drives the coefficients.
        diverged_at: time [s] at which a motion of the batch stopped being finite, infinity where
            it never did, shape (*batch,).
        law_state: internal state of a friction law with memory, (*batch, steps + 1, joint, state);
            None of a law without.
    """

    step: Tensor
    q: Tensor
    qd: Tensor
    qdd: Tensor
    diverged_at: Tensor
    law_state: Tensor | None = None

    @classmethod
    def of(cls, inputs: RolloutInputs, states: tuple[Tensor, ...]) -> "Rollout":
        """The motion of these states, NaN from where it diverged."""
        q, qd, qdd, *law = states
        found = cls(inputs.step, q, qd, qdd, q.new_full(q.shape[:-2], torch.inf), *law)
        # What is lost stays NaN, so that the last sample shows whether anything is.
        if not qd[..., -1, :].isnan().any():
            return found
        lost = qd.isnan().any(-1)
        first = lost.to(torch.int64).argmax(-1, keepdim=True)
        at = torch.gather(found.time.expand(lost.shape), -1, first).squeeze(-1)
        diverged_at = torch.where(lost.any(-1), at, torch.inf)
        # Masked, since gradients of NaN would spoil those of other motions.
        q, qd, qdd = (x.masked_fill(lost[..., None], torch.nan) for x in (q, qd, qdd))
        law = [x.masked_fill(lost[..., None, None], torch.nan) for x in law]
        count = int(lost.any(-1).sum())
        logger.warning("%d rollout(s) diverged, first at %.4g s", count, diverged_at.min())
        return cls(inputs.step, q, qd, qdd, diverged_at, *law)

    @cached_property
    def time(self) -> Tensor:
        """Time of each sample [s], shape (steps + 1,) or (*batch, steps + 1)."""
        return torch.nn.functional.pad(self.step, (1, 0)).cumsum_(-1)

    @property
    def diverged(self) -> Tensor:
        """True for motions that diverged, shape (*batch,)."""
        return torch.isfinite(self.diverged_at)
