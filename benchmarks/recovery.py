"""Friction that is known, found again from what simulated encoders see of it."""

import math
import time
from collections.abc import Sequence

import cases
import numpy as np
import torch

from nfriction import FrictionModel, Recording, rollout
from nfriction.fitting import fit
from nfriction.friction import Constant
from nfriction.signals import quantise

COUNTS, RATE = 8192, 1000
# Released from rest; joint angles from upright [rad].
RELEASES = {
    "swing": (math.pi + 0.8, 0.4, -0.3),
    "179 degrees": (math.radians(1.0), 0.0, 0.0),
}


def simulated(seconds: float, release: Sequence[float], seed: int) -> Recording:
    """What the encoders see of a release from about `release` [rad]."""
    random = torch.Generator().manual_seed(seed)
    q0 = torch.tensor(release, dtype=torch.float64)
    q0 = q0 + 0.01 * torch.randn(3, generator=random, dtype=torch.float64)
    run = rollout(
        cases.rig(), cases.constant(), q0, torch.zeros_like(q0), sample_time=1 / RATE,
        steps=round(seconds * RATE), gradients=False,
    )  # fmt: skip
    return Recording(time=run.time.numpy(), q=quantise(run.q.numpy(), COUNTS), name="simulated")


def recovery(seconds: Sequence[float], seeds: int) -> None:
    """Print how well known friction is found again."""
    truth = torch.tensor([cases.VISCOUS, cases.COULOMB], dtype=torch.float64).T
    law = cases.VISCOUS_COULOMB
    print("release        seconds  largest error [%]  held by 95 %  processor [s]  lost")
    for name, release in RELEASES.items():
        for span in seconds:
            errors, held, spent, lost = [], [], 0.0, set()
            for seed in range(seeds):
                model = FrictionModel(law, Constant(law, 3, 3 * truth))
                start = time.process_time()
                found = fit(model, cases.rig(), simulated(span, release, seed))
                spent += time.process_time() - start
                errors.append((found.model.schedule.values / truth - 1).abs())
                told = found.intervals[: truth.numel()]
                held += [i.low <= t <= i.high for i, t in zip(told, truth.flatten(), strict=True)]
                lost |= set(found.lost)
            print(
                f"{name:14} {span:7g} {100 * float(torch.stack(errors).max()):18.2f} "
                f"{100 * np.mean(held):12.1f}% {spent / seeds:14.1f}  {', '.join(lost) or '-'}",
                flush=True,
            )
