"""Motion over time: exact trajectories, constant energy, the order of the integrator."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from nfriction.plant import PendulumChain, rigs

FULL_TENSOR = [
    [0.002, 0.0388, 0.04, 0.0004, 0.00032, -0.00024],
    [0.0025, 0.0485, 0.05, 0.0005, 0.0004, -0.0003],
    [0.0025, 0.0485, 0.05, 0.0005, 0.0004, -0.0003],
]


@torch.no_grad()
def rk4(rig: PendulumChain, q: Tensor, qd: Tensor, dt: float, steps: int) -> tuple[Tensor, Tensor]:
    """Positions and rates after each step of classical RK4, without torques, time first."""
    tau = torch.zeros_like(q)
    path = [(q, qd)]
    for _ in range(steps):
        a1 = rig(q, qd, tau)
        v2 = qd + dt / 2 * a1
        a2 = rig(q + dt / 2 * qd, v2, tau)
        v3 = qd + dt / 2 * a2
        a3 = rig(q + dt / 2 * v2, v3, tau)
        v4 = qd + dt * a3
        a4 = rig(q + dt * v3, v4, tau)
        q = q + dt / 6 * (qd + 2 * v2 + 2 * v3 + v4)
        qd = qd + dt / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        path.append((q, qd))
    positions, rates = zip(*path, strict=True)
    return torch.stack(positions), torch.stack(rates)


RUNS = [
    "planar_izz_up_20_30_40",
    "planar_izz_down_20.56_32.21_45",
    "planar_none_up_20_30_40",
    "armfree_izz_up_20_30_40",
    "armfree_full_up_20_30_40",
]


def trajectory_error(run: dict[str, Any], seconds: float) -> np.ndarray:
    """Largest position error at each stored time, integrated with order 8 to 1e-12.

    Point masses rotate so fast that RK4 would need steps of 0.1 ms.
    """
    dof, interval = run["dof"], run["dt"]
    inertia = {"full": FULL_TENSOR}.get(run["case"], run["case"])
    rig = rigs.tlrip("free" if dof == 4 else "fixed", inertia)
    rows = np.array(run["data"])[: round(seconds / interval) + 1]
    expected, rates = rows[:, 4 - dof : 4], rows[:, 8 - dof : 8]
    tau = torch.zeros(dof, dtype=torch.float64)

    @torch.no_grad()
    def derivative(_: float, state: np.ndarray) -> np.ndarray:
        q, qd = torch.from_numpy(state).split(dof)
        return torch.cat([qd, rig(q, qd, tau)]).numpy()

    start = np.concatenate([expected[0], rates[0]])
    times = np.linspace(0, seconds, len(rows))
    found = solve_ivp(derivative, (0, seconds), start, "DOP853", times, rtol=1e-12, atol=1e-12)
    return np.abs(found.y[:dof].T - expected).max(1)


@pytest.mark.parametrize("name", RUNS)
def test_short_trajectories_match_the_reference(reference_dir: Path, name: str) -> None:
    data = json.loads((reference_dir / "plant_trajectories.json").read_text())
    # The solver's own tolerance, amplified by chaos over a fraction of a second.
    assert trajectory_error(data["trajectories"][name], 0.4).max() < 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_trajectories_match_the_reference(reference_dir: Path, name: str) -> None:
    data = json.loads((reference_dir / "plant_trajectories.json").read_text())
    run = data["trajectories"][name]
    error = trajectory_error(run, 5.0)
    assert error[: round(2 / run["dt"]) + 1].max() < 1e-7
    assert error.max() < 1e-3


@pytest.mark.parametrize("arm", ["fixed", "free"])
def test_energy_is_constant_and_rk4_has_order_four(arm: str) -> None:
    rig = rigs.tlrip(arm, FULL_TENSOR)
    q0 = torch.tensor([0.3, 0.35, 0.52, 0.7], dtype=torch.float64)[-rig.joints :]
    qd0 = torch.zeros_like(q0)
    ends, drifts = [], []
    for steps in (40, 80, 160):
        q, qd = rk4(rig, q0, qd0, 0.4 / steps, steps)
        kinetic, potential = rig.energy(q, qd)
        total = kinetic + potential
        drifts.append((total - total[0]).abs().max().item())
        ends.append(q[-1])
    # Error falls 16-fold per halving; successive differences show it without an exact solution.
    ratio = ((ends[0] - ends[1]).norm() / (ends[1] - ends[2]).norm()).item()
    assert 3.6 < math.log2(ratio) < 4.6
    assert drifts[-1] < 1e-7 < kinetic.max()


def test_single_pendulum_swings_at_its_small_amplitude_frequency() -> None:
    rig = rigs.multiarm_single()
    amplitude = 1e-4
    q0 = torch.tensor([math.pi + amplitude], dtype=torch.float64)
    omega = math.sqrt(rig.gravity_moment.item() / rig.inertia_coupling.item())
    steps = 200
    q, _ = rk4(rig, q0, torch.zeros(1).double(), math.tau / omega / steps, steps)
    time = torch.arange(steps + 1, dtype=torch.float64) * (math.tau / steps)
    # Amplitude^2 / 16 is the relative change of the period: 1e-9 over one swing.
    assert ((q[:, 0] - math.pi) / amplitude - time.cos()).abs().max() < 1e-6


def test_drag_reduces_energy() -> None:
    rig = rigs.multiarm_double()
    k = torch.tensor([0.01, 0.02], dtype=torch.float64)
    q0, qd0 = torch.tensor([2.0, 0.5]).double(), torch.tensor([1.0, -4.0]).double()
    for dragged in (rig.replace(drag_linear=k), rig.replace(drag_quadratic=k)):
        total = sum(dragged.energy(*rk4(dragged, q0, qd0, 2e-3, 200)))
        assert (total.diff() < 1e-9).all()
        assert total[-1] < total[0] - 1e-3
