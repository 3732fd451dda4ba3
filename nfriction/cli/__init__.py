"""Command line: fit, compare, inspect and export friction models.

Functions `add...(commands)` register commands. Slow imports (torch, pandas, matplotlib) happen only
when a command runs, so that help and usage errors appear at once.
"""

import argparse
import io
import logging
import shlex
import sys
from collections.abc import Sequence

from nfriction.cli import console, demo, estimate, export, inspect, torque
from nfriction.version import __version__

# Functions that register the commands, in the order of the help.
COMMANDS = (
    estimate.add_fit, estimate.add_compare, torque.add_fit, torque.add_score, demo.add_demo,
    inspect.add_report, inspect.add_info, export.add_export, export.add_verify, inspect.add_data,
    demo.add_reproduce, demo.add_twin,
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    An error prints one line on standard error and gives exit status 2, an interrupt gives 130, and
    a closed output pipe 141.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Names of files and recordings may not be valid Unicode.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        try:
            return _answer(words)
        finally:
            sys.stdout.flush()  # otherwise buffered output fails too late to be caught
    except BrokenPipeError:
        return console.drop_output()


def _answer(words: list[str]) -> int:
    """Parse, run and report errors."""
    parser = make_parser()
    arguments = argparse.Namespace(debug="--debug" in words)
    try:
        parser.parse_args(words, arguments)
        if "run" not in arguments:
            parser.print_help(sys.stderr)
            return 2
        # File names that are not UTF-8 cannot be written as they are.
        line = shlex.join(["nfriction", *words]).encode(errors="backslashreplace")
        arguments.command_line = line.decode()
        return _run(arguments)
    except KeyboardInterrupt as interrupt:
        print(f"nfriction: interrupted {interrupt}".rstrip(), file=sys.stderr)
        return 130
    except BrokenPipeError:
        raise
    except (console.UsageError, ValueError, OSError, ImportError) as error:
        if arguments.debug:
            raise
        print(f"nfriction: error: {console.message_of(error)}", file=sys.stderr)
        return 2


def make_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    parser = console.Parser(
        prog="nfriction",
        description="Identify joint friction from encoder logs, and check it by simulating "
        "recordings the fit never saw.",
    )
    parser.add_argument("--version", action="version", version=f"nfriction {__version__}")
    commands = console.Commands(parser)
    for add in COMMANDS:
        add(commands)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    """Run a command whose arguments are valid."""
    import torch

    from nfriction.codegen import CodegenError
    from nfriction.export import ExportError

    handler = logging.StreamHandler()
    handler.setLevel(logging.WARNING)  # a log file may contain more
    handler.addFilter(console.FirstOfItsKind())
    logging.basicConfig(format="nfriction: %(levelname)s: %(message)s", handlers=[handler])
    # Several threads make small tensors up to 100 times slower.
    torch.set_num_threads(1)
    try:
        with console.interruptible(), console.one_line_warnings():
            return arguments.run(arguments)
    # Linear algebra on unusable data raises torch's own errors.
    except (CodegenError, ExportError, ArithmeticError, torch.linalg.LinAlgError) as error:
        raise console.UsageError(str(error)) from error
