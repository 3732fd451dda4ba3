"""`nfriction verify`: prove that an artefact is the model that it should be."""

import argparse
from pathlib import Path

from nfriction.cli import inputs
from nfriction.cli.console import Parser, UsageError

EXAMPLE = """example:
  nfriction verify artefacts/model.pt model.json"""


def add(commands: "argparse._SubParsersAction[Parser]", common: Parser) -> None:
    """Register the command."""
    parser = commands.add_parser(
        "verify", parents=[common], help="prove that an artefact is its model", epilog=EXAMPLE,
        description="Run an artefact (.pt, .pt2, .onnx, or .c with its .contract.json beside it) "
        "over its test vectors and over many points beside the model. Exit status 1 if they "
        "differ. C is compiled and run as it is: verify it from hands that you trust.",
    )  # fmt: skip
    parser.add_argument("artefact", type=Path, metavar="ARTEFACT", help="what export wrote")
    parser.add_argument("model", type=inputs.file, metavar="MODEL", help="model file")
    parser.add_argument("--points", type=inputs.count, default=5000, metavar="N",
                        help="points to draw, to 10 %% beyond the range")  # fmt: skip
    inputs.add_law_option(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Compare, print a table, tell the verdict by the exit status."""
    from nfriction.export import verify_artefact
    from nfriction.io.model_file import load, load_info

    if not arguments.points:
        raise UsageError("--points must be at least 1.")
    model, info = load(arguments.model), load_info(arguments.model)
    verdict = verify_artefact(arguments.artefact, model, info, points=arguments.points)
    head = ("compared at", "points", "torque error", "tolerance", "coefficients", "edges")
    print("{:<14}{:>8}{:>14}{:>11}{:>14}{:>7}  verdict".format(*head))
    for name, parity in (("its vectors", verdict.vectors), ("drawn points", verdict.points)):
        print(
            f"{name:<14}{parity.points:>8}{parity.torque_error:>14.1e}{parity.tolerance:>11.0e}"
            f"{parity.coefficient_error:>14.1e}{parity.edges:>7}  "
            f"{'equal' if parity.passed else 'DIFFERENT'}"
        )
    for difference in verdict.differences:
        print(difference)
    where = Path(arguments.artefact).name
    verb = "is" if verdict.passed else "IS NOT"
    print(f"{where} {verb} {Path(arguments.model).name} (errors relative to full scale)")
    return 0 if verdict.passed else 1
