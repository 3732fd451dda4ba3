"""Time of one call of a controller: p50 and p99 for 1 and 4 joints, one thread.

    python benchmarks/latency.py [--calls 200000]

The controller is an NFLFM (5 x 5 rules and 10 radial units a joint) with random parameters, in all
targets the same. Every call is timed on its own; what the clock costs is in the numbers and is
reported beside them.
"""

from __future__ import annotations

import argparse
import ctypes
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from nfriction import NFLFM, FrictionModel
from nfriction.codegen import build
from nfriction.export.c_export import c
from nfriction.export.controller import controller_of
from nfriction.export.points import draw
from nfriction.modelfile import ModelInfo

JOINTS = (1, 4)
ROWS = 1000  # different samples, taken in turn


@dataclass(frozen=True)
class Case:
    """What every target is given.

    Attributes:
        model: the friction model.
        info: its trained ranges.
        inputs: velocity, acceleration and load, (sample, joint) each.
        calls: how many calls to time.
        folder: for artefacts.
    """

    model: FrictionModel
    info: ModelInfo
    inputs: tuple[np.ndarray, ...]
    calls: int
    folder: Path


Timer = Callable[[Case], np.ndarray]
"""Exports the model of a case, warms up, and gives the nanoseconds of every call."""


def case(joints: int, calls: int, folder: Path) -> Case:
    torch.manual_seed(0)
    model = NFLFM(joints, [0.02, 0.05])
    with torch.no_grad():
        for p in model.parameters():
            p.add_(0.2 * torch.randn(p.shape, dtype=p.dtype))
    ranges = {"qd": [[-8.0, 8.0]] * joints, "qdd": [[-60.0, 60.0]] * joints}
    info = ModelInfo(sample_time=1e-3, input_ranges=ranges)
    inputs = tuple(x.numpy() for x in draw(controller_of(model, info), ROWS))
    return Case(model, info, inputs, calls, folder)


def c_timer(dtype: str) -> Timer:
    def run(given: Case) -> np.ndarray:
        folder = given.folder / f"c_{dtype}_{given.model.joints}"
        c(given.model, folder, given.info, dtype=dtype)
        compiler = build.find_compiler()
        if compiler is None:
            raise SystemExit("no C compiler found")
        library = folder / "latency.so"
        sources = [str(Path(__file__).with_name("latency.c")), str(folder / "nfriction.c")]
        command = [*compiler, "-std=c99", "-O3", *build.FLAGS, f"-I{folder}", "-shared", "-fPIC",
                   *sources, "-o", str(library), "-lm"]  # fmt: skip
        subprocess.run(command, check=True)
        loaded = ctypes.CDLL(str(library))
        arrays = [np.ascontiguousarray(x, dtype=dtype) for x in given.inputs]
        pointers = [ctypes.c_void_p(x.ctypes.data) for x in arrays]
        ns = np.empty(given.calls)
        for calls in (ROWS, given.calls):  # the first round fills the caches
            loaded.latency(ctypes.c_long(calls), ctypes.c_long(ROWS), *pointers,
                           ctypes.c_void_p(ns.ctypes.data))  # fmt: skip
        if dtype == "float64":
            CLOCK.append(_clock_alone(loaded, given.calls))
        return ns

    return run


CLOCK: list[float] = []
"""Median cost of reading the clock twice [ns]."""


def _clock_alone(loaded: ctypes.CDLL, calls: int) -> float:
    ns = np.empty(calls)
    loaded.clock_alone(ctypes.c_long(calls), ctypes.c_void_p(ns.ctypes.data))
    return float(np.median(ns))


# A target is one line here: its name, its timer, and the goals of its p99 for 1 and 4 joints [us].
TARGETS: list[tuple[str, Timer, tuple[float | None, float | None]]] = [
    ("C, double", c_timer("float64"), (0.25, 1.0)),
    ("C, float", c_timer("float32"), (0.25, 1.0)),
]


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--calls", type=int, default=200_000)
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    missed = 0
    print(f"{'':28} {'joints':>6} {'p50':>10} {'p99':>10}   goal of p99")
    with tempfile.TemporaryDirectory() as folder:
        for joints in JOINTS:
            given = case(joints, arguments.calls, Path(folder))
            for name, timer, goals in TARGETS:
                p50, p99 = np.percentile(timer(given), (50, 99)) / 1e3
                goal = goals[JOINTS.index(joints)]
                met = "" if goal is None else f"{goal:g} {'met' if p99 <= goal else 'MISSED'}"
                missed += met.endswith("MISSED")
                print(f"{name:28} {joints:6} {p50:7.3f} us {p99:7.3f} us   {met}", flush=True)
    if CLOCK:
        print(f"The clock itself: {np.median(CLOCK):.0f} ns a call, in the numbers above.")
    return int(missed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
