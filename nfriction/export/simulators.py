"""MJCF and URDF: the nearest damping and friction loss of a simulator's joints, and its price.

Simulators know `damping * qd + frictionloss * sgn(qd)`. Of all such pairs the one that comes
closest along a real motion is written, beside the torque error that is left.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from nfriction.export.robot_xml import mjcf_snippet, patched, urdf_snippet
from nfriction.export.unfiltered import memory_of
from nfriction.friction.models import FrictionModel
from nfriction.io.atomic import write_atomically
from nfriction.io.model_info import ModelInfo
from nfriction.signals import Motion

Load = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Collapse:
    """A model brought down to two numbers a joint.

    Attributes:
        joint_names: in the order of the joints.
        damping: [N m s/rad], (joint,).
        frictionloss: [N m], (joint,).
        rms_torque: of the model along the motion [N m], (joint,).
        rms_error: of what the two numbers give instead [N m], (joint,).
        unit: of a joint's position, "rad" or "m".
    """

    joint_names: tuple[str, ...]
    damping: tuple[float, ...]
    frictionloss: tuple[float, ...]
    rms_torque: tuple[float, ...]
    rms_error: tuple[float, ...]
    unit: str = "rad"

    @property
    def relative_error(self) -> tuple[float, ...]:
        """RMS error over RMS torque of every joint [-]."""
        pairs = zip(self.rms_error, self.rms_torque, strict=True)
        return tuple(e / t if t > 0 else 0.0 for e, t in pairs)

    def __str__(self) -> str:
        torque = "N m" if self.unit == "rad" else "N"
        rows = zip(
            self.joint_names, self.damping, self.frictionloss, self.rms_error,
            self.relative_error, strict=True,
        )  # fmt: skip
        return "\n".join(
            f"{name}: damping {d:.6g} {torque} s/{self.unit}, friction loss {f:.6g} {torque}; "
            f"the torque is off by {e:.3g} {torque} RMS, {100 * r:.3g} % of it"
            for name, d, f, e, r in rows
        )


@torch.no_grad()
def collapse(
    model: FrictionModel,
    motions: Motion | Sequence[Motion],
    *,
    load: Load | None = None,
    info: ModelInfo | None = None,
) -> Collapse:
    """The nearest damping and friction loss along a motion, by least squares over its samples.

    Args:
        model: a friction model.
        motions: in joint coordinates; every sample has the same weight, so that what the mechanism
            does most counts most.
        load: normal load at positions and velocities (sample, joint), as `Plant.load`; 1 if not
            given.
        info: names and unit of the joints.

    Raises:
        ValueError: if the motion is not one of the model's joints, or stands still.
    """
    parts = [motions] if isinstance(motions, Motion) else list(motions)
    torques = [_torque(model, part, load) for part in parts]
    qd = np.concatenate([part.qd for part in parts])
    tau = np.concatenate([x.cpu().numpy() for x in torques])
    sign = np.tanh(qd / model.v_smooth)
    pairs = [_fit(np.stack([qd[:, j], sign[:, j]], -1), tau[:, j], j) for j in range(model.joints)]
    left = tau - np.stack([d * qd[:, j] + f * sign[:, j] for j, (d, f) in enumerate(pairs)], -1)
    info = info or ModelInfo()
    return Collapse(
        joint_names=joint_names(model, info),
        damping=tuple(d for d, _ in pairs),
        frictionloss=tuple(f for _, f in pairs),
        rms_torque=tuple(np.sqrt((tau**2).mean(0)).tolist()),
        rms_error=tuple(np.sqrt((left**2).mean(0)).tolist()),
        unit=info.unit,
    )


def mjcf(
    model: FrictionModel,
    path: str | Path,
    motions: Motion | Sequence[Motion],
    info: ModelInfo | None = None,
    *,
    load: Load | None = None,
    into: str | Path | None = None,
) -> Collapse:
    """Write a model as `damping` and `frictionloss` of MuJoCo's joints.

    Args:
        model: a friction model.
        path: XML file to write; missing folders are made.
        motions, load: see `collapse`.
        info: names of the joints, by which they are found in `into`.
        into: an MJCF file whose joints are given the numbers; default a file of default classes,
            one a joint, to be included and named as the joints' `class`.

    Returns:
        The numbers and what they cost.

    Raises:
        ValueError: see `collapse`; or if `into` is no MJCF, or lacks a joint of that name.
        OSError: if a file cannot be read or written.
    """
    found = collapse(model, motions, load=load, info=info)
    return _written(found, path, "mujoco", mjcf_snippet, into)


def urdf(
    model: FrictionModel,
    path: str | Path,
    motions: Motion | Sequence[Motion],
    info: ModelInfo | None = None,
    *,
    load: Load | None = None,
    into: str | Path | None = None,
) -> Collapse:
    """Write a model as `<dynamics damping friction/>` of URDF joints.

    Args, Returns, Raises: as `mjcf`; without `into` the file holds the joints' elements alone, to
        be copied into a robot.
    """
    found = collapse(model, motions, load=load, info=info)
    return _written(found, path, "robot", urdf_snippet, into)


def _written(
    found: Collapse,
    path: str | Path,
    root: str,
    snippet: Callable[..., bytes],
    into: str | Path | None,
) -> Collapse:
    """Write the numbers as a snippet of its own, or into a robot of that root element."""
    numbers = found.joint_names, found.damping, found.frictionloss
    text = snippet(*numbers, str(found)) if into is None else patched(into, root, *numbers)
    write_atomically(path, text)
    return found


def joint_names(model: FrictionModel, info: ModelInfo) -> tuple[str, ...]:
    """The joints' names, or numbers from 1 where they have none."""
    return tuple(info.joint_names) or tuple(f"joint_{j + 1}" for j in range(model.joints))


def _torque(model: FrictionModel, motion: Motion, load: Load | None) -> Tensor:
    """Friction torque along a motion, (sample, joint)."""
    if motion.qd.ndim != 2 or motion.qd.shape[1] != model.joints:
        raise ValueError(
            f"the motion must be (time, joint) with {model.joints} joints, got {motion.qd.shape}."
        )
    q, qd, qdd = (torch.as_tensor(x) for x in (motion.q, motion.qd, motion.qdd))
    weight = torch.ones_like(qd) if load is None else load(q, qd)
    if not memory_of(model):
        return model(qd, qdd, weight)
    schedule = model.schedule
    states = [schedule.initial_state(qd[0], qdd[0])]
    for k in range(1, len(qd)):
        states.append(schedule.advance(qd[k], qdd[k], states[-1]))
    return model.torque(qd, weight, schedule.coefficients_from(qd, qdd, torch.stack(states)))


def _fit(columns: np.ndarray, tau: np.ndarray, joint: int) -> tuple[float, float]:
    """Damping and friction loss, neither negative: a simulator must not gain energy."""
    sizes = np.sqrt((columns**2).mean(0))
    if not (np.isfinite(tau).all() and np.isfinite(sizes).all() and (sizes > 0).all()):
        raise ValueError(f"joint {joint + 1} stands still along the motion, or it is not finite.")
    found, _ = nnls(columns / sizes, tau)
    damping, frictionloss = (found / sizes).tolist()
    return damping, frictionloss
