"""The twins as data: rigs, hidden friction and releases. The cards in `datasets/` say why."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from nfriction.papers.twin.mechanics import HiddenFriction, Vector
from nfriction.plant import PendulumChain, rigs

Split = Literal["train", "test"]


@dataclass(frozen=True)
class Release:
    """The start of one recording.

    Attributes:
        label: names the recording and its file.
        split: to fit on, or to judge by.
        degrees: joint angles in the rig's own convention [deg].
        qd: joint rates [rad/s].
    """

    label: str
    split: Split
    degrees: Vector
    qd: Vector = (0.0, 0.0, 0.0)

    @property
    def q(self) -> Vector:
        """Joint angles in the rig's own convention [rad]."""
        first, second, third = map(math.radians, self.degrees)
        return first, second, third


@dataclass(frozen=True)
class Specification:
    """A rig, its hidden friction and its recordings.

    Attributes:
        rig: makes the plant.
        friction: the truth.
        duration: of each recording [s].
        releases: in the order in which they are recorded.
    """

    rig: Callable[[], PendulumChain]
    friction: HiddenFriction
    duration: float
    releases: tuple[Release, ...]


# Plain bushings on pins of 16, 12 and 10 mm, coefficient of friction 0.1, a lip seal each.
_TLRIP = Specification(
    rig=rigs.tlrip,
    friction=HiddenFriction(
        seal=(12e-3, 8e-3, 5e-3),
        bearing_arm=(8e-4, 6e-4, 5e-4),
        stribeck_rise=(0.6, 0.5, 0.4),
        stribeck_velocity=(0.3, 0.4, 0.5),
        asymmetry=(0.06, -0.05, 0.04),
        viscous=(4e-2, 3e-2, 2e-2),
        shear_velocity=(4.0, 5.0, 6.0),
    ),
    # As in the TLRIP paper.
    duration=40.0,
    releases=(
        Release("train_upright", "train", (20.0, 30.0, 40.0)),
        Release("train_hanging", "train", (180.0, 0.0, 0.0), (4.0, 0.0, 0.0)),
        Release("test_hanging", "test", (200.56, 32.21, 45.0)),
        Release("test_upright", "test", (60.0, 0.0, 0.0)),
    ),
)

# Ball bearings in the first two joints, a bushing in the last, less grease.
_RTIP = Specification(
    rig=rigs.rtip,
    friction=HiddenFriction(
        seal=(8e-4, 8e-4, 3e-3),
        bearing_arm=(5e-5, 5e-5, 2e-4),
        stribeck_rise=(0.6, 0.5, 0.4),
        stribeck_velocity=(0.3, 0.4, 0.5),
        asymmetry=(0.06, -0.05, 0.04),
        viscous=(1e-2, 1.5e-2, 3e-2),
        shear_velocity=(4.0, 5.0, 6.0),
    ),
    # As in the RTIP paper.
    duration=80.0,
    releases=(
        Release("train_bent", "train", (45.0, 45.0, 45.0)),
        Release("train_zigzag", "train", (-45.0, 45.0, -45.0)),
        Release("test_bent", "test", (20.0, 30.0, 40.0)),
        Release("test_hooked", "test", (45.0, 45.0, -45.0)),
    ),
)

SPECIFICATIONS = {"tlrip": _TLRIP, "rtip": _RTIP}


def names() -> list[str]:
    """Names of the twins."""
    return list(SPECIFICATIONS)


def specification(name: str) -> Specification:
    """A twin's specification by its name.

    Raises:
        ValueError: for a name that is none of `names()`.
    """
    if name not in SPECIFICATIONS:
        raise ValueError(f"no twin {name!r}; there are {', '.join(SPECIFICATIONS)}.")
    return SPECIFICATIONS[name]
