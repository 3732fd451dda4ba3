"""Closed loops: a plant with friction under a controller that reads encoders once per sample.

Between samples the motion is that of `rollout` with the torque held, so a closed-loop motion equals
the rollout with its recorded torques.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.codegen.rollout import SPEED_LIMIT
from nfriction.simulation import protocols, validate
from nfriction.simulation.compiled import System
from nfriction.simulation.rollout import simulate

Array = NDArray[np.float64]


class Feedback(Protocol):
    """Controller in a closed loop; it may keep a state from call to call."""

    def __call__(self, time: float, q: Array) -> Array:
        """Commanded torque [N m] for the positions that the encoders read, both (*batch, joint)."""
        ...


@dataclass(frozen=True)
class Electronics:
    """Encoders, drives and delay between a controller and its machine.

    Attributes:
        sample_time: between two calls of the controller [s].
        counts: of the encoders per revolution, after quadrature; None for exact positions.
        delay: samples from reading the encoders to the resulting torque.
        torque_limit: largest |torque| of the drives [N m].
        torque_bits: of the digital-to-analogue converter over that range; None for exact torques.

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
        """Positions read by the encoders [rad]."""
        if self.counts is None:
            return q
        quantum = 2.0 * np.pi / self.counts
        return quantum * np.rint(q / quantum)

    def drive(self, torque: Array) -> Array:
        """Torque that the drives exert for a command `torque` [N m]."""
        held = np.clip(torque, -self.torque_limit, self.torque_limit)
        if self.torque_bits is None:
            return held
        step = self.torque_limit / 2.0 ** (self.torque_bits - 1)
        return step * np.rint(held / step)


@dataclass(frozen=True, kw_only=True)
class ControlledMotion(protocols.Rollout):
    """A motion under a controller, with torques over each step [N m], (*batch, steps, joint).

    `measured` are the encoder positions from which they were computed [rad], in the same shape.
    """

    tau: Tensor
    measured: Tensor


@validate.outside_inference_mode
@torch.no_grad()
def control(
    plant: protocols.Plant,
    friction: protocols.Friction | None,
    controller: Feedback,
    q0: Tensor,
    qd0: Tensor,
    *,
    steps: int,
    electronics: Electronics = Electronics(),
) -> ControlledMotion:
    """Simulate a plant with friction under a controller.

    A batch of states is also a batch for the controller, so that several settings run at once.

    Args:
        plant, friction: the mechanism and its friction; None for no friction.
        controller: called once per sample, in order, with time and encoder positions.
        q0, qd0: initial state [rad, rad/s] in joint coordinates, (*batch, joint).
        steps: samples after the first.

    Returns:
        The motion; NaN after it diverged, as from `rollout`.

    Raises:
        ValueError: if inputs do not fit, friction is too steep at rest for a stable integration, or
            the controller gives a torque of another shape or one that is not finite.
    """
    model = protocols.NoFriction(plant.joints) if friction is None else friction
    sample_time, substeps = electronics.sample_time, electronics.substeps
    model = protocols.with_sample_time(model, torch.tensor([sample_time]).double())
    given = validate.with_states(
        validate.validate_inputs(plant, model, q0, qd0, None, sample_time, steps, substeps), model
    )
    system = System.of(plant, model)
    validate.require_stability(system, given)
    q, qd, step, axis = given.q0, given.qd0, given.step[:1], given.q0.ndim - 1
    law = [] if given.law_state is None else [given.law_state]
    states = [(q, qd, plant.forward_dynamics(q, qd, torch.zeros_like(q)), *law)]
    hidden: Tensor | None = None
    stateful = protocols.as_stateful(model)
    torques, readings = [], []
    waiting = [np.zeros(q.shape)] * electronics.delay
    diverged_at = torch.full(q.shape[:-1], torch.inf, dtype=q.dtype)
    for k in range(steps):
        reading = electronics.read(q.numpy())
        time = k * sample_time
        wanted = np.asarray(controller(time, reading), dtype=np.float64)
        if wanted.shape != reading.shape or not np.isfinite(wanted).all():
            raise ValueError(
                f"the controller must return finite torques {reading.shape}, got shape "
                f"{wanted.shape} at {time:g} s."
            )
        # Encoders are read before the torque of the sample acts; delayed torques act first.
        waiting.append(electronics.drive(wanted))
        tau = torch.as_tensor(waiting.pop(0)).clone()
        if stateful is not None:
            motion = qd, states[-1][2]
            hidden = (
                stateful.initial_state(*motion) if hidden is None
                else stateful.advance(*motion, hidden)
            )  # fmt: skip
        inputs = protocols.RolloutInputs(
            q, qd, tau.unsqueeze(-2), step, substeps, None, hidden, *law
        )
        after = [x.select(axis, -1).clone() for x in simulate(system, inputs)]
        states.append(tuple(after))
        q, qd, _, *law = after
        torques.append(tau)
        readings.append(torch.as_tensor(reading).clone())
        # A diverged motion must not affect the controllers of the others.
        lost = ~(torch.isfinite(q) & (qd.abs() < SPEED_LIMIT)).all(-1)
        if bool(lost.any()):
            # The sample after this one, as in a rollout.
            diverged_at[lost] = diverged_at[lost].clamp_max((k + 1) * sample_time)
            q = torch.where(lost[..., None], given.q0, q)
            qd = torch.where(lost[..., None], torch.zeros_like(qd), qd)
    seconds = sample_time * torch.arange(steps + 1, dtype=q.dtype)
    gone = (seconds >= diverged_at[..., None])[..., None]
    q, qd, qdd, *law = (torch.stack(x, axis) for x in zip(*states, strict=True))
    q, qd, qdd = (x.masked_fill(gone, torch.nan) for x in (q, qd, qdd))
    law = [x.masked_fill(gone[..., None], torch.nan) for x in law]
    return ControlledMotion(
        step.expand(steps), q, qd, qdd, diverged_at, *law,
        tau=torch.stack(torques, -2), measured=torch.stack(readings, -2),
    )  # fmt: skip
