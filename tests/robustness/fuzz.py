"""Feed damaged files to every loader: it must return something valid or raise a documented error.

    python -m tests.robustness.fuzz --cases 100000 csv rig_json

Run from the repository's root. Loaders run in a child process with a memory limit, every case with
a time limit, so that a crash of a library and a hang are counted too. A case is identified by its
number alone: `--first 4711 --cases 1 --keep case.csv` writes and repeats one.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import json
import math
import mmap
import os
import resource
import select
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from types import FrameType
from typing import NoReturn

from tests.robustness.loaders import LOADERS, Loader

SECONDS, MEMORY = 5.0, 2 * 2**30
_STUCK = 600.0  # wall time without progress [s]; a busy machine may well take a minute
_HARNESS = 77  # exit status of a child that failed outside a case
_PERISHED = 78  # and of one that a library error ends, as it ends a process of its own
_MEMORY_DISK = "/dev/shm" if Path("/dev/shm").is_dir() else None
_COUNTS = struct.Struct("qqq")  # the current case, how many were loaded, how many refused


class Hang(BaseException):
    """A case took too long; derived so that no loader's own `except` catches it."""


@dataclass
class Outcome:
    """Results of the cases of a loader.

    Attributes:
        loaded, refused: number of cases that gave something valid, or a documented error.
        perished: what ended or hung the worker processes of refused cases.
        faults: all other cases by kind: their number, and the first of them with its traceback.
    """

    loader: str
    loaded: int = 0
    refused: int = 0
    seconds: float = 0.0
    perished: Counter[str] = field(default_factory=Counter)
    faults: dict[str, tuple[int, int, str]] = field(default_factory=dict)

    def add_fault(self, kind: str, case: int, description: str) -> None:
        count, first, text = self.faults.get(kind, (0, case, description))
        self.faults[kind] = count + 1, first, text

    def __str__(self) -> str:
        lines = [
            f"{self.loader}: {self.loaded + self.refused} cases, {self.loaded} loaded, "
            f"{self.refused} refused, {sum(n for n, _, _ in self.faults.values())} faults "
            f"({self.seconds:.0f} s)"
        ]
        lines += [f"  apart, {kind}: {count} cases" for kind, count in self.perished.items()]
        for kind, (count, first, description) in self.faults.items():
            lines.append(f"  {kind}: {count} cases, first {first}\n{description}")
        return "\n".join(lines)


def fuzz(
    name: str,
    cases: int,
    *,
    first: int = 0,
    seconds: float = SECONDS,
    memory: int = MEMORY,
    budget: float = math.inf,
    keep: Path | None = None,
) -> Outcome:
    """Run a loader over damaged files.

    Args:
        name: key of `LOADERS`.
        cases: number of cases, counted from `first`.
        seconds: processor time per case [s]; a case that only waits is ended after ten minutes.
        memory: memory of the loader in addition to that of this process [bytes].
        budget: no case is started after this time [s].
        keep: path for the last case's file.
    """
    outcome, begin = Outcome(name), time.monotonic()
    work = _Work(LOADERS[name], first + cases, seconds, memory, begin + budget, keep)
    at = first
    while at < work.end and time.monotonic() < work.deadline:
        # Created here, because a terminated child leaves its files behind.
        with tempfile.TemporaryDirectory(dir=_MEMORY_DISK) as folder:
            at = _run_child(work, at, outcome, Path(folder)) + 1
    outcome.seconds = time.monotonic() - begin
    return outcome


@dataclass(frozen=True)
class _Work:
    """Task of a child: cases up to `end`, none started after the deadline."""

    loader: Loader
    end: int
    seconds: float
    memory: int
    deadline: float
    keep: Path | None


def _run_child(work: _Work, first: int, outcome: Outcome, folder: Path) -> int:
    """Run cases from `first` until all are done or one ends the child; return the last one."""
    shared = mmap.mmap(-1, _COUNTS.size)
    shared[:] = _COUNTS.pack(first, 0, 0)
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        _child(work, first, shared, writer, folder)
    os.close(writer)
    output = b""
    last, since, hung = first, time.monotonic(), False
    while True:
        ready, _, _ = select.select([reader], [], [], 1.0)
        if ready:
            part = os.read(reader, 1 << 16)
            if not part:
                break
            output += part
        case = _COUNTS.unpack(shared)[0]
        if case != last:
            last, since = case, time.monotonic()
        # Code that Python cannot interrupt is ended from here.
        elif time.monotonic() - since > _STUCK + work.seconds:
            os.kill(child, signal.SIGKILL)
            hung = True
    os.close(reader)
    status = os.waitpid(child, 0)[1]
    case, loaded, refused = _COUNTS.unpack(shared)
    outcome.loaded += loaded
    outcome.refused += refused
    for line in output.decode().splitlines():
        outcome.add_fault(*json.loads(line))
    if status and os.WIFEXITED(status) and os.waitstatus_to_exitcode(status) == _HARNESS:
        raise RuntimeError(f"{work.loader.name}: the harness itself failed, see above.")
    if status:
        ended = "hang in a library" if hung else f"the process ended ({_cause(status)})"
        if work.loader.apart:
            outcome.perished[ended] += 1
            outcome.refused += 1
        else:
            outcome.add_fault(ended, case, "")
    return int(case)


def _cause(status: int) -> str:
    if os.WIFSIGNALED(status):
        return signal.Signals(os.WTERMSIG(status)).name
    if os.waitstatus_to_exitcode(status) == _PERISHED:
        return "an error"
    return f"status {os.waitstatus_to_exitcode(status)}"


def _child(work: _Work, first: int, shared: mmap.mmap, writer: int, folder: Path) -> NoReturn:
    """Write faults as lines of JSON, and never return."""
    loader = work.loader
    status = _HARNESS
    try:
        tempfile.tempdir = str(folder)
        faulthandler.disable()  # the parent reports what ends it
        with _quiet(), os.fdopen(writer, "w") as pipe:
            samples = loader.samples(folder)
            warm = folder / f"warm{loader.suffix}"
            for sample in samples:  # libraries are imported before memory is limited
                warm.write_bytes(sample)
                loader.load(warm)
            # Memory in use before does not count for the loader.
            held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (held + work.memory,) * 2)
            # A separate process may be terminated, even if Python cannot interrupt it.
            signal.signal(signal.SIGPROF, signal.SIG_DFL if loader.apart else _too_long)
            counts = [0, 0]
            case = first
            for case in range(first, work.end):
                shared[:] = _COUNTS.pack(case, *counts)
                fault = _try(work, case, samples, folder, counts)
                if fault is not None:
                    pipe.write(json.dumps(fault) + "\n")
                    pipe.flush()
                # After the case, so that one is tried even on a slow machine.
                if time.monotonic() > work.deadline:
                    break
            shared[:] = _COUNTS.pack(case, *counts)
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


def _try(
    work: _Work, case: int, samples: Sequence[bytes], folder: Path, counts: list[int]
) -> tuple[str, int, str] | None:
    """Run one case, which is counted, or reported as kind, number and traceback."""
    loader = work.loader
    rng = Random(f"{loader.name} {case}")
    content = loader.damage(rng, rng.choice(samples))
    path = folder / f"case{loader.suffix}"
    path.write_bytes(content)
    if work.keep is not None:
        work.keep.write_bytes(content)
    try:
        signal.setitimer(signal.ITIMER_PROF, work.seconds)
        try:
            loader.load(path)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
    except loader.refusals as error:
        if loader.names_file and path.name not in str(error):
            return f"{type(error).__name__} without the file's name", case, _trace(error)
        if len(str(error)) > 5000:
            return f"{type(error).__name__} that is endless", case, _trace(error)
        counts[1] += 1
        return None
    except (Exception, Hang) as error:
        if loader.apart and not isinstance(error, AssertionError):
            os._exit(_PERISHED)  # as in a worker; it may have damaged this process, too
        frames = [
            f for f in traceback.extract_tb(error.__traceback__) if "/nfriction/" in f.filename
        ]
        place = f"{Path(frames[-1].filename).name}:{frames[-1].name}" if frames else "?"
        return f"{type(error).__name__} at {place}", case, _trace(error)
    counts[0] += 1
    return None


def _trace(error: BaseException) -> str:
    return "".join(traceback.format_exception(error, limit=-6))[-3000:]


def _too_long(_signal: int, _frame: FrameType | None) -> None:
    raise Hang


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # A loader that computes with invalid numbers before it checks them.
        warnings.filterwarnings("error", category=RuntimeWarning, module=r"nfriction\.")
        yield


def main(argv: Sequence[str] | None = None) -> int:
    """Return exit status 1 if there is a fault."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("loaders", nargs="*", metavar="LOADER", help=", ".join(LOADERS))
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--minutes", type=float, default=math.inf, help="for each loader")
    parser.add_argument("--keep", type=Path, help="write the last case's file there")
    given = parser.parse_args(argv)
    sound = True
    for name in given.loaders or [n for n, loader in LOADERS.items() if loader.available]:
        outcome = fuzz(
            name, given.cases, first=given.first, budget=60 * given.minutes, keep=given.keep
        )
        print(outcome, flush=True)
        sound = sound and not outcome.faults
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main())
