"""`nfriction compare`: fit models, score them, write and show what came out."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nfriction.cli import estimation, names
from nfriction.cli.console import Parser, Progress, UsageError, check_writable, warn

if TYPE_CHECKING:
    from nfriction.comparison import InitialStates
    from nfriction.plant import LinearAxis, PendulumChain
    from nfriction.recording import Recording

EXAMPLE = """example:
  nfriction compare run1.csv run2.csv --held-out run3.csv --rig rig.json \\
      --models NCFM,LFM,NFLFM --out runs/mine"""


def add(commands: argparse._SubParsersAction[Parser], common: Parser) -> None:
    """Register the command."""
    parser = commands.add_parser(
        "compare", parents=[common], help="fit models and score them", epilog=EXAMPLE,
        description="Fit friction models to recordings and score each by simulating recordings "
        "that no fit has seen.",
    )  # fmt: skip
    parser.add_argument("train", nargs="+", type=names.file, metavar="TRAIN",
                        help="recordings to fit, with columns time, q1, ... "
                        "(.csv, .parquet or .npz)")  # fmt: skip
    parser.add_argument("--held-out", nargs="+", type=names.file, default=[], metavar="TEST",
                        help="recordings to judge by, which no fit sees")  # fmt: skip
    add_comparison_options(parser)
    estimation.add_options(parser)
    parser.set_defaults(run=run)


def add_comparison_options(parser: argparse.ArgumentParser) -> None:
    """Options of `compare` and `demo`."""
    parser.add_argument("--models", type=names.models, default=names.DEFAULT_MODELS,
                        help=f"of {', '.join(names.MODELS)}")  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("runs/compare"), help="folder to write")
    parser.add_argument("--initial-states", type=names.file, metavar="FILE",
                        help="table with columns id, q0_1, qd0_1, ... of the recordings' initial "
                        "states (default: estimated from each recording)")  # fmt: skip
    parser.add_argument("--select", action="store_true",
                        help="also say which model the training recordings alone would choose, "
                        "by simulating blocks of them left out of the fits")  # fmt: skip
    parser.add_argument("--no-figures", action="store_true", help="draw no figures")


def run(arguments: argparse.Namespace) -> int:
    """Read, then compare."""
    plant = estimation.read_rig(arguments.rig)
    paths = [*arguments.train, *arguments.held_out]
    recordings = estimation.read_recordings(paths, plant, arguments)
    train, held_out = recordings[: len(arguments.train)], recordings[len(arguments.train) :]
    trained = {recording.digest() for recording in train}
    seen = [r.name for r in held_out if r.digest() in trained]
    if seen:
        raise UsageError(f"{', '.join(seen)}: trained on and held out; a model is judged by "
                         "recordings it has not seen.")  # fmt: skip
    return run_comparison(plant, train, held_out, arguments, estimation.fit_settings(arguments))


def run_comparison(
    plant: PendulumChain | LinearAxis,
    train: list[Recording],
    held_out: list[Recording],
    arguments: argparse.Namespace,
    settings: dict[str, Any],
) -> int:
    """Fit, score, write and print."""
    from nfriction.cli import tables
    from nfriction.comparison import compare
    from nfriction.results import write_results
    from nfriction.selection import select

    states = _initial_states(arguments, plant, [*train, *held_out])
    check_writable(arguments.out)
    selection = None
    with Progress() as progress:
        if arguments.select:
            selection = select(
                plant, arguments.models, train, on_stage=progress.stage,
                callback=lambda stage, _: progress.step(stage), **settings,
            )  # fmt: skip
        comparison = compare(
            plant, arguments.models, train, held_out, initial_states=states,
            on_stage=progress.stage, on_step=progress.step, **settings,
        )  # fmt: skip
        progress.stage("write results and figures")
        write_results(
            comparison, train, held_out, arguments.out,
            command=arguments.command_line, figures=not arguments.no_figures,
        )  # fmt: skip
    print(f"\n{tables.error_tables(comparison)}\n")
    for name, fit in comparison.fits.items():
        print(tables.fit_lines(name, fit))
    if selection is not None:
        print(f"\n{tables.choice(selection)}")
    print(f"\n{tables.verdict(comparison)}")
    best = comparison.fits.get(comparison.best() or "")
    if best is not None:
        print(tables.coefficient_table(best.model, plant.joint_names, plant.unit))
        if intervals := tables.interval_table(best):
            print(intervals)
        print(f"its model file: {arguments.out / 'models' / f'{comparison.best()}.json'}")
    what = "results and models" if arguments.no_figures else "results, models and figures"
    print(f"\n{what} are in {arguments.out}")
    return 0


def _initial_states(
    arguments: argparse.Namespace,
    plant: PendulumChain | LinearAxis,
    recordings: Sequence[Recording],
) -> InitialStates | None:
    """States of these recordings; says which have none and so start from their smoothed motion."""
    from nfriction.recording import read_initial_states

    path = arguments.initial_states
    if path is None:
        return None
    states = read_initial_states(path, degrees=arguments.degrees)
    of = [recording.name for recording in recordings]
    for name in of:
        if name in states and len(states[name][0]) != plant.joints:
            raise UsageError(f"{path}: the state of {name} has {len(states[name][0])} joints, "
                             f"the rig {plant.joints}.")  # fmt: skip
    without = [name for name in of if name not in states]
    if without:
        warn(f"{path} has no state of {', '.join(without)}; estimated from the recording instead.")
    return states
