"""Friction that stops a joint and keeps it at rest."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from nfriction import CVFM, LFM, LinearAxis, PendulumChain, codegen, rollout, score
from nfriction.simulation import compiled, stiction
from tests.fitting.recordings import F64, pendulum, swing
from tests.friction.test_heat import warming

DRY = 2.0


def slide(force: float, *, v0: float = 0.0, steps: int = 1000, **settings):
    """A sliding axis of 4 kg with dry friction of 2 N under a constant force."""
    axis, model = LinearAxis(4.0), CVFM(1, [DRY, 0.0], v_smooth=1e-3)
    tau = torch.full((steps, 1), force, dtype=F64)
    q0, qd0 = torch.zeros(1, dtype=F64), torch.full((1,), v0, dtype=F64)
    return rollout(axis, model, q0, qd0, tau, sample_time=1e-3,
                   **{"scheme": "time_stepping", "gradients": False} | settings)  # fmt: skip


def test_sliding_mass_stops_at_the_predicted_place_and_stays():
    """v0^2 m / (2 F) = 0.16 m, after 0.8 s."""
    run = slide(0.0, v0=0.4, substeps=10)
    assert float(run.q[-1, 0]) == pytest.approx(0.4**2 * 4.0 / (2 * DRY), rel=1e-3)
    stopped = run.qd[:, 0].abs() < 1e-12
    assert bool(stopped[805:].all())
    assert not bool(stopped[:795].any())
    assert float(run.q[-1, 0]) == float(run.q[810, 0])


@pytest.mark.parametrize(
    ("force", "moved"), [(1.9, 0.0), (-1.9, 0.0), (2.5, 0.0625), (-2.5, -0.0625)]
)
def test_force_below_breakaway_causes_no_motion(force, moved):
    assert float(slide(force, substeps=10).q[-1, 0]) == pytest.approx(moved, abs=1e-5)


def test_smooth_sign_creeps_instead_of_resting():
    model, plant = CVFM(1, [0.1, 1e-3], v_smooth=0.01), PendulumChain([0.5], [0.3])
    q0 = torch.tensor([math.pi + 0.05], dtype=F64)
    start = {"q0": q0, "qd0": torch.zeros(1, dtype=F64), "sample_time": 1e-3, "steps": 500}
    settings = {**start, "gradients": False}
    held = rollout(plant, model, **settings, scheme="time_stepping")
    crept = rollout(plant, model, **settings, substeps=4)
    assert bool((held.q == held.q[0]).all())
    assert float((crept.q[-1] - crept.q[0]).abs()) > 1e-3


def test_two_joints_come_to_rest_with_decreasing_energy():
    plant, model = pendulum(), LFM(2, [[4e-3, 6e-2], [2e-3, 2e-2]], v_smooth=0.01)
    q0, zero = torch.tensor([math.pi + 0.6, 0.4], dtype=F64), torch.zeros(2, dtype=F64)
    run = rollout(plant, model, q0, zero, sample_time=1e-3, steps=4000, substeps=4,
                  scheme="time_stepping", gradients=False)  # fmt: skip
    energy = sum(plant.energy(run.q, run.qd))
    assert float(energy.diff().max()) < 1e-5
    assert float(run.qd[-1].abs().max()) < 1e-5
    # Friction keeps it at rest away from equilibrium.
    assert float(plant.gravity(run.q[-1]).abs().max()) > 1e-3


def test_steps_converge_to_the_smooth_solution_while_joints_move():
    plant, model = pendulum(), LFM(2, [[4e-3, 3e-3], [2e-3, 1e-3]], v_smooth=0.01)
    q0, zero = torch.tensor([2.0, 0.4], dtype=F64), torch.zeros(2, dtype=F64)
    settings = {"sample_time": 1e-3, "steps": 300, "gradients": False}
    exact = rollout(plant, model, q0, zero, substeps=20, **settings).q
    settings["scheme"] = "time_stepping"
    errors = [
        float((rollout(plant, model, q0, zero, substeps=n, **settings).q - exact).abs().max())
        for n in (4, 8, 16)
    ]  # fmt: skip
    assert errors[2] < 2e-3
    for coarse, fine in pairwise(errors):
        assert fine < 0.7 * coarse


@pytest.mark.parametrize("torque", [0.0, 0.4])
def test_gear_losses_equal_those_of_smooth_steps(torque):
    """Driven, and back-driven by a swing against friction alone."""
    plant = pendulum(armature=[1e-3, 1e-3]).replace(
        gear_loss=torch.tensor([0.2, 0.4], dtype=F64)
    )  # fmt: skip
    model = CVFM(2, [[0.05, 1e-3], [0.03, 1e-3]], v_smooth=1e-2)
    steps = 300
    tau = torch.full((steps, 2), torque, dtype=F64) * torch.linspace(-1, 1, steps)[:, None]
    start = torch.tensor([math.pi + 1.5, -0.8], dtype=F64), torch.zeros(2, dtype=F64)
    settings = {"sample_time": 1e-3, "gradients": False}
    smooth = rollout(plant, model, *start, tau, substeps=8, **settings).q
    stopped = rollout(plant, model, *start, tau, substeps=8, scheme="time_stepping", **settings).q
    lossless = plant.replace(gear_loss=torch.zeros(2, dtype=F64))
    free = rollout(lossless, model, *start, tau, substeps=8, scheme="time_stepping", **settings).q
    off = float((stopped - smooth).abs().max())
    assert off < 0.01
    assert float((free - stopped).abs().max()) > 5 * off


def test_eager_torch_is_used_if_compilation_fails(monkeypatch, caplog):
    fast = slide(2.5, v0=-0.1, steps=200)

    def refuse(*_, **__):
        raise codegen.CodegenError("no compiler")

    monkeypatch.setattr(codegen, "CompiledRollout", refuse)
    monkeypatch.setattr(compiled, "_known", type(compiled._known)())
    eager = slide(2.5, v0=-0.1, steps=200)
    assert "eager torch, because they cannot be compiled: no compiler" in caplog.text
    torch.testing.assert_close(eager.q, fast.q, rtol=0, atol=1e-12)
    torch.testing.assert_close(eager.qd, fast.qd, rtol=0, atol=1e-12)


def test_batch_equals_its_members():
    plant, model = pendulum(), LFM(2, [4e-3, 3e-2], v_smooth=0.01)
    q0 = torch.tensor([[2.0, 0.4], [3.0, -0.4], [3.5, 0.0]], dtype=F64)
    settings = {"sample_time": 1e-3, "steps": 50, "scheme": "time_stepping", "gradients": False}
    both = rollout(plant, model, q0, torch.zeros_like(q0), **settings)
    assert both.q.shape == (3, 51, 2)
    for k in range(3):
        one = rollout(plant, model, q0[k], torch.zeros(2, dtype=F64), **settings)
        torch.testing.assert_close(both.q[k], one.q, rtol=0, atol=1e-12)


def test_unsupported_options_are_refused():
    with pytest.raises(ValueError, match=r"`scheme` must be one of .*got 'euler'"):
        slide(0.0, scheme="euler")
    with pytest.raises(ValueError, match="has no gradients"):
        slide(0.0, gradients=True)
    plant, zero = pendulum(), torch.zeros(2, dtype=F64)
    with pytest.raises(ValueError, match="needs a friction model"):
        rollout(plant, None, zero, zero, steps=2, scheme="time_stepping")


@pytest.mark.parametrize("compiles", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_heat_equals_that_of_the_smooth_scheme(compiles, monkeypatch):
    plant, start = pendulum(normal_load="bearing"), torch.tensor([2.0, 0.5], dtype=F64)
    given = {"sample_time": 2e-3, "steps": 1000 if compiles else 50, "gradients": False}
    smooth = rollout(plant, warming(), start, 0 * start, substeps=4, **given)
    if not compiles:
        monkeypatch.setattr(stiction, "integrate_compiled", lambda *args, **kwargs: None)
    given |= {"scheme": "time_stepping", "substeps": 40}
    found = rollout(plant, warming(), start, 0 * start, **given)
    torch.testing.assert_close(found.q, smooth.q, rtol=0, atol=1e-3)
    warm = torch.ones(2, 1, dtype=F64)
    later = rollout(plant, warming(), start, 0 * start, hidden_state=warm, **given)
    assert (later.q - found.q).abs().max() > (1e-2 if compiles else 1e-5)


def test_score_accepts_the_scheme():
    """A sign as sharp as this would need a hundred steps of the smooth scheme."""
    truth = LFM(2, [[4e-3, 3e-2], [2e-3, 1e-2]], v_smooth=0.02)
    recording = swing(pendulum(), truth, seconds=1.0)
    sharp = LFM(2, [[4e-3, 3e-2], [2e-3, 1e-2]], v_smooth=1e-6)
    scored = score(pendulum(), sharp, recording, horizons=(0.5,), scheme="time_stepping")
    assert np.isfinite(scored.free_run.all)
    assert scored.free_run.all < 0.01
    assert scored.windows["0.5"].all < 0.01
