"""Simulated recordings with known friction, sampled by an encoder."""

import numpy as np
import torch

from nfriction import LinearAxis, PendulumChain, Recording, rollout
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import LeastSquaresResult
from nfriction.optim.levenberg_marquardt import LevenbergMarquardt
from nfriction.recording.angles import AngleConvention
from nfriction.signals import quantise
from nfriction.simulation.rollout import Scheme

F64 = torch.float64
COUNTS = 8192


def pendulum(**settings) -> PendulumChain:
    return PendulumChain([0.3, 0.2], [0.2, 0.15], inertia=[1e-3, 4e-4], **settings)


def one_link() -> PendulumChain:
    """The simplest mechanism with which a fit has all its stages."""
    return PendulumChain([0.3], [0.2], inertia=[1e-3])


def swing(
    plant: PendulumChain,
    model: FrictionModel,
    *,
    seconds: float = 4.0,
    start: tuple[float, ...] | None = None,
    sample_time: float | np.ndarray = 2e-3,
    convention: str = "relative,upright",
    name: str = "swing",
) -> Recording:
    """A release from rest, quantised in the recording's convention."""
    start = (1.6, 0.8)[: plant.joints] if start is None else start
    steps = sample_time if isinstance(sample_time, np.ndarray) else None
    count = round(seconds / sample_time) if steps is None else len(steps)
    out = rollout(
        plant, model, torch.tensor(start, dtype=F64), torch.zeros(len(start), dtype=F64),
        sample_time=sample_time if steps is None else torch.as_tensor(steps),
        steps=count, substeps=4, gradients=False,
    )  # fmt: skip
    written = AngleConvention.of(convention)
    q = quantise(written.position_from_joint(out.q.numpy()), COUNTS)
    return Recording(out.time.numpy(), q, convention=written, name=name)


def driven_axis(
    axis: LinearAxis, model: FrictionModel, *, seconds: float = 3.0, substeps: int = 2
) -> Recording:
    """An axis driven by two sines, whose position is read to a micrometre."""
    time = np.arange(0.0, seconds, 2e-3)
    force = 6.0 * np.sin(2 * np.pi * time) + 4.0 * np.sin(2 * np.pi * 2.7 * time)
    tau = torch.as_tensor(force[:, None])
    zero = torch.zeros(1, dtype=F64)
    out = rollout(
        axis, model, zero, zero, tau[:-1], sample_time=2e-3, substeps=substeps, gradients=False
    )
    q = 1e-6 * np.rint(out.q.numpy() / 1e-6)
    return Recording(time, q, tau=tau.numpy(), unit="m", name="axis")


def flywheel(
    seed: int,
    friction: FrictionModel,
    counts: int = 4096,
    noise: float = 0.01,
    scheme: Scheme = "rk4",
) -> Recording:
    """A driven axis of 0.13 kg: smooth random force with noise, an encoder, 500 Hz."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, 10.0, 2e-3)[:, None]
    rate, phase = random.uniform(0.6, 9.0, 6), random.uniform(0.0, 6.0, 6)
    tau = 0.6 * np.sin(rate * time + phase).sum(1, keepdims=True)
    zero = torch.zeros(1, dtype=F64)
    out = rollout(
        LinearAxis(0.13), friction, zero, zero, torch.as_tensor(tau[:-1]), sample_time=2e-3,
        substeps=8, gradients=False, scheme=scheme,
    )  # fmt: skip
    read = tau + noise * random.standard_normal(tau.shape)
    return Recording(
        time[:, 0], quantise(out.q.numpy(), counts), tau=read, unit="m", name=f"{seed}"
    )


def solve(
    problem: ShootingProblem, start: torch.Tensor, max_steps: int = 30, cost_tolerance: float = 1e-6
) -> LeastSquaresResult:
    """The minimum of a shooting problem, without a monitor."""
    lower, upper = problem.variables.bounds()
    solver = LevenbergMarquardt(
        max_steps=max_steps, gradient_tolerance=1e-6, cost_tolerance=cost_tolerance,
        step_tolerance=1e-8,
    )  # fmt: skip
    return solver.minimise(problem.linearise, start, cost=problem.cost, lower=lower, upper=upper)
