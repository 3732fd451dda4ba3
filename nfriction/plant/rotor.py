"""One turning axis: a motor on a bench, with a flywheel or a pendulum on its shaft, or bare."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from nfriction.plant.base import Motor, number
from nfriction.plant.chain import PendulumChain


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
