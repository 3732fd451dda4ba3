"""One geared motor with a flywheel: log its current and its encoder, fit the friction."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from nfriction import CVFM, Motor, Recording, Rotor, fit, rigs, rollout

COUNTS = 8192  # per motor revolution
MOTOR = Motor(gear_ratio=50, rotor_inertia=1.2e-5, torque_constant=0.03)
BENCH = Rotor(inertia=0.02, motor=MOTOR, name="wheel", position_quantum=2 * np.pi / COUNTS / 50)
TRUTH = [0.35, 0.12]  # F_c [N m], F_v [N m s/rad], at the joint


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two seconds instead of ten")
    parser.add_argument("--out", type=Path, default=Path("runs/motor"))
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    rigs.write(BENCH, arguments.out / "rig.json")
    logs = [arguments.out / f"run{k + 1}.csv" for k in range(3)]
    for seed, log in enumerate(logs):
        write_log(log, seed, seconds=2.0 if arguments.quick else 10.0)
    print(*logs[0].read_text().splitlines()[:3], sep="\n")

    rig = rigs.read(arguments.out / "rig.json")
    columns = {"time": "Zeit [ms]", "motor1": f"Geber:counts/{COUNTS}", "current1": "Strom [A]"}
    train = [Recording.read(log, columns=columns, plant=rig) for log in logs[:2]]
    found = fit(CVFM(1), rig, train, windows=(0.5, 2.0))
    print(found.status)
    for interval, true in zip(found.intervals, TRUTH, strict=False):
        print(f"{interval.name}: {interval.value:.4f} "
              f"({interval.low:.4f} to {interval.high:.4f}), true {true}")  # fmt: skip
    return 0


def write_log(path: Path, seed: int, seconds: float) -> None:
    """Write a log of a run with a four-sine current, as from a drive with German settings."""
    rng = np.random.default_rng(seed)
    steps, every = round(seconds / 5e-4), 4  # four simulation steps per sample
    sample = np.arange(steps // every) * every * 5e-4
    frequency, phase = rng.uniform(0.2, 2.0, (4, 1)), rng.uniform(0, 2 * np.pi, (4, 1))
    current = 0.35 * np.sin(2 * np.pi * frequency * sample + phase).sum(0)
    torque = BENCH.motor_factors["current"][0] * np.repeat(current, every)
    rest = torch.zeros(1, dtype=torch.float64)
    friction = CVFM(1, TRUTH).requires_grad_(False)
    run = rollout(BENCH, friction, rest, rest, torque[:, None], sample_time=5e-4)
    turns = run.q.numpy()[:-1:every, 0] * 50 / (2 * np.pi)
    read = current + rng.normal(0, 5e-3, current.shape)
    rows = [
        f"{1e3 * t:.1f};{round(n * COUNTS)};{i:.4f}"
        for t, n, i in zip(sample, turns, read, strict=True)
    ]
    path.write_text("\n".join(["Zeit [ms];Geber;Strom [A]", *rows]).replace(".", ",") + "\n")


if __name__ == "__main__":
    raise SystemExit(main())
