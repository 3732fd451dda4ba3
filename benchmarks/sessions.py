"""Time and memory of `fit_sessions` over 10, 100 and 1,000 recordings on disk.

python benchmarks/sessions.py [--counts 10 100 1000] [--jobs -1]
"""

import argparse
import math
import resource
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import torch
from joblib.externals.loky import get_reusable_executor

from nfriction import CVFM, PendulumChain, Recording, fit_sessions, rollout

COUNT = 2 * math.pi / 8192
PLANT = PendulumChain([0.4], [0.4], position_quantum=COUNT)


def record(folder: Path, number: int) -> list[Path]:
    """Free swings of 5 s at 200 Hz, one a session, with 15 % of spread between sessions."""
    rng = np.random.default_rng(0)
    friction = np.array([0.02, 0.006]) * (1 + 0.15 * rng.normal(size=(number, 2))).clip(0.1)
    model = CVFM(1, v_smooth=0.01).requires_grad_(False)
    paths = []
    for k, coefficients in enumerate(friction):
        model.schedule.set_parameter_vector(torch.as_tensor(coefficients))
        start = torch.tensor([math.pi + rng.uniform(1, 2)], dtype=torch.float64)
        found = rollout(PLANT, model, start, 0 * start, sample_time=0.005, steps=1000, substeps=2)
        q = COUNT * np.round(found.q.numpy() / COUNT)
        paths.append(folder / f"session{k}.csv")
        Recording(0.005 * np.arange(1001), q, convention="relative,upright").write(paths[-1])
    return paths


def peak(who: int) -> float:
    """Largest resident memory [MB]; of children, that of the largest."""
    return resource.getrusage(who).ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--jobs", type=int, default=-1)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    print(
        f"{'sessions':>8}  {'s':>7}  {'s each':>7}  {'parent MB':>9}  {'child MB':>8}  F_c spread"
    )
    with tempfile.TemporaryDirectory() as folder:
        for number in arguments.counts:
            paths = record(Path(folder), number)
            begun = time.perf_counter()
            found = fit_sessions(
                CVFM(1, v_smooth=0.01), PLANT, {p.stem: p for p in paths}, jobs=arguments.jobs,
                windows=(0.5, 2.0), drag=False,
            )  # fmt: skip
            seconds = time.perf_counter() - begun
            # Memory of child processes counts once they have ended.
            get_reusable_executor().shutdown(wait=True)
            spread = found.spreads[0]
            print(
                f"{number:8d}  {seconds:7.1f}  {seconds / number:7.3f}  "
                f"{peak(resource.RUSAGE_SELF):9.0f}  {peak(resource.RUSAGE_CHILDREN):8.0f}  "
                f"{spread.between / spread.mean:.1%}"
            )


if __name__ == "__main__":
    main()
