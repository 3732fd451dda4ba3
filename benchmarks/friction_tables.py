"""Friction laws on real tables of friction torque, beside plain least squares.

Prints, for each joint, the NRMSE on contiguous hold-out blocks: of five models by least squares
(the baselines of the data cards: offset, Coulomb and viscous; with three Stribeck terms; with
load-proportional Coulomb friction; five slip elements; all of these), of the best law without
memory that `nfriction.fit_torque` fits, and of the law that it chooses. With `--splits`, the same
on rows that no fit has seen: a run's first 60 %, 40 % or half teach and the rest judges, and the
other way round, relative to the choice among the laws without memory.

    python benchmarks/friction_tables.py --data DATA [--only kr300 ur10 tribometer] [--splits]
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import nfriction
from nfriction.fitting.hysteresis import deflections, path_of, range_of
from nfriction.recording.torque_table import JointTorque, TorqueTable, blocks

Array = NDArray[np.float64]

TABLES: dict[str, tuple[str, dict[str, Any]]] = {
    "kr300": ("kuka_kr300/kr300_A_friction.csv.gz", {}),
    "ur10": ("ur10_rosbag/ur10_exciting_first_friction.csv.gz", {}),
    "tribometer": (
        "presliding_tribometer/tribometer_first.csv.gz",
        {"columns": {"q": "position", "tau": "friction", "load": "normal_force"}, "unit": "m"},
    ),
}
# Shares of a run that train, and that judge.
SPLITS = {
    "60/40": ((0.0, 0.6), (0.6, 1.0)),
    "40/60": ((0.4, 1.0), (0.0, 0.4)),
    "1st half": ((0.0, 0.5), (0.5, 1.0)),
    "2nd half": ((0.5, 1.0), (0.0, 0.5)),
}
BASELINES = ("standard", "Stribeck", "load", "5 slip", "all")


def designs(joint: JointTorque) -> dict[str, Array]:
    """Regressors of the baselines, (row, column)."""
    sign, speed = np.sign(joint.qd), np.abs(joint.qd) / np.abs(joint.qd).max()
    one = np.ones_like(sign)
    load = one if joint.load is None else joint.load / joint.load.mean()
    widths = range_of(joint) * np.geomspace(1e-3, 0.3, 5)
    slip = deflections(path_of(joint), widths, np.zeros(5))
    drops = [np.exp(-((speed / v) ** 2)) * sign for v in (0.01, 0.05, 0.2)]
    standard = np.stack([one, sign, joint.qd], 1)
    every = np.column_stack([standard, *drops, load * sign, slip])
    return {
        "standard": standard,
        "Stribeck": np.column_stack([standard, *drops]),
        "load": np.column_stack([standard, load * sign]),
        "5 slip": np.column_stack([one, joint.qd, slip]),
        "all": every,
    }


def left_out(joint: JointTorque, design: Array, folds: int) -> float:
    """NRMSE of plain least squares on hold-out blocks."""
    square = 0.0
    for block in blocks(joint, folds):
        rest = np.setdiff1d(np.arange(len(joint)), block)
        weights = np.linalg.lstsq(design[rest], joint.tau[rest], rcond=None)[0]
        square += float(np.sum((design[block] @ weights - joint.tau[block]) ** 2))
    return float(np.sqrt(square / len(joint)) / joint.tau.std())


def part(table: TorqueTable, share: tuple[float, float]) -> TorqueTable:
    """Rows of a share of every joint's."""
    cuts = [[int(x * len(joint)) for x in share] for joint in table.joints]
    rows = [j.rows(np.arange(*cut)) for j, cut in zip(table.joints, cuts, strict=True)]
    return replace(table, joints=tuple(rows))


def judge_splits(name: str, table: TorqueTable) -> None:
    """Print NRMSE of the choice over that of the choice without memory, on rows not seen."""
    print(f"\n{name}: NRMSE on other rows over that of the choice without memory")
    print(f"{'':10}" + "".join(f"{joint:>22}" for joint in table.joint_names))
    for split, (train, test) in SPLITS.items():
        taught, unseen = part(table, train), part(table, test)
        every = nfriction.fit_torque(taught)
        without = [n for n, fits in every.fits.items() if fits[0].model.law.memory is None]
        plain = nfriction.fit_torque(taught, without).score(unseen)["nrmse"]
        found = every.score(unseen)
        ratios = found["nrmse"] / plain
        pairs = zip(ratios, found["model"], strict=True)
        print(f"{split:10}" + "".join(f"{r:12.3f} {m:>9}" for r, m in pairs), flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--data", type=Path, required=True, help="folder of the real recordings")
    parser.add_argument("--only", nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("--folds", type=int, default=10)
    parser.add_argument("--splits", action="store_true", help="judge on parts of a run not seen")
    arguments = parser.parse_args(argv)
    for name in arguments.only:
        path, options = TABLES[name]
        table = TorqueTable.read(arguments.data / path, **options)
        if arguments.splits:
            judge_splits(name, table)
            continue
        begin = time.perf_counter()
        found = nfriction.fit_torque(table, folds=arguments.folds)
        errors = found.to_frame()
        memory = {n for n, fits in found.fits.items() if fits[0].model.law.memory is not None}
        plain = errors.drop(columns=list(memory)).min(axis=1)
        print(f"\n{name}: NRMSE on {arguments.folds} hold-out blocks "
              f"({time.perf_counter() - begin:.0f} s)")  # fmt: skip
        heads = (*BASELINES, "no memory", "chosen", "law")
        print(f"{'':8}" + "".join(f"{head:>10}" for head in heads))
        for joint in table.joints:
            chosen = found.chosen[joint.name]
            numbers = [left_out(joint, d, arguments.folds) for d in designs(joint).values()]
            numbers += [float(plain[joint.name]), float(errors[chosen][joint.name])]
            print(f"{joint.name:8}" + "".join(f"{x:10.3f}" for x in numbers) + f"{chosen:>10}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
