"""Rigs: published mechanisms by name, and a user's own from files.

A rig file (JSON or TOML) contains the constructor arguments of `PendulumChain` (kind "chain", the
default), `Rotor` (kind "rotor") or `LinearAxis` (kind "axis"), in SI units:

    {"kind": "chain", "name": "bench", "mass": [0.26, 0.12], "length": [0.17, 0.23],
     "com": [0.16, 0.18], "inertia": [1e-4, 1.7e-4], "convention": ["absolute", "hanging"],
     "position_quantum": 1.571e-4}
    {"kind": "rotor", "inertia": 0.02,
     "motor": {"gear_ratio": 50, "rotor_inertia": 1.2e-5, "torque_constant": 0.03}}

Angles of a chain without a `convention` are relative, from upright. `motor` may be given for every
kind, with one number for all joints or one for each (`Motor`). `buffers` may contain values in
place of derived constants, such as `{"drag_quadratic": [0.01, 0.01]}`, as in the file of a fitted
plant. Robot descriptions (URDF, MJCF) can also be read.
"""

import difflib
import json
import math
import reprlib
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from nfriction.io.files import is_intact, parse_json, write_atomically
from nfriction.plant import robot_file
from nfriction.plant.base import LinearAxis, Plant
from nfriction.plant.chain import Arm, PendulumChain, Rotor

_HANGING = ("relative", "hanging")
_PAPER_QUANTUM = math.tau / 8192  # 2048 pulses per revolution, counted on all four edges

InertiaCase = Literal["none", "izz"] | Sequence[Sequence[float]] | Tensor


def tlrip(
    arm: Literal["fixed", "free"] = "fixed",
    inertia: InertiaCase = "izz",
    *,
    name: str = "tlrip",
    convention: Sequence[str] = ("relative", "upright"),
) -> PendulumChain:
    """Triple link rotary inverted pendulum (Table 2): paper joints 2 to 4, with a free arm 1 to 4.

    Mass centres are in the middle of links; the printed Izz are taken about them. The arm is a rod
    with Izz1 about its own centre; its balance mass is left out, as in all printed equations.

    Args:
        arm: "fixed" (three joints) or "free" (four, the arm first).
        inertia: "none" (point masses), "izz" (slender links with the printed Izz) or a full
            tensor per link, (3, 6) as in `PendulumChain` [kg m^2].
        name, convention: for another rig with the same numbers.

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
    """Rotary triple inverted pendulum of the RTIP paper.

    That paper prints no masses or lengths and describes the same pendulum, so the numbers are
    assumed to be those in Table 2 of the TLRIP paper. In contrast, angles are measured from
    hanging.

    References:
        Comparison of friction estimation models for a rotary triple inverted pendulum.
    """
    return tlrip(arm, inertia, name="rtip", convention=_HANGING)


def _multiarm(
    name: str, mass: list[float], com: list[float], inertia: list[float],
    inner_lengths: list[float], gravity: float = 9.81,
) -> PendulumChain:  # fmt: skip
    """A pendulum of the MultiArm-Pendulum bench (Kaheman et al., arXiv 2205.06231).

    The last link's length is not published for any of them; it is taken as twice the distance to
    its mass centre, as for a uniform rod, and affects only air drag. The authors' values were
    fitted with viscous friction; in free swing only ratios are identifiable.
    """
    return PendulumChain(
        mass=mass,
        com=com,
        length=[*inner_lengths, 2 * com[-1]],
        inertia=inertia,
        gravity=gravity,
        name=f"multiarm-{name}",
        convention=("absolute", "hanging"),
        position_quantum=math.tau / 40_000,
    )


def multiarm_single() -> PendulumChain:
    """Single pendulum of the MultiArm-Pendulum bench (Kaheman et al., arXiv 2205.06231)."""
    return _multiarm("single", [0.14758], [0.14775], [1.0912e-4], [])


def multiarm_double() -> PendulumChain:
    """Double pendulum of the MultiArm-Pendulum bench (Kaheman et al., arXiv 2205.06231)."""
    return _multiarm(
        "double", [0.093844, 0.137596], [0.108565, 0.116779], [4.3753e-4, 1.26883e-3],
        [0.172719], 9.80858,
    )  # fmt: skip


def multiarm_triple() -> PendulumChain:
    """Triple pendulum of the MultiArm-Pendulum bench (Kaheman et al., arXiv 2205.06231)."""
    return _multiarm(
        "triple", [0.258172, 0.279428, 0.118624], [0.160000, 0.202939, 0.183709],
        [1.00043e-4, 3.14160e-4, 1.68739e-4], [0.172800, 0.228700], 9.80834,
    )  # fmt: skip


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

    The source adds the rotors as Ir (gr^2 + 1), -gr Ir, gr^2 Ir to M11, M12, M22: motor 2, carried
    by link 1, turns against its joint. This is exactly equivalent to an inertia of link 2 that is
    smaller by gr Ir, and armatures of (gr^2 + gr + 1) Ir and (gr^2 + gr) Ir, which are used here.
    In build C0 link 2's published inertia about its joint is below m r^2, which is impossible for a
    body; the mass matrix is nevertheless positive definite.

    References:
        github.com/dfki-ric-underactuated-lab/double_pendulum.
    """
    if build not in _DFKI:
        raise ValueError(f"`build` must be one of {sorted(_DFKI)}, got {build!r}.")
    p, gear = _DFKI[build], _DFKI_GEAR
    # Published about the joint; ours are about the mass centre.
    inertia = [i - m * r**2 for i, m, r in zip(p["I"], p["m"], p["r"], strict=True)]
    inertia[1] -= gear * p["Ir"]
    with warnings.catch_warnings():
        # Build C0: documented above, and a user cannot change it.
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

    Published: tau = 95.1089 qdd + Fv qd + Fc sgn(qd) - 3.1648; the offset is on the side of the
    friction, so it is added to tau here with opposite sign. A regression on the recording confirms
    it (+3.10 N, 98.8 kg).
    """
    return LinearAxis(
        95.1089, torque_offset=3.1648, name="emps", joint_names=["axis"], position_quantum=5e-8
    )


def xl330() -> PendulumChain:
    """Pendulum on a Dynamixel XL330 servo (Duclusaud et al., ICRA 2025).

    0.49 kg at 0.10 m as published in each log. The rotor's inertia is not published: 2.1e-3 kg m^2
    brings the total to the 7.0e-3 that fits the drops.
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
        ValueError: for a name that is not in `names()`.
    """
    if name not in _RIGS:
        near = difflib.get_close_matches(str(name), _RIGS, 1)
        hint = f" Did you mean {near[0]}?" if near else ""
        raise ValueError(
            f"no rig {name!r}; there are {', '.join(_RIGS)}, or give a rig file.{hint}"
        )
    return _RIGS[name]()


_KINDS: dict[str, type[PendulumChain] | type[LinearAxis]] = {
    plant.kind: plant for plant in (PendulumChain, Rotor, LinearAxis)
}
# Far beyond any rig; the memory of a chain's matrices grows with the square of its links.
LARGEST_FILE, MOST_LINKS, LARGEST_NUMBER = 2**20, 100, 1e30
_TEXTS = ("kind", "name", "convention", "joint_names", "normal_load")


def of(rig: Plant | str | Path) -> Plant:
    """The given plant, or the one of a name or rig file.

    Raises:
        TypeError: for anything else.
        ValueError, OSError, ImportError: as `by_name` and `read`.
    """
    if isinstance(rig, Plant):
        return rig
    if not isinstance(rig, str | Path):
        raise TypeError(
            "`plant` must be a mechanism such as a PendulumChain, the name of a rig or the path of "
            f"a rig file, got {type(rig).__name__} {reprlib.repr(rig)}."
        )
    return read(rig) if Path(rig).suffix and rig not in _RIGS else by_name(str(rig))


def from_dict(data: Mapping[str, Any]) -> Plant:
    """The plant of a `to_dict`, of any kind.

    Raises:
        ValueError: for an unknown kind, missing or unknown keys, or impossible values.
    """
    if not isinstance(data, Mapping):
        raise ValueError(f"a rig is one table of keys and values, got {reprlib.repr(data)}.")
    kind = data.get("kind", "chain")
    if not isinstance(kind, str) or kind not in _KINDS:
        raise ValueError(f"rig: no kind {reprlib.repr(kind)}; there are {sorted(_KINDS)}.")
    plant = _KINDS[kind]
    for key, value in data.items():
        if key in (*plant.required, *plant.optional, "buffers") and key not in _TEXTS:
            _check_numbers(key, value)
    try:
        return plant.from_dict(data)
    except RuntimeError as error:  # torch, of shapes that do not fit
        raise ValueError(f"its values do not fit together ({str(error)[:300]}).") from error


def read(path: str | Path) -> Plant:
    """Read a rig file: .json, .toml (Python 3.11 or newer), .urdf, or .xml (MJCF or URDF).

    Of a model file, it is the rig as adjusted by the fit.

    Raises:
        ValueError: for another ending, a file that does not parse, or parameters that
            `from_dict` refuses; the message names the file.
        OSError: if the file cannot be read.
        ImportError: for an MJCF file if MuJoCo is not installed.
    """
    path = Path(path)
    try:
        if path.suffix.lower() in robot_file.ENDINGS:
            return robot_file.read_robot(path)
        if path.is_file() and path.stat().st_size > LARGEST_FILE:
            # Before it is read into memory.
            raise ValueError(f"rig files are at most {LARGEST_FILE} bytes.")
        content = _parse(path.read_bytes().decode(), path.suffix.lower())
        if isinstance(content, dict) and "checksum" in content:
            if not is_intact(content):
                raise ValueError("the checksum does not match; damaged or edited.")
            content = content.get("rig")
            if content is None:
                raise ValueError("this model file contains no rig; give a rig file.")
        return from_dict(content)
    except RecursionError:
        raise ValueError(f"{path}: nested too deeply for a rig.") from None
    except ValueError as error:  # those of JSON, TOML and Unicode too
        raise ValueError(f"{path}: {str(error)[:600]}") from error


def write(plant: Plant, path: str | Path) -> None:
    """Write a plant, including fitted buffers, atomically as JSON for `read`.

    Raises:
        ValueError: for an ending other than .json.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        raise ValueError(f"a rig is written as .json, got {path.name!r}.")
    write_atomically(path, (json.dumps(plant.to_dict(), indent=2) + "\n").encode())


def _check_numbers(key: str, value: Any) -> None:
    """Refuse values that torch would accept but no rig has: booleans, and very long lists."""
    if isinstance(value, Mapping):
        for name, entry in value.items():
            _check_numbers(f"{key}.{name}", entry)
    elif value is not None and not _are_numbers(value):
        raise ValueError(
            f"`{key[:100]}` must be finite numbers, at most {MOST_LINKS} in a row, "
            f"got {reprlib.repr(value)}."
        )


def _are_numbers(value: Any, depth: int = 0) -> bool:
    """True for a finite number, or a list or matrix of them."""
    if isinstance(value, (list, tuple)):
        alike = len({isinstance(v, (list, tuple)) for v in value}) < 2
        small = len(value) <= MOST_LINKS and depth < 2
        return alike and small and all(_are_numbers(v, depth + 1) for v in value)
    # In Python, True is an int.
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) <= LARGEST_NUMBER  # false of NaN


def _parse(text: str, suffix: str) -> Any:
    if suffix == ".json":
        try:
            return parse_json(text)
        except json.JSONDecodeError as error:
            raise ValueError(
                f"not valid JSON: {error.msg} at line {error.lineno}, column {error.colno}"
            ) from error
    if suffix != ".toml":
        raise ValueError(f"a rig file ends in .json or .toml, .urdf or .xml, not {suffix!r}.")
    if sys.version_info < (3, 11):
        raise ValueError("reading .toml needs Python 3.11 or newer; write the rig as .json.")
    import tomllib

    return tomllib.loads(text)
