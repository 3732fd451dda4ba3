"""Time of one call of a controller: p50 and p99 for 1 and 4 joints, one thread.

    python benchmarks/latency.py [--calls 200000]

The controller is an NFLFM (5 x 5 rules and 10 radial units a joint) with random parameters, in all
targets the same, and in one of them a LuGre model, whose law has memory. Every call is timed on its
own. For C what two readings of the clock cost (their median, measured beside it) is taken off; the
last column is the mean of many calls in a row, which needs no such correction. Rows of C name the
compiler's options. TorchScript in C++ needs cmake, ONNX Runtime its package; what is not here is
left out.
"""

from __future__ import annotations

import argparse
import ctypes
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import latency_torch
import numpy as np
import torch

from nfriction import NFLFM, FrictionModel
from nfriction.export import c
from nfriction.export.c_file import find_compiler
from nfriction.export.contract import draw
from nfriction.export.controller import controller_of
from nfriction.friction.memory import LuGre
from nfriction.io.model_file import ModelInfo

JOINTS = (1, 4)
ROWS = 1000  # different samples, taken in turn


@dataclass(frozen=True)
class Case:
    """Inputs of every target.

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


@dataclass(frozen=True)
class Times:
    """Nanoseconds of every call, and where it was measured the mean of calls in a row."""

    single: np.ndarray
    mean: float | None = None


Timer = Callable[[Case], Times]
"""Exports the model of a case, warms up and takes the time."""


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


def c_timer(dtype: str, *options: str) -> Timer:
    def run(given: Case) -> Times:
        folder = given.folder / "_".join(["c", dtype, str(given.model.joints), *options])
        c(given.model, folder, given.info, name="nf", dtype=dtype)
        compiler = find_compiler()
        if compiler is None:
            raise FileNotFoundError("no C compiler")
        library = folder / "latency.so"
        sources = [str(Path(__file__).with_name("latency.c")), str(folder / "nf.c")]
        command = [*compiler, "-std=c99", *options, f"-I{folder}", "-shared", "-fPIC", *sources,
                   "-o", str(library), "-lm"]  # fmt: skip
        subprocess.run(command, check=True)
        loaded = ctypes.CDLL(str(library))
        loaded.batch.restype = ctypes.c_double
        arrays = [np.ascontiguousarray(x, dtype=dtype) for x in given.inputs]
        pointers = [ctypes.c_void_p(x.ctypes.data) for x in arrays]
        ns, total = np.empty(given.calls), ctypes.c_double(0.0)
        clock = np.empty(given.calls)
        for calls in (ROWS, given.calls):  # the first round fills the caches
            sizes = ctypes.c_long(calls), ctypes.c_long(ROWS)
            mean = loaded.batch(*sizes, *pointers, ctypes.byref(total))
            loaded.latency(*sizes, *pointers, ctypes.c_void_p(ns.ctypes.data))
            loaded.clock_alone(sizes[0], ctypes.c_void_p(clock.ctypes.data))
        return Times(ns - np.median(clock), mean)

    return run


def with_memory(timer: Timer) -> Timer:
    """A timer of a LuGre model in place of the given one."""

    def run(given: Case) -> Times:
        model = LuGre(given.model.joints, [1.0, 0.5, 0.05, 1e4, 10.0, 0.4])
        return timer(replace(given, model=model, folder=given.folder / "lugre"))

    return run


def alone(timer: Callable[[Case], np.ndarray]) -> Timer:
    """A timer of single calls, each so long that the clock does not count."""
    return lambda given: Times(timer(given))


NATIVE = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast")

# A target is one line here: its name, its timer, and the goals of its p99 for 1 and 4 joints [us].
TARGETS: list[tuple[str, Timer, tuple[float | None, float | None]]] = [
    ("C, double, -O2", c_timer("float64", "-O2"), (None, None)),
    ("C, double, -O3", c_timer("float64", "-O3"), (0.25, 1.0)),
    ("C, double, native", c_timer("float64", *NATIVE), (0.25, 1.0)),
    ("C, float, -O2", c_timer("float32", "-O2"), (None, None)),
    ("C, float, -O3", c_timer("float32", "-O3"), (0.25, 1.0)),
    ("C, float, native", c_timer("float32", *NATIVE), (0.25, 1.0)),
    ("LuGre, C, double, -O2", with_memory(c_timer("float64", "-O2")), (0.25, 1.0)),
    ("TorchScript in C++", alone(latency_torch.torchscript_cpp), (None, None)),
    ("TorchScript in Python", alone(latency_torch.torchscript_python), (None, None)),
    ("ONNX Runtime, double", alone(latency_torch.onnx_runtime), (None, None)),
    ("eager torch", alone(latency_torch.eager), (None, None)),
]


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--calls", type=int, default=200_000)
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    missed = 0
    print(f"native: {' '.join(NATIVE)}")
    print(f"{'us a call':24} {'joints':>6} {'p50':>9} {'p99':>9} {'in a row':>9}   goal of p99")
    with tempfile.TemporaryDirectory() as folder:
        for joints in JOINTS:
            given = case(joints, arguments.calls, Path(folder))
            for name, timer, goals in TARGETS:
                try:
                    times = timer(given)
                except (ImportError, FileNotFoundError) as error:
                    print(f"{name:24} {joints:6} left out: {error}")
                    continue
                p50, p99 = np.percentile(times.single, (50, 99)) / 1e3
                mean = "" if times.mean is None else f"{times.mean / 1e3:.3f}"
                goal = goals[JOINTS.index(joints)]
                met = "" if goal is None else f"{goal:g} {'met' if p99 <= goal else 'MISSED'}"
                missed += met.endswith("MISSED")
                print(f"{name:24} {joints:6} {p50:9.3f} {p99:9.3f} {mean:>9}   {met}", flush=True)
    return int(missed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
