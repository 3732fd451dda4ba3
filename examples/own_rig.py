"""Describe your own rig, read a log in degrees with decimal commas, and fit its friction."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from nfriction import LFM, PendulumChain, Recording, fit, rigs, rollout

# Data-sheet values; angles are absolute, measured from hanging.
BENCH = PendulumChain(
    mass=[0.15, 0.10], length=[0.30, 0.20], com=[0.15, 0.10], inertia=[1.1e-3, 3.3e-4],
    name="bench", convention=("absolute", "hanging"), position_quantum=np.pi / 4096,
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one second instead of eight")
    parser.add_argument("--out", type=Path, default=Path("runs/own_rig"))
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    rigs.write(BENCH, arguments.out / "rig.json")

    log = arguments.out / "log.csv"
    write_log(log, seconds=1.0 if arguments.quick else 8.0)
    print(log.read_text().splitlines()[:3])

    rig = rigs.read(arguments.out / "rig.json")
    recording = Recording.read(
        log, columns={"time": "Zeit", "q1": "Arm", "q2": "Pendel"}, degrees=True
    )
    found = fit(LFM(2), rig, recording, windows=(0.5,), fit_plant=False, drag=False)
    print(found.status)
    print("true   B, C:", *np.round(TRUTH.ravel(), 6))
    print("fitted B, C:", *found.model.schedule.values.flatten().numpy().round(6))
    return 0


TRUTH = np.array([[6e-4, 2e-3], [2e-4, 5e-4]])


def write_log(path: Path, seconds: float) -> None:
    """Write a log of a release from rest, as from a logger with German settings."""
    q0 = torch.tensor([np.pi + 1.2, 0.4], dtype=torch.float64)  # joints: relative, from upright
    friction = LFM(2, TRUTH.tolist()).requires_grad_(False)
    run = rollout(BENCH, friction, q0, 0 * q0, sample_time=2e-3, steps=round(seconds / 2e-3))
    absolute = np.cumsum(run.q.numpy(), 1) - np.pi
    degrees = np.rad2deg(np.round(absolute / BENCH.position_quantum) * BENCH.position_quantum)
    rows = [f"{2e-3 * k:.3f};{a:.4f};{b:.4f}" for k, (a, b) in enumerate(degrees)]
    path.write_text("\n".join(["Zeit;Arm;Pendel", *rows]).replace(".", ",") + "\n")


if __name__ == "__main__":
    raise SystemExit(main())
