"""Rollouts: the motion of a plant with friction by classical Runge-Kutta steps.

Coefficients that depend on the motion are held over a step, as a controller at the sample rate
would hold them; that also breaks the loop in which friction needs the acceleration and the
acceleration needs friction.
"""

import contextlib
import logging
from dataclasses import dataclass
from typing import Any, Literal, Protocol, cast

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from nfriction.compiled import Backend, integrate_compiled, wants_compiled

logger = logging.getLogger(__name__)

# RK4 is stable on the real axis down to h * lambda = -2.785.
RK4_STABILITY = 2.785
# Beyond this many steps a recorded graph takes gigabytes, so it has to be asked for.
GRADIENT_STEPS = 10_000
# A joint faster than this [rad/s] has left any mechanism's range: the rollout has diverged.
SPEED_LIMIT = 1e6


class Plant(Protocol):
    """What a rollout needs of a mechanism; all shapes (*batch, joint)."""

    joints: int

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor: ...
    def load(self, q: Tensor, qd: Tensor) -> Tensor: ...
    def mobility(self) -> Tensor: ...


class Friction(Protocol):
    """What a rollout needs of a friction model."""

    joints: int

    def coefficients(self, qd: Tensor, qdd: Tensor) -> Tensor: ...
    def torque(self, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor: ...
    def slope_at_rest(self) -> Tensor: ...


class RememberingFriction(Friction, Protocol):
    """A friction model whose coefficients have a memory; see `nfriction.friction.Schedule`."""

    state_size: int

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor: ...
    def advance(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor: ...
    def coefficients_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor: ...


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


def stability_limit(plant: Plant, sample_time: float) -> Tensor:
    """Largest slope of friction over velocity that RK4 integrates stably [N m s/rad], (joint,).

    References:
        RK4's real stability bound over the largest diagonal entry of the inverse mass matrix.
    """
    return RK4_STABILITY / (sample_time * plant.mobility())


def required_substeps(plant: Plant, friction: Friction, sample_time: float) -> int:
    """Integration steps a sample that keep the friction's slope at rest stable."""
    excess = friction.slope_at_rest() / stability_limit(plant, sample_time)
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
        drive: what drives motion-dependent coefficients: the simulated motion, or the
            `measured` one, as in the papers.
        measured: velocity and acceleration for `drive="measured"`, each (*batch, steps, joint).
        memory: what the coefficients remember after the first sample, (*batch, joint,
            state_size), where the motion goes on from an earlier one (see `Schedule.states`); by
            default what they would of the first sample alone.
        gradients: record gradients; None does so where any input asks for it, no compiled backend
            is named, and there are at most 10,000 steps (a longer graph takes gigabytes).
        backend: `"torch"` steps in eager torch; `"c"` and `"numba"` compile the same definition
            (no gradients); `"auto"` compiles where it can.
        threads: a compiled batch is shared out among this many.
        progress: show a progress bar (eager torch only; compiled rollouts take milliseconds).

    Returns:
        Rollout with `q` and `qd` of shape (*batch, steps + 1, joint). A diverging candidate is
        no error: `diverged_at` tells when, and NaN follows.

    Raises:
        ValueError: if shapes do not fit, inputs are not finite, or the friction is so steep at
            rest that the integration would be unstable.
        CodegenError: if a backend asked for by name cannot serve.
    """
    if substeps < 1:
        raise ValueError(f"`substeps` must be at least 1, got {substeps}.")
    q, qd, torque, step, steps = _prepare(plant, friction, q0, qd0, tau, sample_time, steps)
    measured = _driving(drive, measured, q, steps)
    _refuse_unstable(plant, friction, float(step.max()), substeps)
    memory = _remembered(friction, memory, q)
    if memory is not None:
        shape = np.broadcast_shapes(q.shape, memory.shape[:-1])
        q, qd = q.expand(shape), qd.expand(shape)
    _compare_sample_times(friction, float(step.mean()))
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
    states = None
    if wants_compiled(backend, q0, gradients):
        states = integrate_compiled(
            plant, friction, q0, qd0, tau, step, substeps, measured, backend, threads,
            memory=memory,
        )  # fmt: skip
    if states is None:
        with contextlib.nullcontext() if gradients else torch.no_grad():
            states = _integrate(
                plant, friction, q0, qd0, tau, step, substeps, measured, memory, progress
            )
    time = torch.cat([torch.zeros_like(step[..., :1]), step.cumsum(-1)], -1)
    q, qd, qdd = states
    diverged_at = _divergence(time, q, qd)
    if torch.isfinite(diverged_at).any():
        lost = (time >= diverged_at[..., None])[..., None]
        q, qd, qdd = (x.masked_fill(lost, torch.nan) for x in states)
    return Rollout(time, q, qd, qdd, diverged_at)


def _integrate(
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
    remembering = _remembering(friction)
    memory: Tensor | None = None
    held: Tensor | None = None
    for k in tqdm(range(step.shape[-1]), disable=not progress, unit="step", leave=False):
        driven = None if measured is None else (measured[0][..., k, :], measured[1][..., k, :])
        if remembering is not None:
            seen = driven or (qd, qdd)
            if memory is not None:
                memory = remembering.advance(*seen, memory)
            else:
                memory = remembering.initial_state(*seen) if first is None else first
            held = remembering.coefficients_from(*seen, memory)
        for _ in range(substeps):
            if friction is not None and remembering is None:
                held = friction.coefficients(*(driven or (qd, qdd)))
            q, qd, qdd = rk4_step(plant, friction, q, qd, tau[..., k, :], held, inner[..., k, None])
        states.append((q, qd, qdd))
    shape = states[-1][0].shape
    return tuple(
        torch.stack([x.expand(shape) for x in one], -2) for one in zip(*states, strict=True)
    )


def _remembering(friction: Friction | None) -> RememberingFriction | None:
    """The friction model if its coefficients have a memory."""
    if getattr(friction, "state_size", 0) > 0:
        return cast(RememberingFriction, friction)
    return None


def _remembered(friction: Friction | None, memory: Tensor | None, q: Tensor) -> Tensor | None:
    """Validate a given memory."""
    if memory is None:
        return None
    given, size = torch.as_tensor(memory).to(q), getattr(friction, "state_size", 0)
    if size == 0:
        raise ValueError("`memory` is for friction whose coefficients have one; leave it out.")
    if given.shape[-2:] != (q.shape[-1], size) or not torch.isfinite(given).all():
        raise ValueError(
            f"`memory` must be finite (*batch, {q.shape[-1]}, {size}), got {tuple(given.shape)}."
        )
    return given


def _asks_gradients(plant: Plant, friction: Friction | None, *inputs: Tensor) -> bool:
    """Whether anything that shapes the motion requires a gradient."""
    given: tuple[Any, ...] = (plant, friction)
    modules = [m for m in given if isinstance(m, nn.Module)]
    owned = [t for m in modules for t in (*m.parameters(), *m.buffers())]
    return any(t.requires_grad for t in (*inputs, *owned))


def _driving(
    drive: str, measured: tuple[Tensor, Tensor] | None, q: Tensor, steps: int
) -> tuple[Tensor, Tensor] | None:
    """Validate the measured motion that drives the coefficients."""
    if drive not in ("simulated", "measured") or (drive == "measured") != (measured is not None):
        raise ValueError(
            '`drive` is "simulated", or "measured" together with `measured=(qd, qdd)`; got '
            f"{drive!r} {'without' if measured is None else 'with'} `measured`."
        )
    if measured is None:
        return None
    found = torch.as_tensor(measured[0]).to(q), torch.as_tensor(measured[1]).to(q)
    for x in found:
        if x.shape[-2:] != (steps, q.shape[-1]) or not torch.isfinite(x.detach()).all():
            raise ValueError(
                f"`measured` must be two finite (*batch, {steps}, {q.shape[-1]}), a value a step, "
                f"got {tuple(found[0].shape)} and {tuple(found[1].shape)}."
            )
    return found


def _prepare(
    plant: Plant,
    friction: Friction | None,
    q0: Tensor,
    qd0: Tensor,
    tau: Tensor | None,
    sample_time: float | Tensor,
    steps: int | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, int]:
    """Validate a rollout's inputs and bring them to tensors of matching shape."""
    q0, qd0 = torch.as_tensor(q0), torch.as_tensor(qd0)
    if not q0.is_floating_point():
        q0 = q0.to(torch.float64)
    qd0 = qd0.to(q0)
    joints = plant.joints
    if friction is not None and friction.joints != joints:
        raise ValueError(f"the plant has {joints} joints, the friction model {friction.joints}.")
    for name, value in (("q0", q0), ("qd0", qd0)):
        if value.ndim == 0 or value.shape[-1] != joints:
            raise ValueError(
                f"`{name}` must be (*batch, joint) with {joints} joints, got {tuple(value.shape)}."
            )
        if not torch.isfinite(value.detach()).all():
            raise ValueError(f"`{name}` must be finite, got NaN or infinity.")
    step = torch.as_tensor(sample_time, dtype=q0.dtype, device=q0.device)
    lengths = {
        "steps": steps,
        "sample_time": step.shape[-1] if step.ndim else None,
        "tau": None if tau is None else tau.shape[-2],
    }
    known = {name: n for name, n in lengths.items() if n is not None}
    if not known or len(set(known.values())) != 1:
        raise ValueError(f"the number of steps must be given and agree, got {known or 'nothing'}.")
    steps = next(iter(known.values()))
    if steps < 1 or not bool((step >= 0).all()) or not torch.isfinite(step).all():
        raise ValueError("`steps` must be at least 1 and `sample_time` finite and positive [s].")
    if step.ndim == 0:
        step = step.expand(steps)
    torque = q0.new_zeros(1, 1).expand(steps, joints) if tau is None else tau.to(q0)
    if torque.shape[-1] != joints:
        raise ValueError(f"`tau` must be (*batch, steps, {joints}), got {tuple(torque.shape)}.")
    if not torch.isfinite(torque.detach()).all():
        raise ValueError("`tau` must be finite, got NaN or infinity.")
    shape = np.broadcast_shapes(
        q0.shape, qd0.shape, (*torque.shape[:-2], joints), (*step.shape[:-1], joints)
    )
    return q0.expand(shape), qd0.expand(shape), torque, step, steps


def _refuse_unstable(
    plant: Plant, friction: Friction | None, sample_time: float, substeps: int
) -> None:
    if friction is None:
        return
    longest_step = sample_time / substeps
    slope, limit = friction.slope_at_rest(), stability_limit(plant, longest_step)
    excess = (slope / limit).reshape(-1, plant.joints).amax(0)
    # As much slack as `required_substeps` takes, so that what it says is never refused.
    if bool((excess * (1 - 1e-9) > 1).any()):
        joint = int(excess.argmax())
        v_smooth = getattr(friction, "v_smooth", float("nan"))
        raise ValueError(
            f"friction of joint {joint + 1} is too steep at rest for steps of {longest_step:g} s: "
            f"slope {float(slope.reshape(-1, plant.joints)[:, joint].max()):.3g} N m s/rad, "
            f"stable below {float(limit.reshape(-1, plant.joints)[:, joint].min()):.3g}. "
            f"Use substeps={required_substeps(plant, friction, sample_time)} or "
            # A twentieth more outweighs the rounding to two digits.
            f"v_smooth >= {1.05 * v_smooth * float(excess.max()):.2g} (now {v_smooth:g})."
        )


def _compare_sample_times(friction: Friction | None, step: float) -> None:
    """Warn of a memory that fades at another rate than the model was made for."""
    meant = getattr(getattr(friction, "schedule", None), "sample_time", None)
    if meant is not None and not 0.5 < step / meant < 2.0:
        logger.warning(
            "samples of %.3g s advance a memory made for %.3g s, so it fades over %.2g times its "
            "time; see `Adaptive.set_sample_time`", step, meant, step / meant,
        )  # fmt: skip


def _divergence(time: Tensor, q: Tensor, qd: Tensor) -> Tensor:
    """Time of the first sample that is not finite or beyond any speed, infinity where none."""
    with torch.no_grad():
        lost = ~(torch.isfinite(q) & (qd.abs() < SPEED_LIMIT)).all(-1)
        first = lost.to(torch.int64).argmax(-1, keepdim=True)
        at = torch.gather(time.expand(lost.shape), -1, first).squeeze(-1)
        diverged_at = torch.where(lost.any(-1), at, torch.inf)
        count = int(lost.any(-1).sum())
        if count:
            logger.warning("%d rollout(s) diverged, first at %.4g s", count, diverged_at.min())
    return diverged_at
