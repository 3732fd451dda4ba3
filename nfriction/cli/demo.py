"""`nfriction demo` and `nfriction twin`: simulated rigs with hidden friction."""

import argparse
import shlex
import sys
from pathlib import Path

from nfriction.cli.console import Parser, check_writable
from nfriction.cli.estimate import add_comparison_options, compare_and_report
from nfriction.cli.inputs import count, seconds

# Held equal to the twins' own by a test; the twins themselves load torch.
DURATION, TWIN_DURATION = 10.0, 20.0
TRUTHS = ("load", "direction", "shear", "warming", "bristle", "ripple", "lag")

# Three steps that a stranger can follow; others are fitted in the same way.
MODELS = "viscous,coulomb-viscous,neuro-fuzzy:coulomb-viscous"

EXAMPLE = """example:
  nfriction demo --models viscous,neuro-fuzzy:load-coulomb --out runs/demo"""
TWIN_EXAMPLE = """example:
  nfriction twin --truth load+warming --seed 1 --out runs/twin"""


def add(commands: "argparse._SubParsersAction[Parser]", common: Parser) -> None:
    """Register the command."""
    parser = commands.add_parser(
        "demo", parents=[common], epilog=EXAMPLE,
        help="simulate a rig with hidden friction, then compare models",
        description="Simulate a triple pendulum (the papers' rig) with friction unknown to every "
        "model, then compare models on recordings as its encoders would give them.",
    )  # fmt: skip
    parser.add_argument("--seed", type=count, default=0, help="of encoder errors and jitter")
    parser.add_argument("--seconds", type=seconds, default=DURATION,
                        help="length of each recording [s]")  # fmt: skip
    add_comparison_options(parser)
    parser.set_defaults(run=run, out=Path("runs/demo"), models=MODELS, degrees=False)


def run(arguments: argparse.Namespace) -> int:
    """Simulate, then compare."""
    from nfriction.papers import twin

    simulated = twin.make(
        "tlrip",
        seed=arguments.seed,
        duration=arguments.seconds,
        progress=sys.stderr.isatty(),
    )
    plant, train, test = simulated.plant, simulated.part("train"), simulated.part("test")
    print(
        "simulated a triple pendulum, as its encoders would record it, with friction unknown to "
        f"every model:\n{len(train)} recordings of {arguments.seconds:g} s to train on, "
        f"{len(test)} to test on"
    )
    return compare_and_report(plant, train, test, arguments, {"fit_plant": False})


def add_twin(commands: "argparse._SubParsersAction[Parser]", common: Parser) -> None:
    """Register `twin`."""
    parser = commands.add_parser(
        "twin", parents=[common], epilog=TWIN_EXAMPLE,
        help="simulate recordings of a rig whose friction a seed draws",
        description="Write recordings of a simulated triple pendulum: two to train on, ten to "
        "judge by, the rig and a card with the true friction.",
    )  # fmt: skip
    parser.add_argument("--truth", default="load", metavar="NAME",
                        help=f"of {', '.join(TRUTHS)}, several with + between them, or plain: dry "
                        "and viscous friction alone")  # fmt: skip
    parser.add_argument("--seed", type=count, default=0,
                        help="of releases, friction, encoder errors and jitter")  # fmt: skip
    parser.add_argument("--seconds", type=seconds, default=TWIN_DURATION,
                        help="length of each recording [s]")  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("runs/twin"), help="folder to write")
    parser.set_defaults(run=run_twin)


def run_twin(arguments: argparse.Namespace) -> int:
    """Simulate and write, then print how to compare models on it."""
    from nfriction.papers.twin import family

    family.effects_of(arguments.truth)  # before a folder is made
    check_writable(arguments.out)
    simulated = family.build(
        arguments.truth,
        arguments.out,
        seed=arguments.seed,
        duration=arguments.seconds,
        progress=sys.stderr.isatty(),
    )
    train, test = simulated.part("train"), simulated.part("test")
    print(
        f"{simulated.name}: {len(train)} recordings of {arguments.seconds:g} s to train on, "
        f"{len(test)} to judge by, and the card README.md are in {arguments.out}"
    )
    folder = shlex.quote(str(arguments.out))
    print(
        f"next: nfriction compare {folder}/train_*.csv.gz --test {folder}/test_*.csv.gz "
        f"--rig {folder}/rig.json --no-fit-plant --initial-states {folder}/recordings.csv"
    )
    return 0
