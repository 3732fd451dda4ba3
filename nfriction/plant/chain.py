"""A chain of pendulum links on a fixed pivot or a rotating arm, and a single turning axis."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nfriction.plant import dynamics
from nfriction.plant.base import Motor, Plant, check_keys, number, numbers, vector
from nfriction.plant.inertia import fastest_mode, inertia_tensors, require_positive_definite

if TYPE_CHECKING:
    from typing_extensions import Self

# Zero in a new chain.
_PER_JOINT = ("angle_offset", "encoder_cosine", "encoder_sine", "gear_loss", "torque_offset")
# Smallest gravity [m/s^2], because loads are in units of a link's weight.
WEIGHTLESS = 1e-6


@dataclass(frozen=True)
class Arm:
    """A rotating arm at whose end the chain hangs.

    Args:
        inertia: of the arm alone about the vertical axis [kg m^2] (m1 L1^2/4 + Izz1 for a link of
            mass m1 with its mass centre half way).
        length: from the vertical axis to the chain's first joint [m].
    """

    inertia: float
    length: float

    def __post_init__(self) -> None:
        # Without length the arm does not move the chain, and the mass matrix may be singular.
        for name in ("inertia", "length"):
            value = number(f"arm's {name}", getattr(self, name), positive=True)
            object.__setattr__(self, name, value)


def _check_options(gravity: float, arm: Arm | None, normal_load: str) -> None:
    if gravity < WEIGHTLESS:
        raise ValueError(
            f"`gravity` must be at least {WEIGHTLESS:g} m/s^2, got {gravity:g}; write "
            f"{WEIGHTLESS:g} for links in a horizontal plane (one joint alone: the kind rotor)."
        )
    if not isinstance(arm, Arm | None):
        raise TypeError(f"`arm` must be an Arm(inertia, length) or None, got {arm!r}.")
    if normal_load not in ("link", "bearing") or (normal_load == "bearing" and arm):
        raise ValueError(
            '`normal_load` must be "link" or, for a chain on a fixed pivot, "bearing", got '
            f"{normal_load!r}."
        )


def _rotor_inertia(
    motor: Motor | None, armature: Sequence[float] | Tensor | None, joints: int
) -> Tensor:
    """Rotor inertia seen at each joint, from the motors or as given, (joints,)."""
    rotor = (motor or Motor()).reflected_inertia(joints)
    if armature is not None:
        if rotor.any():
            raise ValueError("give `armature` or the motor's `rotor_inertia`, not both.")
        rotor = vector("armature", armature, joints)
    if (rotor < 0).any():
        raise ValueError(f"`armature` must not be negative, got {rotor.tolist()}.")
    return rotor


class _Geometry(NamedTuple):
    pose: dynamics.Pose
    arm: dynamics.ArmTerms | None
    coupling: dynamics.Matrix


class PendulumChain(Plant):
    """Frictionless equations of motion M(q) qdd + bias(q, qd) = tau + torque_offset.

    Joint coordinates: with a free arm, column 0 is its angle about the vertical; the first link
    is measured from upright, each further one relative to the previous link. Air drag, gears and
    eccentric encoders are part of a plant once `replace` sets them. With gears, methods take and
    return the motors' torques, from which friction is subtracted on the motor side, as a controller
    commands it; tau above is their torque at the joints. With eccentric encoders, inputs and
    outputs are encoder angles, except that `mass_matrix`, `bias` and `gravity` refer to the true
    angles at that reading.

    Args:
        mass: of each link [kg].
        length: joint to joint, for the last link joint to tip (only drag needs that one) [m].
        com: joint to mass centre [m]; None for the middle of each link.
        inertia: about the mass centre [kg m^2]: None (point masses), Izz per link (slender rods)
            or (links, 6) columns Ixx, Iyy, Izz, Ixy, Ixz, Iyz, link frame x along the link,
            z the joint axis. Without a free arm only Izz matters.
        gravity: [m/s^2].
        arm: the rotating arm; None if it is fixed.
        armature: rotor inertia seen at each joint [kg m^2]; None for that of `motor`, if any.
        normal_load: `"link"` for |N|/(m g) of the joint's own link, as in the paper; `"bearing"`
            for the total force that the joint carries, from all links beyond it; see `load`.
        motor: motors and gears of the joints, with the rotors' inertias.
        convention: of the recordings' columns, see `Plant`.
        joint_names, name, position_quantum: see `Plant`.

    The constants of the equations are buffers, listed below with their units.

    Raises:
        ValueError: for values that are not positive, of another shape, or whose mass matrix is
            not positive definite.

    References:
        TLRIP paper, eqs. (2)-(22), corrected.
    """

    kind = "chain"
    required: ClassVar[tuple[str, ...]] = ("mass", "length")
    optional: ClassVar[tuple[str, ...]] = (
        *("com", "inertia", "gravity", "arm", "armature", "normal_load", "motor"),
        *("convention", "joint_names", "name", "position_quantum"),
    )

    # Constants of the equations, which follow from the arguments unless replaced.
    inertia_coupling: Tensor  # a_ij, (links, links) [kg m^2]; only the upper triangle is read
    gravity_moment: Tensor  # g b_i, (links,) [N m]
    armature: Tensor  # (joints,) [kg m^2]
    length: Tensor  # (links,) [m]
    load_lever: Tensor  # l_i / g, (links,) [s^2]; see `dynamics.bearing_lever` of bearing loads
    # With an arm only: J0, the arm with the links' masses at its end, () [kg m^2], and L1 / g,
    # () [s^2], so that L1 b_i follows `gravity_moment`.
    arm_inertia: Tensor
    arm_lever: Tensor
    inertia_tensor: Tensor  # (links, 6) [kg m^2]
    # Set only by `replace`: a fit estimates them.
    angle_offset: Tensor  # added to q before the geometry is evaluated, (joints,) [rad]
    encoder_cosine: Tensor  # eccentricity, see `dynamics.correct_encoder`, (joints,) [rad]
    encoder_sine: Tensor
    encoder_zero: Tensor  # cosine of the coordinate at hanging, (joints,)
    torque_gain: Tensor  # of gears, see `dynamics.joint_torque`, (joints,) [-]
    gear_loss: Tensor
    torque_offset: Tensor  # added to tau at the joints, (joints,) [N m]
    drag_linear: Tensor  # k1, (links,) [N s/m^2]
    drag_quadratic: Tensor  # k2, (links,) [N s^2/m^3]

    def __init__(
        self,
        mass: Sequence[float] | Tensor,
        length: Sequence[float] | Tensor,
        com: Sequence[float] | Tensor | None = None,
        inertia: Sequence[float] | Sequence[Sequence[float]] | Tensor | None = None,
        *,
        gravity: float = 9.81,
        arm: Arm | None = None,
        armature: Sequence[float] | Tensor | None = None,
        normal_load: Literal["link", "bearing"] = "link",
        motor: Motor | None = None,
        convention: Sequence[str] = ("relative", "upright"),
        joint_names: Sequence[str] | None = None,
        name: str = "",
        position_quantum: float | None = None,
    ) -> None:
        m = vector("mass", mass, None, positive=True)
        gravity = number("gravity", gravity)
        _check_options(gravity, arm, normal_load)
        links, first = len(m), int(arm is not None)
        super().__init__(
            first + links,
            joint_names=joint_names,
            name=name,
            unit="rad",
            convention=convention,
            position_quantum=position_quantum,
            motor=motor,
        )
        self.links, self.first_link = links, first
        size = vector("length", length, links, positive=True)
        centre = size / 2 if com is None else vector("com", com, links)
        tensors = inertia_tensors(inertia, links)
        rotor = _rotor_inertia(motor, armature, self.joints)
        self.bearing_load = normal_load == "bearing"
        self.has_link_load = not self.bearing_load and not arm and "normal_load" in self.optional
        lever = dynamics.bearing_lever(m, size, centre) if self.bearing_load else centre
        buffers = {
            "inertia_coupling": dynamics.coupling_constants(m, size, centre, tensors[:, 2]),
            "gravity_moment": gravity * dynamics.static_moment(m, size, centre),
            "armature": rotor,
            **{name: torch.zeros_like(rotor) for name in _PER_JOINT},
            "torque_gain": torch.ones_like(rotor),
            "drag_linear": torch.zeros_like(m),
            "drag_quadratic": torch.zeros_like(m),
            "length": size,
            "load_lever": lever / gravity,
        }
        if arm:
            buffers["arm_inertia"] = m.sum() * arm.length**2 + arm.inertia
            buffers["arm_lever"] = m.new_tensor(arm.length / gravity)
            buffers["inertia_tensor"] = tensors
        for key, value in buffers.items():
            self.register_buffer(key, value)
        # Joint coordinates are zero upright for the first link, in line for the others.
        hanging = torch.ones_like(rotor)
        hanging[first] = -1.0
        self.register_buffer("encoder_zero", hanging, persistent=False)
        # Absent terms cost nothing: they are Python flags, set here and by `replace`, never
        # tested by value within a step.
        self.has_armature = bool(rotor.any())
        self.has_gear = self.has_drag = self.has_eccentricity = False
        self._slender = bool(torch.equal(tensors[:, 1], tensors[:, 2])) and not bool(
            tensors[:, [0, 3, 4, 5]].any()
        )
        self._given: dict[str, Any] = {
            "convention": list(self.convention),
            "mass": m.tolist(),
            "length": size.tolist(),
            "com": centre.tolist(),
            "inertia": inertia if inertia is None else numbers("inertia", inertia).tolist(),
            "gravity": gravity,
            "arm": asdict(arm) if arm else None,
            "armature": None if armature is None or not self.has_armature else rotor.tolist(),
            "normal_load": normal_load if self.bearing_load else None,
        }
        aligned = self.mass_matrix(rotor.new_zeros(self.joints))
        require_positive_definite(self.inertia_coupling, aligned[first:, first:])

    def mass_matrix(self, q: Tensor) -> Tensor:
        """Mass matrix M(q), symmetric positive definite, (*batch, joint, joint) [kg m^2]."""
        self._check(q=q)
        q = self._true(q, q)[0]
        mass = dynamics.stack_matrix(
            dynamics.joint_matrix(self._mass(self._geometry(q)), self.first_link)
        )
        # That of a single link does not depend on q, but needs its batch shape.
        return mass.expand(np.broadcast_shapes(mass.shape, (*q.shape, self.joints)))

    def bias(self, q: Tensor, qd: Tensor) -> Tensor:
        """Centrifugal, Coriolis, gravity and drag torques [N m], (*batch, joint)."""
        self._check(q=q, qd=qd)
        q, qd = self._true(q, qd)
        force = self._bias(self._geometry(q), qd)
        return dynamics.stack(dynamics.joint_forces(force, self.first_link))

    def gravity(self, q: Tensor) -> Tensor:
        """The gravity part of the bias [N m], (*batch, joint): the potential's gradient."""
        self._check(q=q)
        pose = self._geometry(self._true(q, q)[0]).pose
        force = dynamics.gravity_forces(pose, self.gravity_moment.unbind(-1))
        own = [torch.zeros_like(force[0])] * self.first_link
        return dynamics.stack(dynamics.joint_forces([*own, *force], self.first_link))

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """Joint accelerations [rad/s^2] under torques with friction subtracted [N m].

        All (*batch, joint), with joint angles [rad] and rates [rad/s].
        """
        self._check(q=q, qd=qd, tau=tau)
        if self.has_eccentricity:
            angle, slope, curvature = self._corrected(q)
            return (self._accelerate(angle, slope * qd, tau) - curvature * qd * qd) / slope
        return self._accelerate(q, qd, tau)

    def _accelerate(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """True accelerations at true angles and rates."""
        geometry = self._geometry(q)
        if self.has_gear:
            tau = dynamics.joint_torque(tau, qd, self.torque_gain, self.gear_loss)
        force = dynamics.link_forces((tau + self.torque_offset).unbind(-1), self.first_link)
        bias = self._bias(geometry, qd)
        rhs = [f - h for f, h in zip(force, bias, strict=True)]
        # Every acceleration depends on every input, so all share one shape without broadcasting.
        return torch.stack(
            dynamics.relative(dynamics.solve(self._mass(geometry), rhs), self.first_link), -1
        )

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Joint torques tau (friction subtracted) that give the accelerations `qdd` [N m].

        All (*batch, joint), with joint angles [rad], rates [rad/s], accelerations [rad/s^2].
        """
        self._check(q=q, qd=qd, qdd=qdd)
        if self.has_eccentricity:
            q, slope, curvature = self._corrected(q)
            qd, qdd = slope * qd, slope * qdd + curvature * qd * qd
        geometry = self._geometry(q)
        inertial = dynamics.multiply(
            self._mass(geometry), dynamics.absolute(qdd.unbind(-1), self.first_link)
        )
        force = [f + h for f, h in zip(inertial, self._bias(geometry, qd), strict=True)]
        torque = dynamics.stack(dynamics.joint_forces(force, self.first_link)) - self.torque_offset
        if self.has_gear:
            torque = dynamics.motor_torque(torque, qd, self.torque_gain, self.gear_loss)
        return torque

    def energy(self, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        """Kinetic and potential energy [J], each (*batch); zero height is the first joint's."""
        self._check(q=q, qd=qd)
        q, qd = self._true(q, qd)
        geometry = self._geometry(q)
        rate = dynamics.absolute(qd.unbind(-1), self.first_link)
        kinetic = dynamics.dot(rate, dynamics.multiply(self._mass(geometry), rate)) / 2
        height = [angle.cos() for angle in geometry.pose.angle]
        return kinetic, dynamics.dot(self.gravity_moment.unbind(-1), height)

    def normal_load(self, q: Tensor, qd: Tensor) -> Tensor:
        """Normal force in each joint over the weight that it carries [-].

        For links |N_i| / (m_i g), N_i = m_i l_i qd_i^2 - m_i g cos phi_i with the joint's own rate
        qd_i and the link's absolute angle phi_i from upright; 1 for the arm, whose axis is
        vertical. For bearings the force in the hinge over the weight beyond it, at the acceleration
        of the motion without friction and torque.

        References:
            TLRIP paper, eqs. (26)-(29), with - m g cos phi for + m g cos theta: the printed sign
            belongs to angles from hanging; taken literally, it feeds in energy.
        """
        q, qd = self._true(q, qd)
        if self.bearing_load:
            pose = self._geometry(q).pose
            free = self._accelerate(q, qd, torch.zeros_like(q))
            speed, turn = (dynamics.absolute(x.unbind(-1), 0) for x in (qd, free))
            return dynamics.bearing_load(pose, speed, turn, dynamics.entries(self.load_lever))
        angle = (q + self.angle_offset)[..., self.first_link :].cumsum(-1)
        # The paper's normal force uses the joint's own rate, not the link's absolute one.
        rate = qd[..., self.first_link :]
        load = (self.load_lever * rate * rate - angle.cos()).abs()
        return torch.cat([torch.ones_like(load[..., :1]), load], -1) if self.first_link else load

    @torch.no_grad()
    def decay_rate(self, damping: Tensor) -> Tensor:
        """Fastest decay of velocities that joint friction can cause in any pose [1/s].

        The largest eigenvalue of M^-1 D over a grid of poses, at most 5 degrees apart for one or
        two turning angles and coarser for more, with D the slopes of friction over velocity on the
        joint side of gears. Negative slopes count as zero, which gives an upper bound.

        Args:
            damping: slope of each joint's friction torque [N m s/rad], (*batch, joint).

        Returns:
            Shape (*batch,), the largest over all values of a plant with batches of buffers.
        """
        effective = damping.clamp(min=0.0)
        # LAPACK raises for infinite entries; a caller handles infinite rates.
        if not effective.isfinite().all():
            return effective.amax(-1)
        rows = effective.reshape(-1, self.joints).to(self.armature)
        # Friction acts at the motor; the gear multiplies its slope at the joint by at most this.
        gear = self.torque_gain * (1.0 + self.gear_loss)
        found = [fastest_mode(self, gear * row) for row in rows]
        return torch.stack(found).reshape(damping.shape[:-1])

    def extra_repr(self) -> str:
        arm, given = "free" if self.first_link else "fixed", self._given
        return (
            f"{self.name or 'unnamed'}, links={self.links}, arm={arm}, mass={given['mass']}, "
            f"length={given['length']}, convention={self.convention}, "
            f"armature={self.has_armature}, drag={self.has_drag}, gears={self.has_gear}"
        )

    def _note_replaced(self, names: Collection[str]) -> None:
        super()._note_replaced(names)
        if {"drag_linear", "drag_quadratic"} & set(names):
            if self.first_link:
                raise ValueError(
                    "air drag is modelled only for a fixed arm, without the sweep of a rotating "
                    "one. Use a chain without `arm`."
                )
            self.has_drag = True
        if {"encoder_cosine", "encoder_sine"} & set(names):
            self.has_eccentricity = True
        self.has_armature = self.has_armature or "armature" in names
        self.has_gear = self.has_gear or bool({"torque_gain", "gear_loss"} & set(names))
        # A fit starts at zeros that will change.
        self._slender = self._slender and "inertia_tensor" not in names

    def _corrected(self, q: Tensor) -> dynamics.EncoderCorrection:
        return dynamics.correct_encoder(
            q, self.encoder_zero, self.encoder_cosine, self.encoder_sine
        )

    def _true(self, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        """True angles and rates from encoder readings."""
        if not self.has_eccentricity:
            return q, qd
        corrected = self._corrected(q)
        return corrected.angle, corrected.slope * qd

    def _geometry(self, q: Tensor) -> _Geometry:
        pose = dynamics.pose_of((q + self.angle_offset).unbind(-1)[self.first_link :])
        coupling = dynamics.entries(self.inertia_coupling)
        if not self.first_link:
            return _Geometry(pose, None, coupling)
        lever = (self.gravity_moment * self.arm_lever.unsqueeze(-1)).unbind(-1)
        tensor = None
        if not self._slender:
            tensor = [list(row.unbind(-1)) for row in self.inertia_tensor.unbind(-2)]
        arm = dynamics.arm_terms(pose, coupling, self.arm_inertia, lever, tensor)
        return _Geometry(pose, arm, coupling)

    def _mass(self, geometry: _Geometry) -> dynamics.Matrix:
        """Mass matrix over (arm angle, absolute link angles), rotors included."""
        mass = dynamics.planar_mass(geometry.pose, geometry.coupling)
        if geometry.arm is not None:
            mass = dynamics.with_arm_mass(mass, geometry.arm)
        if self.has_armature:
            dynamics.add_rotors(mass, self.armature.unbind(-1), self.first_link)
        return mass

    def _bias(self, geometry: _Geometry, qd: Tensor) -> list[Tensor]:
        """Bias over (arm angle, absolute link angles)."""
        joint = qd.unbind(-1)
        rate = dynamics.absolute(joint[self.first_link :], 0)
        squared = [x * x for x in rate]
        bias = dynamics.gravity_forces(geometry.pose, self.gravity_moment.unbind(-1))
        dynamics.add_centrifugal(bias, geometry.pose, geometry.coupling, squared)
        if self.has_drag:
            coefficients = (self.length, self.drag_linear, self.drag_quadratic)
            drag = dynamics.drag_forces(geometry.pose, rate, *(x.unbind(-1) for x in coefficients))
            bias = [h + d for h, d in zip(bias, drag, strict=True)]
        if geometry.arm is not None:
            bias = dynamics.with_arm_bias(bias, geometry.arm, joint[0], rate, squared)
        return bias

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        arm = data.get("arm")
        if arm is not None:
            check_keys("arm", arm, ("inertia", "length"))
            data = {**data, "arm": Arm(**arm)}
        plant = super().from_dict(data)
        # Values from a file have not been checked by the constructor.
        dynamics.check_gear(plant.torque_gain, plant.gear_loss)
        return plant


class Rotor(PendulumChain):
    """Equation of motion (inertia + rotor) qdd - mass g com sin q = tau + torque_offset.

    In rad and N m at the joint, after the gear if there is one; q is measured from upright. It is a
    chain of one link, but described like the load of a motor, with all inertia in one number.

    Args:
        inertia: of everything on the shaft about the axis, without the motor's rotor [kg m^2].
        mass: of a pendulum or an unbalanced load [kg]; zero if balanced.
        com: distance from the axis to the centre of that mass [m].
        motor: its rotor's inertia is added, times the gear ratio squared.
        convention: `("relative", "hanging")` if zero is the rest pose of a pendulum.
        name, joint_names, position_quantum: see `Plant`.

    Raises:
        ValueError: if nothing has an inertia, or `inertia` is less than `mass com^2`.
    """

    kind = "rotor"
    required = ()
    optional = ("inertia", "mass", "com", "motor", "convention", "joint_names", "name",
                "position_quantum")  # fmt: skip

    def __init__(
        self,
        inertia: float = 0.0,
        mass: float = 0.0,
        com: float = 0.0,
        *,
        motor: Motor | None = None,
        convention: Sequence[str] = ("relative", "upright"),
        joint_names: Sequence[str] | None = None,
        name: str = "",
        position_quantum: float | None = None,
    ) -> None:
        values = {"inertia": inertia, "mass": mass, "com": com}
        given = {key: number(key, value) for key, value in values.items()}
        inertia, mass, com = given.values()
        if mass < 0 or inertia < 0:
            raise ValueError(f"`mass` and `inertia` must not be negative, got {mass}, {inertia}.")
        if bool(mass) != bool(com):
            raise ValueError(
                f"`mass` and `com` belong together, got {mass} and {com}: a pendulum needs both; "
                "omit both for a balanced wheel."
            )
        # Up to round-off: a point mass on a massless rod has exactly this inertia.
        if inertia < (1 - 1e-9) * mass * com**2:
            raise ValueError(
                f"`inertia` is about the axis and at least mass com^2 = {mass * com**2:.4g} "
                f"kg m^2, got {inertia:g}."
            )
        if not isinstance(motor, Motor | None):
            raise TypeError(f"`motor` must be a Motor(gear_ratio, ...) or None, got {motor!r}.")
        # All inertia in one number, because its parts are not identifiable separately.
        rotor = 0.0 if motor is None else float(motor.reflected_inertia(1))
        if not inertia + rotor > 0:
            raise ValueError(
                "a rotor needs `inertia`, or a `motor` with a `rotor_inertia` [kg m^2]."
            )
        super().__init__(
            [mass or 1.0], [2 * abs(com) or 1.0], [com if mass else 0.0],
            [inertia + rotor - mass * com**2],
            motor=None if motor is None else replace(motor, rotor_inertia=0.0),
            convention=convention, joint_names=joint_names, name=name,
            position_quantum=position_quantum,
        )  # fmt: skip
        self.motor = motor
        self._given = {**given, "convention": list(self.convention)}

    def normal_load(self, q: Tensor, qd: Tensor) -> Tensor:
        """1 [-], because the load of a motor's gear and bearings hardly depends on the pose."""
        return torch.ones_like(q)

    def extra_repr(self) -> str:
        given = ", ".join(f"{key}={self._given[key]}" for key in ("inertia", "mass", "com"))
        return f"{self.name or 'unnamed'}, {given}, motor={self.motor}"
