"""Networks put to the test: their error bars, and whether one that is accepted is better.

    python benchmarks/networks.py coverage [--seeds 30]
    python benchmarks/networks.py twins [--seeds 10] [--truths Stribeck LuGre ...] [--model NFCVFM]

`coverage` learns a swing whose viscous coefficient follows speed and acceleration by rules that the
seed draws, and prints how often the 95 % error bars along the swing hold the truth.

`twins` fits a network and its law to two short recordings, and simulates both on ten releases that
no fit has seen. Truths are laws on one link, or effects of `nfriction twin --truth` on three links
(ten times as slow). A model with a network or further inputs counts as accepted, and as worse if
its median error is over 1 % above its law's.
"""

import argparse
import math
import time
from typing import NamedTuple

import numpy as np
import torch

from nfriction import (
    NFCVFM,
    NFNCFM,
    FrictionModel,
    PendulumChain,
    Plant,
    Recording,
    fit,
    rollout,
)
from nfriction.evaluation.score import RMSE
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction import model_by_name
from nfriction.papers.twin import family
from nfriction.signals import quantise

LINK = {"mass": [0.2], "length": [0.4]}
COUNTS, SECONDS, HELD_OUT = 8192, 3.0, 10
LAWS = ("CVFM", "Stribeck", "NLFM", "LuGre", "one-sided", "network")
Start = tuple[torch.Tensor, torch.Tensor]


class Twin(NamedTuple):
    """A rig, recordings to fit to, and true motions with their starts to judge by."""

    plant: Plant
    recordings: list[Recording]
    held_out: list[tuple[Start, np.ndarray]]


def rules(random: np.random.Generator) -> FrictionModel:
    """Viscous friction that falls with the speed and follows the acceleration [N m s/rad]."""
    truth = NFNCFM(1, [random.uniform(1.5e-3, 3e-3)], terms=(3, 3), head_units=1)
    truth.schedule.set_range(12.0, [-80.0, 80.0])
    planes = truth.requires_grad_(False).schedule.network.anfis.consequents
    planes[..., 0] = -random.uniform(0.4, 1.0)
    planes[..., 1] = random.uniform(-0.3, 0.3)
    planes[..., 2] = random.uniform(0.2, 0.5)
    return truth


def drawn(truth: str, random: np.random.Generator) -> FrictionModel:
    """Friction of a link in bearings, a few hundredths of its weight [N m]."""
    scale = 9.81 * 0.2 * 0.2 * random.uniform(0.01, 0.04)
    dry, slow, viscous = scale * random.uniform((0.5, 0.2, 0.03), (1.0, 0.6, 0.1))
    speed, stiffness = random.uniform(0.3, 2.0), dry / random.uniform(1e-3, 1e-2)
    if truth == "network":
        return rules(random)
    if truth == "one-sided":
        lean = scale * random.uniform(0.05, 0.2)
        return NFCVFM(1, [dry, viscous, lean], inputs=["direction"]).requires_grad_(False)
    damping = random.uniform(0.3, 1.0) * math.sqrt(stiffness * 0.01)
    values = {
        "CVFM": (dry, viscous),
        "Stribeck": (dry, slow, viscous, speed, 2.0),
        "NLFM": (0.0, dry, viscous, slow, speed),
        "LuGre": (dry, slow, speed, stiffness, damping, viscous),
    }
    return model_by_name(truth)(1, values[truth])


def on_one_link(truth: str, seed: int) -> Twin:
    """Releases of one link, read by an encoder."""
    random = np.random.default_rng([seed, LAWS.index(truth)])
    plant = PendulumChain(**LINK, position_quantum=2 * math.pi / COUNTS)
    friction, runs = drawn(truth, random), []
    for _ in range(2 + HELD_OUT):
        start = torch.tensor([math.pi + random.choice([-1.0, 1.0]) * random.uniform(0.8, 2.6)])
        begin = (start.double(), torch.zeros(1, dtype=torch.float64))
        run = rollout(plant, friction, *begin, sample_time=2e-3, steps=round(SECONDS / 2e-3),
                      substeps=4, gradients=False)  # fmt: skip
        runs.append((begin, run.q.numpy()))
    time_ = 2e-3 * np.arange(len(runs[0][1]))
    recordings = [
        Recording(time_, quantise(q, COUNTS), convention="relative,upright", name=f"{truth} {k}")
        for k, (_, q) in enumerate(runs[:2])
    ]
    return Twin(plant, recordings, runs[2:])


def on_three(truth: str, seed: int) -> Twin:
    """Releases of the family's three links."""
    found = family.draw(truth, seed=seed, duration=SECONDS)
    held_out = []
    for label, split in found.splits.items():
        true = found.truth[label]
        begin = torch.as_tensor(true.q[0]), torch.as_tensor(true.qd[0])
        held_out += [(begin, true.q)] if split == "test" else []
    return Twin(found.plant, found.part("train"), held_out)


def errors(found: FitResult, twin: Twin) -> np.ndarray:
    """Free-run error on each held-out release [rad]."""
    rmse = []
    for (q, qd), true in twin.held_out:
        run = rollout(found.plant, found.model, q, qd, sample_time=SECONDS / (len(true) - 1),
                      steps=len(true) - 1, gradients=False)  # fmt: skip
        rmse.append(RMSE.of(run.q.numpy() - true).all)
    return np.array(rmse)


def twins(truths: list[str], first: int, seeds: int, model: str) -> None:
    accepted = worse = 0
    for seed in range(first, first + seeds):
        for truth in truths:
            begun = time.process_time()
            twin = on_one_link(truth, seed) if truth in LAWS else on_three(truth, seed)
            law, net = (
                fit(m, twin.plant, twin.recordings, fit_plant=False, drag=False)
                for m in (model.removeprefix("NF"), model)
            )
            kept = "Network rejected" in net.status
            before, after = (1e3 * errors(f, twin) for f in (law, net))
            a, b = np.median(before), np.median(after)
            changed = not kept or bool(net.inputs)
            lost = changed and bool(b > 1.01 * a)
            accepted, worse = accepted + changed, worse + lost
            words = "WORSE" if lost else "kept" if kept else "better"
            inputs = ", ".join(gain.name for gain in net.inputs)
            print(f"{truth + ' ' + str(seed):16} {a:8.3f} -> {b:8.3f} mrad  {words:6} {inputs:16} "
                  f"worse on {np.sum(after > 1.01 * before)} of {len(after)}, "
                  f"{time.process_time() - begun:.0f} s", flush=True)  # fmt: skip
    print(f"{worse} worse of {accepted} accepted, of {seeds * len(truths)}")


def coverage(first: int, seeds: int) -> None:
    plant = PendulumChain(**LINK, position_quantum=1e-4)
    rows = []
    for seed in range(first, first + seeds):
        begun, random = time.process_time(), np.random.default_rng(seed)
        truth = rules(random)
        start = torch.tensor([math.pi + random.uniform(2.0, 2.8)], dtype=torch.float64)
        q = rollout(plant, truth, start, 0 * start, sample_time=1e-3, steps=10_000).q.numpy()
        swing = Recording(1e-3 * np.arange(len(q)), np.round(q / 1e-4) * 1e-4,
                          convention="relative,upright", name="swing")  # fmt: skip
        found = fit(NFNCFM(1, terms=(3, 3)), plant, swing, windows=(0.5,), fit_plant=False,
                    drag=False, max_steps=15)  # fmt: skip
        assert found.uncertainty is not None
        motion = [torch.as_tensor(x[::20]) for x in (found.motions[0].qd, found.motions[0].qdd)]
        true = truth.schedule(*motion)
        off = found.model.schedule(*motion).detach() - true
        held = off.abs() <= 1.96 * found.uncertainty.sd(*motion)
        slow = motion[0].abs().flatten() < 2.0
        size = (off / true).flatten().square()
        rows.append([float(100 * x) for x in (
            held.double().mean(), held[slow].double().mean(),
            size.mean().sqrt(), size[slow].mean().sqrt(),
        )])  # fmt: skip
        print(f"{seed:4} holds {rows[-1][0]:4.0f} % (below 2 rad/s {rows[-1][1]:4.0f} %), off by "
              f"{rows[-1][2]:.2f} % ({rows[-1][3]:.2f} %)  {time.process_time() - begun:.0f} s  "
              f"{found.status}", flush=True)  # fmt: skip
    mean = np.mean(rows, axis=0)
    print(f"holds {mean[0]:.1f} % ({mean[1]:.1f} %), off by {mean[2]:.2f} % ({mean[3]:.2f} %)")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("what", choices=["coverage", "twins"])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--truths", nargs="+", default=list(LAWS))
    parser.add_argument("--model", default="NFCVFM")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.what == "coverage":
        coverage(arguments.first, arguments.seeds)
    else:
        twins(arguments.truths, arguments.first, arguments.seeds, arguments.model)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
