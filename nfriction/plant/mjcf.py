"""Links of an MJCF, as MuJoCo's own compiler understands it (default classes, geoms, meshes)."""

import warnings
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from nfriction.plant.reduction import LARGEST_NUMBER, LONGEST_NAME, HingedLink, RigidBody

# What makes many bodies of a line, or reads other files as descriptions.
_NO_CHAIN = ("replicate", "composite", "flexcomp", "attach", "plugin", "extension", "include")


def mjcf_links(path: Path, root: Element) -> tuple[list[HingedLink], NDArray[np.float64], str]:
    """The hinged links of an MJCF at its reference pose, its gravity [m/s^2], and its name.

    Damping, friction loss, limits, contacts and actuators are not read: friction is no part of a
    plant.

    Args:
        path: of the file, in whose folder its meshes lie.
        root: its root element.

    Raises:
        ValueError: for what MuJoCo refuses, and for joints that are no hinges, springs, tendons,
            equalities, or a medium that brakes.
        ImportError: where MuJoCo is not installed.
    """
    for element in root.iter():
        name = element.get("name", "")
        if len(name) > LONGEST_NAME:
            raise ValueError(f"{name[:80]!r}... is a name of {len(name)} characters.")
        if element.tag in _NO_CHAIN:
            raise ValueError(f"<{element.tag}> is not read; write the chain out in one file.")
    try:
        import mujoco
    except ImportError as error:
        raise ImportError(
            "reading an MJCF takes MuJoCo, whose compiler knows its default classes and "
            "geometries: pip install mujoco; or give a URDF or a rig file."
        ) from error
    model, data = _at_reference(path, mujoco)
    links: list[HingedLink] = []
    mover: list[int | None] = [None]  # of the world
    for body in range(1, model.nbody):
        of = mover[model.body_parentid[body]]
        for k in range(model.body_jntnum[body]):
            joint = model.body_jntadr[body] + k
            links.append(
                HingedLink(
                    model.joint(joint).name or f"joint{joint + 1}",
                    of,
                    data.xaxis[joint].copy(),
                    data.xanchor[joint].copy(),
                    float(model.dof_armature[model.jnt_dofadr[joint]]),
                    float(model.qpos0[model.jnt_qposadr[joint]]),
                )
            )
            of = len(links) - 1
        mover.append(of)
        if of is not None:
            frame = data.ximat[body].reshape(3, 3)
            inertia = frame @ np.diag(model.body_inertia[body]) @ frame.T
            links[of].bodies.append(
                RigidBody(float(model.body_mass[body]), data.xipos[body].copy(), inertia)
            )
    return links, np.array(model.opt.gravity), root.get("model", "")


def _at_reference(path: Path, mujoco: Any) -> tuple[Any, Any]:
    """The compiled model, and its data at the reference pose."""
    said: list[str] = []
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(said.append)  # else MuJoCo writes a file where the user stands
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
        _refuse_more_than_hinges(model, mujoco)
        data = mujoco.MjData(model)
        data.qpos[:] = model.qpos0
        mujoco.mj_kinematics(model, data)
    finally:
        mujoco.set_mju_user_warning(handler)
    numbers = (model.body_mass, model.body_inertia, model.dof_armature, model.qpos0,
               model.opt.gravity, data.xipos, data.ximat, data.xanchor, data.xaxis)  # fmt: skip
    if not all((np.abs(x) <= LARGEST_NUMBER).all() for x in numbers):  # false of NaN
        hint = f" (MuJoCo says: {'; '.join(dict.fromkeys(said))[:300]})" if said else ""
        raise ValueError(f"its bodies and joints need numbers of at most {LARGEST_NUMBER:g}{hint}.")
    for words in dict.fromkeys(said):
        warnings.warn(f"{path}: MuJoCo says: {words}", stacklevel=2)
    return model, data


def _refuse_more_than_hinges(model: Any, mujoco: Any) -> None:
    """Refuse what acts on a chain and is no part of our equations."""
    for joint in range(model.njnt):
        name = model.joint(joint).name
        kind = mujoco.mjtJoint(model.jnt_type[joint])
        if kind != mujoco.mjtJoint.mjJNT_HINGE:
            word = kind.name.removeprefix("mjJNT_").lower()
            raise ValueError(f"joint {name!r} is {word!r}; a pendulum's joints are hinges.")
        if np.any(model.jnt_stiffness[joint]):
            raise ValueError(f"joint {name!r} has a spring; a plant has none.")
    for count, what in ((model.neq, "equality constraints"), (model.ntendon, "tendons")):
        if count:
            raise ValueError(f"it has {what}; a plant is a chain of free hinges.")
    if model.opt.density or model.opt.viscosity:
        raise ValueError(
            "its medium brakes (density, viscosity); set both to 0: air drag is fitted with the "
            "friction."
        )
    if model.body_gravcomp.any():
        raise ValueError("it compensates gravity (gravcomp); leave that to the torques.")
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
        raise ValueError("its gravity is switched off, and a pendulum needs some.")
