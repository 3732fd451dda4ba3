"""A family of twins for testing methods: a seed draws releases, friction and its parameters.

The friction torque of a joint, with only the effects that its truth names, is

    tau_f = w D s + w B v / (1 + |v / v_t|^m)
    D = F (1 - a + a |R| / R_0) (1 + r cos(k q + p)) (1 + b exp(-(u / v_s)^2))
    s = tanh(v / v_smooth),  w = (1 + d s) exp(-h),  h' = P / C - h / T,  u' = (v - u) / T_u

with the bearing force |R| relative to its value R_0 at rest, heat h from the power P that friction
dissipates, and the lagging velocity u, which to first order is v - T_u dv/dt. Bristles of stiffness
K = F / x replace w D s by K z with z' = v - |v| K z / max(w D, F / 4) (Dahl). The friction is
passive: D, B and w are positive, and bristles return at most the energy stored in them.

Mechanics, friction and integrator are independent of the library. No law or input of the library
may be built from these formulas: the family is for testing, with model classes of its own.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm import tqdm

from nfriction.evaluation.compare import Comparison
from nfriction.io.files import write_atomically
from nfriction.papers.twin.dataset import RATE, Encoder, Release, Twin, record, sample_count, write
from nfriction.papers.twin.mechanics import Array, Links, TrueMotion, Vector
from nfriction.plant import rigs

DURATION = 20.0  # of a release [s]
HELD_OUT = 10  # test releases
COUNT = Encoder().quantum  # [rad]
# Largest error [counts] to which an error of one count at every joint of a release may grow: beyond
# it a free run would measure the error of its start rather than that of the friction model.
PREDICTABLE = 16
CANDIDATES = 20  # releases simulated at a time
# Random number streams, beyond those of the encoders, which are numbered by recording.
OF_FRICTION, OF_RELEASES = 2**16, 2**16 + 1
# Velocity over which the sign of dry friction changes, for the integrator's sake [rad/s].
V_SMOOTH = 0.01


class Parameter(NamedTuple):
    """A parameter of the friction, drawn uniformly for every joint."""

    effect: str  # the truth to which it belongs; empty if every truth has it
    low: float | Vector  # smallest value, for all joints or for each
    high: float | Vector  # largest value
    absent: float  # the value if the truth lacks the effect
    meaning: str  # symbol, unit and name
    signed: bool = False  # both signs are equally likely


PARAMETERS = {
    "dry": Parameter("", (0.03, 0.02, 0.01), (0.06, 0.04, 0.02), 0.0, "F [N m], dry friction"),
    "viscous": Parameter("", (0.03, 0.02, 0.015), (0.06, 0.04, 0.03), 0.0, "B [N m s/rad]"),
    "share": Parameter("load", 0.5, 1.0, 0.0, "a, load-dependent share of dry friction"),
    "lean": Parameter("direction", 0.1, 0.3, 0.0, "d, asymmetry with direction", signed=True),
    "thin_from": Parameter("shear", 1.0, 4.0, np.inf, "v_t [rad/s], at which B is halved"),
    "thinning": Parameter("shear", 0.7, 1.3, 1.0, "m, exponent of Cross's law"),
    "capacity": Parameter("warming", 2.0, 5.0, np.inf, "C [J], heat that divides friction by e"),
    "cooling": Parameter("warming", 5.0, 20.0, 1.0, "T [s], time constant of cooling"),
    "slip": Parameter("bristle", 0.03, 0.08, 0.0, "x [rad], deflection at which bristles slip"),
    "ripple": Parameter("ripple", 0.2, 0.5, 0.0, "r, amplitude over the position"),
    "waves": Parameter("ripple", (1.0, 2.0, 3.0), (1.0, 2.0, 3.0), 1.0, "k, waves per revolution"),
    "phase": Parameter("ripple", 0.0, 2 * np.pi, 0.0, "p [rad]"),
    "rise": Parameter("lag", 0.5, 1.0, 0.0, "b, dry friction at rest over that in motion, minus 1"),
    "film": Parameter("lag", 0.5, 1.5, 1.0, "v_s [rad/s], over which a film builds up"),
    "lag": Parameter("lag", 0.02, 0.06, 1.0, "T_u [s], lag of the film behind the velocity"),
}
TRUTHS = tuple(dict.fromkeys(p.effect for p in PARAMETERS.values() if p.effect))
PLAIN = "plain"
"""The truth without any effect: only dry and viscous friction."""


def effects_of(truth: str) -> tuple[str, ...]:
    """The effects in a name such as "load+warming"; ValueError for unknown or repeated ones."""
    effects = () if truth == PLAIN else tuple(truth.split("+"))
    if not set(effects) <= set(TRUTHS) or len(set(effects)) < len(effects):
        raise ValueError(
            f"a truth is {PLAIN} or different ones of {', '.join(TRUTHS)} with + between them, "
            f"got {truth!r}."
        )
    return effects


def parameters(truth: str, seed: int) -> dict[str, Array]:
    """Parameters of a truth's friction, each (joint, 1).

    An effect has the same parameters in every truth of the same seed.
    """
    effects = effects_of(truth)
    random = np.random.default_rng([seed, OF_FRICTION])
    drawn = {}
    for name, p in PARAMETERS.items():
        # Drawn even if not used, so that later values do not depend on the truth.
        value = np.array(p.low) + np.subtract(p.high, p.low) * random.random(3)
        sign = random.choice([-1.0, 1.0], 3)
        if p.effect and p.effect not in effects:
            value = np.full(3, p.absent)
        drawn[name] = (value * sign if p.signed else value)[:, None]
    return drawn


def draw(truth: str, *, seed: int = 0, duration: float = DURATION, progress: bool = False) -> Twin:
    """Simulate a rig of the family: two training releases and ten test releases.

    The plant is `twin.plant`, the recordings are `twin.part("train")` and `twin.part("test")`.
    Releases start at rest; for testing, only those with a predictable true motion are used.

    Args:
        truth: one of `TRUTHS`, or several joined by +, or "plain".
        seed: for releases, parameters, encoders and jitter.
        duration: of each recording [s].

    Raises:
        ValueError: for an unknown truth, or a duration of fewer than 8 samples.
    """
    friction = parameters(truth, seed)
    samples = sample_count(duration)
    plant = rigs.tlrip()
    motion = _Motion(Links.of(plant), friction)
    random = np.random.default_rng([seed, OF_RELEASES])
    chosen: list[tuple[Vector, TrueMotion]] = []
    while len(chosen) < 2 + HELD_OUT:
        poses: list[Vector] = []
        for k in range(CANDIDATES):
            tilt, second, third = random.uniform([20.0, -60.0, -60.0], [90.0, 60.0, 60.0])
            first = random.choice([-1.0, 1.0]) * tilt + (180.0 if k % 2 else 0.0)
            # Rounded as a person would set them [deg].
            poses.append((round(first, 1), round(second, 1), round(third, 1)))
        found, growth = motion.simulate(poses, samples, progress=progress)
        if not chosen:
            growth[:2] = 0.0  # training windows are too short for errors of their start to matter
        chosen += [(poses[k], found[k]) for k in np.flatnonzero(growth <= PREDICTABLE * COUNT)]
    del chosen[2 + HELD_OUT :]
    releases = [Release(f"test_{k - 1}", "test", pose) for k, (pose, _) in enumerate(chosen)]
    releases[:2] = [Release(f"train_{k + 1}", "train", chosen[k][0]) for k in range(2)]
    truths = {r.label: found for r, (_, found) in zip(releases, chosen, strict=True)}
    return record(f"{truth}-{seed}", plant, releases, truths, seed)


def build(
    truth: str,
    out: str | os.PathLike[str],
    *,
    seed: int = 0,
    duration: float = DURATION,
    progress: bool = False,
) -> Twin:
    """Draw a twin and write it to a folder: the files of `twin.build`, and the card `README.md`."""
    twin = draw(truth, seed=seed, duration=duration, progress=progress)
    write(twin, Path(out))
    command = f"nfriction twin --truth {truth} --seed {seed} --seconds {duration:g}"
    card = _card(twin, command, parameters(truth, seed))
    write_atomically(Path(out) / "README.md", card.encode())
    return twin


def held_out(comparison: Comparison) -> pd.DataFrame:
    """Free-run errors over the test recordings by model: median and pooled, by joint [rad].

    Pooled errors are the root mean square over recordings, as in `Comparison.table`; one recording
    may dominate them, unlike the median.
    """
    columns = [*comparison.joint_names, "all"]
    median = {
        model: np.median([[*s.free_run.joints, s.free_run.all] for s in scores], axis=0)
        for model, scores in comparison.scores("test").items()
    }
    table = pd.DataFrame.from_dict(median, orient="index", columns=columns).rename_axis("model")
    return pd.concat({"median": table, "pooled": comparison.table()}, axis=1)


class _Motion:
    """Motion of many releases at once, each a column of arrays (joint, release).

    The state is (5, joint, release): absolute angles and velocities, deflection of the bristles,
    heat and lagging velocity of every joint.
    """

    def __init__(self, links: Links, friction: Mapping[str, Array]) -> None:
        a22, a33, a44, a23, a24, a34 = links.coupling
        self.coupling = np.array([[a22, a23, a24], [a23, a33, a34], [a24, a34, a44]])[..., None]
        self.mass, self.com = np.array(links.mass)[:, None], np.array(links.com)[:, None]
        # No hinge follows the last link.
        self.length = np.array([*links.length[:-1], 0.0])[:, None]
        self.moment, self.gravity = np.array(links.moment)[:, None], links.gravity
        self.at_rest = self.gravity * np.cumsum(self.mass[::-1], axis=0)[::-1]
        self.friction = friction

    def rates(self, state: Array) -> tuple[Array, Array]:
        """Derivative of the state, and friction torques (joint, release)."""
        angle, rate, bend, heat, lagging = state
        of = self.friction
        # Upright is the real axis: products give cosines and sines of angle differences.
        along = np.exp(1j * angle)
        between = self.coupling * (along[:, None] * along.conj())
        force = self.moment * along.imag - (between.imag * (rate * rate)).sum(axis=1)
        q, v = _joint(angle), _joint(rate)
        sign = np.tanh(v / V_SMOOTH)
        scale = (1.0 + of["lean"] * sign) * np.exp(-heat)
        dry = scale * of["dry"]
        dry *= 1.0 + of["ripple"] * np.cos(of["waves"] * q + of["phase"])
        dry *= 1.0 + of["rise"] * np.exp(-((lagging / of["film"]) ** 2))
        fluid = scale * of["viscous"] * v / (1.0 + np.abs(v / of["thin_from"]) ** of["thinning"])

        def drag_of(level: Array) -> tuple[Array, Array]:
            """Torque of dry friction, and the deflection rate of the bristles."""
            if not of["slip"].any():
                return level * sign, np.zeros_like(v)
            torque = of["dry"] / of["slip"] * bend
            # Without the bound, unloaded bristles would be too fast for the integration steps.
            return torque, v - np.abs(v) * torque / np.maximum(level, of["dry"] / 4)

        def accelerations(drag: Array) -> Array:
            # The torque of a joint acts on two links.
            torque = drag + fluid
            torque[:-1] -= torque[1:]
            return np.linalg.solve(between.real.T, (force - torque).T[..., None])[..., 0].T

        drag, bending = drag_of(dry)
        acceleration = accelerations(drag)
        if of["share"].any():
            # The load depends on the acceleration, which depends on it so little (a few percent)
            # that a third repetition would change friction by less than a thousandth.
            for _ in range(2):
                load = self.reaction(along, rate, acceleration) / self.at_rest
                drag, bending = drag_of(dry * (1.0 + of["share"] * (load - 1.0)))
                acceleration = accelerations(drag)
        # Dissipated power: all except the part that deflects the bristles.
        power = drag * (v - bending) + fluid * v
        warming = power / of["capacity"] - heat / of["cooling"]
        change = [rate, acceleration, bending, warming, (v - lagging) / of["lag"]]
        return np.stack(change), drag + fluid

    def reaction(self, along: NDArray[np.complex128], rate: Array, acceleration: Array) -> Array:
        """Force carried by each joint's bearing [N], from all links beyond it."""
        turn = (1j * acceleration - rate * rate) * along
        beyond = np.cumsum(self.length * turn, axis=0)
        hinge = np.concatenate([np.zeros_like(beyond[:1]), beyond[:-1]])
        inertial = self.mass * (hinge + self.com * turn + self.gravity)
        return np.abs(np.cumsum(inertial[::-1], axis=0)[::-1])

    def simulate(
        self,
        poses: Sequence[Vector],
        samples: int,
        *,
        step: float = 1.0 / RATE,
        progress: bool = False,
    ) -> tuple[list[TrueMotion], Array]:
        """Motions of releases at rest, and the largest growth of a one-count error [rad].

        Every release is simulated twice, once with every joint off by one count.
        """
        count = len(poses)
        off = COUNT * np.array([1.0, -1.0, 1.0])[:, None]
        start = np.radians(np.array(poses)).T
        state = np.zeros((5, 3, 2 * count))
        state[0] = np.cumsum(np.concatenate([start, start + off], axis=1), axis=0)
        kept, growth = np.empty((samples, 4, 3, count)), np.zeros(count)
        for sample in tqdm(range(samples), unit="samples", disable=not progress):
            change, torque = self.rates(state)
            q = _joint(state[0])
            growth = np.maximum(growth, np.abs(q[:, count:] - q[:, :count]).max(axis=0))
            now = (q, _joint(state[1]), _joint(change[1]), torque)
            kept[sample] = [part[:, :count] for part in now]
            # One classical Runge-Kutta step.
            second, _ = self.rates(state + 0.5 * step * change)
            third, _ = self.rates(state + 0.5 * step * second)
            fourth, _ = self.rates(state + step * third)
            state = state + step / 6.0 * (change + 2.0 * (second + third) + fourth)
        # Releases first, with the samples of each contiguous.
        parts = np.ascontiguousarray(kept.transpose(3, 1, 0, 2))
        return [TrueMotion(*of) for of in parts], growth


def _joint(absolute: Array) -> Array:
    """Joint angles or velocities from absolute ones."""
    return np.concatenate([absolute[:1], absolute[1:] - absolute[:-1]])


def _card(twin: Twin, command: str, friction: Mapping[str, Array]) -> str:
    """The card of a twin: its friction and releases."""
    effects = effects_of(twin.name.rpartition("-")[0])
    rows = "\n".join(
        f"| {name} | {p.meaning} | {', '.join(f'{x:.4g}' for x in friction[name][:, 0])} |"
        for name, p in PARAMETERS.items()
        if not p.effect or p.effect in effects
    )
    starts = "\n".join(
        f"| `{label}` | {', '.join(f'{x:.1f}' for x in np.degrees(q0))} |"
        for label, (q0, _) in twin.initial_states.items()
    )
    return f"""# {twin.name}

A simulated triple pendulum, written by `{command}`.

Friction: {" and ".join(effects) or "dry and viscous"}; the equations are in
`nfriction/papers/twin/family.py`. **Never fit on these values or on `truth.npz`.**

| parameter | meaning | joints 2, 3, 4 |
|---|---|---|
{rows}

Encoders with 2048 lines, four counts each; files as in the card of `tlrip_twin`. Releases at rest:

| id | angles [deg] |
|---|---|
{starts}

An error of one count at every joint of a test release grows to at most {PREDICTABLE} counts.
"""
