"""Mechanisms with published parameters, by name: the papers' rigs and benches with recordings."""

import math
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

from torch import Tensor

from nfriction.plant.arm import Arm
from nfriction.plant.axis import LinearAxis
from nfriction.plant.base import Plant
from nfriction.plant.chain import PendulumChain
from nfriction.plant.rigfile import from_dict, read, write

__all__ = [
    "by_name",
    "dfki",
    "emps",
    "from_dict",
    "multiarm_double",
    "multiarm_single",
    "multiarm_triple",
    "names",
    "read",
    "rtip",
    "tlrip",
    "write",
    "xl330",
]

_HANGING = ("relative", "hanging")
_PAPER_QUANTUM = math.tau / 8192  # 2048 pulses per revolution, counted on all four edges
_MULTIARM_QUANTUM = math.tau / 40_000

InertiaCase = Literal["none", "izz"] | Sequence[Sequence[float]] | Tensor


def tlrip(
    arm: Literal["fixed", "free"] = "fixed",
    inertia: InertiaCase = "izz",
    *,
    name: str = "tlrip",
    convention: Sequence[str] = ("relative", "upright"),
) -> PendulumChain:
    """Triple link rotary inverted pendulum (Table 2); paper joints 2, 3, 4, with a free arm 1 too.

    Mass centres half way. The printed Izz are taken about the mass centres. The arm is a rod with
    Izz1 about its own centre; its balance mass appears in no printed equation and is left out.

    Args:
        arm: "fixed" (three joints) or "free" (four, the arm first).
        inertia: "none" (point masses), "izz" (slender links with the printed Izz) or a full
            tensor per link, (3, 6) as in `PendulumChain` [kg m^2].
        name, convention: for a rig of the same numbers.
    Raises:
        ValueError: for another `arm` or `inertia`.
    References:
        Comparative study of joint neuro-fuzzy friction models for a triple link rotary inverted
        pendulum, Table 2.
    """
    if arm not in ("fixed", "free"):
        raise ValueError(f'`arm` must be "fixed" or "free", got {arm!r}.')
    if isinstance(inertia, str) and inertia not in ("none", "izz"):
        raise ValueError(f'`inertia` must be "none", "izz" or (3, 6) numbers, got {inertia!r}.')
    arm_mass, arm_length, arm_izz = 3.1129, 0.42021, 0.25
    tensor: Any = inertia
    if isinstance(inertia, str):
        tensor = [0.04, 0.05, 0.05] if inertia == "izz" else None
    about_axis = arm_mass * arm_length**2 / 4 + (0.0 if tensor is None else arm_izz)
    free = arm == "free"
    return PendulumChain(
        mass=[0.7298, 0.6789, 0.45],
        length=[0.2675, 0.3650, 0.4240],
        inertia=tensor,
        arm=Arm(about_axis, arm_length) if free else None,
        joint_names=["joint1"] * free + ["joint2", "joint3", "joint4"],
        name=name,
        convention=convention,
        position_quantum=_PAPER_QUANTUM,
    )


def rtip(arm: Literal["fixed", "free"] = "fixed", inertia: InertiaCase = "izz") -> PendulumChain:
    """Rotary triple inverted pendulum of the second paper.

    Assumed: that paper prints no masses or lengths and describes the same pendulum, so the numbers
    are Table 2 of the first. Known to differ: angles are measured from hanging.

    Args:
        arm, inertia: as in `tlrip`.
    References:
        Comparison of friction estimation models for a rotary triple inverted pendulum.
    """
    return tlrip(arm, inertia, name="rtip", convention=_HANGING)


def multiarm_single() -> PendulumChain:
    """Single pendulum of the MultiArm-Pendulum bench (Kaheman et al., arXiv 2205.06231).

    The last link's length is published for none of the three; it is taken as twice the distance to
    its mass centre, as for an even rod, and matters to air drag only. The authors' values were
    fitted with viscous friction; in free swing only ratios are identifiable.
    """
    return PendulumChain(
        mass=[0.14758],
        com=[0.14775],
        length=[2 * 0.14775],
        inertia=[1.0912e-4],
        name="multiarm-single",
        convention=("absolute", "hanging"),
        position_quantum=_MULTIARM_QUANTUM,
    )


def multiarm_double() -> PendulumChain:
    """Double pendulum of the MultiArm-Pendulum bench; see `multiarm_single`."""
    return PendulumChain(
        mass=[0.093844, 0.137596],
        com=[0.108565, 0.116779],
        length=[0.172719, 2 * 0.116779],
        inertia=[4.3753e-4, 1.26883e-3],
        gravity=9.80858,
        name="multiarm-double",
        convention=("absolute", "hanging"),
        position_quantum=_MULTIARM_QUANTUM,
    )


def multiarm_triple() -> PendulumChain:
    """Triple pendulum of the MultiArm-Pendulum bench; see `multiarm_single`."""
    return PendulumChain(
        mass=[0.258172, 0.279428, 0.118624],
        com=[0.160000, 0.202939, 0.183709],
        length=[0.172800, 0.228700, 2 * 0.183709],
        inertia=[1.00043e-4, 3.14160e-4, 1.68739e-4],
        gravity=9.80834,
        name="multiarm-triple",
        convention=("absolute", "hanging"),
        position_quantum=_MULTIARM_QUANTUM,
    )


# m [kg], r = joint to mass centre [m], l = lengths [m], I about the joint [kg m^2], Ir = rotor
# inertia before the gear [kg m^2]; data/system_identification/identified_parameters of the source.
_DFKI: dict[str, dict[str, Any]] = {
    "A0": {"m": (0.608, 0.630), "r": (0.275, 0.166), "l": (0.3, 0.2),
           "I": (0.05472, 0.02522), "Ir": 6.07e-5},
    "C0": {"m": (0.6417, 0.5639), "r": (0.2, 0.3213), "l": (0.2, 0.3),
           "I": (0.02671, 0.05388), "Ir": 9.94e-5},
    "C1": {"m": (0.5235, 0.6256), "r": (0.2, 0.2557), "l": (0.2, 0.3),
           "I": (0.03189, 0.05087), "Ir": 6.29e-5},
}  # fmt: skip
_DFKI_GEAR = 6


def dfki(build: Literal["A0", "C0", "C1"]) -> PendulumChain:
    """Driven double pendulum of DFKI with quasi-direct drives, in three builds.

    The source adds the rotors as Ir (gr^2 + 1), -gr Ir, gr^2 Ir to M11, M12, M22: motor 2 turns
    against its joint, carried by link 1. That is, exactly, an inertia of link 2 smaller by gr Ir
    and armatures of (gr^2 + gr + 1) Ir and (gr^2 + gr) Ir, and is built so. In build C0 link 2's
    published inertia about its joint is below m r^2, which no body has; the mass matrix is
    positive definite all the same.

    Args:
        build: A0 (lengths 0.3, 0.2 m), C0 or C1 (0.2, 0.3 m).
    Raises:
        ValueError: for another build.
    References:
        github.com/dfki-ric-underactuated-lab/double_pendulum.
    """
    if build not in _DFKI:
        raise ValueError(f"`build` must be one of {sorted(_DFKI)}, got {build!r}.")
    p, gear = _DFKI[build], _DFKI_GEAR
    inertia = [i - m * r**2 for i, m, r in zip(p["I"], p["m"], p["r"], strict=True)]
    inertia[1] -= gear * p["Ir"]
    with warnings.catch_warnings():
        # Build C0: stated above, and its user cannot change it.
        warnings.filterwarnings("ignore", message="the inertia of link")
        return PendulumChain(
            mass=p["m"],
            com=p["r"],
            length=p["l"],
            inertia=inertia,
            armature=[(gear**2 + gear + 1) * p["Ir"], (gear**2 + gear) * p["Ir"]],
            name=f"dfki-{build}",
            convention=_HANGING,
            position_quantum=3.815e-4,
        )


def emps() -> LinearAxis:
    """Electro-mechanical positioning system, a ball-screw axis (Janot, Gautier, Brunot 2019).

    Published: tau = 95.1089 qdd + Fv qd + Fc sgn(qd) - 3.1648; the offset is on the friction's
    side, so it adds to tau here with the other sign. A regression on the recording confirms it
    (+3.10 N, 98.8 kg).
    """
    return LinearAxis(
        95.1089, torque_offset=3.1648, name="emps", joint_names=["axis"], position_quantum=5e-8
    )


def xl330() -> PendulumChain:
    """Pendulum on a Dynamixel XL330 servo (Duclusaud et al., ICRA 2025).

    0.49 kg at 0.10 m as published in each log. The rotor's inertia is not: 2.1e-3 kg m^2 brings
    the total to the 7.0e-3 that fits the drops.
    """
    return PendulumChain(
        mass=[0.49],
        length=[0.10],
        com=[0.10],
        armature=[2.1e-3],
        name="xl330",
        convention=_HANGING,
        position_quantum=1.534e-3,
    )


_RIGS: dict[str, Callable[[], Plant]] = {
    "tlrip": tlrip,
    "rtip": rtip,
    "multiarm-single": multiarm_single,
    "multiarm-double": multiarm_double,
    "multiarm-triple": multiarm_triple,
    "dfki-A0": partial(dfki, "A0"),
    "dfki-C0": partial(dfki, "C0"),
    "dfki-C1": partial(dfki, "C1"),
    "emps": emps,
    "xl330": xl330,
}


def names() -> list[str]:
    """Names that `by_name` takes."""
    return list(_RIGS)


def by_name(name: str) -> Plant:
    """A rig by its name.

    Raises:
        ValueError: for a name that is none of `names()`.
    """
    if name not in _RIGS:
        raise ValueError(f"no rig {name!r}; there are {', '.join(_RIGS)}, or give a rig file.")
    return _RIGS[name]()
