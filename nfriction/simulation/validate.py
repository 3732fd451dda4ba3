"""Validation of what a rollout is given."""

import logging
import math

import numpy as np
import torch
from torch import Tensor

from nfriction.simulation.protocols import Friction, Plant
from nfriction.simulation.rk4 import required_substeps, stability_limit

logger = logging.getLogger(__name__)


def all_finite(x: Tensor) -> bool:
    """Whether no element is NaN or infinite, in one pass over them."""
    if not x.numel():
        return True
    low, high = x.detach().aminmax()  # NaN if there is one
    return math.isfinite(low) and math.isfinite(high)


def driving_motion(
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
        if x.shape[-2:] != (steps, q.shape[-1]) or not all_finite(x):
            raise ValueError(
                f"`measured` must be two finite (*batch, {steps}, {q.shape[-1]}), a value a step, "
                f"got {tuple(found[0].shape)} and {tuple(found[1].shape)}."
            )
    return found


def prepared(
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
        if not all_finite(value):
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
    if steps < 1 or not bool((step >= 0).all()) or not all_finite(step):
        raise ValueError("`steps` must be at least 1 and `sample_time` finite and positive [s].")
    if step.ndim == 0:
        step = step.expand(steps)
    torque = q0.new_zeros(1, 1).expand(steps, joints) if tau is None else tau.to(q0)
    if torque.shape[-1] != joints:
        raise ValueError(f"`tau` must be (*batch, steps, {joints}), got {tuple(torque.shape)}.")
    if tau is not None and not all_finite(torque):
        raise ValueError("`tau` must be finite, got NaN or infinity.")
    shape = np.broadcast_shapes(
        q0.shape, qd0.shape, (*torque.shape[:-2], joints), (*step.shape[:-1], joints)
    )
    return q0.expand(shape), qd0.expand(shape), torque, step, steps


def refuse_unstable(
    plant: Plant, friction: Friction | None, sample_time: float, substeps: int
) -> None:
    if friction is None:
        return
    longest_step = sample_time / substeps
    slope, limit = friction.zero_velocity_damping(), stability_limit(plant, longest_step)
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


def compare_sample_times(friction: Friction | None, step: float) -> None:
    """Warn of a memory that fades at another rate than the model was made for."""
    meant = getattr(getattr(friction, "schedule", None), "sample_time", None)
    if meant is not None and not 0.5 < step / meant < 2.0:
        logger.warning(
            "samples of %.3g s advance a memory made for %.3g s, so it fades over %.2g times its "
            "time; see `Adaptive.set_sample_time`", step, meant, step / meant,
        )  # fmt: skip


def given_memory(friction: Friction | None, memory: Tensor | None, q: Tensor) -> Tensor | None:
    """Validate a given memory."""
    if memory is None:
        return None
    given, size = torch.as_tensor(memory).to(q), getattr(friction, "state_size", 0)
    if size == 0:
        raise ValueError("`memory` is for friction whose coefficients have one; leave it out.")
    if given.shape[-2:] != (q.shape[-1], size) or not all_finite(given):
        raise ValueError(
            f"`memory` must be finite (*batch, {q.shape[-1]}, {size}), got {tuple(given.shape)}."
        )
    return given
