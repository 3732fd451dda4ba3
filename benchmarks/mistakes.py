"""Typical mistakes of a new user, and the answer of a fit with default settings.

    python benchmarks/mistakes.py [--law CVFM] [--seeds 1] [--only "torque in mN m" ...]
    python benchmarks/mistakes.py --rigs 8

A driven arm of two links with geared motors and a free double pendulum are simulated with exact
stiction, two recordings of 10 s at 500 Hz with 4096 counts each. Each mistake is made in both
recordings or in the rig. A mistake counts as named if a warning contains its words, as unusable
if the fit is not rated good, and as SILENT otherwise; the two sound rows must be rated good.

With `--rigs`, the mistakes are made on random rigs of one link or two with random laws. The rig
of a fit is off as drawings are, except where the mistake is one in the rig. There, a sound row may
be doubtful, as a term may be off by two of its standard deviations, and a torque constant 15 % off
may be silent, as such terms hide it.
"""

import argparse
import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from own_rigs import Rig, random_rig, recorded

from nfriction import PendulumChain, Plant, Recording, fit

LINKS = {
    "mass": [0.6, 0.4], "length": [0.3, 0.25], "com": [0.15, 0.12], "inertia": [4.5e-3, 2.1e-3],
    "convention": ("relative", "hanging"),
}  # fmt: skip
ROTORS = {"armature": [0.03, 0.01]}
FRICTION = ((0.12, 0.04), (0.04, 0.015))
BEARINGS = ((0.006, 0.002), (0.002, 6e-4))
EFFORT = (0.8, 0.25)

Change = Callable[[Recording], Recording]


class Mistake(NamedTuple):
    """A mistake: words of a warning that names it, the change of recordings, and of the rig."""

    name: str
    words: str
    recording: Change = lambda r: r
    rig: dict[str, object] | None = None
    free: bool = False


def scaled(q: ArrayLike = 1.0, tau: ArrayLike = 1.0) -> Change:
    """Positions and torques times a factor, or one for each joint."""
    return lambda r: r._replace(
        q=np.multiply(r.q, q), tau=None if r.tau is None else np.multiply(r.tau, tau)
    )


def shifted(zero: float) -> Change:
    """Another zero of the first joint [rad]."""
    return lambda r: r._replace(q=r.q + zero * np.eye(r.joints)[0])


def spiked(r: Recording) -> Recording:
    """Three samples off by a radian, as a lost message leaves them."""
    q = r.q.copy()
    q[[900, 2200, 3900], 0] += 1.0
    return r._replace(q=q)


def late(r: Recording) -> Recording:
    """Torques that arrive 30 ms late."""
    return r._replace(tau=np.concatenate([np.repeat(r.tau[:1], 15, 0), r.tau[:-15]]))


def drifting(r: Recording) -> Recording:
    """A zero of the first torque sensor that moves by 0.03 N m."""
    return r._replace(tau=r.tau + np.outer(0.03 * r.time / r.time[-1], np.eye(r.joints)[0]))


def reversed_in_time(r: Recording) -> Recording:
    return r._replace(q=r.q[::-1].copy())


def mistakes(links: Mapping[str, Any]) -> Iterator[Mistake]:
    """The sound rigs, then a mistake each, in data or in these links."""
    joints = len(links["mass"])
    given = {key: np.array(links[key]) for key in ("mass", "length", "com", "inertia")}
    about = given["inertia"] + given["mass"] * given["com"] ** 2

    def last(factor: float) -> list[float]:
        return [*[1.0] * (joints - 1), factor]

    def rig(**factors: float) -> dict[str, object]:
        return {key: (factor * given[key]).tolist() for key, factor in factors.items()}

    yield Mistake("none, driven", "")
    yield Mistake("none, free", "", free=True)
    yield Mistake("sign of the last joint", "reversed|wrong sign", scaled(q=last(-1)))
    yield Mistake("sign of all torques", "reversed|wrong sign", scaled(tau=-1))
    yield Mistake("zero off by 90 degrees", "90 degrees off", shifted(math.pi / 2))
    yield Mistake("upright taken for hanging", "from upright",
                  shifted(math.pi))  # fmt: skip
    yield Mistake("degrees as radians", "in degrees", scaled(q=180 / math.pi), free=True)
    yield Mistake("torque in mN m", "1000 times|times too large", scaled(tau=1e3))
    yield Mistake("lengths in mm", "lengths are in mm", rig=rig(length=1e3, com=1e3))
    yield Mistake("masses in g", "masses are in g", rig=rig(mass=1e3, inertia=1e3))
    if joints > 1:
        yield Mistake("sign of one torque", "reversed|wrong sign", scaled(tau=last(-1)))
        yield Mistake("absolute angles as relative", "angles are absolute",
                      lambda r: r._replace(q=np.cumsum(r.q, axis=1)), free=True)  # fmt: skip
        yield Mistake("joints swapped", "exchanged", lambda r: r._replace(q=r.q[:, ::-1].copy()))
        yield Mistake("torques swapped", "exchanged",
                      lambda r: r._replace(tau=r.tau[:, ::-1].copy()))  # fmt: skip
    yield Mistake("torque 30 ms late", "later than positions", late)
    yield Mistake("rotor inertia missing", "rotor|armature", rig={"armature": [0.0] * joints})
    yield Mistake("inertia about the joint", "about the joint",
                  rig={"inertia": about.tolist()}, free=True)  # fmt: skip
    yield Mistake("inertia in kg cm^2", "kg cm^2", rig=rig(inertia=1e4), free=True)
    yield Mistake("rig in g, mm and g mm^2", "g mm^2", free=True,
                  rig=rig(mass=1e3, length=1e3, com=1e3, inertia=1e9))  # fmt: skip
    yield Mistake("spikes in a position", "jumps", spiked)
    guessed = {"mass": np.resize([0.5, 0.5], joints).tolist(), "com": None, "inertia": None}
    guessed["length"] = (given["length"] * np.resize([2 / 3, 1.0], joints)).tolist()
    for free in (False, True):
        name = f"masses and lengths guessed, {'free' if free else 'driven'}"
        yield Mistake(name, "several terms of the rig", rig=guessed, free=free)
    yield Mistake("time reversed", "backwards|gains energy", reversed_in_time, free=True)
    yield Mistake(
        "time in ms as s", "unit of its time|in ms", lambda r: r._replace(time=1e3 * r.time)
    )
    for free in (False, True):
        name = f"500 Hz taken for 250, {'free' if free else 'driven'}"
        yield Mistake(name, "sample rate is", lambda r: r._replace(time=2 * r.time), free=free)
    yield Mistake("torque constant 15 % off", "times those of the rig", scaled(tau=1.15))
    yield Mistake(
        "torque constant 15 %, masses 6 % off",
        "times those of the rig",
        scaled(tau=1.15),
        rig={"mass": (given["mass"] * np.resize([1.06, 0.94], joints)).tolist()},
    )
    yield Mistake("a torque sensor's zero drifts", "offset of the torque of joint1 grows", drifting)
    yield Mistake("motor's angle as the joint's (1:5)", "too large|gear ratio", scaled(q=5.0))
    yield Mistake("horizontal instead of vertical", "vertical plane", rig={"gravity": 1e-6},
                  free=True)  # fmt: skip
    yield Mistake(
        "torque not recorded", "name the columns of the torque", lambda r: r._replace(tau=None)
    )


def answer(of: Mistake, rig: Rig, plant: Plant, law: str, seed: int) -> tuple[str, str]:
    """The verdict on a fit with this plant to data of a rig with a mistake, and its words."""
    recordings = [of.recording(r) for r in recorded(rig, seed)]
    said: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = fit(law, plant, recordings)
            verdict, reason = found.usability
            said = [*found.mistakes, *found.warnings]
        except (ValueError, ArithmeticError) as error:
            verdict, reason = "refused", str(error)
    said += [reason, *(str(w.message) for w in caught)]
    named = [text for text in said for word in of.words.split("|") if of.words and word in text]
    if not of.words:
        doubtful = verdict == "doubtful" and rig.given is not rig.plant
        how = "sound" if verdict == "good" else verdict if doubtful else "FALSE ALARM"
        return how, f"{verdict}: {reason}"
    if named:
        return "named", f"{verdict}: {named[0]}"
    return ("unusable" if verdict != "good" else "SILENT"), f"{verdict}: {reason}"


def cases(arguments: argparse.Namespace) -> Iterator[tuple[Mistake, Rig, Plant, str, int]]:
    """The arguments of `answer`."""
    for number in range(arguments.rigs):
        rig = random_rig(number)._replace(sticks=True, substeps=100)
        data = rig.plant.to_dict()
        for of in mistakes(data):
            if of.free != rig.driven:
                plant = PendulumChain.from_dict(data | of.rig) if of.rig else rig.given
                yield of, rig, plant, rig.law, number
    for seed in range(0 if arguments.rigs else arguments.seeds):
        for of in mistakes(LINKS):
            links = LINKS | ({} if of.free else ROTORS)
            plant = PendulumChain(**links)
            truth, effort = (BEARINGS, ()) if of.free else (FRICTION, EFFORT)
            rig = Rig(of.name, plant, plant, "CVFM", truth, effort, sticks=True, substeps=100)
            yield of, rig, PendulumChain(**links | (of.rig or {})), arguments.law, seed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--law", default="CVFM")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--rigs", type=int, default=0, help="number of random rigs")
    parser.add_argument("--only", nargs="+", help="names of mistakes")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for of, rig, plant, law, seed in cases(arguments):
        if not arguments.only or of.name in arguments.only:
            begun = time.perf_counter()
            how, words = answer(of, rig, plant, law, seed)
            seconds = time.perf_counter() - begun
            name = f"{rig.name:24}" * (arguments.rigs > 0) + f"{of.name:36}"
            print(f"{name} {how:12} {words[:200]}  ({seconds:.0f} s)", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
