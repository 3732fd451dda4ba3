"""Draw the figure of the page on friction with memory, and print its numbers.

python docs/memory.py
"""

import math
from itertools import pairwise
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from torch import Tensor, nn

from nfriction import LinearAxis, rollout
from nfriction.friction.memory import LUGRE, LuGre, maxwell_slip

F64 = torch.float64
# F_c, F_d, v_s, sigma_0, sigma_1, sigma_2 of Canudas de Wit et al. (1995), table 1.
CLASSIC = [1.0, 0.5, 0.001, 1e5, math.sqrt(1e5), 0.4]
SLIP = [400.0, 200.0, 100.0, 50.0, 1e-4, 3e-4, 1e-3, 3e-3, 0.1, 1e-12, 0.01]


class Pulled(nn.Module):
    """A mass of 1 kg on a spring of 2 N/m, whose other end a force of 2 N/m moves."""

    joints = 1

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        return tau - 2.0 * q

    def load(self, q: Tensor, qd: Tensor) -> Tensor:
        return torch.ones_like(q)

    def decay_rate(self, damping: Tensor) -> Tensor:
        return damping.amax(-1)


def presliding() -> tuple[Tensor, Tensor]:
    """Displacement and force of a Maxwell-slip contact with an inner loop."""
    law, c = maxwell_slip(4), torch.tensor(SLIP, dtype=F64)
    turns = [0.0, 4e-3, -4e-3, 1e-3, -1e-3, 4e-3]
    path = torch.cat([torch.linspace(a, b, 400, dtype=F64) for a, b in pairwise(turns)])
    one = torch.ones(1, dtype=F64)
    state, forces = law.initial_state(one), []
    for qd in path.diff()[:, None]:
        state = law.memory.advance(state, qd, one, c, 1.0)
        forces.append(law.memory.torque(state, 0.0 * qd, one, c))
    return path[1:], torch.cat(forces)


def breakaway(rate: float) -> float:
    """Force at which a mass of 1 kg breaks away, under a force that grows by `rate` [N/s]."""
    step = min(1e-3, 1e-3 / rate)
    count = round(2.0 / rate / step)
    push = (torch.arange(count, dtype=F64)[:, None] + 0.5) * step * rate
    rest = torch.zeros(1, dtype=F64)
    model = LuGre(1, CLASSIC).requires_grad_(False)
    run = rollout(LinearAxis(1.0), model, rest, rest, push, sample_time=step)
    # Behind its peak, friction no longer holds against the force.
    law, one = LUGRE.memory, torch.ones_like(run.qd)
    force = law.torque(run.law_state, run.qd, one, torch.tensor(CLASSIC, dtype=F64))
    return float(force.max())


def lag(frequency: float) -> tuple[Tensor, Tensor]:
    """Velocity and friction while the velocity swings about 1.5 mm/s without turning."""
    t = torch.arange(0.0, 4.0 / frequency, 1e-4, dtype=F64)
    v = 1.5e-3 * (1.0 - 0.9 * torch.cos(2.0 * math.pi * frequency * t))
    c, one = torch.tensor(CLASSIC, dtype=F64), torch.ones(1, dtype=F64)
    state, forces = LUGRE.initial_state(one), []
    for qd in v[:, None]:
        state = LUGRE.memory.advance(state, qd, one, c, 1e-4)
        forces.append(LUGRE.memory.torque(state, qd, one, c))
    last = round(1.0 / frequency / 1e-4)
    return v[-last:], torch.cat(forces)[-last:]


def stick_slip() -> tuple[Tensor, Tensor]:
    """Time and velocity of the pulled mass."""
    t = (torch.arange(40_000, dtype=F64)[:, None] + 0.5) * 1e-3
    rest = torch.zeros(1, dtype=F64)
    run = rollout(Pulled(), LuGre(1, CLASSIC).requires_grad_(False), rest, rest, 2.0 * 0.1 * t)
    return run.time, run.qd[:, 0]


def main() -> None:
    """Write `memory.png` beside this file."""
    figure, axes = plt.subplots(2, 2, figsize=(9, 6), layout="constrained")
    displacement, force = presliding()
    axes[0, 0].plot(1e3 * displacement, force)
    axes[0, 0].set(xlabel="displacement [mm]", ylabel="friction [N]", title="Maxwell-slip: loops")
    rates = [1.0, 2.0, 5.0, 10.0, 20.0, 50.0]
    peaks = [breakaway(rate) for rate in rates]
    print(
        "breakaway [N]:", ", ".join(f"{r:g} N/s {p:.2f}" for r, p in zip(rates, peaks, strict=True))
    )
    axes[0, 1].plot(rates, peaks, "o-")
    axes[0, 1].set(xlabel="rate of the force [N/s]", ylabel="breakaway [N]", title="LuGre: rate")
    for frequency in (1.0, 10.0, 25.0):
        velocity, force = lag(frequency)
        half = len(velocity) // 2
        up, down = ((v - 1.5e-3).abs().argmin() for v in (velocity[:half], velocity[half:]))
        width = float(force[up] - force[half + down])
        print(f"lag at {frequency:g} Hz: {width:.3f} N wider on the way up at 1.5 mm/s")
        axes[1, 0].plot(1e3 * velocity, force, label=f"{frequency:g} Hz")
    axes[1, 0].set(xlabel="velocity [mm/s]", ylabel="friction [N]", title="LuGre: lag")
    axes[1, 0].legend()
    time, velocity = stick_slip()
    k = torch.nonzero((velocity[:-1] < 0.1) & (velocity[1:] >= 0.1))[:, 0]
    share = (0.1 - velocity[k]) / (velocity[k + 1] - velocity[k])
    print(f"stick-slip period: {float((time[k] + 1e-3 * share).diff().mean()):.4f} s")
    axes[1, 1].plot(time, velocity)
    axes[1, 1].set(xlabel="time [s]", ylabel="velocity [m/s]", title="LuGre: stick-slip")
    figure.savefig(Path(__file__).with_name("memory.png"), dpi=120)


if __name__ == "__main__":
    main()
