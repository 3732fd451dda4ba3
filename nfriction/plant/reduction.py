"""A serial chain of hinged bodies in space as links in one plane, on a pivot or a rotating arm.

Robot descriptions (URDF, MJCF) may contain any spatial mechanism; those that are not a
`PendulumChain` are refused with the name of the joint and the rule.
"""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NoReturn

import numpy as np
import torch
from numpy.typing import NDArray

from nfriction.plant.chain import Arm, PendulumChain
from nfriction.plant.inertia import inertia_tensors

Array = NDArray[np.float64]

MOST_JOINTS, LONGEST_NAME = 50, 200
# In m, kg or kg m^2: far beyond any mechanism, and its squares can be summed.
LARGEST_NUMBER = 1e9
# The error of a right angle written as 1.57 is smaller [rad]; a larger tilt is intended.
TILT = 1e-3
# Largest distance of a mass centre from the line through the joints, in lengths of the link.
ASIDE = 1e-3


@dataclass(frozen=True)
class RigidBody:
    """Mass [kg], mass centre (3,) [m] and inertia about it (3, 3) [kg m^2], in world axes."""

    mass: float
    com: Array
    inertia: Array


@dataclass
class HingedLink:
    """A hinge and all bodies that turn with it, at the pose in which the file describes it."""

    name: str  # of the joint
    parent: int | None  # index of the link that carries the hinge; None for the ground
    axis: Array  # unit vector in the world, (3,)
    anchor: Array  # a point of the axis in the world, (3,) [m]
    armature: float = 0.0  # rotor inertia seen at the joint [kg m^2]
    reading: float = 0.0  # the joint's coordinate at this pose [rad]
    bodies: list[RigidBody] = field(default_factory=list)  # those that no later hinge turns

    def whole(self) -> RigidBody:
        """All bodies as one."""
        mass = sum(body.mass for body in self.bodies)
        if not mass > 0:
            _refuse(self.name, "carries no mass; add an inertial to the bodies it moves")
        com = sum((b.mass * b.com for b in self.bodies), np.zeros(3)) / mass
        inertia = np.zeros((3, 3))
        for body in self.bodies:
            d = body.com - com
            inertia += body.inertia + body.mass * (d @ d * np.eye(3) - np.outer(d, d))
        return RigidBody(mass, com, inertia)


@dataclass(frozen=True)
class _Planar:
    """Lengths and angles of the links in their plane."""

    length: list[float]
    com: list[float]
    angle: list[float]
    reach: Array  # of the mass centres along the joints' axis


def pendulum_chain(links: Sequence[HingedLink], gravity: Array, name: str) -> PendulumChain:
    """The planar chain that these links form, given in any order, under a gravity (3,) [m/s^2].

    Joint coordinates are those of the file: if the first link at zero is nearer to upright than to
    hanging, its angle is measured from upright, otherwise from hanging, and the difference goes
    into `angle_offset`. A first joint about the vertical becomes the arm. The length of the last
    link, which only drag needs, is that of a rod with its mass and inertia.
    """
    chain = _in_series(links)
    strength = float(np.linalg.norm(gravity))
    if not strength > 0:
        raise ValueError("there is no gravity, but a pendulum needs gravity.")
    up = -gravity / strength
    arm = chain[0] if len(chain) > 1 and _tilt(chain[0].axis, up) < TILT else None
    hinged = chain[1:] if arm else chain
    z = _common_axis(hinged, up)
    plane = np.stack([up, np.cross(z, up)])
    bodies = [link.whole() for link in hinged]
    flat = _in_plane(hinged, bodies, plane, z)
    # The nearer zero keeps `angle_offset` small, and often exactly zero.
    hanging = math.cos(flat.angle[0] - hinged[0].reading) < 0
    turns = np.diff([math.pi * hanging, *flat.angle])
    offset = [math.remainder(t - k.reading, math.tau) for t, k in zip(turns, hinged, strict=True)]
    tensors = np.array([_tensor(b.inertia, a, plane, z) for b, a in
                        zip(bodies, flat.angle, strict=True)])  # fmt: skip
    mass = [body.mass for body in bodies]
    carrier = None
    if arm:
        carrier, tensors = _carried(arm, hinged[0], mass, flat, tensors, up, z)
    with warnings.catch_warnings():
        # The tensors were checked before terms of other bodies were added to them.
        warnings.filterwarnings("ignore", message="the inertia of link")
        plant = PendulumChain(
            mass=mass,
            length=flat.length,
            com=flat.com,
            inertia=tensors.tolist() if arm else tensors[:, 2].tolist(),
            gravity=strength,
            arm=carrier,
            armature=[link.armature for link in chain],
            convention=("relative", "hanging" if hanging else "upright"),
            joint_names=[link.name for link in chain],
            name=name,
        )
    # A sine of pi gives 1e-16, but a chain that hangs at zero has no offset.
    offset = [0.0] * bool(arm) + [0.0 if abs(o) < 1e-12 else o for o in offset]
    if any(offset):
        plant = plant.replace(angle_offset=torch.tensor(offset, dtype=torch.float64))
    return plant


def _in_series(links: Sequence[HingedLink]) -> list[HingedLink]:
    """The links from the ground outward."""
    if not links:
        raise ValueError("it has no joint that turns; a chain needs at least one hinge.")
    if len(links) > MOST_JOINTS:
        raise ValueError(f"it has {len(links)} joints; chains of up to {MOST_JOINTS} are read.")
    chain: list[HingedLink] = []
    at: int | None = None
    while len(chain) < len(links):
        after = [k for k, link in enumerate(links) if link.parent == at]
        if len(after) > 1:
            where = "the ground" if at is None else f"joint {links[at].name!r}"
            names = ", ".join(repr(links[k].name) for k in after)
            raise ValueError(f"{where} carries several joints ({names}): a chain has no branches.")
        if not after:
            raise ValueError("the joints do not follow one another from the ground.")
        at = after[0]
        chain.append(links[at])
    return chain


# What to do with other robots.
IN_SPACE = (
    'For a spatial robot, make the joints with other axes "fixed" and record with these at rest, '
    "or fit the torques that its inverse dynamics do not explain with `nfriction fit-torque`"
)


def _common_axis(links: Sequence[HingedLink], up: Array) -> Array:
    """The axis about which all links turn, made exactly horizontal."""
    first = links[0]
    for link in links:
        lean = abs(math.pi / 2 - _tilt(link.axis, up))
        if lean > TILT:
            _refuse(link.name, f"has an axis {math.degrees(lean):.3g} degrees off the horizontal; "
                    "gravity must act in the plane of the links (only the first of several joints "
                    f"may turn about the vertical, as an arm). {IN_SPACE}")  # fmt: skip
        apart = _tilt(link.axis, first.axis)
        if apart > TILT:
            _refuse(link.name, f"has an axis {math.degrees(apart):.3g} degrees off that of "
                    f"{first.name!r}; all links must turn in one plane. {IN_SPACE}")  # fmt: skip
        # Not reversed here, because the sign of its recordings would silently change.
        if link.axis @ first.axis < 0:
            _refuse(link.name, f"turns against {first.name!r}: reverse its axis and the sign of "
                    "its recordings")  # fmt: skip
    # A right angle written as 1.57 tilts the axis unintentionally.
    level = first.axis - (first.axis @ up) * up
    return level / np.linalg.norm(level)


def _in_plane(
    links: Sequence[HingedLink], bodies: Sequence[RigidBody], plane: Array, z: Array
) -> _Planar:
    """Lengths, mass centres along the links, and absolute angles from upright."""
    length, com, angle = [], [], []
    for k, (link, body) in enumerate(zip(links, bodies, strict=True)):
        centre = plane @ (body.com - link.anchor)
        last = k == len(links) - 1
        ahead = centre if last else plane @ (links[k + 1].anchor - link.anchor)
        reach = float(np.hypot(*ahead))
        if last:
            about_joint = float(z @ body.inertia @ z) + body.mass * reach**2
            # A uniform rod of mass m and length L has m L^2 / 3 about its end.
            size = math.sqrt(3 * about_joint / body.mass) or 1.0
            along = ahead / reach if reach > 1e-9 * size else np.array([-1.0, 0.0])
        else:
            if not reach > 0:
                _refuse(links[k + 1].name, f"turns about the very axis of {link.name!r}; links "
                        "need a length")  # fmt: skip
            size, along = reach, ahead / reach
            aside = along[0] * centre[1] - along[1] * centre[0]
            # The equations have no mass off the line through the joints.
            if abs(aside) > ASIDE * size:
                _refuse(link.name, f"carries a mass centre {1e3 * abs(aside):.4g} mm off the line "
                        f"to {links[k + 1].name!r}, {1e3 * size:.4g} mm away; it must lie on that "
                        "line")  # fmt: skip
        length.append(size)
        com.append(float(centre @ along))
        angle.append(math.atan2(along[1], along[0]))
    return _Planar(length, com, angle, np.array([body.com @ z for body in bodies]))


def _tensor(inertia: Array, angle: float, plane: Array, z: Array) -> list[float]:
    """Ixx, Iyy, Izz, Ixy, Ixz, Iyz in the frame of a link at an angle from upright."""
    x = np.array([math.cos(angle), math.sin(angle)]) @ plane
    frame = np.stack([x, np.cross(z, x), z])
    i = frame @ inertia @ frame.T
    return [i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]


def _carried(
    arm: HingedLink, first: HingedLink, mass: Sequence[float], flat: _Planar, tensors: Array,
    up: Array, z: Array,
) -> tuple[Arm, Array]:  # fmt: skip
    """The arm, and the links' tensors as it sees them.

    A chain on an arm has all mass centres at one distance from the vertical axis. If the distances
    differ, the differences enter the equations as products of inertia.
    """
    sign = 1.0 if arm.axis @ up > 0 else -1.0
    beside = float((first.anchor - arm.anchor) @ np.cross(z, up))
    m = np.array(mass)
    reach = sign * (flat.reach - arm.anchor @ z)
    length = float(m @ reach / m.sum())
    if not length > 0:
        _refuse(arm.name, f"turns so that {first.name!r} points inward ({1e3 * length:.4g} mm): "
                "the first axis must point up and the others outward, or down and inward; "
                "reverse one and the sign of its recordings")  # fmt: skip
    if abs(beside) > ASIDE * length:
        _refuse(first.name, f"passes the axis of {arm.name!r} at {1e3 * abs(beside):.4g} mm; the "
                "two axes must meet")  # fmt: skip
    inertia_tensors(tensors.tolist(), len(m))  # warns if no body can have such an inertia
    seen = tensors.copy()
    seen[:, 4:] *= sign
    moment = m * (reach - length)
    for k in range(len(m)):
        seen[k, 4] -= moment[k] * flat.com[k] + moment[k + 1 :].sum() * flat.length[k]
    own = 0.0
    for body in arm.bodies:
        radius = body.com - arm.anchor
        radius = radius - (radius @ up) * up
        own += float(up @ body.inertia @ up + body.mass * (radius @ radius))
    own += float(m @ (reach**2 - length**2))
    if not own > 0:
        _refuse(arm.name, "carries no mass of its own; add an inertial to the bodies it moves")
    return Arm(own, length), seen


def _tilt(one: Array, other: Array) -> float:
    """Angle between two axes regardless of their sense [rad], 0 to pi/2."""
    return math.atan2(float(np.linalg.norm(np.cross(one, other))), abs(float(one @ other)))


def _refuse(joint: str, why: str) -> NoReturn:
    raise ValueError(f"joint {joint!r} {why}.")
