"""Recordings of simulated rigs whose friction no model here can express exactly.

Rigs, hidden friction and releases are defined here; the cards in `datasets/` explain the choices.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from tqdm import tqdm

from nfriction.io.files import atomic_write
from nfriction.io.formats import write_table
from nfriction.papers.twin.mechanics import HiddenFriction, Links, TrueMotion, Vector, simulate
from nfriction.plant import PendulumChain, rigs
from nfriction.recording import MINIMUM_SAMPLES, Array, Recording, read_initial_states
from nfriction.recording.angles import AngleConvention

Split = Literal["train", "test"]
RATE = 1000  # samples per second
JITTER = 5e-6  # standard deviation of the sampling instants [s]
QUICK_DURATION = 10.0  # of recordings for a quick test [s]
COUNTS = 8192
"""Counts per revolution of the papers' encoders: four edges for each of 2048 lines."""
# Released exactly upright, a pendulum never falls; a hand releases it about this far off [deg].
RELEASE_ERROR = 0.1


@dataclass(frozen=True)
class Release:
    """The start of one recording."""

    label: str  # name of the recording and its file
    split: Split  # for fitting or for testing
    degrees: Vector  # joint angles in the rig's own convention [deg]
    qd: Vector = (0.0, 0.0, 0.0)  # joint velocities [rad/s]


@dataclass(frozen=True)
class Specification:
    """A rig, its hidden friction, and its recordings in order, each of this duration [s]."""

    rig: Callable[[], PendulumChain]
    friction: HiddenFriction
    duration: float
    releases: tuple[Release, ...]


# Plain bushings on pins of 16, 12 and 10 mm, friction coefficient 0.1, each with a lip seal.
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

# Ball bearings in the first two joints, a bushing in the last, and less grease.
_RTIP = Specification(
    rig=rigs.rtip,
    friction=replace(
        _TLRIP.friction,
        seal=(8e-4, 8e-4, 3e-3),
        bearing_arm=(5e-5, 5e-5, 2e-4),
        viscous=(1e-2, 1.5e-2, 3e-2),
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

# The TLRIP paper's friction experiment from (180°, 0, 0), measured from hanging: released upright.
_EXPERIMENT = replace(_TLRIP, releases=(Release("experiment", "train", (RELEASE_ERROR, 0.0, 0.0)),))

SPECIFICATIONS = {"tlrip": _TLRIP, "rtip": _RTIP, "experiment": _EXPERIMENT}


def names() -> list[str]:
    """Names of the twins."""
    return list(SPECIFICATIONS)


def specification(name: str) -> Specification:
    """A twin's specification by its name, which must be one of `names()`."""
    if name not in SPECIFICATIONS:
        raise ValueError(f"no twin {name!r}; there are {', '.join(SPECIFICATIONS)}.")
    return SPECIFICATIONS[name]


@dataclass(frozen=True)
class Encoder:
    """An incremental encoder; all four edges per line are counted.

    Attributes:
        eccentricity: amplitude of the error that repeats every revolution [counts].
        phase: angle at which that error crosses zero [rad].
        edges: displacement of each of the four edges of a line [counts], within ± 0.5.
    """

    eccentricity: float = 0.0
    phase: float = 0.0
    edges: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @property
    def quantum(self) -> float:
        """Angle of one count [rad]."""
        return math.tau / COUNTS

    @classmethod
    def drawn(cls, random: np.random.Generator) -> Encoder:
        """An encoder of typical quality: eccentricity 0.3 counts, edge errors 0.05 counts RMS."""
        phase = float(random.uniform(0.0, math.tau))
        edges = tuple((0.05 * random.standard_normal(4)).tolist())
        return cls(eccentricity=0.3, phase=phase, edges=edges)

    def read(self, q: Array) -> Array:
        """Positions [rad] read by the counter at true positions of any shape."""
        place = q / self.quantum + self.eccentricity * np.sin(q - self.phase)
        # The nearest count; displaced edges then shift positions near an edge to the next count.
        count = np.floor(place + 0.5)
        # The edge below a count lies half a count down, displaced.
        edges = np.array(self.edges)
        below = count - 0.5 + edges[count.astype(np.int64) % 4]
        above = count + 0.5 + edges[(count.astype(np.int64) + 1) % 4]
        return self.quantum * (count + (place >= above) - (place < below))


@dataclass(frozen=True, eq=False, repr=False)
class Twin:
    """Recordings of a simulated rig, and the truth behind them.

    Attributes:
        recordings: by label, in the rig's own convention.
        splits: by label: for fitting ("train") or for testing ("test").
        initial_states: by label: exact q0 and qd0 at the release, in the rig's own convention.
        truth: by label: the motion before the encoder, in joint coordinates. Never fit to it.
    """

    name: str
    plant: PendulumChain
    recordings: dict[str, Recording]
    splits: dict[str, Split]
    initial_states: dict[str, tuple[Array, Array]]
    truth: dict[str, TrueMotion] = field(repr=False)

    def part(self, split: Split) -> list[Recording]:
        """The recordings of one split."""
        return [self.recordings[label] for label, own in self.splits.items() if own == split]


def make(
    name: str, *, seed: int = 0, duration: float | None = None, progress: bool = False
) -> Twin:
    """Simulate a twin's recordings in memory.

    Args:
        name: "tlrip", "rtip" or "experiment".
        seed: for the encoders' errors and the clock's jitter; the motion itself is deterministic.
        duration: of each recording [s]; by default that of the experiment. A shorter twin is the
            beginning of a longer one.

    Raises:
        ValueError: for an unknown name or a duration of fewer than 8 samples.
    """
    specified = specification(name)
    duration = specified.duration if duration is None else duration
    samples = sample_count(duration)
    plant = specified.rig()
    # The twin's own mechanics use only the numbers of the rig.
    links = Links.of(plant)
    convention = AngleConvention.of(plant)
    truth = {}
    total = samples // RATE * len(specified.releases)
    with tqdm(total=total, desc=f"{name} twin", unit="s", disable=not progress) as bar:
        for release in specified.releases:
            truth[release.label] = simulate(
                links,
                specified.friction,
                tuple(convention.position_to_joint(np.radians(release.degrees)).tolist()),
                tuple(convention.rate_to_joint(np.array(release.qd)).tolist()),
                samples=samples,
                rate=RATE,
                advance=bar.update,
            )
    return record(name, plant, specified.releases, truth, seed)


def sample_count(duration: float) -> int:
    """Number of samples in a recording of `duration` [s]; raises if that is too short or long."""
    samples = round(duration * RATE)
    if not MINIMUM_SAMPLES <= samples <= 1000 * RATE:  # 2 GB of memory
        raise ValueError(
            f"`duration` must be at least {MINIMUM_SAMPLES / RATE} s, at most 1000 s, got "
            f"{duration}; {QUICK_DURATION:g} s is enough for a quick look."
        )
    return samples


def record(
    name: str,
    plant: PendulumChain,
    releases: Sequence[Release],
    truth: dict[str, TrueMotion],
    seed: int,
) -> Twin:
    """A twin from true motions, as measured by encoders and a clock with seeded random errors."""
    random = np.random.default_rng([seed, 0])
    # The same encoders in all recordings, as on a real rig.
    encoders = [Encoder.drawn(random) for _ in plant.joint_names]
    convention, recordings = AngleConvention.of(plant), {}
    for index, (label, motion) in enumerate(truth.items()):
        # A stream for each release: a shorter twin is the beginning of a longer one.
        random = np.random.default_rng([seed, index + 1])
        late = JITTER * np.clip(random.standard_normal(len(motion.q)), -3.0, 3.0)
        # The release is the origin of time, and its state is known exactly.
        late[0] = 0.0
        # Jitter is far below a sample time, so second-order Taylor errors are far below a count.
        moved = motion.q + late[:, None] * (motion.qd + 0.5 * late[:, None] * motion.qdd)
        position = convention.position_from_joint(moved)
        recordings[label] = Recording(
            time=np.arange(len(position)) / RATE,
            q=np.stack([e.read(q) for e, q in zip(encoders, position.T, strict=True)], axis=1),
            names=plant.joint_names,
            convention=convention,
            name=label,
        )
    return Twin(
        name=name,
        plant=plant,
        recordings=recordings,
        splits={release.label: release.split for release in releases},
        initial_states={r.label: (np.radians(r.degrees), np.array(r.qd)) for r in releases},
        truth=truth,
    )


def build(
    name: str,
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    duration: float | None = None,
    progress: bool = False,
) -> Twin:
    """Simulate a twin's recordings and write them to a folder.

    The folder then contains `<label>.csv.gz` for every recording, `recordings.csv` (splits, initial
    states, digests), `rig.json` and `truth.npz`. Equal arguments give equal bytes.

    Args:
        name, seed, duration, progress: as for `make`.
        out: the folder; created if missing; files with these names are replaced.
    """
    twin = make(name, seed=seed, duration=duration, progress=progress)
    write(twin, Path(out))
    return twin


def write(twin: Twin, folder: Path) -> None:
    """Write a twin's recordings, their overview, its rig and its truth; see `build`."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for label, recording in twin.recordings.items():
        name, (q0, qd0) = f"{label}.csv.gz", twin.initial_states[label]
        recording.write(folder / name)
        rows.append(
            {
                "id": label,
                "file": name,
                "split": twin.splits[label],
                "n": len(recording),
                "duration_s": recording.duration,
                **{f"q0_{k + 1}": value for k, value in enumerate(q0)},
                **{f"qd0_{k + 1}": value for k, value in enumerate(qd0)},
                "digest": recording.digest(),
            }
        )
    rigs.write(twin.plant, folder / "rig.json")
    arrays = {
        f"{label}_{key}": getattr(motion, key)
        for label, motion in twin.truth.items()
        for key in ("q", "qd", "qdd", "tau_f")
    }
    # Not compressed: floats hardly shrink, and compressing them would take longest of all.
    with atomic_write(folder / "truth.npz") as unfinished, unfinished.open("wb") as file:
        np.savez(file, **arrays)
    write_table(pd.DataFrame(rows), folder / "recordings.csv")


def read(name: str, folder: Path) -> Twin:
    """A twin from the folder to which `build` wrote it.

    Raises:
        OSError: if a file is missing.
    """
    plant = rigs.read(folder / "rig.json")
    assert isinstance(plant, PendulumChain)  # `write` accepts no other
    overview = pd.read_csv(folder / "recordings.csv", dtype={"id": str, "file": str})
    with np.load(folder / "truth.npz", allow_pickle=False) as kept:
        truth = {
            label: TrueMotion(*(kept[f"{label}_{f.name}"] for f in fields(TrueMotion)))
            for label in overview["id"]
        }
    return Twin(
        name=name,
        plant=plant,
        recordings={
            label: Recording.read(folder / file, convention=plant.convention, name=label)
            for label, file in zip(overview["id"], overview["file"], strict=True)
        },
        splits=dict(zip(overview["id"], overview["split"], strict=True)),
        initial_states=dict(read_initial_states(folder / "recordings.csv")),
        truth=truth,
    )
