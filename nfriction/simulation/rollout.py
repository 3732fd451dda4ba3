"""Rollouts: the motion of a plant with friction by classical Runge-Kutta steps.

Coefficients that depend on the motion are held over a step, as a controller at the sample rate
would hold them; that also breaks the loop in which friction needs the acceleration and the
acceleration needs friction.
"""

import logging
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor, nn

from nfriction.simulation.adjoint import differentiable
from nfriction.simulation.compiled import Backend, integrate_compiled, wants_compiled
from nfriction.simulation.mechanism import mechanism_of
from nfriction.simulation.protocols import Friction, Plant
from nfriction.simulation.rk4 import stepped
from nfriction.simulation.stiction import stuck
from nfriction.simulation.validate import (
    all_finite,
    compare_sample_times,
    driving_motion,
    given_memory,
    prepared,
    refuse_unstable,
)

logger = logging.getLogger(__name__)

Scheme = Literal["rk4", "stop"]
# Beyond this many steps gradients are rarely meant and may take gigabytes: they must be asked for.
GRADIENT_STEPS = 10_000
# A joint faster than this [rad/s] has left any mechanism's range: the rollout has diverged.
SPEED_LIMIT = 1e6


@dataclass(frozen=True)
class Rollout:
    """A simulated motion.

    Attributes:
        time: [s], shape (steps + 1,) or (*batch, steps + 1).
        q: joint position [rad], shape (*batch, steps + 1, joint).
        qd: joint velocity [rad/s], same shape.
        qdd: joint acceleration known at each sample, that of the step before (at the start: without
            friction) [rad/s^2], same shape; with `qd` it drives the coefficients.
        diverged_at: time [s] at which a candidate stopped being finite, infinity where it never
            did, shape (*batch,).
    """

    time: Tensor
    q: Tensor
    qd: Tensor
    qdd: Tensor
    diverged_at: Tensor

    @property
    def diverged(self) -> Tensor:
        """Which candidates diverged, shape (*batch,)."""
        return torch.isfinite(self.diverged_at)


def rollout(
    plant: Plant,
    friction: Friction | None,
    q0: Tensor,
    qd0: Tensor,
    tau: Tensor | None = None,
    *,
    sample_time: float | Tensor = 1e-3,
    steps: int | None = None,
    substeps: int = 1,
    scheme: Scheme = "rk4",
    drive: Literal["simulated", "measured"] = "simulated",
    measured: tuple[Tensor, Tensor] | None = None,
    memory: Tensor | None = None,
    gradients: bool | None = None,
    backend: Backend = "auto",
    threads: int = 1,
    progress: bool = False,
) -> Rollout:
    """Simulate a plant with friction from an initial state.

    Models that `fit` and `load` return ask for no gradients and are compiled, thousands of times
    faster than eager torch. To train through a rollout ask for them first,
    `model.requires_grad_(True)`; a new model of one's own does so by itself.

    Args:
        plant: the mechanism, e.g. `rigs.tlrip()`.
        friction: friction model, or None for no friction.
        q0, qd0: initial state [rad, rad/s] in joint coordinates, shape (*batch, joint).
        tau: joint torque [N m], held over each step, shape (steps, joint) or
            (*batch, steps, joint); None for none.
        sample_time: step [s], or steps of their own, shape (steps,) or (*batch, steps).
        steps: number of steps; may be left out where `tau` or `sample_time` gives it.
        substeps: Runge-Kutta steps to each sample. Coefficients with a memory advance once a
            sample; others are held anew at each of these steps.
        scheme: `"rk4"` takes friction as the smooth function of velocity that it is, and creeps
            where it ought to rest; `"stop"` takes semi-implicit steps of first order in which dry
            friction stops a joint and holds it, however steep. It needs shorter steps, and has no
            gradients, no measured drive and no coefficients with a memory.
        drive: what drives motion-dependent coefficients: the simulated motion, or the
            `measured` one, as in the papers.
        measured: velocity and acceleration for `drive="measured"`, each (*batch, steps, joint).
        memory: what the coefficients remember after the first sample, (*batch, joint,
            state_size), where the motion goes on from an earlier one (see `Schedule.states`); by
            default what they would of the first sample alone.
        gradients: make the motion differentiable; None does so where any input asks for it, no
            compiled backend is named, and there are at most 10,000 steps.
        backend: `"torch"` steps in eager torch; `"c"` and `"numba"` compile the same definition
            (no gradients); `"auto"` compiles where it can. Gradients then come from an adjoint
            pass over all steps at once, good for one derivative; for higher ones, or within
            `torch.func`, `"torch"` records every step.
        threads: a compiled batch is shared out among this many.
        progress: show a progress bar (eager torch only; compiled rollouts take milliseconds).

    Returns:
        Rollout with `q` and `qd` of shape (*batch, steps + 1, joint). A diverging candidate is
        no error: `diverged_at` tells when, and NaN follows.

    Raises:
        ValueError: if shapes do not fit, inputs are not finite, the friction is so steep at rest
            that the integration would be unstable, or the scheme cannot do what is asked.
        CodegenError: if a backend asked for by name cannot serve.
    """
    if substeps < 1:
        raise ValueError(f"`substeps` must be at least 1, got {substeps}.")
    q, qd, torque, step, steps = prepared(plant, friction, q0, qd0, tau, sample_time, steps)
    measured = driving_motion(drive, measured, q, steps)
    if scheme not in get_args(Scheme):
        raise ValueError(f"`scheme` must be one of {get_args(Scheme)}, got {scheme!r}.")
    if scheme == "stop":
        if friction is None or gradients or measured is not None or memory is not None:
            raise ValueError(
                '`scheme="stop"` needs a friction model, and has no gradients, measured drive or '
                'memory; use scheme="rk4" for these.'
            )
        return _finished(step, stuck(plant, friction, q, qd, torque, step, substeps, progress))
    refuse_unstable(plant, friction, float(step.max()), substeps)
    memory = given_memory(friction, memory, q)
    if memory is not None:
        shape = np.broadcast_shapes(q.shape, memory.shape[:-1])
        q, qd = q.expand(shape), qd.expand(shape)
    compare_sample_times(friction, float(step.mean()))
    if gradients is None:
        gradients = (
            backend in ("auto", "torch")
            and torch.is_grad_enabled()
            and steps <= GRADIENT_STEPS
            and _asks_gradients(plant, friction, q, qd, torque)
        )
    return integrate(
        plant, friction, q, qd, torque, step, substeps=substeps, measured=measured, memory=memory,
        gradients=gradients, backend=backend, threads=threads, progress=progress,
    )  # fmt: skip


def integrate(
    plant: Plant,
    friction: Friction | None,
    q0: Tensor,
    qd0: Tensor,
    tau: Tensor,
    step: Tensor,
    *,
    substeps: int = 1,
    measured: tuple[Tensor, Tensor] | None = None,
    memory: Tensor | None = None,
    gradients: bool = False,
    backend: Backend = "auto",
    threads: int = 1,
    progress: bool = False,
) -> Rollout:
    """`rollout` without its checks, for searches whose trials may well be unstable.

    Shapes: q0, qd0 (*batch, joint); tau (*batch, steps, joint) and step (*batch, steps), or
    without the batch; the rest as in `rollout`.
    """
    compiled = wants_compiled(backend, q0, gradients)

    def simulate() -> tuple[Tensor, ...]:
        found = None
        if compiled or (gradients and wants_compiled(backend, q0, gradients=False)):
            found = integrate_compiled(
                plant, friction, q0, qd0, tau, step, substeps, measured, backend, threads,
                memory=memory,
            )  # fmt: skip
        return found or record()

    def record() -> tuple[Tensor, ...]:
        return stepped(plant, friction, q0, qd0, tau, step, substeps, measured, memory, progress)

    mechanism = None
    if gradients and backend == "auto":
        mechanism = mechanism_of(plant, friction, q0, qd0, tau, step, measured)
    if mechanism is not None:
        states = differentiable(simulate, mechanism, q0, qd0, tau, step, substeps, measured)
    elif gradients:
        states = record()
    else:
        with torch.no_grad():
            states = simulate()
    return _finished(step, states)


def _finished(step: Tensor, states: tuple[Tensor, ...]) -> Rollout:
    """A motion with its time; what diverged is NaN from there on."""
    time = torch.cat([torch.zeros_like(step[..., :1]), step.cumsum(-1)], -1)
    q, qd, qdd = states
    diverged_at = _divergence(time, q, qd)
    if torch.isfinite(diverged_at).any():
        lost = (time >= diverged_at[..., None])[..., None]
        q, qd, qdd = (x.masked_fill(lost, torch.nan) for x in states)
    return Rollout(time, q, qd, qdd, diverged_at)


def _asks_gradients(plant: Plant, friction: Friction | None, *inputs: Tensor) -> bool:
    """Whether anything that shapes the motion requires a gradient."""
    given: tuple[Any, ...] = (plant, friction)
    modules = [m for m in given if isinstance(m, nn.Module)]
    owned = [t for m in modules for t in (*m.parameters(), *m.buffers())]
    return any(t.requires_grad for t in (*inputs, *owned))


def _divergence(time: Tensor, q: Tensor, qd: Tensor) -> Tensor:
    """Time of the first sample that is not finite or beyond any speed, infinity where none."""
    with torch.no_grad():
        if all_finite(q) and all(abs(float(v)) < SPEED_LIMIT for v in qd.aminmax()):
            return time.new_full(q.shape[:-2], torch.inf)
        lost = ~(torch.isfinite(q) & (qd.abs() < SPEED_LIMIT)).all(-1)
        first = lost.to(torch.int64).argmax(-1, keepdim=True)
        at = torch.gather(time.expand(lost.shape), -1, first).squeeze(-1)
        diverged_at = torch.where(lost.any(-1), at, torch.inf)
        count = int(lost.any(-1).sum())
        if count:
            logger.warning("%d rollout(s) diverged, first at %.4g s", count, diverged_at.min())
    return diverged_at
