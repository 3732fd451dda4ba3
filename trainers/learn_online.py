"""Let the papers' network learn online while friction drifts; compare with the frozen network.

    python trainers/learn_online.py
    python trainers/learn_online.py --seconds 120 --fall 0.5 --out runs/online

The rig is the hanging link on its driven arm from the control study, with a random torque at the
arm. A network is set to the linear law fitted to a cold recording. Then the arm's friction falls as
it warms up. The network learns from the motor torque minus that of inertia and gravity, computed
from encoder counts with the filters of a controller. Prints the errors of both torques relative to
the true one, and writes the figure, the model and its C code.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import common
import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from torch import Tensor

from nfriction import fit, rollout, save
from nfriction.cli.inputs import count, positive
from nfriction.friction.neurofuzzy import NFLFM
from nfriction.io.model_file import ModelInfo
from nfriction.papers.control import study
from nfriction.papers.nffem.fit_rbf import place_units
from nfriction.papers.nffem.online import OnlineNetwork, OnlineOptions, write_online
from nfriction.papers.nffem.rbf_coefficients import RBFCoefficients
from nfriction.papers.twin.dataset import COUNTS
from nfriction.plant import PendulumChain
from nfriction.plots import style
from nfriction.signals import Motion, SecondOrderLowPass, causal_motion

COLD_SECONDS = 12.0
CUTOFF = 20.0  # of the controller's filters [Hz]
EVERY = 5  # one of this many samples is learnt
BLOCK = 10.0  # duration of a row of the table [s]


def train(argv: Sequence[str] | None) -> str:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=positive, default=90.0, help="of the warming motion")
    parser.add_argument("--fall", type=float, default=0.4, help="share that friction loses")
    parser.add_argument("--warming", type=positive, default=30.0, help="time constant of it [s]")
    parser.add_argument("--units", type=common.natural, default=10, help="of the network")
    parser.add_argument("--forgetting", type=positive, default=10.0, help="of the learning [s]")
    parser.add_argument("--seed", type=count, default=0, help="of the motor's torque")
    parser.add_argument("--out", type=Path, default=Path("runs/online"), help="folder to write")
    given = parser.parse_args(argv)
    # A row of the table is a full block.
    if not 0 <= given.fall < 1:
        parser.error(f"--fall must be a share from 0 and below 1, got {given.fall:g}.")
    if given.seconds < BLOCK:
        parser.error(f"--seconds must be at least {BLOCK:g}, got {given.seconds:g}.")
    plant = study.single_link()
    cold = study.driven_recording(
        plant, study.true_friction(plant), seconds=COLD_SECONDS, seed=given.seed
    )
    law = fit("LFM", plant, cold, method="equation_error", fit_plant=False)
    motion, true = _warming_motion(plant, given)
    values = law.model.schedule.coefficient_sets()["always"]
    first = slice(0, round(1000 * COLD_SECONDS))
    model = NFLFM(plant.joints, network="rbf", head_units=given.units).requires_grad_(False)
    assert isinstance(model.schedule, RBFCoefficients)
    qd, qdd = (x[first].numpy() for x in motion[:2])
    place_units(model.schedule, values, values, [Motion(np.arange(len(qd)) / 1000, qd, qd, qdd)])
    before = motion[3][first] - model(*(x[first] for x in motion[:3]))
    # Neighbouring errors are correlated, so 0.2 s of samples are worth about one.
    options = OnlineOptions(
        noise=float(before[1000:, 0].square().mean().sqrt()) * (0.2 / (EVERY * 1e-3)) ** 0.5,
        forgetting=given.forgetting, sample_time=EVERY * 1e-3,
    )  # fmt: skip
    learner = OnlineNetwork(model, options)
    errors = []
    for sample in zip(*(x[::EVERY] for x in motion), true[::EVERY], strict=True):
        *known, measured, truth = sample
        errors.append([float((f(*known)[0] if f is learner else f(*known))[0] - truth[0])
                       for f in (model, learner)])  # fmt: skip
        learner.learn(*known, measured)
    table = _table(np.array(errors), true[::EVERY, 0].numpy())
    path = save(model, given.out / "NFLFM.json", ModelInfo(joint_names=plant.joint_names))
    table.to_csv(given.out / "drift.csv")
    _draw(table).savefig(given.out / "drift.png", dpi=150)
    written = write_online(model, given.out, options, name="arm")
    return (
        f"error of the arm's friction torque, root mean square [mN m]\n{table.round(1)}\n"
        f"wrote {path}, drift.csv, drift.png and {', '.join(p.name for p in written)}"
    )


def _warming_motion(
    plant: PendulumChain, given: argparse.Namespace
) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor], Tensor]:
    """Velocity, acceleration, load, measured and true friction torque, each (sample, joint).

    Torque, position and velocity pass through the same filters as the acceleration, so that all
    have the same delay.
    """
    friction, seconds = study.true_friction(plant), round(given.seconds)
    random = np.random.default_rng([given.seed, 1])
    time = np.arange(1000 * seconds) / 1000
    frequency = np.geomspace(0.2, 2.0, 6)
    phase = random.uniform(0, 2 * np.pi, len(frequency))
    tau = torch.zeros(len(time), plant.joints, dtype=torch.float64)
    tau[:, 0] = torch.as_tensor(0.9 * np.sin(2 * np.pi * frequency * time[:, None] + phase).sum(1))
    whole = friction.schedule.coefficient_sets()["always"].clone()
    state = torch.tensor([0.0, torch.pi], dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    q, true = [], []
    for second in range(seconds):
        left = 1 - given.fall * (1 - np.exp(-second / given.warming))
        warm = whole.clone()
        # Dry and viscous terms; the others are velocities and ratios.
        warm[0, [0, 1, 5]] *= left
        friction.schedule.set_coefficients(warm)
        part = tau[1000 * second : 1000 * (second + 1)]
        run = rollout(plant, friction, *state, part, sample_time=1e-3)
        state = run.q[-1], run.qd[-1]
        q.append(run.q[:-1])
        true.append(friction(run.qd, run.qdd, plant.load(run.q, run.qd))[:-1])
    low_pass = SecondOrderLowPass(CUTOFF, 1e-3)

    def lagged(x: object, times: int = 2) -> Tensor:
        values = np.asarray(x)
        for _ in range(times):
            values = low_pass(values)
        return torch.as_tensor(values)

    read = study.ELECTRONICS.read(torch.cat(q).numpy())
    seen = causal_motion(time, read, COUNTS, CUTOFF)
    place, qd, qdd = lagged(read), lagged(seen.qd, 1), torch.as_tensor(seen.qdd)
    measured = lagged(tau) - plant.inverse_dynamics(place, qd, qdd)
    return (qd, qdd, plant.load(place, qd), measured), lagged(torch.cat(true))


def _table(errors: np.ndarray, true: np.ndarray) -> pd.DataFrame:
    """Errors by block of time, one column each."""
    size = round(BLOCK / (EVERY * 1e-3))
    rows = {}
    for start in range(0, len(errors) - size + 1, size):
        part = slice(start, start + size)
        columns = np.column_stack([errors[part], true[part]])
        rows[f"{start * EVERY / 1000:g} to {(start + size) * EVERY / 1000:g} s"] = 1e3 * np.sqrt(
            np.mean(columns**2, axis=0)
        )
    return pd.DataFrame.from_dict(
        rows, orient="index", columns=["frozen", "learning", "friction torque itself"]
    )


def _draw(table: pd.DataFrame) -> Figure:
    figure, axes = style.panels(1, 1, style.PAGE, 2.4)
    ax, looks = axes[0, 0], style.looks(table.columns[:2])
    middle = BLOCK * (0.5 + np.arange(len(table)))
    for name in table.columns[:2]:
        ax.plot(middle, table[name], **looks[name].line | {"marker": "o", "markersize": 4})
    ax.set_ylim(bottom=0)
    ax.set_xlabel("time [s]")
    ax.set_ylabel("error of the torque [mN m]")
    style.legend(figure, [looks[n].handle for n in table.columns[:2]], list(table.columns[:2]))
    return figure


if __name__ == "__main__":
    common.run(train)
