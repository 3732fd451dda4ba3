"""A process of its own for work that may perish of the file it is given.

Libraries that read what others wrote can be ended by it (SIGSEGV), be kept busy for ever, or have
their memory spoilt. `run` starts such work, `serve` is what the process does.
"""

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from multiprocessing.spawn import get_executable
from pathlib import Path
from typing import Any

# How much longer than its processor time a busy machine may take.
BUSY = 10.0
_REFUSAL = "refusal.txt"
# Bytes of room to a byte that it may write into a file.
_WRITTEN = 4
# Python puts the folder where the user stands first in the path; what lies there is no module.
_START = """import sys
sys.path[:] = [place for place in sys.path if place]
from {module} import main
main()
"""


class PerishedError(ValueError):
    """The process was ended by a signal or an error, or did not end in time."""


class RefusedError(ValueError):
    """The process read the file, and says what is wrong with it."""


def run(module: str, asked: Mapping[str, Any], folder: Path, *, seconds: float) -> None:
    """Let a module's `main` work in a process of its own, and wait for it.

    Args:
        module: full name; its `main()` calls `serve`.
        asked: what to do, plain JSON.
        folder: empty, for its results; its temporary files go there, too.
        seconds: of processor time that it may take, imports included.

    Raises:
        RefusedError: in its own words.
        PerishedError: it was ended by a signal, by an error of its own, or by the time; says how.
    """
    # What this process imports from, the other does, too.
    places = os.pathsep.join(place or os.getcwd() for place in sys.path)
    temporary = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(folder))
    told = {"folder": str(folder), "seconds": seconds, "asked": dict(asked)}
    with tempfile.TemporaryFile() as words:
        try:
            ended = subprocess.run(
                [get_executable(), "-c", _START.format(module=module)],
                input=json.dumps(told).encode(), stdout=subprocess.DEVNULL, stderr=words,
                env=os.environ | temporary | {"PYTHONPATH": places}, timeout=BUSY * seconds,
                check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise PerishedError("it does not come to an end") from None
        refusal = folder / _REFUSAL
        if refusal.exists():
            raise RefusedError(refusal.read_text(encoding="utf-8", errors="replace"))
        if ended.returncode:
            words.seek(max(0, words.seek(0, os.SEEK_END) - 1000))
            raise PerishedError(_end(ended.returncode, words.read()))


def serve(
    work: Callable[[Mapping[str, Any], Path], None],
    *,
    refusals: tuple[type[Exception], ...],
    room: int,
) -> None:
    """Do what standard input asks for, within limits.

    Args:
        work: takes what is asked and the folder for results.
        refusals: errors of it that tell of the file.
        room: address space that it may take [bytes]; no file that it writes takes over a quarter.
    """
    told = json.load(sys.stdin)
    folder = Path(told["folder"])
    _limit(told["seconds"], room)
    try:
        work(told["asked"], folder)
    except refusals as error:
        why = str(error)[:1000]
        (folder / _REFUSAL).write_text(why, encoding="utf-8", errors="replace")


def _limit(seconds: float, room: int) -> None:
    """Bound processor time and memory, where the system can; what is bounded closer stays so."""
    try:
        import resource
    except ImportError:
        return
    bounds = {
        resource.RLIMIT_CPU: math.ceil(time.process_time() + seconds),
        resource.RLIMIT_AS: room,
        resource.RLIMIT_FSIZE: room // _WRITTEN,
        resource.RLIMIT_CORE: 0,
    }
    for what, bound in bounds.items():
        soft, hard = resource.getrlimit(what)
        known = [x for x in (soft, hard) if x != resource.RLIM_INFINITY]
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(what, (min([bound, *known]), hard))


def _end(status: int, words: bytes) -> str:
    """How a process ended: the signal, or its last words."""
    if status < 0:
        name = signal.Signals(-status).name
        return "it does not come to an end" if name == "SIGXCPU" else name
    lines = words.decode(errors="replace").strip().splitlines()
    return lines[-1][:200] if lines else f"exit status {status}"
