"""The console: errors and warnings on one line, progress, Ctrl-C."""

import argparse
import logging
import os
import re
import signal
import sys
import tempfile
import textwrap
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn


class UsageError(Exception):
    """The request cannot be met; the message states the reason and a remedy."""


class _Help(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Shows defaults that exist; keeps the layout of examples."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        # "(default: None)" says nothing, and some help texts state the default in words.
        if action.default in (None, False, []) or "(default: " in (action.help or ""):
            return action.help
        return super()._get_help_string(action)

    def _split_lines(self, text: str, width: int) -> list[str]:
        # Names with hyphens are not split, so that they can be copied.
        return textwrap.wrap(" ".join(text.split()), width, break_on_hyphens=False)


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, and whose help shows defaults."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(formatter_class=_Help, **kwargs)

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}; see {self.prog} --help.")


class Commands:
    """The commands of a parser."""

    def __init__(self, parser: Parser) -> None:
        self._parsers = parser.add_subparsers(metavar="COMMAND")

    def add(
        self, name: str, run: Callable[[argparse.Namespace], int], help: str, *,
        description: str, example: str,
    ) -> Parser:  # fmt: skip
        """Register a command, whose `run` returns the exit status, and return its parser."""
        parser: Parser = self._parsers.add_parser(
            name, help=help, description=description, epilog=f"example:\n  {example}"
        )
        parser.set_defaults(run=run)
        parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
        return parser


def check_writable(folder: Path) -> None:
    """Refuse an unwritable folder before the work rather than after it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise UsageError(f"cannot make the folder {folder}: there is a file in its way.") from None
    # Permissions alone do not show whether writing works: the disk may be full or read-only.
    with tempfile.TemporaryFile(dir=folder):
        pass


# The library's messages advise Python callers; these patterns turn the advice into options.
_OPTIONS: tuple[tuple[re.Pattern[str], str | Callable[[re.Match[str]], str]], ...] = (
    (re.compile(r'columns=\{"(\w+)": "\.\.\."\}'), r"--columns \1=NAME"),
    (
        re.compile(r'columns=\{("\w+": "[^"]+"(?:, "\w+": "[^"]+")*)\}'),
        lambda found: '--columns "' + found[1].replace('": "', "=").replace('", "', ",")[1:],
    ),
    (re.compile(r"`(columns|degrees)(=True)?`"), r"--\1"),
    (re.compile(r'`encoder_reference="(\w+)"`'), r"--encoder-reference \1"),
    (re.compile(r"`fit_delay=True`(, or `recording\.advance_torque\([^)]+\)`)?"), "--fit-delay"),
    (
        re.compile("create the model yourself and pass it as `into`"),
        "name its law, --law my.py:LAW",
    ),
)


def one_line(message: object) -> str:
    """A message of the library on one line, its advice given as command-line options."""
    text = " ".join(str(message).split())
    for argument, option in _OPTIONS:
        text = argument.sub(option, text)
    return text


def message_of(error: Exception) -> str:
    """An error on one line."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return one_line(error)


def warn(message: str) -> None:
    """Print a warning on standard error."""
    print(f"nfriction: warning: {message}", file=sys.stderr)


def drop_output() -> int:
    """Suppress further output after the reader closed it; return the status of a closed pipe."""
    # Python flushes once more at exit.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 128 + 13  # SIGPIPE, which not every system has


class FirstOfItsKind(logging.Filter):
    """Passes a message once, because thousands of simulations in a search may diverge."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """True for the first message with these words, whatever its numbers."""
        words = re.sub(r"[\d.]+(e[+-]?\d+)?", "", record.getMessage())
        first = words not in self.seen
        self.seen.add(words)
        return first


@contextmanager
def one_line_warnings() -> Iterator[None]:
    """Print Python's warnings as the command line's own."""

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        warn(one_line(message))

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


_interrupted = threading.Event()


@contextmanager
def interruptible() -> Iterator[None]:
    """Remember a Ctrl-C or SIGTERM, because solvers catch it to return their best point.

    The run ends at its next progress report.
    """

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        _interrupted.set()
        raise KeyboardInterrupt

    _interrupted.clear()
    if threading.current_thread() is not threading.main_thread():
        yield  # signals reach the main thread only
        return
    before = {kind: signal.signal(kind, interrupt) for kind in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler or signal.SIG_DFL)


# Time between two lines of progress in a log [s].
_QUIET = 10.0


class Progress:
    """Progress through the stages of a run, also logged, with elapsed time.

    On a terminal it is a bar; otherwise, as in a job's log, at most one line every ten seconds.
    """

    def __init__(self, logger: logging.Logger | None = None) -> None:
        # Slow to import, and not needed for `--help`.
        from tqdm import tqdm

        self._what, self._logger = "start", logger
        self._begun = self._shown = time.monotonic()
        self._ended = self._expected = self._steps = 0
        self._bar = tqdm(disable=not sys.stderr.isatty(), leave=False, bar_format="{desc} {bar:20}")

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, _type: object, error: BaseException | None, _trace: object) -> None:
        self._bar.close()
        # The message that the user sees; the stage is known only here.
        if isinstance(error, KeyboardInterrupt):
            error.args = (f"({self._what}); no file was left half-written",)

    def stage(self, what: str) -> None:
        """Begin a stage."""
        self._check()
        if self._logger is not None:
            self._logger.info(what)
        self._what, self._steps = what, 0
        self._show(what)

    def expect(self, stages: int) -> None:
        """Announce further stages."""
        self._expected += stages
        self._bar.total = self._expected

    def done(self) -> None:
        """End a stage."""
        self._check()
        self._ended += 1
        self._bar.update()

    def step(self, stage: str) -> None:
        """Count a step of a solver."""
        self._check()
        self._steps += 1
        self._show(f"{self._what}, {stage}, step {self._steps}")

    def resume(self) -> None:
        """Go on after an interrupt, with the fits that were finished by then."""
        _interrupted.clear()
        warn("interrupted: the finished fits are scored; another interrupt ends the run.")

    def _show(self, what: str) -> None:
        now = time.monotonic()
        count = f"{self._ended + 1} of {self._expected}: " if self._expected else ""
        line = f"{count}{what} ({now - self._begun:.0f} s)"
        if not self._bar.disable:
            self._bar.set_description_str(line)
        elif now - self._shown >= _QUIET:
            self._shown = now
            print(f"nfriction: {line}", file=sys.stderr, flush=True)

    def _check(self) -> None:
        if _interrupted.is_set():
            raise KeyboardInterrupt
