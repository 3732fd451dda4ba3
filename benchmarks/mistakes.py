"""Typical mistakes of a new user, and the answer of a fit with default settings.

    python benchmarks/mistakes.py [--law CVFM] [--seeds 1] [--only "torque in mN m" ...]

A driven arm of two links with geared motors and a free double pendulum are simulated with exact
stiction, two recordings of 10 s at 500 Hz with 4096 counts each. Each mistake is made in both
recordings or in the rig. A mistake counts as named if a warning contains its words, as unusable
if the fit is not rated good, and as SILENT otherwise; the two sound rows must be rated good.
"""

import argparse
import math
import time
import warnings
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from own_rigs import Rig, recorded

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


def scaled(q: tuple[float, float] = (1, 1), tau: tuple[float, float] = (1, 1)) -> Change:
    """Positions and torques times a factor for each joint."""
    return lambda r: r._replace(q=r.q * q, tau=None if r.tau is None else r.tau * tau)


def shifted(zero: float) -> Change:
    """Another zero of the first joint [rad]."""
    return lambda r: r._replace(q=np.add(r.q, (zero, 0.0)))


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
    return r._replace(tau=np.add(r.tau, np.outer(0.03 * r.time / r.time[-1], (1.0, 0.0))))


def reversed_in_time(r: Recording) -> Recording:
    return r._replace(q=r.q[::-1].copy())


def mistakes() -> Iterator[Mistake]:
    """The sound rigs, then a mistake each."""
    both, second = (lambda k: (k, k)), (lambda k: (1, k))
    yield Mistake("none, driven", "")
    yield Mistake("none, free", "", free=True)
    yield Mistake("sign of joint 2", "reversed|wrong sign", scaled(q=second(-1)))
    yield Mistake("sign of all torques", "reversed|wrong sign", scaled(tau=both(-1)))
    yield Mistake("sign of one torque", "reversed|wrong sign", scaled(tau=second(-1)))
    yield Mistake("zero off by 90 degrees", "90 degrees off", shifted(math.pi / 2))
    yield Mistake("upright taken for hanging", "from upright",
                  shifted(math.pi))  # fmt: skip
    yield Mistake("absolute angles as relative", "angles are absolute",
                  lambda r: r._replace(q=np.cumsum(r.q, axis=1)), free=True)  # fmt: skip
    yield Mistake("degrees as radians", "in degrees", scaled(q=both(180 / math.pi)), free=True)
    yield Mistake("torque in mN m", "1000 times", scaled(tau=both(1e3)))
    yield Mistake(
        "lengths in mm", "lengths are in mm", rig={"length": [300, 250], "com": [150, 120]}
    )
    yield Mistake("masses in g", "masses are in g", rig={"mass": [600, 400], "inertia": [4.5, 2.1]})
    yield Mistake("joints swapped", "exchanged", lambda r: r._replace(q=r.q[:, ::-1].copy()))
    yield Mistake("torques swapped", "exchanged",
                  lambda r: r._replace(tau=r.tau[:, ::-1].copy()))  # fmt: skip
    yield Mistake("torque 30 ms late", "later than positions", late)
    yield Mistake("rotor inertia missing", "rotor|armature", rig={"armature": [0.0, 0.0]})
    yield Mistake("inertia about the joint", "about the joint",
                  rig={"inertia": [0.018, 0.00786]}, free=True)  # fmt: skip
    yield Mistake("inertia in kg cm^2", "kg cm^2", rig={"inertia": [45.0, 21.0]}, free=True)
    yield Mistake("rig in g, mm and g mm^2", "g mm^2", free=True,
                  rig={"mass": [600, 400], "length": [300, 250], "com": [150, 120],
                       "inertia": [4.5e6, 2.1e6]})  # fmt: skip
    yield Mistake("spikes in a position", "jumps", spiked)
    guessed = {"mass": [0.5, 0.5], "length": [0.2, 0.25], "com": None, "inertia": None}
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
    yield Mistake("torque constant 15 % off", "times those of the rig", scaled(tau=both(1.15)))
    yield Mistake(
        "torque constant 15 %, masses 6 % off",
        "times those of the rig",
        scaled(tau=both(1.15)),
        rig={"mass": [0.636, 0.376]},
    )
    yield Mistake("a torque sensor's zero drifts", "offset of the torque of joint1 grows", drifting)
    yield Mistake("motor's angle as the joint's (1:5)", "too large|gear ratio",
                  scaled(q=both(5.0)))  # fmt: skip
    yield Mistake("horizontal instead of vertical", "horizontal",
                  rig={"gravity": 0.0}, free=True)  # fmt: skip
    yield Mistake(
        "torque not recorded", "name the columns of the torque", lambda r: r._replace(tau=None)
    )


def answer(of: Mistake, law: str, seed: int) -> tuple[str, str]:
    """The verdict on a fit to data with a mistake, and the words of the fit."""
    drive = {} if of.free else ROTORS
    plant: Plant = PendulumChain(**LINKS, **drive)
    truth = BEARINGS if of.free else FRICTION
    made = Rig(f"{of.name} {seed}", plant, plant, "CVFM", truth, () if of.free else EFFORT,
               sticks=True, substeps=100)  # fmt: skip
    recordings = [of.recording(r) for r in recorded(made, seed)]
    said: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = fit(law, PendulumChain(**LINKS | drive | (of.rig or {})), recordings)
            verdict, reason = found.usability
            said = [*found.mistakes, *found.warnings]
        except (ValueError, ArithmeticError) as error:
            verdict, reason = "refused", str(error)
    said += [reason, *(str(w.message) for w in caught)]
    named = [text for text in said for word in of.words.split("|") if of.words and word in text]
    if not of.words:
        return ("sound" if verdict == "good" else "FALSE ALARM"), f"{verdict}: {reason}"
    if named:
        return "named", f"{verdict}: {named[0]}"
    return ("unusable" if verdict != "good" else "SILENT"), f"{verdict}: {reason}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--law", default="CVFM")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--only", nargs="+", help="names of mistakes")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for seed in range(arguments.seeds):
        for of in mistakes():
            if not arguments.only or of.name in arguments.only:
                begun = time.perf_counter()
                how, words = answer(of, arguments.law, seed)
                seconds = time.perf_counter() - begun
                print(f"{of.name:36} {how:12} {words[:200]}  ({seconds:.0f} s)", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
