"""Tune a fuzzy controller by differential evolution: error of the torque against number of rules.

    python trainers/evolve_rules.py --twin tlrip --joint 2 --out runs/evolve

Coefficients by class define the output ranges of a controller with the papers' rules; evolution
varies its ranges and the terms of its rules, and omits rules. Writes the Pareto front as table and
figure, tested on recordings not used for tuning. `--resume` continues after the last generation.
"""

from collections.abc import Sequence

import common
import numpy as np
import pandas as pd
import torch

from nfriction.papers.controller.evolve import (
    Candidate,
    EvolutionOptions,
    TorqueSamples,
    evolve,
    torque_error,
)
from nfriction.papers.reproduction.procedure import controllers_from_classes
from nfriction.papers.reproduction.stages import fit_by_class
from nfriction.plant import Plant
from nfriction.plots import style
from nfriction.signals import Motion

MODELS = ("ANCFM", "ACFM", "ACVFM", "ALFM", "ANLFM")
# Every fifth sample is used, and errors are averaged over blocks of ten: 50 ms at 1 kHz.
THINNED, BLOCK = 5, 10


def train(argv: Sequence[str] | None) -> str:
    parser = common.parser(__doc__.splitlines()[0])
    parser.add_argument("--model", choices=MODELS, default="ALFM")
    parser.add_argument("--joint", type=int, default=1, help="of the rig, from 1")
    parser.add_argument("--population", type=int, default=20)
    parser.add_argument("--generations", type=int, default=40)
    parser.add_argument("--prices", type=float, nargs="+", default=[0.0, 0.1, 0.3, 1.0],
                        help="of all rules, as shares of the first error")  # fmt: skip
    given = parser.parse_args(argv)
    workspace, bench = common.start(given)
    adaptive = fit_by_class(workspace, bench, given.model).model
    train_motions = bench.train_motions
    controllers = controllers_from_classes(
        adaptive.law,
        adaptive.schedule.values,
        np.concatenate([m.qd for m in train_motions]),
        np.concatenate([m.qdd for m in train_motions]),
    )
    if not 1 <= given.joint <= len(controllers):
        raise ValueError(f"--joint must be 1 to {len(controllers)}, got {given.joint}.")
    start, joint = controllers[given.joint - 1], given.joint - 1
    samples = _samples(bench.plant, train_motions, joint)
    options = EvolutionOptions(
        prices=tuple(given.prices), population=given.population, generations=given.generations,
        seed=given.seed, checkpoint=given.out / "checkpoints" / "evolution.json",
    )  # fmt: skip
    front = evolve(start, adaptive.law, samples, v_smooth=adaptive.v_smooth, options=options)
    others = bench.motions[len(train_motions) :] or train_motions
    judged = _samples(bench.plant, others, joint)
    first = Candidate(
        start, torque_error(start, adaptive.law, samples, adaptive.v_smooth),
        len(start.rule_base.rules),
    )  # fmt: skip
    table = pd.DataFrame(
        [
            (one.rules, 1e3 * one.error,
             1e3 * torque_error(one.controller, adaptive.law, judged, adaptive.v_smooth))
            for one in (first, *front)
        ],
        index=["as given", *(f"candidate {k + 1}" for k in range(len(front)))],
        columns=["rules", "training error [mN m]", "test error [mN m]"],
    )  # fmt: skip
    table.to_csv(given.out / "pareto.csv", index_label="controller")
    _draw(table).savefig(given.out / "pareto.png", dpi=150)
    return f"{table.round(3).to_string()}\nwrote {given.out / 'pareto.csv'} and its figure"


def _samples(plant: Plant, motions: Sequence[Motion], joint: int) -> TorqueSamples:
    """Motion and friction torque of one joint of a freely swinging rig."""
    q, qd, qdd = (
        torch.as_tensor(np.concatenate([getattr(m, key) for m in motions]))
        for key in ("q", "qd", "qdd")
    )
    q, qd, qdd = q[::THINNED], qd[::THINNED], qdd[::THINNED]
    with torch.no_grad():
        # Without a drive, friction is the negative of the torque from inverse dynamics.
        torque, load = -plant.inverse_dynamics(q, qd, qdd), plant.load(q, qd)
    return TorqueSamples(qd[:, joint], qdd[:, joint], load[:, joint], torque[:, joint], BLOCK)


def _draw(table: pd.DataFrame) -> "style.Figure":
    """Errors over the number of rules, with the initial controller marked."""
    figure, axes = style.panels(1, 1, style.PAGE, 2.6)
    ax, front = axes[0, 0], table.iloc[1:]
    columns = table.columns[1:]
    looks = style.looks(columns)
    for column in columns:
        line = looks[column].line | {"marker": "o", "markersize": 4}
        ax.plot(front["rules"], front[column], **line)
        ax.plot(table["rules"].iloc[:1], table[column].iloc[:1], **line | {"marker": "x"})
    ax.set_xlabel("rules (cross: controller as given)")
    ax.set_ylabel("error of the torque [mN m]")
    style.legend(
        figure, [looks[column].handle for column in columns],
        [column.removesuffix(" [mN m]") for column in columns],
    )  # fmt: skip
    return figure


if __name__ == "__main__":
    common.run(train)
