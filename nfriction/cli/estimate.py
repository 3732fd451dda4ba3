"""`nfriction fit` and `nfriction compare`: fit models to recordings, write and print results."""

from __future__ import annotations

import argparse
import logging
import math
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nfriction.cli import inputs
from nfriction.cli.console import Commands, Progress, UsageError, check_writable, warn
from nfriction.friction import plain_name

if TYPE_CHECKING:
    from nfriction.evaluation.compare import Comparison, InitialStates
    from nfriction.evaluation.cross_validation import Selection
    from nfriction.friction.models import FrictionModel
    from nfriction.io.model_file import ModelInfo
    from nfriction.plant import Plant
    from nfriction.recording import Recording


def add_fit(commands: Commands) -> None:
    """Register `fit`."""
    parser = commands.add(
        "fit", run_fit, "fit one model",
        description="Fit one friction model to recordings and write it as a model file.",
        example="nfriction fit run1.csv run2.csv --rig rig.json --model load-coulomb "
        "--out lfm.json",
    )  # fmt: skip
    parser.add_argument("recordings", nargs="+", type=inputs.file, metavar="RECORDING",
                        help=f"file with columns time, q1, ... ({inputs.FORMATS})")  # fmt: skip
    parser.add_argument("--model", type=inputs.model, default="neuro-fuzzy:load-coulomb",
                        help=f"{inputs.MODELS}; or my.py:LAW, a law of your own")  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("model.json"), help="model file to write")
    inputs.add_fit_options(parser)


def add_compare(commands: Commands) -> None:
    """Register `compare`."""
    parser = commands.add(
        "compare", run_compare, "fit models and score them",
        description="Fit friction models to recordings and score each by simulating recordings "
        "that no fit has seen.",
        example="nfriction compare run1.csv run2.csv --test run3.csv --rig rig.json \\\n"
        "      --models viscous,load-coulomb,neuro-fuzzy:load-coulomb --out runs/mine",
    )  # fmt: skip
    parser.add_argument("train", nargs="+", type=inputs.file, metavar="TRAIN", help="recordings to "
                        f"fit, with columns time, q1, ... ({inputs.FORMATS})")  # fmt: skip
    parser.add_argument("--test", nargs="+", type=inputs.file, default=[], metavar="TEST",
                        help="recordings for testing, which no fit sees")  # fmt: skip
    add_comparison_options(parser)
    inputs.add_fit_options(parser)


def add_comparison_options(parser: argparse.ArgumentParser) -> None:
    """Options of `compare` and `demo`."""
    add = parser.add_argument
    add("--models", type=inputs.models, default=inputs.DEFAULT_MODELS,
        help=f"comma-separated: {inputs.MODELS}; or my.py:LAW, a law of your own"
        )  # fmt: skip
    add("--out", type=Path, default=Path("runs/compare"), help="folder to write")
    add("--initial-states", type=inputs.file, metavar="FILE",
        help="table with columns id, q0_1, qd0_1, ... of the recordings' initial states (default: "
        "estimated from each recording)")  # fmt: skip
    add("--select", action="store_true", help="also choose a model on the training recordings "
        "alone, by cross-validation over blocks of time")  # fmt: skip
    add("--no-figures", action="store_true", help="draw no figures")
    add("--also", choices=("svg", "pdf", "gif"), action="append", default=[], metavar="FORMAT",
        help="also write figures as svg or pdf, or animations of the test recordings as gif; can "
        "be repeated")  # fmt: skip
    add("--jobs", type=inputs.jobs, default=1, metavar="N",
        help="number of parallel fits, each in its own process; -1 for one per core (needs joblib; "
        "the results are the same)")  # fmt: skip
    add("--log-file", type=Path, metavar="FILE", help="append a log of stages, times and results")


def run_fit(arguments: argparse.Namespace) -> int:
    """Fit, write the model, report."""
    from nfriction.cli.tables import coefficient_table, fit_lines, interval_table
    from nfriction.evaluation.results import model_info
    from nfriction.fitting.fit import fit
    from nfriction.io.model_file import save

    plant = inputs.read_rig(arguments.rig)
    recordings = inputs.read_recordings(arguments.recordings, plant, arguments)
    if arguments.out.is_dir():
        raise UsageError(f"--out of fit must be a file, but {arguments.out} is a folder.")
    check_writable(arguments.out.parent)
    with Progress() as progress:
        progress.stage(f"fit {arguments.model}")
        found = fit(
            arguments.model, plant, recordings, callback=lambda stage, _: progress.step(stage),
            **inputs.fit_settings(arguments),
        )  # fmt: skip
        progress.stage("write the model")
    info = model_info(found, recordings)
    save(found.model, arguments.out, info)
    print(fit_lines(arguments.model, found, found.usability))
    print(f"position error over training windows: {1e3 * found.residual:.3g} m{plant.unit}")
    print(coefficient_table(found.model, plant.joint_names, plant.unit))
    if intervals := interval_table(found):
        print(intervals)
    print(f"wrote {arguments.out}")
    usable = found.converged and found.usability[0] != "do not use"
    if usable and _has_controller(found.model, info):
        further = ["nfriction", "export", str(arguments.out), "--format", "torchscript"]
        print(f"next: {shlex.join(further + inputs.law_words(found.model.law.name))}")
    return 0


def _has_controller(model: FrictionModel, info: ModelInfo) -> bool:
    from nfriction.export import controller_of

    try:
        controller_of(model, info)
    except ValueError:
        return False
    return True


def run_compare(arguments: argparse.Namespace) -> int:
    """Read, then compare."""
    plant = inputs.read_rig(arguments.rig)
    paths = [*arguments.train, *arguments.test]
    recordings = inputs.read_recordings(paths, plant, arguments)
    train, test = recordings[: len(arguments.train)], recordings[len(arguments.train) :]
    return compare_and_report(plant, train, test, arguments, inputs.fit_settings(arguments))


def compare_and_report(
    plant: Plant,
    train: list[Recording],
    test: list[Recording],
    arguments: argparse.Namespace,
    settings: dict[str, Any],
) -> int:
    """Fit, score, write and print; the status is 1 if a model failed, 130 if interrupted."""
    from nfriction.cli.tables import verdict
    from nfriction.evaluation.compare import check_recordings, compare
    from nfriction.evaluation.cross_validation import select
    from nfriction.evaluation.parallel import INTERRUPTED
    from nfriction.evaluation.results import exclusive, report_of, write_results
    from nfriction.report import write_report

    check_recordings(train, test)  # before a selection that takes long
    states = _initial_states(arguments, plant, [*train, *test])
    check_writable(arguments.out)
    selection = None
    with exclusive(arguments.out), _log(arguments.log_file) as logger, Progress(logger) as progress:
        settings = settings | {"progress": progress, "jobs": arguments.jobs}
        progress.expect(1)
        logger.info(arguments.command_line)
        if arguments.select:
            selection = select(plant, arguments.models, train, **settings)
        comparison = compare(
            plant, arguments.models, train, test, initial_states=states, **settings
        )
        progress.stage("write results and figures")
        page = report_of(arguments.out)
        write_results(
            comparison, train, test, arguments.out, selection=selection,
            command=arguments.command_line, figures=not arguments.no_figures,
            formats=arguments.also,
        )  # fmt: skip
        if page is not None:
            write_report(arguments.out, page)  # replaces the page of an earlier run
        logger.info(verdict(comparison))
    _print(comparison, selection, plant, train, arguments)
    return 130 if INTERRUPTED in comparison.failed.values() else bool(comparison.failed)


def _print(
    comparison: Comparison,
    selection: Selection | None,
    plant: Plant,
    train: Sequence[Recording],
    arguments: argparse.Namespace,
) -> None:
    from nfriction.cli import tables
    from nfriction.evaluation.results import model_info

    print(f"\n{tables.error_tables(comparison)}")
    # Tables show abbreviations, which a user of plain names may not know.
    names = (*comparison.fits, *comparison.failed)
    print(f"models: {', '.join(f'{name}: {plain_name(name)}' for name in names)}\n")
    for name, fit in comparison.fits.items():
        print(tables.fit_lines(name, fit, comparison.rating(name)))
    for name, why in comparison.failed.items():
        print(f"{name}: not fitted: {why}")
    if selection is not None:
        print(f"\n{tables.choice(selection)}")
    print(f"\n{tables.verdict(comparison)}")
    best = comparison.fits.get(comparison.best() or "")
    model = arguments.out / "models" / f"{comparison.best()}.json"
    if best is not None:
        print(tables.coefficient_table(best.model, plant.joint_names, plant.unit))
        if intervals := tables.interval_table(best):
            print(intervals)
        print(f"its model file: {model}")
    what = "results and models" if arguments.no_figures else "results, models and figures"
    print(f"\n{what} are in {arguments.out}")
    if conclusion := _conclusion(comparison):
        print(f"\n{conclusion}")
        print(f"all figures on a page: {shlex.join(['nfriction', 'report', str(arguments.out)])}")
        if best is not None and _has_controller(best.model, model_info(best, train)):
            export = ["nfriction", "export", str(model), "--format", "c", "--out", "controller"]
            export += inputs.law_words(best.model.law.name)
            print(f"this model as C code:  {shlex.join(export)}")


def _conclusion(comparison: Comparison) -> str:
    """The best model's gain in a sentence; empty if none is better, or the best is unusable."""
    from nfriction.evaluation.compare import NO_FRICTION

    best = comparison.best() or NO_FRICTION
    if best == NO_FRICTION or comparison.rating(best)[0] == "do not use":
        return ""
    over, unit = comparison.judged_over(), comparison.unit
    error, lasting = comparison.table(over)["all"], f" of {over} s" * bool(over)
    without, learnt = float(error[NO_FRICTION]), float(error[best])
    # Without friction a mechanism may turn over: thousands of milliradians are hard to imagine.
    shown = [f"{x:.3g} {unit}" if x >= 1 else f"{1e3 * x:.3g} m{unit}" for x in (without, learnt)]
    end = f"with the friction learnt ({plain_name(best)}) they miss it by {shown[1]}"
    if not math.isfinite(without):
        return f"Without friction, simulations{lasting} of the test recordings diverge;\n{end}."
    less = math.floor(1e4 * (1 - learnt / without)) / 100  # rounded down: never quite all
    return (
        f"Without friction, simulations{lasting} of the test recordings miss the measured motion "
        f"by {shown[0]};\n{end}, {less:.{3 if less < 99.9 else 4}g} % less."
    )


@contextmanager
def _log(path: Path | None) -> Iterator[logging.Logger]:
    """The command's logger; it and all others of the package write into a file."""
    package = logging.getLogger("nfriction")
    if path is None:
        yield package
        return
    handler = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
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
    arguments: argparse.Namespace, plant: Plant, recordings: Sequence[Recording]
) -> InitialStates | None:
    """Initial states of these recordings; warns of recordings that have none."""
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
        warn(f"{path} has no state of {', '.join(without)}; it is estimated from the recording.")
    return states
