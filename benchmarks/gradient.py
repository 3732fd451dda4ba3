"""Gradients and regularised fits: what training a neuro-fuzzy model costs.

Run from the repository's root: `python benchmarks/gradient.py`. Each part runs in a fresh process
on one pinned thread, so that its peak memory is its own.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from unittest import mock

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


def median_time(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median processor and wall time [s]: on an idle machine the same."""
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(repeats):
        start = timing.CLOCK(), time.perf_counter()
        work()
        times[0].append(timing.CLOCK() - start[0])
        times[1].append(time.perf_counter() - start[1])
    processor, wall = (sorted(found)[repeats // 2] for found in times)
    return processor, wall


def operations(work: Callable[[], object]) -> int:
    """Number of operations that eager torch runs, those of the backward pass included."""
    from torch.utils._python_dispatch import TorchDispatchMode

    class Counter(TorchDispatchMode):
        count = 0

        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            Counter.count += 1
            return function(*args, **(kwargs or {}))

    with Counter():
        work()
    return Counter.count


def torch_gradient(repeats: int) -> None:
    """Gradient of the position error of all windows with respect to every parameter."""
    import cases
    import torch

    from nfriction import rollout
    from nfriction.simulation.compiled import Backend

    torch.set_num_threads(1)
    plant, model = cases.rig(), cases.neurofuzzy(terms=(5, 6))
    q0, qd0 = cases.release(WINDOWS)
    with torch.no_grad():
        target = rollout(plant, model, q0, qd0, steps=STEPS, backend="torch").q + 1e-3
    before = peak_memory()

    def gradient(backend: Backend = "auto") -> None:
        model.zero_grad(set_to_none=True)
        motion = rollout(plant, model, q0, qd0, steps=STEPS, gradients=True, backend=backend)
        (motion.q - target).square().mean().backward()

    seconds, wall = median_time(gradient, repeats)
    peak, calls = peak_memory(), operations(gradient)
    found = [p.grad for p in model.parameters()]
    if not all(g is not None and torch.isfinite(g).all() for g in found):
        raise SystemExit("the gradient is not finite, or lacks a parameter")
    count = sum(p.numel() for p in model.parameters())
    print(
        f"  {count} parameters; memory {before:.0f} MB before, {peak:.0f} MB at the peak; "
        f"{wall:.2f} s by the wall; {calls} operations, {1e6 * seconds / calls:.1f} us each"
    )
    verdict("gradient, adjoint in eager torch, motion compiled [s]", seconds, 1.0)
    verdict("peak memory of the process [GB]", peak / 1e3, 1.0)
    with mock.patch("nfriction.simulation.rollout.integrate_compiled", return_value=None):
        seconds, _ = median_time(gradient, repeats)
    verdict("the same with nothing compiled [s]", seconds, 1.0)
    seconds, _ = median_time(lambda: gradient("torch"), 1)
    difference = max(
        float((p.grad - g).abs().max() / g.abs().max())
        for p, g in zip(model.parameters(), found, strict=True)
    )
    print(f"  every step recorded: {seconds:.2f} s; the gradients agree to {difference:.0e}")


def gauss_newton(repeats: int) -> None:
    """Exact sensitivities of all windows by parameters and start states, to normal equations."""
    import cases
    import torch

    from nfriction import rollout
    from nfriction.fitting.data.windows import Windows
    from nfriction.fitting.shooting.problem import ShootingProblem
    from nfriction.fitting.shooting.sensitivity import StepJacobian

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
        )
        identity = torch.eye(3, dtype=torch.float64)
        problem = ShootingProblem(StepJacobian(plant, model, []), model, windows, 1e-3, identity)
        x = problem.variables.start()
        found = problem.linearise(x)
        if not torch.isfinite(found.hessian).all():
            raise SystemExit("the Gauss-Newton model is not finite")
        seconds, _ = median_time(lambda p=problem, x=x: p.linearise(x), repeats)
        count = problem.variables.friction_count
        print(f"  {name}: {count} friction parameters and {x.numel()} unknowns: "
              f"{seconds:.3f} s, peak {peak_memory():.0f} MB", flush=True)  # fmt: skip


def one_width_a_unit():
    """The papers' 2-10-2 network: 10 centres in the plane, 10 widths, 52 parameters."""
    import torch
    from torch import nn

    from nfriction.fuzzy import RBFNetwork

    class PaperNetwork(RBFNetwork):
        """Offers the columns that its outputs share, as a user's own module may."""

        def __init__(self) -> None:
            super().__init__(1)
            self.log_widths = nn.Parameter(self.log_widths.detach()[..., :1].clone())

        @torch.no_grad()
        def jacobian_columns(self, x, out=None):
            shared, moving = self.units + 1, self.units * self.inputs
            F = x.new_empty(1, shared + moving + self.units, len(x)) if out is None else out
            d = F[:, shared : shared + moving].unflatten(1, (self.units, self.inputs))
            torch.sub(x.movedim(0, -1).unsqueeze(1), self.centres.unsqueeze(-1), out=d)
            squares = torch.mul(d[:, :, 0], d[:, :, 0], out=F[:, -self.units :])
            squares.addcmul_(d[:, :, 1], d[:, :, 1])
            phi = F[:, : self.units]
            torch.mul(squares, -0.5 * torch.exp(-2.0 * self.log_widths), out=phi)
            phi.clamp_(min=self.least_exponent).exp_()
            F[:, self.units] = 1.0
            squares.mul_(phi)
            d.mul_(phi.unsqueeze(2))
            return F

        @torch.no_grad()
        def jacobian_maps(self):
            inputs, units, weight = self.inputs, self.units, self.output_weight.detach()
            slope = weight * torch.exp(-2.0 * self.log_widths).mT
            own, one = (torch.eye(n).to(weight) for n in (self.outputs, units))
            blocks = (
                torch.diag_embed(slope.repeat_interleave(inputs, 2)),
                torch.diag_embed(slope),
                torch.einsum("ab,uv->aubv", own, one).flatten(2),
                own.unsqueeze(1),
            )
            names, maps = [name for name, _ in self.named_parameters()], {}
            starts = {"centres": units + 1, "log_widths": units + 1 + units * inputs,
                      "output_weight": 0, "output_bias": units}  # fmt: skip
            by_name = dict(zip(starts, blocks, strict=True))
            for name in names:
                block, start = by_name[name], starts[name]
                columns = units * (2 + inputs) + 1
                maps[name] = weight.new_zeros(1, self.outputs, columns, block.shape[-1])
                maps[name][:, :, start : start + block.shape[-2]] = block
            return maps

    return PaperNetwork()


def regularised(repeats: int) -> None:
    """One iteration of Bayesian regularisation: network 2-10-2, 40,000 samples."""
    import torch

    from nfriction.fuzzy import RBFNetwork
    from nfriction.papers.nffem.evidence import EvidenceOptions, bayesian_regularisation
    from nfriction.papers.nffem.jacobian import normal_equations

    torch.set_num_threads(1)
    random = torch.Generator().manual_seed(0)
    x = 2 * torch.rand(40_000, 1, 2, generator=random, dtype=torch.float64) - 1
    y = torch.stack([torch.sin(3 * x[..., 0]) * x[..., 1], torch.exp(-x.square().sum(-1))], -1)
    y = y + 0.01 * torch.randn(y.shape, generator=random, dtype=torch.float64)
    for name, network in (
        ("a width a unit", one_width_a_unit()),
        ("a width per axis", RBFNetwork(1)),
    ):
        written = normal_equations(network, x[:50], y[:50])
        # Within another module what the network offers beyond its outputs is not seen.
        plain = normal_equations(torch.nn.Sequential(network), x[:50], y[:50])
        if not torch.allclose(written.JtJ, plain.JtJ, rtol=1e-10, atol=1e-10):
            raise SystemExit("the written derivatives are not the automatic ones")
        stamps = [(timing.CLOCK(), time.perf_counter())]
        options = EvidenceOptions(
            max_steps=3 * repeats,
            callback=lambda _, s=stamps: s.append((timing.CLOCK(), time.perf_counter())),
        )
        bayesian_regularisation(network, x, y, options=options)
        steps, walls = (
            sorted(1e3 * (b[i] - a[i]) for a, b in pairwise(stamps[1:])) for i in range(2)
        )
        middle, count = len(steps) // 2, sum(p.numel() for p in network.parameters())
        print(f"  {count} parameters ({name}), {len(steps)} iterations, "
              f"{walls[middle]:.0f} ms by the wall")  # fmt: skip
        verdict("iteration of Bayesian regularisation [ms]", steps[middle], 30.0)


PARTS: dict[str, tuple[str, Callable[[int], None]]] = {
    "gradient": (f"Gradient of {WINDOWS} windows x {STEPS} steps", torch_gradient),
    "model": (f"Gauss-Newton model of {WINDOWS} windows x {STEPS} steps", gauss_newton),
    "evidence": ("Bayesian regularisation, network 2-10-2, 40,000 samples", regularised),
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
