"""Simulated rigs with hidden friction: `nfriction demo`, `twin`, and the papers' `reproduce`."""

import argparse
import shlex
import sys
from pathlib import Path

from nfriction.cli.console import Commands, check_writable
from nfriction.cli.estimate import add_comparison_options, compare_and_report
from nfriction.cli.inputs import count, positive

# Copies of the twins' values, kept equal by a test, because importing the twins loads torch.
DURATION, TWIN_DURATION = 10.0, 20.0
TRUTHS = ("load", "direction", "shear", "warming", "bristle", "ripple", "lag")

# Three models, each of which extends the previous one; others are fitted in the same way.
MODELS = "viscous,coulomb-viscous,neuro-fuzzy:coulomb-viscous"


def add_demo(commands: Commands) -> None:
    """Register `demo`."""
    parser = commands.add(
        "demo", run_demo, "simulate a rig with hidden friction, then compare models",
        description="Simulate a triple pendulum (the papers' rig) with friction that no model can "
        "express exactly, then compare models on recordings by simulated encoders.",
        example="nfriction demo --models viscous,neuro-fuzzy:load-coulomb --out runs/demo",
    )  # fmt: skip
    parser.add_argument("--seed", type=count, default=0, help="seed of encoder errors and jitter")
    parser.add_argument("--seconds", type=positive, default=DURATION,
                        help="length of each recording [s]")  # fmt: skip
    add_comparison_options(parser)
    parser.set_defaults(out=Path("runs/demo"), models=MODELS, degrees=False)


def run_demo(arguments: argparse.Namespace) -> int:
    """Simulate, then compare."""
    from nfriction.papers import twin

    simulated = twin.make(
        "tlrip", seed=arguments.seed, duration=arguments.seconds, progress=sys.stderr.isatty()
    )
    plant, train, test = simulated.plant, simulated.part("train"), simulated.part("test")
    print(
        "simulated a triple pendulum, recorded by encoders, with friction that no model can "
        f"express exactly:\n{len(train)} recordings of {arguments.seconds:g} s for training, "
        f"{len(test)} for testing"
    )
    return compare_and_report(plant, train, test, arguments, {"fit_plant": False})


def add_twin(commands: Commands) -> None:
    """Register `twin`."""
    parser = commands.add(
        "twin", run_twin, "simulate recordings of a rig with randomly drawn friction",
        description="Write recordings of a simulated triple pendulum: two for training, ten for "
        "testing, with the rig and a card that describes the true friction.",
        example="nfriction twin --truth load+warming --seed 1 --out runs/twin",
    )  # fmt: skip
    parser.add_argument("--truth", default="load", metavar="NAME",
                        help=f"effects in the true friction, joined by +: {', '.join(TRUTHS)}; or "
                        "plain for dry and viscous friction alone")  # fmt: skip
    parser.add_argument("--seed", type=count, default=0,
                        help="seed of releases, friction, encoder errors and jitter")  # fmt: skip
    parser.add_argument("--seconds", type=positive, default=TWIN_DURATION,
                        help="length of each recording [s]")  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("runs/twin"), help="folder to write")


def run_twin(arguments: argparse.Namespace) -> int:
    """Simulate and write, then print how to compare models on it."""
    from nfriction.papers.twin import family

    family.effects_of(arguments.truth)  # before a folder is made
    check_writable(arguments.out)
    simulated = family.build(
        arguments.truth, arguments.out, seed=arguments.seed, duration=arguments.seconds,
        progress=sys.stderr.isatty(),
    )  # fmt: skip
    train, test = simulated.part("train"), simulated.part("test")
    print(
        f"{simulated.name}: {len(train)} recordings of {arguments.seconds:g} s for training, "
        f"{len(test)} for testing, and the card README.md are in {arguments.out}"
    )
    folder = shlex.quote(str(arguments.out))
    print(
        f"next: nfriction compare {folder}/train_*.csv.gz --test {folder}/test_*.csv.gz "
        f"--rig {folder}/rig.json --no-fit-plant --initial-states {folder}/recordings.csv"
    )
    return 0


def add_reproduce(commands: Commands) -> None:
    """Register `reproduce`."""
    parser = commands.add(
        "reproduce", run_reproduce, "reproduce the papers' tables and figures on simulated twins",
        description="Simulate the rigs of both papers with friction unknown to every model, train "
        "all their models, and compare tables and figures with the printed ones.",
        example="nfriction reproduce --quick --out runs/papers\n\nAn interrupted run resumes where "
        "it left off when it is started again with the same options.",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("runs/papers"), help="folder to write")
    parser.add_argument("--quick", action="store_true",
                        help="recordings of 10 s and shorter searches: a quarter of an hour on "
                        "one core")  # fmt: skip
    parser.add_argument("--seed", type=count, default=0,
                        help="seed of the encoders' errors and of the searches")  # fmt: skip
    parser.add_argument("--jobs", type=count, default=2, help="models trained in parallel")
    parser.add_argument("--no-figures", action="store_true", help="draw no figures")


def run_reproduce(arguments: argparse.Namespace) -> int:
    """Run what is not finished, then print and write everything."""
    from dataclasses import replace

    from nfriction.evaluation.results import exclusive
    from nfriction.papers.reproduction import page, tables
    from nfriction.papers.reproduction.stages import reproduce
    from nfriction.papers.reproduction.workspace import FULL, QUICK

    check_writable(arguments.out)
    settings = replace(QUICK if arguments.quick else FULL, seed=arguments.seed)
    progress = sys.stderr.isatty()
    # Two runs in one folder would mistake each other's stages for their own.
    with exclusive(arguments.out):
        workspace = reproduce(arguments.out, settings, jobs=arguments.jobs, progress=progress)
        page.write_tables(workspace, command=arguments.command_line)
        print(page.text(workspace))
        if not arguments.no_figures:
            page.draw_all(workspace, progress=progress)
        written = page.write_page(workspace)
    print(f"\ntables, models and figures are in {arguments.out}, all on one page: {written}\n")
    print(tables.conclusion(workspace))
    return 0
