"""Mechanisms from robot descriptions: URDF, read with the standard library, or MuJoCo's MJCF."""

import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from nfriction.plant.chain import PendulumChain
from nfriction.plant.reduction import (
    LARGEST_NUMBER,
    LONGEST_NAME,
    Array,
    HingedLink,
    RigidBody,
    pendulum_chain,
)

ENDINGS = (".urdf", ".xml", ".mjcf")
LARGEST_FILE = 64 * 2**20
GRAVITY = np.array([0.0, 0.0, -9.81])  # URDF states none, but its z is up (REP 103) [m/s^2]

_HINGES = ("revolute", "continuous")
# Elements that generate many bodies, or read other files as descriptions.
_NO_CHAIN = ("replicate", "composite", "flexcomp", "attach", "plugin", "extension", "include")


def read_robot(path: str | Path) -> PendulumChain:
    """The chain of a URDF or MJCF, with the file's joint names and coordinates.

    Serial chains of hinges with parallel, horizontal axes are read, alone or on an arm that turns
    about the vertical. Bodies fixed to a link count as part of it. Rotor inertias are MJCF's
    `armature`; friction, limits, contacts and actuators are left out.
    """
    path = Path(path)
    root = parse_xml(path)
    # Macros are a program, which a reader of data must not run.
    if any("xacro" in element.tag for element in root.iter()):
        raise ValueError("contains macros; expand it first: xacro robot.xacro > robot.urdf")
    if root.tag == "robot":
        return pendulum_chain(urdf_links(root), GRAVITY, root.get("name", ""))
    if root.tag == "mujoco":
        return pendulum_chain(*mjcf_links(path, root))
    raise ValueError(f"the root element is <{root.tag[:40]}>, neither <robot> nor <mujoco>.")


def parse_xml(path: Path, *, comments: bool = False) -> Element:
    """The root of an XML file, with its comments as elements if `comments`."""
    size = path.stat().st_size
    if size > LARGEST_FILE:
        raise ValueError(f"{size} bytes are too large for a robot description.")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"must be UTF-8 ({error.reason}).") from error
    # Entities can be made to grow without bound, or to read other files; no robot needs them.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("declares a document type or entities, which is refused.")
    builder = ElementTree.TreeBuilder(insert_comments=comments)
    try:
        return ElementTree.fromstring(text, ElementTree.XMLParser(target=builder))
    except ElementTree.ParseError as error:
        raise ValueError(f"not XML, or cut short ({error}).") from error


def urdf_links(robot: Element) -> list[HingedLink]:
    """The hinged links of a robot, with the bodies fixed to them; its root link is the ground."""
    links = _named(robot, "link")
    children: dict[str, list[Element]] = {name: [] for name in links}
    carried: set[str] = set()
    for name, joint in _named(robot, "joint").items():
        parent, child = (_link(joint, end, name, links) for end in ("parent", "child"))
        if child in carried:
            raise ValueError(f"link {child!r} is the child of two joints; a chain has no loop.")
        carried.add(child)
        children[parent].append(joint)
    # A tree has one root; with more there are several robots in one file.
    roots = [name for name in links if name not in carried]
    if len(roots) != 1:
        raise ValueError(f"there must be one link that no joint carries, got {roots}.")
    found: list[HingedLink] = []
    reached = 0
    # Link, its frame in the world, and the hinge that moves it.
    waiting: list[tuple[str, Array, Array, int | None]]
    waiting = [(roots[0], np.eye(3), np.zeros(3), None)]
    while waiting:
        name, turn, place, mover = waiting.pop()
        reached += 1
        if mover is not None and (inertial := links[name].find("inertial")) is not None:
            found[mover].bodies.append(_body(inertial, name, turn, place))
        for joint in children[name]:
            rotation, shift = _origin(joint, f"joint {joint.get('name')!r}")
            frame, origin, of = turn @ rotation, place + turn @ shift, mover
            if joint.get("type") != "fixed":
                found.append(_hinge(joint, frame, origin, mover))
                of = len(found) - 1
            waiting.append((_link(joint, "child", "", links), frame, origin, of))
    # Links in a loop are carried by each other, and never reached from the root.
    if reached < len(links):
        raise ValueError(f"{len(links) - reached} links form a loop without connection to ground.")
    return found


def _hinge(joint: Element, frame: Array, origin: Array, parent: int | None) -> HingedLink:
    name = str(joint.get("name"))
    if joint.get("type") not in _HINGES:
        raise ValueError(
            f"joint {name!r} is {joint.get('type', '')[:80]!r}; a pendulum's are revolute or "
            "continuous."
        )
    # A coupled joint removes a degree of freedom of the chain.
    if joint.find("mimic") is not None:
        raise ValueError(f"joint {name!r} mimics another; every joint must be free.")
    given = joint.find("axis")
    axis = _numbers(given, "xyz", f"axis of joint {name!r}", "1 0 0")
    size = float(np.linalg.norm(axis))
    if not size > 0:
        raise ValueError(f"joint {name!r} has an axis without direction.")
    return HingedLink(name, parent, frame @ axis / size, origin)


def _body(inertial: Element, link: str, turn: Array, place: Array) -> RigidBody:
    what = f"link {link!r}"
    rotation, com = _origin(inertial, f"inertial of {what}")
    given, mass = inertial.find("inertia"), inertial.find("mass")
    # URDF allows them to be absent, but then simulators use different defaults.
    if given is None or mass is None:
        raise ValueError(f"{what}: an inertial needs `mass` and `inertia`.")
    xx, yy, zz, xy, xz, yz = (
        float(_numbers(given, f"i{pair}", f"inertia of {what}", count=1)[0])
        for pair in ("xx", "yy", "zz", "xy", "xz", "yz")
    )
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    kilograms = float(_numbers(mass, "value", f"mass of {what}", count=1)[0])
    if kilograms < 0 or min(xx, yy, zz) < 0:
        raise ValueError(f"{what}: mass and moments of inertia must not be negative.")
    frame = turn @ rotation
    return RigidBody(kilograms, place + turn @ com, frame @ matrix @ frame.T)


def _origin(element: Element, what: str) -> tuple[Array, Array]:
    """Rotation and shift of an element's `origin`."""
    from scipy.spatial.transform import Rotation  # slow to import

    given = element.find("origin")
    what = f"origin of the {what}"
    # Roll, pitch and yaw are about fixed axes, which lower-case letters denote.
    turn = Rotation.from_euler("xyz", _numbers(given, "rpy", what, "0 0 0"))
    return turn.as_matrix(), _numbers(given, "xyz", what, "0 0 0")


def _numbers(
    element: Element | None, key: str, what: str, default: str | None = None, count: int = 3
) -> Array:
    text = default if element is None else element.get(key, default)
    try:
        values = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        values = np.zeros(0)
    # False of NaN.
    if len(values) != count or not (np.abs(values) <= LARGEST_NUMBER).all():
        raise ValueError(
            f"{what}: `{key}` must be {count} finite numbers up to {LARGEST_NUMBER:g}, "
            f"got {(text or '')[:80]!r}."
        )
    return values


def _named(robot: Element, tag: str) -> dict[str, Element]:
    found: dict[str, Element] = {}
    for element in robot.findall(tag):
        name = element.get("name", "")
        if len(name) > LONGEST_NAME:
            raise ValueError(f"{tag} {name[:80]!r}... has a name of {len(name)} characters.")
        if not name or name in found:
            raise ValueError(f"every {tag} needs a unique name, got {name[:80]!r} again or empty.")
        found[name] = element
    return found


def _link(joint: Element, end: str, name: str, links: dict[str, Element]) -> str:
    given = joint.find(end)
    link = "" if given is None else given.get("link", "")
    if link not in links:
        raise ValueError(f"joint {name!r} has a {end} that is not a link: {link[:80]!r}.")
    return link


def mjcf_links(path: Path, root: Element) -> tuple[list[HingedLink], Array, str]:
    """The hinged links of an MJCF at its reference pose, its gravity [m/s^2], and its name.

    Read with MuJoCo's own compiler, which resolves default classes, geoms and meshes.
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
            "reading an MJCF file needs MuJoCo, whose compiler resolves default classes and "
            "geometries: pip install mujoco; or give a URDF or a rig file."
        ) from error
    model, data = _at_reference(path, mujoco)
    links: list[HingedLink] = []
    mover: list[int | None] = [None]  # of the world
    for body in range(1, model.nbody):
        of = mover[model.body_parentid[body]]
        for k in range(model.body_jntnum[body]):
            joint = model.body_jntadr[body] + k
            name = model.joint(joint).name or f"joint{joint + 1}"
            hinge = HingedLink(name, of, data.xaxis[joint].copy(), data.xanchor[joint].copy())
            hinge.armature = float(model.dof_armature[model.jnt_dofadr[joint]])
            hinge.reading = float(model.qpos0[model.jnt_qposadr[joint]])
            links.append(hinge)
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
    mujoco.set_mju_user_warning(said.append)  # otherwise MuJoCo writes a log file to the folder
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
        _refuse_more_than_hinges(model, mujoco)
        data = mujoco.MjData(model)
        # The pose in which the file describes the bodies: MuJoCo's coordinates equal `ref`.
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
    """Refuse forces on a chain that are not part of the equations of motion."""
    for joint in range(model.njnt):
        name = model.joint(joint).name
        kind = mujoco.mjtJoint(model.jnt_type[joint])
        if kind != mujoco.mjtJoint.mjJNT_HINGE:
            word = kind.name.removeprefix("mjJNT_").lower()
            raise ValueError(f"joint {name!r} is {word!r}; a pendulum's joints are hinges.")
        if np.any(model.jnt_stiffness[joint]):
            raise ValueError(f"joint {name!r} has a spring; a plant has none.")
    no_gravity = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    for found, why in (
        (model.neq, "it has equality constraints; a plant is a chain of free hinges"),
        (model.ntendon, "it has tendons; a plant is a chain of free hinges"),
        # Air drag is fitted together with the friction.
        (
            model.opt.density or model.opt.viscosity,
            "its medium causes drag; set density and viscosity to 0",
        ),
        (model.body_gravcomp.any(), "it compensates gravity (gravcomp); leave that to the torques"),
        (no_gravity, "its gravity is switched off, but a pendulum needs gravity"),
    ):
        if found:
            raise ValueError(f"{why}.")
