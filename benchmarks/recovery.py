"""Friction that is known, found again from what simulated encoders see of it."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cases
import numpy as np
import recovery_mujoco
import torch
from numpy.typing import NDArray

from nfriction import FrictionModel, PendulumChain, Recording, rollout
from nfriction.fitting.adjusted_plant import adjusted_buffers
from nfriction.fitting.fit import fit
from nfriction.fitting.plant_parameters import plant_parameters
from nfriction.friction.coefficients import Constant
from nfriction.signals import kalman_smoother, quantise

Array = NDArray[np.float64]

COUNTS, RATE = 8192, 1000
# Released from rest; joint angles from upright [rad].
RELEASES = {
    "swing": (math.pi + 0.8, 0.4, -0.3),
    "179 degrees": (math.radians(1.0), 0.0, 0.0),
}
TRUTH = np.array([cases.VISCOUS, cases.COULOMB]).T
# How many times the true friction a search starts from.
START = 3.0
# The peer simulates from the first state on, or windows [s] from smoothed states.
PEER_WINDOWS = (None, 0.5)


@dataclass
class Row:
    """Result of one method in recordings of one release and length."""

    errors: list[float] = field(default_factory=list)
    held: list[bool] = field(default_factory=list)
    widths: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)
    remarks: set[str] = field(default_factory=set)

    def add(self, values: Array, low: Array, high: Array, spent: tuple[float, float]) -> None:
        """One fit: coefficients and the ends of their intervals, (joint, 2)."""
        self.errors.append(float(np.abs(values / TRUTH - 1).max()))
        self.held += ((low <= TRUTH) & (high >= TRUTH)).flatten().tolist()
        self.widths += ((high - low) / 2 / TRUTH).flatten().tolist()
        self.processor.append(spent[0])
        self.wall.append(spent[1])

    def __str__(self) -> str:
        return (
            f"{100 * max(self.errors):11.2f} {100 * np.mean(self.held):9.1f} "
            f"{100 * np.median(self.widths):14.3f} {np.mean(self.processor):13.1f} "
            f"{np.mean(self.wall):9.1f}  {', '.join(sorted(self.remarks)) or '-'}"
        )


def simulated(seconds: float, release: Sequence[float], seed: int) -> Recording:
    """Encoder readings of a release from about `release` [rad]."""
    random = torch.Generator().manual_seed(seed)
    q0 = torch.tensor(release, dtype=torch.float64)
    q0 = q0 + 0.01 * torch.randn(3, generator=random, dtype=torch.float64)
    run = rollout(
        cases.rig(), cases.constant(), q0, torch.zeros_like(q0), sample_time=1 / RATE,
        steps=round(seconds * RATE), gradients=False,
    )  # fmt: skip
    return Recording(time=run.time.numpy(), q=quantise(run.q.numpy(), COUNTS), name="simulated")


def given(seed: int) -> PendulumChain:
    """The mechanism as one knows it: ratios, lengths and zeros off by as much as a fit expects.

    Intervals around a plant that is known exactly would hold the truth too often.
    """
    plant = cases.rig()
    terms = plant_parameters(plant, driven=())
    sd = torch.tensor([t.prior_sd for t in terms], dtype=torch.float64)
    random = torch.Generator().manual_seed(seed)
    off = torch.randn(len(terms), generator=random, dtype=torch.float64).clamp(-2.0, 2.0)
    return plant.replace(**adjusted_buffers(plant, terms, sd * off))


def ours(recording: Recording, row: Row, seed: int) -> None:
    """Fit friction and plant."""
    law = cases.VISCOUS_COULOMB
    model = FrictionModel(law, Constant(law, 3, torch.as_tensor(START * TRUTH)))
    plant = given(seed)
    begun = _clocks()
    found = fit(model, plant, recording)
    spent = _since(begun)
    told = found.intervals[: TRUTH.size]
    values, low, high = (
        np.array([getattr(i, end) for i in told]).reshape(TRUTH.shape)
        for end in ("value", "low", "high")
    )
    row.add(values, low, high, spent)
    row.remarks |= {f"not identifiable: {name}" for name in found.unidentifiable}
    if not found.converged:
        row.remarks.add("not converged")


def mujoco(length: float | None) -> Callable[[Recording, Row, int], None]:
    """MuJoCo's toolbox, which is given the true plant."""

    def identify(recording: Recording, row: Row, _seed: int) -> None:
        plant = cases.rig()
        joint = recording.joint_coordinates(plant)
        begun = _clocks()
        motion = kalman_smoother(joint.time, joint.q)
        found = recovery_mujoco.identified(plant, joint, motion, TRUTH, START, length)
        spent = _since(begun)
        low, high = found.values - found.half_widths, found.values + found.half_widths
        row.add(found.values, low, high, spent)
        row.remarks |= {f"{name} at a bound" for name in found.at_bounds}

    return identify


def recovery(
    seconds: Sequence[float], seeds: int, releases: Sequence[str], peer: str | None
) -> None:
    """Print how well known friction is found again."""
    methods: dict[str, Callable[[Recording, Row, int], None]] = {"nfriction": ours}
    for length in PEER_WINDOWS if peer == "mujoco" else ():
        name = "whole" if length is None else f"{length:g} s windows"
        methods[f"MuJoCo sysid, {name}"] = mujoco(length)
    print(
        "release      seconds  method                       error [%]  held [%]  half-width [%]  "
        "processor [s]  wall [s]  remarks"
    )
    for name in releases:
        for span in seconds:
            for method, identify in methods.items():
                row = Row()
                for seed in range(seeds):
                    identify(simulated(span, RELEASES[name], seed), row, seed)
                print(f"{name:12} {span:7g}  {method:27} {row}", flush=True)


def _clocks() -> tuple[float, float]:
    return time.process_time(), time.perf_counter()


def _since(begun: tuple[float, float]) -> tuple[float, float]:
    now = _clocks()
    return now[0] - begun[0], now[1] - begun[1]
