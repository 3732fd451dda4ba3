"""Links of a URDF, by the standard library alone."""

import math
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from nfriction.plant.reduction import LARGEST_NUMBER, LONGEST_NAME, HingedLink, RigidBody

Array = NDArray[np.float64]

GRAVITY = np.array([0.0, 0.0, -9.81])
"""URDF has none; its world has z up (REP 103) [m/s^2]."""

_HINGES = ("revolute", "continuous")


def urdf_links(robot: Element) -> list[HingedLink]:
    """The hinged links of a robot, with what is fixed to them.

    Its root link stands on the ground. Limits, friction and transmissions are not read: friction
    is no part of a plant.

    Args:
        robot: the file's root element.

    Raises:
        ValueError: for links or joints that are no tree of hinges and fixed joints, or numbers
            that are none.
    """
    links = _named(robot, "link")
    children: dict[str, list[Element]] = {name: [] for name in links}
    carried: set[str] = set()
    for name, joint in _named(robot, "joint").items():
        parent, child = (_link(joint, end, name, links) for end in ("parent", "child"))
        if child in carried:
            raise ValueError(f"link {child!r} hangs on two joints; a chain closes no loop.")
        carried.add(child)
        children[parent].append(joint)
    roots = [name for name in links if name not in carried]
    if len(roots) != 1:
        raise ValueError(f"there must be one link that no joint carries, got {roots}.")
    found: list[HingedLink] = []
    reached = 0
    # Link, its frame in the world, and the hinge that moves it.
    waiting: list[tuple[str, Array, Array, int | None]] = [(roots[0], np.eye(3), np.zeros(3), None)]
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
    if reached < len(links):
        raise ValueError(f"{len(links) - reached} links go round in a circle, off the ground.")
    return found


def _hinge(joint: Element, frame: Array, origin: Array, parent: int | None) -> HingedLink:
    name = str(joint.get("name"))
    if joint.get("type") not in _HINGES:
        raise ValueError(
            f"joint {name!r} is {joint.get('type', '')[:80]!r}; a pendulum's are revolute or "
            "continuous."
        )
    if joint.find("mimic") is not None:
        raise ValueError(f"joint {name!r} mimics another; every joint must be free.")
    given = joint.find("axis")
    axis = _numbers(given, "xyz", f"axis of joint {name!r}", "1 0 0")
    size = float(np.linalg.norm(axis))
    if not size > 0:
        raise ValueError(f"joint {name!r} has an axis of no direction.")
    return HingedLink(name, parent, frame @ axis / size, origin)


def _body(inertial: Element, link: str, turn: Array, place: Array) -> RigidBody:
    what = f"link {link!r}"
    rotation, com = _origin(inertial, f"inertial of {what}")
    given, mass = inertial.find("inertia"), inertial.find("mass")
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
    given = element.find("origin")
    what = f"origin of the {what}"
    roll, pitch, yaw = _numbers(given, "rpy", what, "0 0 0").tolist()
    sr, cr, sp, cp = math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch)
    sy, cy = math.sin(yaw), math.cos(yaw)
    rotation = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return rotation, _numbers(given, "xyz", what, "0 0 0")


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
            raise ValueError(
                f"every {tag} needs a name of its own, got {name[:80]!r} again or empty."
            )
        found[name] = element
    return found


def _link(joint: Element, end: str, name: str, links: dict[str, Element]) -> str:
    given = joint.find(end)
    link = "" if given is None else given.get("link", "")
    if link not in links:
        raise ValueError(f"joint {name!r} has a {end} that is no link: {link[:80]!r}.")
    return link
