"""MJCF and URDF: the closest damping and friction loss of a simulator's joints, and the error.

Simulators model `damping * qd + frictionloss * sgn(qd)`. The pair that comes closest along a real
motion is written, with its residual torque error. MuJoCo also has LuGre friction, as part of its
motors, so that LuGre and Dahl are exported exactly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np
import torch
from torch import Tensor

from nfriction.friction.inputs import has_input
from nfriction.friction.memory import DAHL, LUGRE
from nfriction.friction.models import FrictionModel
from nfriction.io.files import write_atomically
from nfriction.io.model_file import ModelInfo, check_joints
from nfriction.plant.robot_file import parse_xml
from nfriction.signals import Motion

Load = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class DampingFit:
    """Damping and friction loss closest to a model.

    `lugre`, empty without LuGre friction, contains stiffness, damping, Coulomb and static friction
    of bristles and Stribeck velocity, in MuJoCo's order.
    """

    joint_names: tuple[str, ...]
    damping: tuple[float, ...]  # [N m s/rad], (joint,)
    frictionloss: tuple[float, ...]  # [N m], (joint,)
    rms_torque: tuple[float, ...]  # of the model along the motion [N m], (joint,)
    rms_error: tuple[float, ...]  # of the torque with these two numbers [N m], (joint,)
    unit: str = "rad"  # of a joint's position, "rad" or "m"
    lugre: tuple[tuple[float, ...], ...] = ()  # (joint, 5)

    @property
    def relative_error(self) -> tuple[float, ...]:
        """RMS error over RMS torque of every joint [-]."""
        pairs = zip(self.rms_error, self.rms_torque, strict=True)
        return tuple(e / t if t > 0 else 0.0 for e, t in pairs)

    def __str__(self) -> str:
        torque = "N m" if self.unit == "rad" else "N"
        if self.lugre:
            bristles = zip(self.joint_names, self.damping, self.lugre, strict=True)
            return "\n".join(
                f"{name}: damping {d:.6g} {torque} s/{self.unit}, LuGre friction "
                f"{' '.join(f'{x:.6g}' for x in own)}, exact"
                for name, d, own in bristles
            )
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
def fit_damping_frictionloss(
    model: FrictionModel,
    motions: Motion | Sequence[Motion],
    *,
    load: Load | None = None,
    info: ModelInfo | None = None,
) -> DampingFit:
    """Fit damping and friction loss to a model by least squares over the samples of a motion.

    Motions are in joint coordinates; every sample has the same weight. `load` is the normal load at
    positions and velocities (sample, joint), such as `Plant.load`, 1 by default.

    Raises:
        ValueError: if the motion has other joints than the model, or none of it moves, or there is
            no `load` for friction that depends on the position.
    """
    parts = [motions] if isinstance(motions, Motion) else list(motions)
    torques = [_torque(model, part, load) for part in parts]
    qd = np.concatenate([part.qd for part in parts])
    tau = np.concatenate([x.cpu().numpy() for x in torques])
    sign = np.tanh(qd / model.v_smooth)
    pairs = [_fit(np.stack([qd[:, j], sign[:, j]], -1), tau[:, j], j) for j in range(model.joints)]
    left = tau - np.stack([d * qd[:, j] + f * sign[:, j] for j, (d, f) in enumerate(pairs)], -1)
    info = info or ModelInfo()
    return DampingFit(
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
    patch: str | Path | None = None,
) -> DampingFit:
    """Write a model as `damping` and `frictionloss` of MuJoCo's joints.

    Constant LuGre and Dahl friction becomes damping and, on each joint, a motor without input whose
    attribute `lugre` is the friction (MuJoCo 4.0).

    Args:
        path: XML file to write; missing folders are made.
        motions, load: see `fit_damping_frictionloss`.
        info: names of the joints, by which they are found in `patch`.
        patch: an MJCF file to copy with these numbers for its joints; by default a file of default
            classes is written, one per joint, to be included and used as the joints' `class`; a
            motor names its joint. Motors that are LuGre friction of these joints are replaced.

    Returns:
        The numbers and their errors.

    Raises:
        ValueError: see `fit_damping_frictionloss`; or if `patch` is not MJCF, or lacks a joint of
            that name.
        OSError: if a file cannot be read or written.
    """
    found = _bristles(model, info or ModelInfo())
    found = found or fit_damping_frictionloss(model, motions, load=load, info=info)
    return _written(found, path, "mujoco", patch)


def urdf(
    model: FrictionModel,
    path: str | Path,
    motions: Motion | Sequence[Motion],
    info: ModelInfo | None = None,
    *,
    load: Load | None = None,
    patch: str | Path | None = None,
) -> DampingFit:
    """Write a model as `<dynamics damping friction/>` of URDF joints.

    Args, Returns, Raises: as `mjcf`; without `patch` the file contains only the joints' elements,
        to be copied into a robot.
    """
    found = fit_damping_frictionloss(model, motions, load=load, info=info)
    return _written(found, path, "robot", patch)


def _bristles(model: FrictionModel, info: ModelInfo) -> DampingFit | None:
    """Parameters of a law that MuJoCo has: LuGre, or Dahl, without Stribeck effect and damping."""
    if model.law not in (DAHL, LUGRE) or model.schedule.follows_motion:
        return None
    values = model.schedule.rest_coefficients().detach().tolist()
    rows = [{"F_d": 0.0, "v_s": 1.0, "sigma_1": 0.0, **dict(zip(model.law.names, of, strict=True))}
            for of in values]  # fmt: skip
    zero = (0.0,) * model.joints
    return DampingFit(
        joint_names(model, info),
        tuple(row.get("sigma_2", row.get("F_v", 0.0)) for row in rows),
        zero, zero, zero, info.unit,
        tuple((row["sigma_0"], row["sigma_1"], row["F_c"], row["F_c"] + row["F_d"], row["v_s"])
              for row in rows),
    )  # fmt: skip


def _written(
    found: DampingFit, path: str | Path, root: str, patch: str | Path | None
) -> DampingFit:
    """Write the numbers into a new file, or into a robot with that root element."""
    if patch is not None:
        write_atomically(path, patched(patch, root, found))
        return found
    # An XML comment must not contain two hyphens.
    note = "\n".join(f"       {x}" for x in str(found).replace("--", "- -").splitlines())
    whole, row = _SNIPPETS[root]
    rows = "\n".join(
        row.format(name=quoteattr(name), damping=d, friction=f)
        for name, d, f in zip(found.joint_names, found.damping, found.frictionloss, strict=True)
    )
    motors = ElementTree.Element(root)
    _add_motors(motors, found)
    text = "".join(f"{ElementTree.tostring(x, encoding='unicode')}\n" for x in motors)
    write_atomically(path, whole.format(note=note, rows=rows, motors=text).encode())
    return found


def _add_motors(tree: ElementTree.Element, found: DampingFit) -> None:
    """Add a motor of MuJoCo for each joint with LuGre friction; it has no other function."""
    if not found.lugre:
        return
    actuators = tree.find("actuator")
    actuators = ElementTree.SubElement(tree, "actuator") if actuators is None else actuators
    for name, own in zip(found.joint_names, found.lugre, strict=True):
        friction = " ".join(f"{x:.15g}" for x in own)
        motor = {"joint": name, "input": "none", "motorconst": "0", "resistance": "1"}
        ElementTree.SubElement(actuators, "dcmotor", motor, lugre=friction)


# Files by their root element, with their entry for a joint. MJCF gets a default class for each
# joint; the elements in a URDF are to be copied into a robot.
_NOTE = "  <!-- Closest to the model along a recorded motion:\n{note}\n  -->\n"
_SNIPPETS = {
    "mujoco": (
        f"<mujoco>\n{_NOTE}  <default>\n{{rows}}\n  </default>\n{{motors}}</mujoco>\n",
        "    <default class={name}>\n"
        '      <joint damping="{damping!r}" frictionloss="{friction!r}"/>\n'
        "    </default>",
    ),
    "robot": (
        f'<robot name="friction">\n{_NOTE}{{rows}}\n{{motors}}</robot>\n',
        "  <joint name={name}>\n"
        '    <dynamics damping="{damping!r}" friction="{friction!r}"/>\n'
        "  </joint>",
    ),
}


def joint_names(model: FrictionModel, info: ModelInfo) -> tuple[str, ...]:
    """The joints' names, or numbers from 1 if they have none."""
    check_joints(info, model.joints)
    return tuple(info.joint_names) or tuple(f"joint{j + 1}" for j in range(model.joints))


def _torque(model: FrictionModel, motion: Motion, load: Load | None) -> Tensor:
    """Friction torque along a motion, (sample, joint)."""
    if motion.qd.ndim != 2 or motion.qd.shape[1] != model.joints:
        raise ValueError(
            f"the motion must be (time, joint) with {model.joints} joints, got {motion.qd.shape}."
        )
    if model.law.memory is not None:
        raise ValueError(
            f"damping and friction loss have no memory, but the law {model.law.name!r} has: export "
            "a model without memory, such as coulomb-viscous."
        )
    time, q, qd, qdd = map(torch.tensor, (motion.time, motion.q, motion.qd, motion.qdd))
    if load is None and has_input(model.law, "position"):
        raise ValueError("friction by position needs `load=plant.load`, of the plant of its fit.")
    weight = torch.ones_like(qd) if load is None else load(q, qd)
    schedule = model.schedule
    states = schedule.states(qd, qdd, time)
    return model.torque(qd, weight, schedule.coefficients_from(qd, qdd, states))


def _fit(columns: np.ndarray, tau: np.ndarray, joint: int) -> tuple[float, float]:
    """Damping and friction loss, neither negative: a simulator must not gain energy."""
    from scipy.optimize import nnls  # slow to import

    sizes = np.sqrt((columns**2).mean(0))
    if not (np.isfinite(tau).all() and np.isfinite(sizes).all() and (sizes > 0).all()):
        raise ValueError(f"joint {joint + 1} does not move, or its motion is not finite.")
    found, _ = nnls(columns / sizes, tau)
    damping, frictionloss = (found / sizes).tolist()
    return damping, frictionloss


def patched(path: str | Path, root: str, found: DampingFit) -> bytes:
    """A robot description with that root element, and the friction of the named joints replaced."""
    try:
        tree = parse_xml(Path(path), comments=True)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if tree.tag != root:
        raise ValueError(f"{path}: the root element is <{tree.tag[:40]}>, not <{root}>.")
    # In MJCF, elements of that name also refer to joints elsewhere.
    bodies = tree.findall("worldbody") if root == "mujoco" else [tree]
    joints = [joint for body in bodies for joint in body.iter("joint")]
    for name, d, f in zip(found.joint_names, found.damping, found.frictionloss, strict=True):
        matches = [joint for joint in joints if joint.get("name") == name]
        if len(matches) != 1:
            known = ", ".join(str(joint.get("name")) for joint in joints)[:200]
            raise ValueError(
                f"{path}: there must be one joint called {name!r}, found {len(matches)}; its "
                f"joints are {known or 'none'}. Name the model's joints in `joint_names`."
            )
        target = matches[0]
        if root == "robot":
            dynamics = target.find("dynamics")
            target = ElementTree.SubElement(target, "dynamics") if dynamics is None else dynamics
        target.set("damping", repr(d))
        target.set("frictionloss" if root == "mujoco" else "friction", repr(f))
    for group in tree.findall("actuator"):
        for old in group.findall("dcmotor[@lugre][@input='none']"):
            if old.get("joint") in found.joint_names:
                group.remove(old)
    _add_motors(tree, found)
    text = ElementTree.tostring(tree, encoding="unicode")
    return f'<?xml version="1.0" encoding="utf-8"?>\n{text}\n'.encode()
