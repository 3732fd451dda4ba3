"""Plants: their common base, and the simplest one, a driven mass on a straight guide.

A plant is a module whose buffers are the constants of M(q) qdd + bias(q, qd) = tau +
torque_offset, with tau the torque at the joints, after gears if there are any. Friction is not
part of it: a rollout subtracts friction from tau.
"""

from __future__ import annotations

import copy
import difflib
import reprlib
import warnings
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from nfriction.recording.angles import AngleConvention

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True)
class Motor:
    """Motors that drive joints through gears: one number for all joints, or one for each.

    Recordings may contain the motors' angles and currents instead of positions and torques of
    joints, see `Recording.read`.

    Args:
        gear_ratio: turns of the motor per turn of its joint [-]; for an axis, motor angle per
            distance [rad/m]. Negative if they have opposite directions.
        rotor_inertia: of the rotor about its own axis, before the gear [kg m^2].
        torque_constant: torque of the motor per current, before the gear [N m/A]; None if no
            current is read.

    Raises:
        ValueError: for a ratio or constant of zero, a negative inertia, or non-numbers.
    """

    gear_ratio: float | Sequence[float] = 1.0
    rotor_inertia: float | Sequence[float] = 0.0
    torque_constant: float | Sequence[float] | None = None

    def __post_init__(self) -> None:
        for name, given in _known(asdict(self)).items():
            many = given if isinstance(given, list | tuple) else [given]
            found = vector(f"motor's {name}", many, None)
            bad, rule = (found < 0, "negative") if name == "rotor_inertia" else (found == 0, "zero")
            if bad.any():
                raise ValueError(f"`motor's {name}` must not be {rule}, got {found.tolist()}.")

    def each(self, name: str, joints: int) -> Tensor:
        """A field of every joint, (joints,)."""
        given = getattr(self, name)
        many = given if isinstance(given, list | tuple) else [given] * joints
        return vector(f"motor's {name}", many, joints)

    def reflected_inertia(self, joints: int) -> Tensor:
        """Inertia of each rotor seen at its joint, times the ratio squared, (joints,) [kg m^2]."""
        return self.each("rotor_inertia", joints) * self.each("gear_ratio", joints) ** 2


class Plant(nn.Module, ABC):
    """Base of the mechanisms; all methods take joint coordinates of shape (*batch, joint).

    Fits can adjust terms of `PendulumChain` and `LinearAxis` only.

    Args:
        joint_names: one per joint; None for joint1, joint2, ...
        name: of the mechanism, in tables and files.
        unit: of a position, "rad" or "m".
        convention: of the angles in its recordings' columns, ("relative" | "absolute",
            "upright" | "hanging"). The methods here always take relative angles from upright.
        position_quantum: smallest step of the position [rad or m]; None if unknown.
        motor: what drives the joints, if known.
    """

    kind: ClassVar[str]  # in files
    required: ClassVar[tuple[str, ...]]  # constructor arguments that a file must contain
    optional: ClassVar[tuple[str, ...]]

    torque_offset: Tensor
    load_waves: Tensor  # k of each joint [1/rad; 1/m]; zero: `load` is the normal load
    load_phase: Tensor  # p of each joint [rad]
    has_position_load: bool = False
    has_drag: bool = False
    first_link: int = 0
    # True if `load` is that of each joint's own link, and could be that of its bearing.
    has_link_load: bool = False
    _given: dict[str, Any]  # constructor arguments as plain numbers

    def __init__(
        self,
        joints: int,
        *,
        joint_names: Sequence[str] | None,
        name: str,
        unit: str,
        convention: Sequence[str] = ("relative", "upright"),
        position_quantum: float | None = None,
        motor: Motor | None = None,
    ) -> None:
        super().__init__()
        names = _texts("joint_names", joint_names or [f"joint{i + 1}" for i in range(joints)])
        if len(names) != joints or len(set(names)) != joints:
            raise ValueError(f"`joint_names` must be {joints} different names, got {names}.")
        angles = AngleConvention.of(_texts("convention", convention))
        if not isinstance(name, str):
            raise ValueError(f"`name` must be text, got {reprlib.repr(name)}.")
        if position_quantum is not None:
            position_quantum = number("position_quantum", position_quantum, positive=True)
        self.joints = joints
        self.joint_names = names
        self.name = name
        self.unit = unit
        self.convention = (angles.angles, angles.measured_from)
        self.position_quantum = position_quantum
        if not isinstance(motor, Motor | None):
            raise TypeError(f"`motor` must be a Motor(gear_ratio, ...) or None, got {motor!r}.")
        self.motor = motor
        for buffer in ("load_waves", "load_phase"):
            self.register_buffer(buffer, torch.zeros(joints, dtype=torch.float64))
        _ = self.motor_factors  # raises unless there is one number for each joint

    @property
    def effort(self) -> str:
        """Name of what moves a joint: a torque, or the force on an axis."""
        return "force" if self.unit == "m" else "torque"

    @property
    def effort_unit(self) -> str:
        return "N" if self.unit == "m" else "N m"

    @property
    def motor_factors(self) -> dict[str, list[float]]:
        """Position of each joint per motor angle, and its torque per motor current, if known."""
        if self.motor is None:
            return {}
        ratio = self.motor.each("gear_ratio", self.joints)
        found = {"motor": (1.0 / ratio).tolist()}
        if self.motor.torque_constant is not None:
            constant = self.motor.each("torque_constant", self.joints)
            found["current"] = (constant * ratio).tolist()
        return found

    def forward(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """Acceleration; the same as `forward_dynamics`, so that a plant can be exported."""
        return self.forward_dynamics(q, qd, tau)

    # Equations of motion, defined by each mechanism.

    @abstractmethod
    def gravity(self, q: Tensor) -> Tensor:
        """The gravity part of the bias."""

    @abstractmethod
    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """Acceleration at a state under joint torques."""

    @abstractmethod
    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Joint torques that give the accelerations."""

    def load(self, q: Tensor, qd: Tensor) -> Tensor:
        """Quantity other than speed on which the friction of each joint depends [-].

        The normal force over the weight that the joint carries; with `load_waves` k,
        (1 + cos(k q + p)) / 2 instead.
        """
        self._check(q=q, qd=qd)
        if self.has_position_load:
            return 0.5 + 0.5 * (self.load_waves * q + self.load_phase).cos()
        return self.normal_load(q, qd)

    @abstractmethod
    def normal_load(self, q: Tensor, qd: Tensor) -> Tensor:
        """Normal force in each joint over the weight that it carries [-], of its link or of all."""

    @abstractmethod
    def decay_rate(self, damping: Tensor) -> Tensor:
        """Fastest decay of velocities [1/s] that slopes (*batch, joint) of friction can cause."""

    def replace(self, **buffers: Tensor) -> Self:
        """A shallow copy with some buffers replaced and the others shared; this plant is unchanged.

        Args:
            **buffers: tensors by buffer name. They may carry gradients and extra leading
                dimensions that broadcast against the batch: `gravity_moment` of shape (P, 1, n)
                goes with `q` of shape (P, W, n).

        Raises:
            ValueError: for a name that is not a buffer, or trailing dimensions that differ.
            TypeError: for a value that is not a floating-point tensor.
        """
        own = dict(self.named_buffers(recurse=False))
        for name, value in buffers.items():
            if name not in own:
                raise ValueError(f"no buffer `{name}` to replace; there are {sorted(own)}.")
            if not isinstance(value, Tensor) or not value.is_floating_point():
                raise TypeError(f"`{name}` must be a floating-point tensor, got {value!r}.")
            trailing = tuple(own[name].shape)
            # Leading dimensions are batches of plants; the trailing ones belong to the buffer.
            if tuple(value.shape[value.ndim - len(trailing) :]) != trailing:
                raise ValueError(
                    f"`{name}` must have shape (*batch, {', '.join(map(str, trailing))}), "
                    f"got {tuple(value.shape)}."
                )
        values = {**own, **buffers}
        for name, value in buffers.items():
            # A module lists each tensor once, but each buffer must be found under its own name.
            if sum(value is other for other in values.values()) > 1:
                values[name] = value.view_as(value)
        # A deep copy takes shared and replaced objects from its memo.
        shared = (*self.parameters(), *(v for v in vars(self).values() if not isinstance(v, dict)))
        memo: dict[int, Any] = {id(v): v for v in shared}
        memo |= {id(own[name]): value for name, value in values.items()}
        clone = copy.deepcopy(self, memo)
        clone._note_replaced(buffers)
        return clone

    def _note_replaced(self, names: Collection[str]) -> None:
        """Hook of `replace` for terms that are omitted while their buffers are zero."""
        if "load_waves" in names:
            self.has_position_load = bool(self.load_waves.any())

    def _check(self, **states: Tensor) -> None:
        for name, value in states.items():
            tensor = isinstance(value, Tensor)
            if not tensor or value.shape[-1:] != (self.joints,):
                got = f"shape {tuple(value.shape)}" if tensor else reprlib.repr(value)
                raise ValueError(
                    f"`{name}` must be (*batch, {self.joints}), a tensor with the joints "
                    f"{self.joint_names} last, got {got}."
                )

    def to_dict(self) -> dict[str, Any]:
        """Constructor arguments, and buffers that were replaced, as plain JSON types."""
        data = {
            "kind": self.kind,
            "name": self.name,
            "joint_names": list(self.joint_names),
            "position_quantum": self.position_quantum,
            "motor": None if self.motor is None else _known(asdict(self.motor)),
            **self._given,
        }
        data = _known(data)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # shown when this plant was built
            fresh = dict(self.from_dict(data).named_buffers())
        # Only these, so that a file stays readable and unchanged buffers follow from its arguments.
        changed = {
            name: value.tolist()
            for name, value in self.named_buffers()
            if not torch.equal(value.cpu(), fresh[name].to(value.dtype))
        }
        return {**data, "buffers": changed} if changed else data

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """The plant of `to_dict`, whose `buffers` replace derived ones.

        Raises:
            ValueError: for missing or unknown keys, or values the constructor refuses.
        """
        check_keys("rig", data, cls.required, (*cls.optional, "buffers", "kind"))
        given = {key: data[key] for key in (*cls.required, *cls.optional) if key in data}
        if given.get("motor") is not None:
            check_keys("motor", given["motor"], (), [f.name for f in fields(Motor)])
            given["motor"] = Motor(**given["motor"])
        buffers = data.get("buffers", {})
        check_keys("buffers", buffers, (), buffers)
        values = {name: numbers(name, value) for name, value in buffers.items()}
        for name, value in values.items():
            if not value.isfinite().all():
                raise ValueError(f"`{name}` must be finite, got {value.tolist()}.")
        return cls(**given).replace(**values)


class LinearAxis(Plant):
    """Equation of motion mass * qdd = tau + torque_offset - asymmetry |qd|, in m and N.

    Args:
        mass: moving mass [kg], including the drive's inertia unless `motor` has it.
        torque_offset: constant force added to tau [N].
        name, joint_names, position_quantum, motor: see `Plant`.
    """

    kind = "axis"
    required = ("mass",)
    optional = ("torque_offset", "motor", "name", "joint_names", "position_quantum")

    mass: Tensor  # (1,) [kg]
    # Difference in viscous resistance between the two directions, (1,) [N s/m]; zero unless
    # `replace` sets it. With viscous friction B it is passive up to B.
    asymmetry: Tensor

    def __init__(
        self,
        mass: float,
        *,
        torque_offset: float = 0.0,
        name: str = "",
        joint_names: Sequence[str] | None = None,
        position_quantum: float | None = None,
        motor: Motor | None = None,
    ) -> None:
        super().__init__(
            1, joint_names=joint_names, name=name, unit="m", position_quantum=position_quantum,
            motor=motor,
        )  # fmt: skip
        self.links = 1
        moved = vector("mass", [mass], 1, positive=True)
        if motor is not None:
            moved = moved + motor.reflected_inertia(1)
        self.register_buffer("mass", moved)
        self.register_buffer("torque_offset", vector("torque_offset", [torque_offset], 1))
        self.register_buffer("asymmetry", torch.zeros(1, dtype=torch.float64))
        self._given = {"mass": float(mass), "torque_offset": float(torque_offset)}

    def mass_matrix(self, q: Tensor) -> Tensor:
        """The mass [kg], (*batch, 1, 1)."""
        self._check(q=q)
        return torch.broadcast_tensors(self.mass, q)[0].unsqueeze(-1)

    def bias(self, q: Tensor, qd: Tensor) -> Tensor:
        """Force that depends on the direction of motion [N], (*batch, 1)."""
        self._check(q=q, qd=qd)
        return self.asymmetry * qd.abs() + torch.zeros_like(q)

    def gravity(self, q: Tensor) -> Tensor:
        """Zero force [N], (*batch, 1)."""
        self._check(q=q)
        return torch.zeros_like(q)

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """Acceleration [m/s^2], (*batch, 1), under a force with friction subtracted [N]."""
        self._check(q=q, qd=qd, tau=tau)
        qdd = (tau + self.torque_offset - self.asymmetry * qd.abs()) / self.mass
        return qdd.expand(np.broadcast_shapes(qdd.shape, q.shape, qd.shape))

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Force tau (friction subtracted) that gives the acceleration `qdd` [N], (*batch, 1)."""
        self._check(q=q, qd=qd, qdd=qdd)
        return self.mass * qdd + self.asymmetry * qd.abs() - self.torque_offset

    def energy(self, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        """Kinetic and (zero) potential energy [J], each (*batch)."""
        self._check(q=q, qd=qd)
        kinetic = (self.mass * qd * qd / 2).squeeze(-1)
        return kinetic, torch.zeros_like(kinetic)

    def normal_load(self, q: Tensor, qd: Tensor) -> Tensor:
        """Normal load over the load at rest [-]: 1, since the guide always carries the weight."""
        return torch.ones_like(q)

    @torch.no_grad()
    def decay_rate(self, damping: Tensor) -> Tensor:
        """Decay of the velocity under a friction slope [N s/m] of shape (*batch, 1), [1/s]."""
        return (damping.clamp(min=0.0).to(self.mass) / self.mass).amax(-1)

    def extra_repr(self) -> str:
        offset = self.torque_offset.tolist()
        return f"{self.name or 'unnamed'}, mass={self.mass.tolist()} kg, offset={offset} N"


def _known(data: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in data.items() if value is not None}


def check_keys(
    what: str, data: Mapping[str, Any], required: Collection[str], optional: Collection[str] = ()
) -> None:
    """Refuse a table with missing or unknown keys."""
    if not isinstance(data, Mapping):
        raise ValueError(f"{what} must be a table of keys and values, got {reprlib.repr(data)}.")
    known = [*required, *optional]
    missing = [key for key in required if key not in data]
    unknown = [str(key) for key in data if key not in known]
    near = [m for key in unknown[:9] for m in difflib.get_close_matches(key, known, 1)]
    faults = [f"missing keys {missing}"] * bool(missing)
    faults += [f"unknown keys {reprlib.repr(unknown)}"] * bool(unknown)
    faults += [f"did you mean {', '.join(near)}?"] * bool(near)
    if missing or unknown:
        raise ValueError(
            f"{what}: {', '.join(faults)}; required {sorted(required)}, "
            f"optional {sorted(optional)}."
        )


def _texts(name: str, values: object) -> tuple[str, ...]:
    """A list of texts; a single text would silently become a list of its letters."""
    if not isinstance(values, list | tuple) or not all(isinstance(v, str) for v in values):
        raise ValueError(f"`{name}` must be a list of texts, got {reprlib.repr(values)}.")
    return tuple(values)


def number(name: str, value: object, *, positive: bool = False) -> float:
    """One finite number, or an error that names it."""
    if isinstance(value, list | tuple):
        raise ValueError(f"`{name}` must be one number, got {reprlib.repr(value)}.")
    return vector(name, [value], 1, positive=positive).item()


def vector(name: str, values: object, count: int | None, *, positive: bool = False) -> Tensor:
    """`count` (None: one or more) finite numbers as a float64 tensor on the CPU, or an error."""
    wanted = "one or more numbers" if count is None else f"a list of {count}"
    result = numbers(name, values, wanted)
    if result.ndim != 1 or not len(result) or count not in (None, len(result)):
        raise ValueError(f"`{name}` must be {wanted}, got {result.tolist()}.")
    if not result.isfinite().all() or (positive and not (result > 0).all()):
        rule = "positive and finite" if positive else "finite"
        raise ValueError(f"`{name}` must be {rule}, got {result.tolist()}.")
    return result


def numbers(name: str, values: object, wanted: str = "numbers") -> Tensor:
    """Numbers as a float64 tensor on the CPU, or an error that names them."""
    try:
        return torch.as_tensor(values, dtype=torch.float64).detach().cpu()
    # Ragged lists, texts, and whole numbers that exceed every float.
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise ValueError(f"`{name}` must be {wanted}, got {reprlib.repr(values)}.") from error
