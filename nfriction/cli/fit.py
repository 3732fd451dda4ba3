"""`nfriction fit`: fit one model and write its file."""

import argparse
import shlex
from pathlib import Path

from nfriction.cli import estimation, names
from nfriction.cli.console import Parser, Progress, UsageError, check_writable

EXAMPLE = """example:
  nfriction fit run1.csv run2.csv --rig rig.json --model LFM --out lfm.json"""


def add(commands: "argparse._SubParsersAction[Parser]", common: Parser) -> None:
    """Register the command."""
    parser = commands.add_parser(
        "fit", parents=[common], help="fit one model", epilog=EXAMPLE,
        description="Fit one friction model to recordings and write it as a model file.",
    )  # fmt: skip
    parser.add_argument("recordings", nargs="+", type=names.file, metavar="RECORDING",
                        help=f"with columns time, q1, ... ({names.FORMATS})")  # fmt: skip
    parser.add_argument("--model", type=names.model, default="NFLFM",
                        help=f"one of {', '.join(names.MODELS)}")  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("model.json"), help="model file to write")
    estimation.add_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Fit, write the model, report."""
    from nfriction.cli.tables import coefficient_table, fit_lines, interval_table
    from nfriction.evaluation.results import model_info
    from nfriction.fitting.fit import fit
    from nfriction.friction import model_by_name
    from nfriction.io.model_file import save

    plant = estimation.read_rig(arguments.rig)
    model = model_by_name(arguments.model)(plant.joints)
    recordings = estimation.read_recordings(arguments.recordings, plant, arguments)
    if arguments.out.is_dir():
        raise UsageError(f"--out of fit is a file, and {arguments.out} is a folder.")
    check_writable(arguments.out.parent)
    with Progress() as progress:
        progress.stage(f"fit {arguments.model}")
        found = fit(
            model, plant, recordings, callback=lambda stage, _: progress.step(stage),
            **estimation.fit_settings(arguments),
        )  # fmt: skip
        progress.stage("write the model")
    save(model, arguments.out, model_info(found, recordings))
    print(fit_lines(arguments.model, found))
    print(f"position error over training windows: {1e3 * found.residual:.3g} m{plant.unit}")
    print(coefficient_table(model, plant.joint_names, plant.unit))
    if intervals := interval_table(found):
        print(intervals)
    print(f"wrote {arguments.out}")
    if found.converged:
        further = ["nfriction", "export", str(arguments.out), "--format", "torchscript"]
        print(f"next: {shlex.join(further)}")
    return 0
