"""Fair timing: one pinned thread, contestants that take turns, medians, one table."""

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

# Read by numerical libraries when they are loaded, so this module comes before them.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import numpy as np  # noqa: E402

# Windows counts processor time in ticks of 16 ms.
CLOCK = time.perf_counter if sys.platform == "win32" else time.process_time


@dataclass(frozen=True)
class Contestant:
    """One way to do the work.

    Attributes:
        name: as the table calls it.
        run: does the work once and returns the final state to compare.
        scale: how often the work that `run` does fits into the whole; times are multiplied by it.
        tolerance: how far the final state may lie from the reference.
        rounds: in how many rounds it takes part; slow ones sit some out.
        note: what a reader must know.
        expected: state to compare with where `run` stops short of the reference's end.
    """

    name: str
    run: Callable[[], np.ndarray]
    scale: float = 1.0
    tolerance: float = 1e-9
    rounds: int = 10**9
    note: str = ""
    expected: np.ndarray | None = None


def pin() -> str:
    """Keep this process on the least busy core; a word on whether that was possible."""
    if not hasattr(os, "sched_setaffinity"):
        return "not pinned (this platform cannot)"

    def delay(core: int) -> float:
        """Wall time that 50 ms of work take there."""
        os.sched_setaffinity(0, {core})
        start, work = time.perf_counter(), time.process_time()
        while time.process_time() - work < 0.05:
            pass
        return time.perf_counter() - start

    core = min(os.sched_getaffinity(0), key=delay)
    os.sched_setaffinity(0, {core})
    return f"pinned to core {core}"


def yardstick() -> str:
    """Speed of this machine now: absolute times mean nothing without it."""
    import torch

    x = torch.ones((), dtype=torch.float64)
    start = CLOCK()
    for _ in range(20_000):
        x = x + 1.0
    return f"yardstick: {(CLOCK() - start) / 20_000 * 1e6:.1f} us an eager scalar addition"


def race(contestants: list[Contestant], rounds: int) -> dict[str, tuple[float, int]]:
    """Median seconds and number of runs of each contestant, in turns.

    Counted is processor time, on one pinned thread the wall time of an idle machine: neighbours
    that take the core for a while are left out. Taking turns, all see the same clock rate and
    caches. Each must have run once before (compiled, caches filled).
    """
    times: dict[str, list[float]] = {c.name: [] for c in contestants}
    for k in range(rounds):
        for c in contestants:
            if k < c.rounds:
                start = CLOCK()
                c.run()
                times[c.name].append(c.scale * (CLOCK() - start))
    return {name: (float(np.median(t)), len(t)) for name, t in times.items()}


def compare(title: str, contestants: list[Contestant], rounds: int) -> dict[str, float]:
    """Check that all reach the reference's final state, race them, and print a table.

    The first contestant is the reference of states and of ratios.

    Raises:
        SystemExit: if a contestant ends elsewhere: it does other work, so its time says nothing.
    """
    print(f"\n{title}", flush=True)
    reference = contestants[0].run()
    deviation = {}
    for c in contestants:
        expected = reference if c.expected is None else c.expected
        deviation[c.name] = float(np.abs(c.run() - expected).max())
        if not deviation[c.name] <= c.tolerance:
            raise SystemExit(
                f"{c.name} ends {deviation[c.name]:.2g} from {contestants[0].name}, "
                f"more than {c.tolerance:g}: not the same work."
            )
    found = race(contestants, rounds)
    own = found[contestants[0].name][0]
    print(f"  {'':28} {'median':>11} {'ratio':>9} {'runs':>5}  {'deviation':>9}")
    for c in contestants:
        seconds, runs = found[c.name]
        print(
            f"  {c.name:28} {1e3 * seconds:8.2f} ms {seconds / own:8.2f}x {runs:5}  "
            f"{deviation[c.name]:9.1e}  {c.note}",
            flush=True,
        )
    return {name: seconds for name, (seconds, _) in found.items()}


def verdict(claim: str, value: float, target: float, *, at_least: bool = False) -> None:
    """Print whether a target is met."""
    met = value >= target if at_least else value <= target
    sign = ">=" if at_least else "<="
    print(f"  {'met   ' if met else 'MISSED'} {claim}: {value:.3g} (target {sign} {target:g})")
