"""`nfriction compare`: fit models, score them, write and print the results."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nfriction.cli import estimation, names
from nfriction.cli.console import Parser, Progress, UsageError, check_writable, warn

if TYPE_CHECKING:
    from nfriction.evaluation.compare import InitialStates
    from nfriction.plant import Plant
    from nfriction.recording import Recording

EXAMPLE = """example:
  nfriction compare run1.csv run2.csv --test run3.csv --rig rig.json \\
      --models NCFM,LFM,NFLFM --out runs/mine"""


def add(commands: argparse._SubParsersAction[Parser], common: Parser) -> None:
    """Register the command."""
    parser = commands.add_parser(
        "compare", parents=[common], help="fit models and score them", epilog=EXAMPLE,
        description="Fit friction models to recordings and score each by simulating recordings "
        "that no fit has seen.",
    )  # fmt: skip
    parser.add_argument(
        "train",
        nargs="+",
        type=names.file,
        metavar="TRAIN",
        help=f"recordings to fit, with columns time, q1, ... ({names.FORMATS})",
    )
    parser.add_argument("--test", nargs="+", type=names.file, default=[], metavar="TEST",
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
                        "states (default: estimated from the first 0.2 s of each, which are "
                        "then not scored)")  # fmt: skip
    parser.add_argument("--select", action="store_true",
                        help="also choose a model on the training recordings alone, by "
                        "cross-validation over blocks of time")  # fmt: skip
    parser.add_argument("--no-figures", action="store_true", help="draw no figures")
    parser.add_argument("--jobs", type=jobs, default=1, metavar="N",
                        help="fits at the same time, each in a process of its own; -1 for one to "
                        "each core (needs joblib; the results are the same)")  # fmt: skip
    parser.add_argument("--log-file", type=Path, metavar="FILE",
                        help="append a log of stages, times and results")  # fmt: skip


def jobs(text: str) -> int:
    """A number of processes from 1, or -1, for argparse."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1 and value != -1:
        raise argparse.ArgumentTypeError(
            f"must be a whole number from 1, or -1 for one to each core, got {text!r}"
        )
    return value


def run(arguments: argparse.Namespace) -> int:
    """Read, then compare."""
    plant = estimation.read_rig(arguments.rig)
    paths = [*arguments.train, *arguments.test]
    recordings = estimation.read_recordings(paths, plant, arguments)
    train, test = recordings[: len(arguments.train)], recordings[len(arguments.train) :]
    return run_comparison(plant, train, test, arguments, estimation.fit_settings(arguments))


def run_comparison(
    plant: Plant,
    train: list[Recording],
    test: list[Recording],
    arguments: argparse.Namespace,
    settings: dict[str, Any],
) -> int:
    """Fit, score, write and print.

    Returns:
        The exit status: 1 where a model could not be fitted.
    """
    from nfriction.cli import tables
    from nfriction.evaluation.compare import check_recordings, compare
    from nfriction.evaluation.cross_validation import select
    from nfriction.evaluation.results import write_results

    check_recordings(train, test)  # before a choice that takes long
    states = _initial_states(arguments, plant, [*train, *test])
    check_writable(arguments.out)
    selection = None
    with _log(arguments.log_file) as logger, Progress(logger) as progress:
        settings = settings | {"progress": progress, "jobs": arguments.jobs}
        logger.info(arguments.command_line)
        if arguments.select:
            selection = select(plant, arguments.models, train, **settings)
        comparison = compare(
            plant, arguments.models, train, test, initial_states=states, **settings
        )
        progress.stage("write results and figures")
        write_results(
            comparison, train, test, arguments.out, selection=selection,
            command=arguments.command_line, figures=not arguments.no_figures,
        )  # fmt: skip
        logger.info(tables.verdict(comparison))
    print(f"\n{tables.error_tables(comparison)}\n")
    for name, fit in comparison.fits.items():
        print(tables.fit_lines(name, fit))
    for name, why in comparison.failed.items():
        print(f"{name}: not fitted: {why}")
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
    return 1 if comparison.failed else 0


@contextmanager
def _log(path: Path | None) -> Iterator[logging.Logger]:
    """The command's logger, which with all others of the package writes into a file."""
    package = logging.getLogger("nfriction")
    if path is None:
        yield package
        return
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    before = package.level
    package.addHandler(handler)
    package.setLevel(logging.INFO)
    try:
        yield package
    finally:
        package.setLevel(before)
        package.removeHandler(handler)
        handler.close()


def _initial_states(
    arguments: argparse.Namespace,
    plant: Plant,
    recordings: Sequence[Recording],
) -> InitialStates | None:
    """States of these recordings; warns of those that have none."""
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
