"""Learn friction that depends on the motion of a joint; show the result as rules in words."""

import argparse
import copy
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from nfriction import NFNCFM, PendulumChain, Recording, fit, plots, rollout
from nfriction.report import rules_in_words


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one second instead of ten")
    parser.add_argument("--out", type=Path, default=Path("runs/neuro_fuzzy"))
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)

    pendulum = PendulumChain(mass=[0.2], length=[0.4], position_quantum=1e-4)
    seconds, steps = (1.0, 2) if arguments.quick else (10.0, 15)
    recording = swing(pendulum, seconds)
    model = NFNCFM(1, terms=(3, 3))
    before = copy.deepcopy(model)
    found = fit(model, pendulum, recording, windows=(0.5,), fit_plant=False, drag=False,
                max_steps=steps)  # fmt: skip
    print(found.status)
    # A rule that the recording hardly fired repeats its neighbours and the prior.
    (joint,), (fired,) = rules_in_words(model, ["pendulum"]), found.rule_seconds()
    for rule, duration in zip(joint.rules, fired, strict=True):
        print(f"{rule.sentence([('C_p', 'N m s/rad')])} (fired for {duration:.2f} s)")
    before.schedule.set_range(model.schedule.velocity_range, [-80.0, 80.0])
    plots.memberships(model, before).savefig(arguments.out / "memberships.png", dpi=150)
    figure = plots.coefficient_surfaces(model, found.motions)
    figure.savefig(arguments.out / "coefficients.png", dpi=150)
    return 0


def swing(plant: PendulumChain, seconds: float) -> Recording:
    """A swing whose viscous coefficient falls with the velocity, from 3e-3 to 1e-3 N m s/rad."""
    truth = NFNCFM(1, [2e-3], terms=(3, 3), head_units=1).requires_grad_(False)
    truth.schedule.set_range(12.0, [-80.0, 80.0])
    truth.schedule.network.anfis.consequents[..., 0] = -1.0  # slope over the scaled velocity
    truth.schedule.network.anfis.consequents[..., 2] = 0.5
    q0 = torch.tensor([np.pi + 2.5], dtype=torch.float64)
    run = rollout(plant, truth, q0, 0 * q0, sample_time=1e-3, steps=round(1e3 * seconds))
    q = np.round(run.q.numpy() / 1e-4) * 1e-4
    return Recording(1e-3 * np.arange(len(q)), q, convention="relative,upright", name="swing")


if __name__ == "__main__":
    raise SystemExit(main())
