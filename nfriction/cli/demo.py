"""`nfriction demo`: simulate a rig with hidden friction, then compare models on it."""

import argparse
import sys
from pathlib import Path

from nfriction.cli.console import Parser
from nfriction.cli.estimate import add_comparison_options, compare_and_report
from nfriction.cli.inputs import count, seconds

# Held equal to `twin.QUICK_DURATION` by a test; the twin itself loads torch.
DURATION = 10.0

# Three steps that a stranger can follow; others are fitted in the same way.
MODELS = "viscous,coulomb-viscous,neuro-fuzzy:coulomb-viscous"

EXAMPLE = """example:
  nfriction demo --models viscous,neuro-fuzzy:load-coulomb --out runs/demo"""


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
