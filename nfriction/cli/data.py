"""`nfriction data`: public recordings of real mechanisms."""

import argparse
from pathlib import Path

from nfriction.cli.console import Parser, UsageError, warn

EXAMPLE = """example:
  nfriction data get multiarm-triple"""


def add(commands: "argparse._SubParsersAction[Parser]", common: Parser) -> None:
    """Register the command."""
    parser = commands.add_parser(
        "data", parents=[common], help="list or fetch public recordings", epilog=EXAMPLE,
        description="List public recordings of real mechanisms, or fetch their originals from "
        "GitHub and convert them to tables in SI. Originals that are in the folder are not "
        "fetched again.",
    )  # fmt: skip
    parser.add_argument("action", choices=("list", "get"), help="list the sets, or get some")
    parser.add_argument("names", nargs="*", metavar="NAME", help="sets to get")
    parser.add_argument("--out", type=Path, default=Path("data"), help="folder to write")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """List or fetch; the status is 1 where a table is not that of the documentation."""
    from nfriction.io.public_data import fetch, public_sets

    sets = public_sets()
    if arguments.action == "list":
        width = max(map(len, sets))
        for name, chosen in sets.items():
            print(f"{name:<{width}}  {chosen.about}")
            print(f"{'':<{width}}  {chosen.repository}, licence: {chosen.licence}")
        return 0
    if not arguments.names:
        raise UsageError(f"name sets to get: {', '.join(sets)}.")
    status = 0
    for name in arguments.names:
        folder = arguments.out / name
        fetched = fetch(name, folder)
        if fetched.differing:
            status = 1
            warn(f"{', '.join(fetched.differing)}: not the table that the documentation used "
                 "(SHA-256 differs); results may differ, too")  # fmt: skip
        print(f"{name}: {len(fetched.tables)} recordings and recordings.csv are in {folder} "
              f"({sets[name].repository}, licence: {sets[name].licence})")  # fmt: skip
    return status
