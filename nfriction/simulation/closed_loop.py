"""Closed loops: a plant with friction under a controller that reads encoders once a sample.

Between samples the motion is that of `rollout` with the torque held, so one motion of a closed loop
equals the rollout of its recorded torques.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.codegen.rollout_program import SPEED_LIMIT
from nfriction.simulation.compiled import System
from nfriction.simulation.protocols import (
    Friction,
    NoFriction,
    Plant,
    Rollout,
    RolloutInputs,
    as_stateful,
)
from nfriction.simulation.rollout import simulate
from nfriction.simulation.validate import (
    outside_inference_mode,
    require_stability,
    validate_inputs,
    with_law_state,
)

Array = NDArray[np.float64]


class Feedback(Protocol):
    """Controller as seen by a closed loop; it may keep a state of its own from call to call."""

    def __call__(self, time: float, q: Array) -> Array:
        """Torque wanted [N m] for the positions that the encoders read, both (*batch, joint)."""
        ...


@dataclass(frozen=True)
class Electronics:
    """Encoders, drives and delay between a controller and its machine.

    Attributes:
        sample_time: between two calls of the controller [s].
        counts: of the encoders a revolution, after quadrature; None for exact positions.
        delay: samples from reading the encoders to the torque that follows from it.
        torque_limit: largest |torque| of the drives [N m].
        torque_bits: of the digital-to-analogue converter over that range; None for exact torques.
        substeps: integration steps to a sample.

    Raises:
        ValueError: if a number is out of its range, or a converter has no torque limit.
    """

    sample_time: float = 1e-3
    counts: float | None = None
    delay: int = 0
    torque_limit: float = float("inf")
    torque_bits: int | None = None
    substeps: int = 1

    def __post_init__(self) -> None:
        if self.counts is not None and not self.counts > 0:
            raise ValueError(f"`counts` must be positive, got {self.counts}.")
        if not isinstance(self.delay, int) or self.delay < 0:
            raise ValueError(f"`delay` must be a whole number of samples, got {self.delay!r}.")
        if not self.torque_limit > 0:
            raise ValueError(f"`torque_limit` must be positive [N m], got {self.torque_limit}.")
        if self.torque_bits is not None and not (
            1 <= self.torque_bits <= 32 and self.torque_limit < float("inf")
        ):
            raise ValueError(
                "`torque_bits` must be 1 to 32 and needs a finite `torque_limit`, got "
                f"{self.torque_bits} with {self.torque_limit} N m."
            )

    def read(self, q: Array) -> Array:
        """Positions that the encoders give [rad]."""
        if self.counts is None:
            return q
        quantum = 2.0 * np.pi / self.counts
        return quantum * np.rint(q / quantum)

    def drive(self, torque: Array) -> Array:
        """Torque that the drives exert when asked for `torque` [N m]."""
        held = np.clip(torque, -self.torque_limit, self.torque_limit)
        if self.torque_bits is None:
            return held
        step = self.torque_limit / 2.0 ** (self.torque_bits - 1)
        return step * np.rint(held / step)


@dataclass(frozen=True, kw_only=True)
class ControlledMotion(Rollout):
    """A motion under a controller.

    Attributes:
        tau: torque over each step [N m], (*batch, steps, joint).
        measured: positions that the encoders gave for it [rad], same shape.
    """

    tau: Tensor
    measured: Tensor


@outside_inference_mode
@torch.no_grad()
def control(
    plant: Plant,
    friction: Friction | None,
    controller: Feedback,
    q0: Tensor,
    qd0: Tensor,
    *,
    steps: int,
    electronics: Electronics = Electronics(),
) -> ControlledMotion:
    """Simulate a plant with friction under a controller.

    A batch of states is one batch for the controller, so that several settings run at once.

    Args:
        plant, friction: the mechanism and its friction; None for no friction.
        controller: called once a sample, in order, with time and encoder positions.
        q0, qd0: initial state [rad, rad/s] in joint coordinates, (*batch, joint).
        steps: samples after the first.
        electronics: sample time, encoders, delay and drives.

    Returns:
        The motion; NaN from where it diverged, as of `rollout`.

    Raises:
        ValueError: if inputs do not fit, friction is too steep at rest for a stable integration, or
            the controller gives a torque of another shape or one that is not finite.
    """
    model = NoFriction(plant.joints) if friction is None else friction
    given = validate_inputs(
        plant, model, q0, qd0, None, electronics.sample_time, steps, electronics.substeps
    )
    given = with_law_state(given, model, None)
    system = System.of(plant, model)
    require_stability(system, given)
    q, qd, step = given.q0, given.qd0, given.step[:1]
    qdd = plant.forward_dynamics(q, qd, torch.zeros_like(q))
    stateful = as_stateful(model)
    hidden: Tensor | None = None
    law_states: list[Tensor] = []
    if given.law_state is not None:
        law_states.append(given.law_state)
    states, torques, readings = [(q, qd, qdd)], [], []
    waiting = [np.zeros(q.shape)] * electronics.delay
    diverged_at = torch.full(q.shape[:-1], torch.inf, dtype=q.dtype)
    for k in range(steps):
        time = k * electronics.sample_time
        reading = electronics.read(q.numpy())
        # Encoders are read before the torque of the sample acts.
        wanted = np.asarray(controller(time, reading), dtype=np.float64)
        if wanted.shape != reading.shape or not np.isfinite(wanted).all():
            raise ValueError(
                f"the controller must give finite torques {reading.shape}, got shape "
                f"{wanted.shape} at {time:g} s."
            )
        # Samples in flight: those read now act after the delay.
        waiting.append(electronics.drive(wanted))
        tau = torch.as_tensor(waiting.pop(0)).clone()
        if stateful is not None:
            if hidden is None:
                hidden = stateful.initial_state(qd, qdd)
            else:
                hidden = stateful.advance(qd, qdd, hidden)
        inputs = RolloutInputs(q, qd, tau.unsqueeze(-2), step, electronics.substeps, None, hidden)
        inputs = with_law_state(inputs, model, law_states[-1] if law_states else None)
        found = simulate(system, inputs)
        q, qd, qdd = (x[..., -1, :].clone() for x in found[:3])
        law_states += [x[..., -1, :, :].clone() for x in found[3:]]
        states.append((q, qd, qdd))
        torques.append(tau)
        readings.append(torch.as_tensor(reading).clone())
        # A motion that is lost must not reach the controllers of the others.
        lost = ~(torch.isfinite(q) & (qd.abs() < SPEED_LIMIT)).all(-1)
        if bool(lost.any()):
            # The sample after this one, as of a rollout.
            diverged_at[lost] = diverged_at[lost].clamp_max((k + 1) * electronics.sample_time)
            q = torch.where(lost[..., None], given.q0, q)
            qd = torch.where(lost[..., None], torch.zeros_like(qd), qd)
    seconds = electronics.sample_time * torch.arange(steps + 1, dtype=q.dtype)
    gone = (seconds >= diverged_at[..., None])[..., None]
    q, qd, qdd = (
        torch.stack(x, -2).masked_fill(gone, torch.nan) for x in zip(*states, strict=True)
    )
    applied, read = torch.stack(torques, -2), torch.stack(readings, -2)
    law = None
    if law_states:
        law = torch.stack(law_states, -3).masked_fill(gone[..., None], torch.nan)
    return ControlledMotion(
        step.expand(steps), q, qd, qdd, diverged_at, law, tau=applied, measured=read
    )
