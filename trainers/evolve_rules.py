"""Tune a fuzzy controller by differential evolution: error of the torque against number of rules.

    python trainers/evolve_rules.py --twin tlrip --joint 2 --out runs/evolve

Coefficients by class define the output ranges of a controller with the papers' rules; evolution
varies its ranges and the terms of its rules, and omits rules. Writes the Pareto front as table and
figure, with errors on a twin's test recordings, and the rules of each candidate as a file for
`nfriction.papers.controller.load_rules`. `--resume` continues after the last generation.
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
from nfriction.papers.controller.rules import save_rules
from nfriction.papers.reproduction.procedure import controllers_from_classes
from nfriction.papers.reproduction.stages import fit_by_class
from nfriction.papers.reproduction.workspace import Bench
from nfriction.plots import style
from nfriction.recording import Recording
from nfriction.signals import Motion

MODELS = ("ANCFM", "ACFM", "ACVFM", "ALFM", "ANLFM")
# Every fifth sample is used, and errors are averaged over blocks of ten: 50 ms at 1 kHz.
THINNED, BLOCK = 5, 10


def train(argv: Sequence[str] | None) -> str:
    parser = common.parser(__doc__.splitlines()[0])
    parser.add_argument("--model", choices=MODELS, default="ALFM")
    parser.add_argument("--joint", type=common.natural, default=1, help="of the rig, from 1")
    parser.add_argument("--population", type=common.natural, default=20)
    parser.add_argument("--generations", type=common.natural, default=40)
    parser.add_argument("--prices", type=float, nargs="+", default=[0.0, 0.1, 0.3, 1.0],
                        help="of all rules, as shares of the first error")  # fmt: skip
    given = parser.parse_args(argv)
    options = EvolutionOptions(
        prices=tuple(given.prices), population=given.population, generations=given.generations,
        seed=given.seed, checkpoint=given.out / "checkpoints" / "evolution.json",
    )  # fmt: skip
    bench = common.read(given)
    if given.joint > bench.plant.joints:
        raise ValueError(f"--joint must be 1 to {bench.plant.joints}, got {given.joint}.")
    workspace = common.start(given, bench)
    adaptive = fit_by_class(workspace, bench, given.model).model
    train_motions = bench.train_motions
    controllers = controllers_from_classes(
        adaptive.law,
        adaptive.schedule.values,
        np.concatenate([m.qd for m in train_motions]),
        np.concatenate([m.qdd for m in train_motions]),
    )
    start, joint = controllers[given.joint - 1], given.joint - 1
    samples = _samples(bench, bench.train, train_motions, joint)
    front = evolve(start, adaptive.law, samples, v_smooth=adaptive.v_smooth, options=options)
    first = Candidate(
        start, torque_error(start, adaptive.law, samples, adaptive.v_smooth),
        len(start.rule_base.rules),
    )  # fmt: skip
    table = pd.DataFrame(
        [(one.rules, 1e3 * one.error) for one in (first, *front)],
        index=["as given", *(f"candidate {k + 1}" for k in range(len(front)))],
        columns=["rules", "training error [mN m]"],
    )
    if bench.test:
        judged = _samples(bench, bench.test, bench.motions[len(train_motions) :], joint)
        table["test error [mN m]"] = [
            1e3 * torque_error(one.controller, adaptive.law, judged, adaptive.v_smooth)
            for one in (first, *front)
        ]
    table.to_csv(given.out / "pareto.csv", index_label="controller")
    _draw(table).savefig(given.out / "pareto.png", dpi=150)
    for old in given.out.glob("candidate-*.json"):  # of an earlier run, which may have had more
        old.unlink()
    for number, one in enumerate(front, 1):
        save_rules(one.controller.rule_base, given.out / f"candidate-{number}.json")
    common.finished(given)
    return (
        f"{table.round(3).to_string()}\n"
        f"wrote {given.out / 'pareto.csv'}, its figure and candidate-1.json to "
        f"candidate-{len(front)}.json"
    )


def _samples(
    bench: Bench, recordings: Sequence[Recording], motions: Sequence[Motion], joint: int
) -> TorqueSamples:
    """Motion and friction torque of one joint: the drive's torque minus that of the motion."""
    plant = bench.plant
    driven = [r.joint_coordinates(plant).torque_at(r.time) for r in recordings]
    tau = torch.as_tensor(np.concatenate(driven))
    q, qd, qdd = (
        torch.as_tensor(np.concatenate([getattr(m, key) for m in motions]))
        for key in ("q", "qd", "qdd")
    )
    q, qd, qdd = q[::THINNED], qd[::THINNED], qdd[::THINNED]
    with torch.no_grad():
        torque = tau[::THINNED] - plant.inverse_dynamics(q, qd, qdd)
        load = plant.load(q, qd)
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
