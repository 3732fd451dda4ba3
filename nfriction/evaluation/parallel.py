"""Pieces of independent work: one after the other, or in parallel processes by joblib.

Which processes is joblib's business: its own on this machine, or those of a cluster where the
caller says so, `with joblib.parallel_config(backend="dask"):`. What a piece logs and warns of is
told here, as if it had been done here, and every piece has one thread, wherever it is done.
"""

import logging
import signal
import textwrap
import threading
import uuid
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import torch

T = TypeVar("T")
# As `warnings.warn_explicit` keeps what it has shown.
_Registry = dict[str | tuple[str, type[Warning], int], int]

# Tells this process from those that work for it.
_HERE = uuid.uuid4().hex
_LOGGER = logging.getLogger("nfriction")


@dataclass
class _Told:
    """What a piece of work logged and warned of."""

    records: list[logging.LogRecord] = field(default_factory=list)
    warned: list[warnings.WarningMessage] = field(default_factory=list)

    def tell(self, shown: _Registry) -> None:
        """Tell it here; `shown` remembers what need not be told twice."""
        for record in self.records:
            logger = logging.getLogger(record.name)
            if logger.isEnabledFor(record.levelno):
                logger.handle(record)
        for w in self.warned:
            warnings.warn_explicit(str(w.message), w.category, w.filename, w.lineno, registry=shown)


@dataclass(frozen=True)
class _Piece(Generic[T]):
    """Work to be done in some process."""

    label: str
    work: Callable[..., T]
    arguments: tuple[Any, ...]
    home: str
    level: int

    def __call__(self) -> tuple[str, T, _Told]:
        told = _Told()
        with ExitStack() as stack:
            stack.enter_context(one_thread())
            if self.home != _HERE:
                stack.enter_context(_listening(told, self.level))
            return self.label, _named(self.label, self.work, self.arguments), told


def check_jobs(jobs: int) -> None:
    """Refuse a number of processes that means nothing, or that needs a library not there.

    Raises:
        ValueError: if it is 0.
        ImportError: if it is not 1 and joblib is not installed.
    """
    if jobs == 0:
        raise ValueError("`jobs` must be at least 1, or -1 for one to each core, got 0.")
    if jobs != 1:
        try:
            import joblib  # noqa: F401
        except ImportError as error:
            raise ImportError(
                f"jobs={jobs} needs joblib: `pip install nfriction[parallel]`; jobs=1 does not."
            ) from error


def done(
    work: Callable[..., T],
    pieces: Mapping[str, tuple[Any, ...]],
    *,
    jobs: int = 1,
    on_stage: Callable[[str], None] | None = None,
) -> Iterator[tuple[str, T]]:
    """Do independent pieces of work and give each as it is finished.

    Args:
        work: a function; for more than one process it must be found by its name.
        pieces: its arguments by the label of each piece.
        jobs: at most so many processes; -1 for one to each core. In this process where it is 1,
            or where there is one piece.
        on_stage: told what is being done.

    Yields:
        Label and result; in order where `jobs` is 1, else as they come.

    Raises:
        ImportError: if joblib is needed and not installed.
        ValueError, RuntimeError, ...: the first error of a piece, its message preceded by the
            label. Pieces not finished by then are given up.
    """
    check_jobs(jobs)
    say = on_stage or (lambda _: None)
    if jobs == 1 or len(pieces) < 2:
        for label, arguments in pieces.items():
            say(label)
            yield _Piece(label, work, arguments, _HERE, logging.NOTSET)()[:2]
        return
    from joblib import Parallel, delayed

    level = _LOGGER.getEffectiveLevel()
    calls = [
        delayed(_Piece(label, work, arguments, _HERE, level))()
        for label, arguments in pieces.items()
    ]
    say(textwrap.shorten(" | ".join(pieces), 60, placeholder=" ..."))
    shown: _Registry = {}
    pool = Parallel(n_jobs=min(jobs, len(calls)), batch_size=1, return_as="generator_unordered")
    with _deaf_to_interrupts():
        coming = pool(calls)
    for finished, (label, value, told) in enumerate(coming, 1):
        told.tell(shown)
        say(f"{label} done, {len(calls) - finished} of {len(calls)} left")
        yield label, value


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread: faster for small tensors, and the same sums on every machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _named(label: str, work: Callable[..., T], arguments: tuple[Any, ...]) -> T:
    """The result, or the work's error with the label before its message."""
    try:
        return work(*arguments)
    except (ValueError, TypeError, LookupError, ArithmeticError, RuntimeError) as error:
        error.args = (f"{label}: {error}", *error.args[1:])
        raise


@contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Processes begun in the block never hear a Ctrl-C.

    It reaches every process of a terminal. The one that asked for the work ends the others, whose
    solvers would take it for a wish to stop early.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is None or threading.current_thread() is not threading.main_thread():
        yield  # not for Python, or not for this thread to change
        return
    # What is ignored stays so in processes begun now, whatever they run.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class _Collector(logging.Handler):
    """Keeps what its own thread logs, in a form that travels."""

    def __init__(self, into: list[logging.LogRecord]) -> None:
        super().__init__()
        self.into = into
        self.thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self.thread:
            record.msg, record.args = record.getMessage(), None
            record.exc_info = None
            self.into.append(record)


@contextmanager
def _listening(told: _Told, level: int) -> Iterator[None]:
    """Collect what the block logs and warns of."""
    collector, before = _Collector(told.records), _LOGGER.level
    _LOGGER.addHandler(collector)
    _LOGGER.setLevel(level)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
        told.warned += caught
    finally:
        _LOGGER.removeHandler(collector)
        _LOGGER.setLevel(before)
