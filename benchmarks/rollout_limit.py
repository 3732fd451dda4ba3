"""Compiled rollouts against hand-written C: 40,000 steps of three links, one pinned thread.

Run from the repository's root: `python benchmarks/rollout_limit.py [--numba] [--repeats 15]`.
The contestants take turns, so that a busy machine slows all of them alike.
"""

import argparse
import ctypes
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch

from nfriction.codegen import build, compile_rollout

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.codegen.mechanisms import Coulomb, NeuroFuzzy, Pendulum

STEPS, DT = 40_000, 1e-3
FUZZY = ("centre", "log_width", "rule", "unit_centre", "unit_log_width", "unit_out", "scale")


def limit(plant: Pendulum, friction: Coulomb, folder: str) -> Callable[..., tuple]:
    """The hand-written rollout, compiled with the flags that the emitted code gets."""
    library = Path(folder) / "limit.so"
    source = Path(__file__).with_name("rollout_limit.c")
    compiler = build.find_compiler()
    if compiler is None:
        raise SystemExit("no C compiler found")
    flags = ["-O3", *build.FLAGS, "-march=native", "-shared", "-fPIC"]
    subprocess.run([*compiler, *flags, "-o", str(library), str(source), "-lm"], check=True)
    function = ctypes.CDLL(str(library)).limit_rollout

    def flat(module: torch.nn.Module, names: tuple[str, ...]) -> np.ndarray:
        return torch.cat([getattr(module, n).detach().reshape(-1) for n in names]).numpy()

    body = flat(plant, ("moment", "inertia", "gravity"))
    fuzzy = flat(friction, FUZZY) if isinstance(friction, NeuroFuzzy) else None
    constant = friction.log.detach().numpy().copy()

    def run(q0: np.ndarray, qd0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q, qd = np.empty((STEPS + 1, 3)), np.empty((STEPS + 1, 3))
        pointers = [ctypes.c_void_p(None if a is None else a.ctypes.data)
                    for a in (body, constant, fuzzy, q0, qd0, q, qd)]  # fmt: skip
        function(ctypes.c_long(STEPS), ctypes.c_double(DT), *pointers)
        return q, qd

    return run


def measure(runs: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            times[name].append(time.perf_counter() - start)
    return {name: float(np.median(t[1:])) for name, t in times.items()}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--numba", action="store_true", help="also time the numba backend")
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    q0, qd0 = np.array([[2.0, 0.3, -0.4]]), np.zeros((1, 3))
    for friction in (Coulomb(), NeuroFuzzy()):
        plant = Pendulum()
        with tempfile.TemporaryDirectory() as folder:
            by_hand = limit(plant, friction, folder)
            runs: dict[str, Callable[[], object]] = {"hand": partial(by_hand, q0[0], qd0[0])}
            for backend in ("c", "numba") if options.numba else ("c",):
                start = time.perf_counter()
                compiled = compile_rollout(plant, friction, backend=backend)
                print(f"{type(friction).__name__} {backend}: ready in "
                      f"{time.perf_counter() - start:.2f} s")  # fmt: skip
                runs[backend] = partial(compiled, q0, qd0, steps=STEPS, time_step=DT)
            q, _ = by_hand(q0[0], qd0[0])
            ours = compiled(q0, qd0, steps=STEPS, time_step=DT).q[0]
            print(f"  agreement after 1000 steps {np.abs(q[1000] - ours[1000]).max():.1e} rad")
            times = measure(runs, options.repeats)
            for name, seconds in times.items():
                print(f"  {name:6} {1e3 * seconds:8.2f} ms  {seconds / times['hand']:.2f} x hand")
    return 0


if __name__ == "__main__":
    sys.exit(main())
