"""Fair timing: one pinned thread, contestants that take turns, medians, one table."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass

# Read by numerical libraries when they are loaded, so this module comes before them.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")

import numpy as np


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
    """

    name: str
    run: Callable[[], np.ndarray]
    scale: float = 1.0
    tolerance: float = 1e-9
    rounds: int = 10**9
    note: str = ""


def pin() -> str:
    """Keep this process on one core; a word on whether that was possible."""
    if not hasattr(os, "sched_setaffinity"):
        return "not pinned (this platform cannot)"
    core = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    return f"pinned to core {core}"


def race(contestants: list[Contestant], rounds: int) -> dict[str, tuple[float, int]]:
    """Median seconds and number of runs of each contestant, in turns.

    A busy machine then slows all of them alike. Each must have run once before (compiled, caches
    filled).
    """
    times: dict[str, list[float]] = {c.name: [] for c in contestants}
    for k in range(rounds):
        for c in contestants:
            if k < c.rounds:
                start = time.perf_counter()
                c.run()
                times[c.name].append(c.scale * (time.perf_counter() - start))
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
        states = c.run()
        # A contestant with a shorter horizon is compared by the caller's choice of reference.
        deviation[c.name] = float(np.abs(states - reference).max())
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
