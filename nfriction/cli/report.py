"""`nfriction report`: one self-contained HTML page of a comparison's folder."""

import argparse
from pathlib import Path

from nfriction.cli.console import Parser, UsageError, warn

EXAMPLE = """example:
  nfriction report runs/mine --out mine.html"""


def add(commands: "argparse._SubParsersAction[Parser]", common: Parser) -> None:
    """Register the command."""
    parser = commands.add_parser(
        "report", parents=[common], help="write a page of a comparison's folder", epilog=EXAMPLE,
        description="Write the folder of compare or demo as one self-contained HTML file: tables "
        "that sort, figures that zoom, fuzzy rules, verdicts.",
    )  # fmt: skip
    parser.add_argument("folder", type=Path, metavar="RUN", help="folder of compare or demo")
    parser.add_argument("--out", type=Path, metavar="FILE",
                        help="file to write (default: report.html in the folder)")  # fmt: skip
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Read, write."""
    from nfriction.report import write_report

    if not arguments.folder.is_dir():
        raise UsageError(f"{arguments.folder} is no folder; give one that compare or demo wrote.")
    out = arguments.out or arguments.folder / "report.html"
    if out.is_dir():
        raise UsageError(f"--out is a file, and {out} is a folder.")
    for note in write_report(arguments.folder, out).notes:
        warn(note)
    print(f"wrote {out}")
    return 0
