"""Start-up in fresh processes: the first rollout, compiled and cached, and what imports cost.

Run from the repository's root: `python benchmarks/startup.py`. All is wall time beyond
`import torch`, on one pinned thread.
"""

import argparse
import os
import subprocess
import sys
import tempfile

import timing  # first: it sets what libraries read when they are loaded
from timing import verdict

FIRST_CALL = """
import time, torch
start = time.perf_counter()
from nfriction import LFM, rigs, rollout
zero = torch.zeros(3, dtype=torch.float64)
rollout(rigs.tlrip(), LFM(3, [0.01, 0.01]), zero + 3.0, zero, steps=1000, backend="compiled",
        gradients=False)
print(time.perf_counter() - start)
"""
IMPORTS = """
import time
start = time.perf_counter()
import torch
middle = time.perf_counter()
{more}
print(time.perf_counter() - middle)
"""


def _python(code: str, *flags: str, cache: str | None = None) -> subprocess.CompletedProcess:
    environment = dict(os.environ) | ({"NFRICTION_CACHE": cache} if cache else {})
    return subprocess.run(
        [sys.executable, *flags, "-c", code],
        capture_output=True, text=True, check=True, env=environment,
    )  # fmt: skip


def first_calls(repeats: int) -> None:
    """The first rollout of a process: the very first on a machine, then those that follow."""
    with tempfile.TemporaryDirectory() as cache:
        calls = [float(_python(FIRST_CALL, cache=cache).stdout) for _ in range(1 + repeats)]
    verdict("first call, compiling [s]", calls[0], 1.5)
    verdict("the same, cached [s]", sorted(calls[1:])[repeats // 2], 0.5)


def imports(repeats: int) -> None:
    """The package loads its parts when they are asked for, so both are timed."""
    used = "import nfriction; nfriction.rollout, nfriction.fit, nfriction.NFLFM"
    for code in ("import nfriction", used):
        times = sorted(float(_python(IMPORTS.format(more=code)).stdout) for _ in range(repeats))
        if code == "import nfriction":
            verdict(f"`{code}` [s]", times[repeats // 2], 0.3)
        else:
            print(f"  `{code}`: {times[repeats // 2]:.2f} s, of it, cumulative [ms]:")
    log = _python(IMPORTS.format(more=used), "-X", "importtime").stderr
    for milliseconds, name in offenders(log)[:12]:
        print(f"    {milliseconds:7.1f}  {name}")


def offenders(log: str) -> list[tuple[float, str]]:
    """Packages that `-X importtime` reports below nfriction, by cumulative time.

    A package within a package of the same family is counted in it.
    """
    lines = [line.split(":", 1)[1].split("|") for line in log.splitlines() if "|" in line]
    rows = [(float(c) / 1e3, n.rstrip()) for _, c, n in lines if c.strip().isdigit()]
    after = next(i for i, (_, name) in enumerate(rows) if name.strip() == "torch") + 1
    depth = [len(name) - len(name.lstrip()) for _, name in rows]
    kept = []
    for i in range(after, len(rows)):
        # The importer is the next row with less indentation.
        importer = next((rows[j][1].strip() for j in range(i + 1, len(rows))
                         if depth[j] < depth[i]), "")  # fmt: skip
        name = rows[i][1].strip()
        own = name.split(".")[0] == importer.split(".")[0]
        if not own or name.startswith("nfriction"):
            kept.append((rows[i][0], f"{name}  (by {importer})" if importer else name))
    return sorted(kept, reverse=True)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args(argv)
    print(f"Start-up beyond `import torch`, wall time; {timing.pin()}; {timing.yardstick()}")
    first_calls(options.repeats)
    imports(options.repeats)
    return 0


if __name__ == "__main__":
    sys.exit(main())
