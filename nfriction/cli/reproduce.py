"""`nfriction reproduce`: every model, table and figure of the two papers, on simulated twins."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from nfriction.cli.console import Parser, check_writable
from nfriction.cli.inputs import count

EXAMPLE = """example:
  nfriction reproduce --quick --out runs/papers

An interrupted run resumes where it left off when it is started again with the same options."""


def add(commands: argparse._SubParsersAction[Parser], common: Parser) -> None:
    """Register the command."""
    parser = commands.add_parser(
        "reproduce", parents=[common], epilog=EXAMPLE,
        help="reproduce the papers' tables and figures on simulated twins",
        description="Simulate the rigs of both papers with friction unknown to every model, train "
        "all their models, and set tables and figures beside the printed ones.",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("runs/papers"), help="folder to write")
    parser.add_argument("--quick", action="store_true",
                        help="recordings of 10 s and shorter searches: a few minutes on two "
                        "cores")  # fmt: skip
    parser.add_argument("--seed", type=count, default=0,
                        help="of the encoders' errors and of the searches")  # fmt: skip
    parser.add_argument("--jobs", type=count, default=2, help="models trained at a time")
    parser.add_argument("--no-figures", action="store_true", help="draw no figures")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run what is not finished, then print and write everything."""
    from dataclasses import replace

    from nfriction.evaluation.results import exclusive
    from nfriction.papers.reproduction import tables
    from nfriction.papers.reproduction.page import write_page
    from nfriction.papers.reproduction.stages import reproduce
    from nfriction.papers.reproduction.workspace import FULL, QUICK

    check_writable(arguments.out)
    settings = replace(QUICK if arguments.quick else FULL, seed=arguments.seed)
    progress = sys.stderr.isatty()
    # Two runs in one folder would take each other's stages for their own.
    with exclusive(arguments.out):
        workspace = reproduce(arguments.out, settings, jobs=arguments.jobs, progress=progress)
        tables.write_tables(workspace, command=arguments.command_line)
        print(tables.text(workspace))
        if not arguments.no_figures:
            from nfriction.papers.reproduction.figures import draw_all

            draw_all(workspace, progress=progress)
        page = write_page(workspace)
    print(f"\ntables, models and figures are in {arguments.out}, all on one page: {page}\n")
    print(tables.conclusion(workspace))
    return 0
