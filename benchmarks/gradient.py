"""Gradients, regularised fits and start-up: what a fit of a neuro-fuzzy model costs.

Run from the repository's root: `python benchmarks/gradient.py`. Each part runs in a fresh process
on one pinned thread, so that its peak memory is its own.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import timing  # first: it sets what libraries read when they are loaded
from timing import verdict

WINDOWS, STEPS = 400, 100


def peak_memory() -> float:
    """Largest resident size of this process so far [MB]; 0 where the platform does not tell."""
    try:
        import resource
    except ImportError:
        return 0.0
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def median_time(work: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = timing.CLOCK()
        work()
        times.append(timing.CLOCK() - start)
    return sorted(times)[len(times) // 2]


def torch_gradient(repeats: int) -> None:
    """Gradient of the position error of all windows with respect to every parameter."""
    import cases
    import torch

    from nfriction import rollout

    torch.set_num_threads(1)
    plant, model = cases.rig(), cases.neurofuzzy(terms=(5, 6))
    q0, qd0 = cases.release(WINDOWS)
    with torch.no_grad():
        target = rollout(plant, model, q0, qd0, steps=STEPS, backend="torch").q + 1e-3
    before = peak_memory()

    def gradient() -> None:
        model.zero_grad(set_to_none=True)
        motion = rollout(plant, model, q0, qd0, steps=STEPS, gradients=True)
        (motion.q - target).square().mean().backward()

    seconds = median_time(gradient, repeats)
    count = sum(p.numel() for p in model.parameters())
    missing = [n for n, p in model.named_parameters() if p.grad is None]
    if missing or not all(torch.isfinite(p.grad).all() for p in model.parameters()):
        raise SystemExit(f"the gradient is not finite, or lacks {missing}")
    print(
        f"  {count} parameters; memory {before:.0f} MB before, {peak_memory():.0f} MB at the peak"
    )
    verdict("gradient in eager torch [s]", seconds, 1.0)
    verdict("peak memory of the process [GB]", peak_memory() / 1e3, 1.0)


def gauss_newton(repeats: int) -> None:
    """Exact sensitivities of all windows by parameters and start states, to normal equations."""
    import cases
    import torch

    from nfriction import rollout
    from nfriction.fitting.sensitivity import StepJacobian
    from nfriction.fitting.trajectory import TrajectoryProblem
    from nfriction.fitting.windows import Windows

    torch.set_num_threads(1)
    for name, model in (("constant", cases.constant()), ("neuro-fuzzy", cases.neurofuzzy())):
        plant = cases.rig()
        q0, qd0 = cases.release(WINDOWS)
        motion = rollout(plant, model, q0, qd0, steps=STEPS, gradients=False)
        windows = Windows(
            q=motion.q + 1e-3,
            tau=torch.zeros(WINDOWS, STEPS, 3, dtype=torch.float64),
            step=torch.full((WINDOWS, STEPS), cases.DT, dtype=torch.float64),
            weight=torch.ones(WINDOWS, STEPS + 1, dtype=torch.float64),
            q0=q0,
            qd0=qd0,
            names=("benchmark",) * WINDOWS,
        )
        identity = torch.eye(3, dtype=torch.float64)
        problem = TrajectoryProblem(StepJacobian(plant, model, []), windows, 1e-3, identity)
        x = problem.start()
        found = problem.quadratic(x)
        if not torch.isfinite(found.hessian).all():
            raise SystemExit("the Gauss-Newton model is not finite")
        seconds = median_time(lambda p=problem, x=x: p.quadratic(x), repeats)
        print(f"  {name}: {problem.friction_count} friction parameters and {x.numel()} unknowns: "
              f"{seconds:.3f} s, peak {peak_memory():.0f} MB", flush=True)  # fmt: skip


def regularised(repeats: int) -> None:
    """One iteration of Bayesian regularisation: network 2-10-2, 40,000 samples."""
    import torch

    from nfriction.fuzzy import RBFNetwork
    from nfriction.solve import bayesian_regularisation

    torch.set_num_threads(1)
    random = torch.Generator().manual_seed(0)
    x = 2 * torch.rand(40_000, 1, 2, generator=random, dtype=torch.float64) - 1
    y = torch.stack([torch.sin(3 * x[..., 0]) * x[..., 1], torch.exp(-x.square().sum(-1))], -1)
    y = y + 0.01 * torch.randn(y.shape, generator=random, dtype=torch.float64)
    network = RBFNetwork(1)
    stamps = [timing.CLOCK()]
    bayesian_regularisation(
        network, x, y, max_steps=3 * repeats, callback=lambda _: stamps.append(timing.CLOCK())
    )
    steps = sorted(b - a for a, b in pairwise(stamps[1:]))
    count = sum(p.numel() for p in network.parameters())
    print(f"  {count} parameters (a width per axis; 52 with one width a unit), "
          f"{len(steps)} iterations")  # fmt: skip
    verdict("iteration of Bayesian regularisation [ms]", 1e3 * steps[len(steps) // 2], 30.0)


FIRST_CALL = """
import time, torch
start = time.perf_counter()
from nfriction import LFM, rigs, rollout
zero = torch.zeros(3, dtype=torch.float64)
rollout(rigs.tlrip(), LFM(3, [0.01, 0.01]), zero + 3.0, zero, steps=1000, backend={backend!r},
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


def startup(repeats: int) -> None:
    """First calls in fresh processes, and what `import nfriction` adds to `import torch`."""
    for backend in ("c", "numba"):
        with tempfile.TemporaryDirectory() as cache:
            try:
                calls = [
                    float(_python(FIRST_CALL.format(backend=backend), cache=cache).stdout)
                    for _ in range(1 + repeats)
                ]
            except subprocess.CalledProcessError as error:
                print(f"  {backend} left out: {error.stderr.strip().splitlines()[-1]}")
                continue
        verdict(f"first call beyond `import torch`, {backend}, compiling [s]", calls[0], 4.0)
        verdict("the same, cached [s]", sorted(calls[1:])[repeats // 2], 1.0)
    # The package loads its parts when they are asked for, so both are told.
    used = "import nfriction; nfriction.rollout, nfriction.fit, nfriction.NFLFM"
    for code in ("import nfriction", used):
        times = sorted(float(_python(IMPORTS.format(more=code)).stdout) for _ in range(repeats))
        verdict(f"`{code}` beyond `import torch` [s]", times[repeats // 2], 0.3)
    print("  worst offenders after torch, cumulative [ms]:")
    log = _python(IMPORTS.format(more=used), "-X", "importtime").stderr
    for milliseconds, name in offenders(log)[:12]:
        print(f"    {milliseconds:7.1f}  {name}")


def offenders(log: str) -> list[tuple[float, str]]:
    """Packages that `-X importtime` reports below nfriction, by cumulative time.

    A package within a package of the same family is counted in it.
    """
    rows = [line.split(":", 1)[1].split("|") for line in log.splitlines() if "|" in line]
    rows = [(float(c) / 1e3, n.rstrip()) for _, c, n in rows if c.strip().isdigit()]
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


PARTS: dict[str, tuple[str, Callable[[int], None]]] = {
    "gradient": (f"Gradient of {WINDOWS} windows x {STEPS} steps, eager torch", torch_gradient),
    "model": (f"Gauss-Newton model of {WINDOWS} windows x {STEPS} steps", gauss_newton),
    "evidence": ("Bayesian regularisation, network 2-10-2, 40,000 samples", regularised),
    "startup": ("Start-up in fresh processes (wall time)", startup),
}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--part", choices=PARTS, help="only this one, in this process")
    options = parser.parse_args(argv)
    if options.part:
        title, part = PARTS[options.part]
        print(f"{title}; {timing.pin()}; {timing.yardstick()}", flush=True)
        part(options.repeats)
        return 0
    script = str(Path(__file__).resolve())
    codes = [
        subprocess.run(
            [sys.executable, script, "--part", name, "--repeats", str(options.repeats)], check=False
        ).returncode
        for name in PARTS
    ]
    return max(codes)


if __name__ == "__main__":
    sys.exit(main())
