"""Your own friction law: define one function; fits, rollouts and exports work with it."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nfriction import FrictionModel, PendulumChain, Recording, export, fit, rollout
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import Coefficient, Law


def sticky(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Coulomb friction, and a term that grows with the square of the velocity."""
    coulomb, square = coefficients.unbind(-1)
    return coulomb * torch.tanh(qd / v_smooth) + square * qd * qd.abs()


STICKY = Law(
    "sticky", (Coefficient("K", "N m"), Coefficient("D", "N m s^2/rad^2")), sticky
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one second instead of ten")
    parser.add_argument("--out", type=Path, default=Path("runs/own_law"))
    arguments = parser.parse_args(argv)

    pendulum = PendulumChain(mass=[0.2], length=[0.4], position_quantum=1e-4)
    truth = FrictionModel(STICKY, Constant(STICKY, 1, [2e-3, 4e-4])).requires_grad_(False)
    recording = swing(pendulum, truth, seconds=1.0 if arguments.quick else 10.0)

    model = FrictionModel(STICKY, Constant(STICKY, 1))
    found = fit(model, pendulum, recording, windows=(0.5,), fit_plant=False, drag=False)
    print(found.status)
    for interval, true in zip(found.intervals, (2e-3, 4e-4), strict=True):
        print(f"{interval.name}: {interval.value:.5g} ({interval.low:.5g} to {interval.high:.5g}), "
              f"true {true:.5g}")  # fmt: skip
    arguments.out.mkdir(parents=True, exist_ok=True)
    print("wrote", export.torchscript(found.model, arguments.out / "sticky.pt"))
    return 0


def swing(plant: PendulumChain, friction: FrictionModel, seconds: float) -> Recording:
    """A release from rest, as measured by an encoder."""
    q0 = torch.tensor([np.pi + 2.0], dtype=torch.float64)
    run = rollout(plant, friction, q0, 0 * q0, sample_time=1e-3, steps=round(1e3 * seconds))
    q = np.round(run.q.numpy() / 1e-4) * 1e-4
    return Recording(1e-3 * np.arange(len(q)), q, convention="relative,upright", name="swing")


if __name__ == "__main__":
    raise SystemExit(main())
