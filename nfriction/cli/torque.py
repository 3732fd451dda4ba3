"""`nfriction fit-torque` and `nfriction score-torque`: tables of friction torque over velocity."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from nfriction.cli import inputs
from nfriction.cli.console import Commands, Progress, UsageError, check_writable, one_line, warn
from nfriction.friction import model_list, plain_name

if TYPE_CHECKING:
    import pandas as pd

    from nfriction.recording.torque_table import TorqueTable

COLUMNS = "columns qd and tau, perhaps time, q, qdd, load, temperature and joint; or qd1, tau1, ..."


def add_fit(commands: Commands) -> None:
    """Register `fit-torque`."""
    parser = commands.add(
        "fit-torque", run_fit, "fit models to friction torque over velocity",
        description="Fit friction models to a table of friction torque over velocity, from "
        "constant-velocity tests or the residuals of inverse dynamics, and compare them on "
        "hold-out blocks.",
        example="nfriction fit-torque table.csv --models viscous,coulomb-viscous,stribeck "
        "--out runs/joint",
    )  # fmt: skip
    add = parser.add_argument
    add("table", type=inputs.file, metavar="TABLE", help=f"{COLUMNS} ({inputs.FORMATS})")
    add("--models", type=inputs.models,
        help=f"comma-separated: {model_list(of_tables=True)} (default: all constant laws that the "
        "columns allow)")  # fmt: skip
    add("--out", type=Path, default=Path("runs/torque"), help="folder to write")
    add("--folds", type=inputs.count, default=10, metavar="N",
        help="blocks that are left out in turn")  # fmt: skip
    add("--no-figures", action="store_true", help="draw no figure")
    _add_reading(parser)
    add("--unit", choices=("rad", "m"), default="rad", help="of positions: m for a sliding axis")


def add_score(commands: Commands) -> None:
    """Register `score-torque`."""
    parser = commands.add(
        "score-torque", run_score, "score models on friction torque over velocity",
        description="Predict the friction torque of a table with a model file, or with the models "
        "that fit-torque chose, and print the error of each joint.",
        example="nfriction score-torque runs/joint other_table.csv",
    )  # fmt: skip
    add = parser.add_argument
    add("model", type=Path, metavar="MODEL", help="model file, or folder that fit-torque wrote")
    add("table", type=inputs.file, metavar="TABLE", help=f"{COLUMNS} ({inputs.FORMATS})")
    _add_reading(parser)


def _add_reading(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--degrees", action="store_true", help="velocities are in degrees")
    parser.add_argument("--columns", type=inputs.columns, metavar="OURS=THEIRS,...",
                        help="the table's names for qd, tau, ..., with a unit if it is not SI, "
                        "e.g. qd=speed:rpm,tau=torque")  # fmt: skip


def run_fit(arguments: argparse.Namespace) -> int:
    """Fit, write, print."""
    from nfriction.evaluation.torque_tables import fit_torque
    from nfriction.report.torque import choice_table, error_table, write_torque_fits

    if arguments.folds < 2:
        raise UsageError("--folds must be at least 2.")
    table = _read(arguments, arguments.unit)
    check_writable(arguments.out)
    with Progress() as progress:
        found = fit_torque(table, arguments.models, folds=arguments.folds, progress=progress.stage)
        progress.stage("write results and figure")
        written = write_torque_fits(
            found, arguments.out, command=arguments.command_line, figures=not arguments.no_figures
        )
    for name, why in found.failed.items():
        warn(f"{plain_name(name)} was not fitted: {one_line(why)}")
    for remark in found.table.remarks[len(table.remarks) :]:
        warn(one_line(remark))
    print(f"{error_table(found)}\n\n{choice_table(found)}\n")
    print(_printed(found.intervals()))
    print(f"\nwrote {written[-2]}")
    return 1 if found.failed else 0


def run_score(arguments: argparse.Namespace) -> int:
    """Predict, compare, print."""
    from nfriction.evaluation.torque_tables import read_models, score_models

    if not arguments.model.exists():
        raise UsageError(f"{arguments.model} does not exist; check the path.")
    models = read_models(arguments.model)
    print(_printed(score_models(models, _read(arguments, models[0].unit))))
    return 0


def _read(arguments: argparse.Namespace, unit: str) -> TorqueTable:
    from nfriction.recording.torque_table import TorqueTable

    table = TorqueTable.read(
        arguments.table, columns=arguments.columns, degrees=arguments.degrees,
        unit="m" if unit == "m" else "rad",
    )  # fmt: skip
    for remark in table.remarks:
        warn(one_line(remark))
    return table


def _printed(frame: pd.DataFrame) -> str:
    from nfriction.evaluation.tables import four_digits

    frame = frame.assign(model=frame["model"].map(plain_name))
    text = frame.reset_index().to_string(index=False, float_format=four_digits, na_rep="")
    return "\n".join(line.rstrip() for line in text.splitlines())
