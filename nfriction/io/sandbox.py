"""Worker processes for libraries that an untrusted file may crash, hang or corrupt.

`run_isolated` starts one and waits for it; `worker_main` is what the worker runs.
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

# Allowed ratio of wall time to processor time, because a machine may be busy.
BUSY = 10.0
_REFUSAL = "refusal.txt"
# Share of the address space that one written file may take.
_FILE_SHARE = 4
# Python puts the working directory first in the path; a file there must not shadow a module.
_START = """import sys
sys.path[:] = [place for place in sys.path if place]
from {module} import main
main()
"""


class WorkerDied(ValueError):  # noqa: N818 - an exit, as in ProcessLookupError's family
    """The worker was killed by a signal, ended with an error, or ran out of time."""


class InvalidFile(ValueError):  # noqa: N818 - it names the finding
    """The worker read the file and refused it; the message is the worker's."""


def run_isolated(module: str, task: Mapping[str, Any], folder: Path, *, seconds: float) -> None:
    """Run a module's `main`, which calls `worker_main`, in a worker process and wait for it.

    Args:
        task: plain JSON.
        folder: empty; for the results and the worker's temporary files.
        seconds: processor time limit [s], imports included.
    """
    # The worker imports from the same places as this process.
    path = os.pathsep.join(place or os.getcwd() for place in sys.path)
    temporary = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(folder))
    request = {"folder": str(folder), "seconds": seconds, "task": dict(task)}
    with tempfile.TemporaryFile() as errors:
        try:
            ended = subprocess.run(
                [get_executable(), "-c", _START.format(module=module)],
                input=json.dumps(request).encode(), stdout=subprocess.DEVNULL, stderr=errors,
                env=os.environ | temporary | {"PYTHONPATH": path}, timeout=BUSY * seconds,
                check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise WorkerDied("it does not come to an end") from None
        # A file, because printed text could come from the library, and exit codes have no message.
        refusal = folder / _REFUSAL
        if refusal.exists():
            raise InvalidFile(refusal.read_text(encoding="utf-8", errors="replace"))
        if ended.returncode:
            errors.seek(max(0, errors.seek(0, os.SEEK_END) - 1000))
            lines = errors.read().decode(errors="replace").strip().splitlines()
            cause = lines[-1][:200] if lines else f"exit status {ended.returncode}"
            if ended.returncode < 0:
                name = signal.Signals(-ended.returncode).name
                cause = "it does not come to an end" if name == "SIGXCPU" else name
            raise WorkerDied(cause)


def worker_main(work: Callable[[Mapping[str, Any], Path], None], *, memory: int) -> None:
    """Do the task on standard input within limits of time and memory.

    Args:
        work: function of the task and the folder for results. Its ValueErrors concern the file;
            `run_isolated` raises them as `InvalidFile`.
        memory: limit of the address space [bytes]; a written file may take a quarter of it.
    """
    request = json.load(sys.stdin)
    folder = Path(request["folder"])
    _limit(request["seconds"], memory)
    try:
        work(request["task"], folder)
    except ValueError as error:
        reason = str(error)[:1000]
        (folder / _REFUSAL).write_text(reason, encoding="utf-8", errors="replace")


def _limit(seconds: float, memory: int) -> None:
    """Limit processor time and memory if the system can; never raise an existing limit."""
    try:
        import resource
    except ImportError:
        return
    bounds = {
        resource.RLIMIT_CPU: math.ceil(time.process_time() + seconds),
        resource.RLIMIT_AS: memory,
        resource.RLIMIT_FSIZE: memory // _FILE_SHARE,
        # No core dumps of gigabytes.
        resource.RLIMIT_CORE: 0,
    }
    for kind, bound in bounds.items():
        soft, hard = resource.getrlimit(kind)
        known = [x for x in (soft, hard) if x != resource.RLIM_INFINITY]
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(kind, (min([bound, *known]), hard))
