"""Rollouts of friction with memory: order, stability, rest, energy, agreement of executors."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor, nn

from nfriction import LFM, LinearAxis, PendulumChain, Recording, Stribeck, load, rollout, save
from nfriction.evaluation.score import score
from nfriction.friction.coefficients import Constant
from nfriction.friction.hysteresis import (
    ELEMENTS,
    FADING,
    FIRST,
    OFFSET,
    SLIP,
    STRIBECK,
    TURN,
    VISCOUS,
    Slip,
)
from nfriction.friction.memory import (
    LUGRE,
    Dahl,
    ElastoPlastic,
    LuGre,
    MaxwellSlip,
    NFDahl,
    NFElastoPlastic,
    NFLuGre,
    steady_friction,
)
from nfriction.friction.models import FrictionModel

F64 = torch.float64
CHAIN = PendulumChain([0.3, 0.2], [0.2, 0.15], inertia=[1e-3, 4e-4])
REST = torch.zeros(2, dtype=F64)
Q0 = torch.tensor([2.2, 0.6], dtype=F64)
SOFT = [0.03, 0.015, 0.1, 3.0, 0.01, 0.003]
STIFF = [0.03, 0.015, 0.1, 1e5, 1.0, 0.003]
# Mass, spring and pull of the example of Canudas de Wit et al., section IV.C.
MASS, SPRING, PULL = 1.0, 2.0, 0.1
CLASSIC = [1.0, 0.5, 0.001, 1e5, math.sqrt(1e5), 0.4]


class Pulled(nn.Module):
    """A mass on a spring, whose other end moves as `tau = SPRING * position`."""

    joints = 1

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        return (tau - SPRING * q) / MASS

    def load(self, q: Tensor, qd: Tensor) -> Tensor:
        return torch.ones_like(q)

    def decay_rate(self, damping: Tensor) -> Tensor:
        return damping.amax(-1) / MASS


def models() -> dict[str, FrictionModel]:
    """Soft contacts of all laws for the chain."""
    found: dict[str, FrictionModel] = {
        "lugre": LuGre(2, SOFT),
        "stiff": LuGre(2, STIFF),
        "dahl": Dahl(2, [0.03, 0.003, 3.0]),
        "elasto-plastic": ElastoPlastic(2, [*SOFT, 0.5]),
        "slip": MaxwellSlip(
            2, [1.0, 0.5, 0.3, 0.2, 0.1, 1e-3, 5e-3, 0.02, 0.05, 0.1, 3e-3, 0.3, 0.1]
        ),
    }
    networks = {
        "neuro-fuzzy": NFLuGre(2, SOFT, terms=(3, 2)),
        "neuro-fuzzy dahl": NFDahl(2, [0.03, 0.003, 3.0], terms=(3, 2)),
        "neuro-fuzzy elasto-plastic": NFElastoPlastic(2, [*SOFT, 0.5], terms=(3, 2)),
    }
    for network in networks.values():
        network.schedule.set_range(10.0, [-100.0, 100.0])
        lower, upper = network.schedule.bounds()
        noise = torch.randn(lower.shape, generator=torch.Generator().manual_seed(0), dtype=F64)
        network.schedule.set_parameter_vector(torch.where(lower < upper, 0.3 * noise, 0.0))
    found |= networks
    return {name: model.requires_grad_(False) for name, model in found.items()}


every_model = pytest.mark.parametrize("name", models())


@cache
def solution(soft: bool) -> np.ndarray:
    """Positions of the chain every 0.05 s by a stiff solver of high order."""
    law, model = LUGRE.memory, LuGre(2, SOFT if soft else STIFF)
    assert law is not None
    c, one = model.schedule.rest_coefficients().detach(), torch.ones(2, dtype=F64)

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        q, v, z = torch.tensor(y).reshape(3, 2)
        friction = law.torque(z[:, None], v, one, c)
        steady = steady_friction(v, c[:, 0], c[:, 1], c[:, 2])
        slip = v - c[:, 3] * v.abs() * z / steady
        return torch.cat([v, CHAIN.forward_dynamics(q, v, -friction), slip]).numpy()

    start = np.concatenate([Q0.numpy(), np.zeros(4)])
    times = np.arange(0.0, 1.01, 0.05)
    found = solve_ivp(rate, (0, 1.01), start, "LSODA", times, rtol=1e-9, atol=1e-12)
    return np.asarray(found.y[:2].T)


def error(soft: bool, steps: int) -> float:
    """Largest position error over one second with this number of steps per 0.05 s."""
    model = LuGre(2, SOFT if soft else STIFF).requires_grad_(False)
    run = rollout(CHAIN, model, Q0, REST, sample_time=0.05 / steps, steps=20 * steps)
    return float(np.abs(run.q[::steps].numpy() - solution(soft)).max())


@pytest.mark.slow
def test_resolved_contact_is_solved_to_second_order() -> None:
    coarse, fine = error(True, 25), error(True, 100)
    assert fine < 1e-5
    assert coarse / fine > 10.0  # 16 in the limit


@pytest.mark.slow
def test_a_contact_too_stiff_for_the_step_is_solved_to_first_order() -> None:
    coarse, fine = error(False, 50), error(False, 400)
    assert fine < 1e-3
    assert coarse / fine > 3.0


# The stiff tests include LuGre contacts, the slow ones many slip elements.
@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=[pytest.mark.slow] * (x in {"lugre", "elasto-plastic", "slip"}))
     for x in models()],
)  # fmt: skip
def test_compiled_and_eager_steps_agree(name: str) -> None:
    model = models()[name]
    # Rounding errors grow fast if contacts break away within a step.
    steps, apart = (30, 1e-8) if name == "stiff" else (120, 1e-10)
    q0 = Q0 + torch.tensor([[0.0, 0.1], [0.3, -0.2], [-1.0, 0.5], [0.1, 0.1]], dtype=F64)
    runs = [
        rollout(CHAIN, model, q0, REST, steps=steps, substeps=2, backend=backend)
        for backend in ("compiled", "torch")
    ]
    assert all(torch.isfinite(x).all() for x in (runs[0].q, runs[0].law_state))
    torch.testing.assert_close(runs[0].q, runs[1].q, rtol=0, atol=apart)
    torch.testing.assert_close(runs[0].qd, runs[1].qd, rtol=0, atol=1e3 * apart)
    torch.testing.assert_close(runs[0].law_state, runs[1].law_state, rtol=0, atol=apart)
    alone = rollout(CHAIN, model, q0[2], REST, steps=steps, substeps=2)
    torch.testing.assert_close(runs[0].q[2], alone.q, rtol=0, atol=apart)


def test_motion_continues_from_its_state() -> None:
    model = models()["lugre"]
    whole = rollout(CHAIN, model, Q0, REST, steps=400)
    assert whole.law_state is not None
    second = rollout(
        CHAIN, model, whole.q[200], whole.qd[200], steps=200, law_state=whole.law_state[200]
    )
    torch.testing.assert_close(second.q, whole.q[200:], rtol=0, atol=1e-12)
    torch.testing.assert_close(second.law_state, whole.law_state[200:], rtol=0, atol=1e-12)
    forgotten = rollout(CHAIN, model, whole.q[200], whole.qd[200], steps=200)
    assert float((forgotten.q - whole.q[200:]).abs().max()) > 1e-4


def test_stiff_contact_is_stable_unlike_with_an_explicit_step() -> None:
    # A contact of 1e5 N m/rad on 0.01 kg m^2 oscillates at 500 Hz: an explicit step of 1 ms
    # diverges.
    axis = LinearAxis(0.01)
    model = LuGre(1, [1.0, 0.5, 0.01, 1e5, 1.0, 0.1]).requires_grad_(False)
    push = torch.full((2000, 1), 0.9, dtype=F64)
    run = rollout(axis, model, torch.zeros(1, dtype=F64), torch.zeros(1, dtype=F64), push)
    assert float(run.qd.abs().max()) < 0.02
    assert float(run.qd[-1000:].abs().max()) < 1e-9
    q, v, z = 0.0, 0.0, 0.0
    for _ in range(200):
        v += 1e-3 * (0.9 - 1e5 * z - (1.0 + 0.1) * v) / 0.01
        q, z = q + 1e-3 * v, z + 1e-3 * v
    assert abs(v) > 1e3


@every_model
def test_friction_does_not_inject_energy_into_a_free_mechanism(name: str) -> None:
    model = models()[name]
    run = rollout(CHAIN, model, Q0, REST, sample_time=1e-3, steps=10_000)
    kinetic, potential = CHAIN.energy(run.q, run.qd)
    c = model.schedule.rest_coefficients()
    at = model.law.names.index("k_1" if name == "slip" else "sigma_0")
    stiffness = c[:, at : at + model.law.state_size]
    assert run.law_state is not None
    total = kinetic + potential + 0.5 * (stiffness * run.law_state**2).sum((-1, -2))
    swing = float(total.max() - total.min())
    # An explicit part of the step, the mechanism, exchanges energy to the step's accuracy.
    assert float(total.diff().max()) < 2e-3 * swing
    assert float((total - total.cummin(0).values).max()) < 5e-3 * swing
    assert float(kinetic[-1]) < 1e-3 * swing


@pytest.mark.parametrize("offset", [0.1, -0.1, -2e-8])
def test_torque_that_cancels_an_offset_does_not_change_the_motion(offset: float) -> None:
    def motion(offset: float) -> Tensor:
        model = Slip(1).requires_grad_(False)
        c = model.schedule.parameter_vector().clone()
        c[OFFSET], c[VISCOUS], c[FIRST] = offset, 0.05, 0.3
        c[FIRST + ELEMENTS] = 0.02
        model.schedule.set_parameter_vector(c)
        push = 0.5 * torch.sin(4 * math.pi * 1e-3 * torch.arange(500, dtype=F64)) + offset
        return rollout(LinearAxis(0.02), model, REST[:1], REST[:1], push[:, None]).q

    torch.testing.assert_close(motion(offset), motion(0.0), rtol=0, atol=1e-9)


def test_friction_that_falls_with_displacement_keeps_the_order() -> None:
    """A user-defined law may have a negative narrow element, whose slope at rest is negative."""
    signed = tuple(replace(c, positive=False) if c.linear else c for c in SLIP.coefficients)
    law = replace(SLIP, coefficients=signed)
    values = [0.0] * (FIRST + 2 * ELEMENTS)
    values[VISCOUS], values[TURN], values[STRIBECK], values[FADING] = 0.5, 0.1, 0.1, 1e-9
    values[FIRST : FIRST + 2] = [-0.2, 1.0]
    values[FIRST + ELEMENTS :] = [1e-5] + [1e-3] * (ELEMENTS - 1)
    model = FrictionModel(law, Constant(law, 1, values)).requires_grad_(False)
    zero = torch.zeros(1, dtype=F64)
    push = 3.0 * torch.sin(2 * math.pi * torch.arange(1000, dtype=F64) / 1000)[:, None]
    coarse, fine = (
        rollout(LinearAxis(0.5), model, zero, zero, push, substeps=n).q for n in (1, 50)
    )
    assert float((coarse - fine).abs().max()) < 2e-4


def test_joint_on_a_slope_does_not_creep() -> None:
    # One minute at 0.9 of breakaway; with a smoothed sign the joint would creep at 0.9 of its
    # width.
    axis = LinearAxis(2.0)
    push = torch.full((60_000, 1), 0.9, dtype=F64)
    start = torch.zeros(1, dtype=F64)
    for model in (ElastoPlastic(1, [*CLASSIC, 0.95]), LuGre(1, CLASSIC)):
        held = rollout(axis, model.requires_grad_(False), start, start, push)
        assert 0 < float(held.q[-1]) < 1e-4
        assert abs(float(held.q[-1] - held.q[1000])) < 1e-9
    smooth = Stribeck(1, [1.0, 0.0, 0.4, 0.1, 2.0]).requires_grad_(False)
    creep = rollout(axis, smooth, start, start, push)
    assert float(creep.q[-1]) > 0.1


def stick_slip(step: float, seconds: float = 40.0) -> tuple[np.ndarray, np.ndarray]:
    """Times and velocities of the pulled mass."""
    count = round(seconds / step)
    time = (torch.arange(count, dtype=F64) + 0.5) * step
    model = LuGre(1, CLASSIC).requires_grad_(False)
    start = torch.zeros(1, dtype=F64)
    pull = (SPRING * PULL * time)[:, None]
    run = rollout(Pulled(), model, start, start, pull, sample_time=step, backend="compiled")
    return run.time.numpy(), run.qd[:, 0].numpy()


def period(time: np.ndarray, velocity: np.ndarray) -> float:
    """Mean time between slips, detected by upward crossings of the pull's velocity."""
    k = np.flatnonzero((velocity[:-1] < PULL) & (velocity[1:] >= PULL))
    share = (PULL - velocity[k]) / (velocity[k + 1] - velocity[k])
    crossings = time[k] + share * (time[k + 1] - time[k])
    assert len(crossings) >= 3
    return float(np.diff(crossings).mean())


@pytest.mark.slow
def test_stick_slip_period_equals_that_of_the_published_equations() -> None:
    f_c, f_d, v_s, stiffness, damping, viscous = CLASSIC

    def rate(t: float, y: np.ndarray) -> list[float]:
        x, v, z = y
        slip = v - stiffness * abs(v) * z / (f_c + f_d * math.exp(-((v / v_s) ** 2)))
        force = stiffness * z + damping * slip + viscous * v
        return [v, (SPRING * (PULL * t - x) - force) / MASS, slip]

    found = solve_ivp(rate, (0, 40), [0.0, 0.0, 0.0], "Radau", rtol=1e-7, atol=1e-11, max_step=0.1)
    published = period(found.t, found.y[1])
    assert published == pytest.approx(6.363, abs=2e-3)
    assert period(*stick_slip(1e-3)) == pytest.approx(published, rel=2e-3)
    assert period(*stick_slip(5e-3)) == pytest.approx(published, rel=0.02)


def breakaway(rate: float) -> float:
    """Largest friction of a 1 kg mass with a force that grows at this rate [N/s]."""
    count = round(2000.0 / min(rate, 2.0))
    step = 2.0 / rate / count
    push = (torch.arange(count, dtype=F64)[:, None] + 0.5) * step * rate
    start, law = torch.zeros(1, dtype=F64), LUGRE.memory
    model = LuGre(1, CLASSIC).requires_grad_(False)
    run = rollout(LinearAxis(1.0), model, start, start, push, sample_time=step)
    assert law is not None
    assert run.law_state is not None
    c = torch.tensor(CLASSIC, dtype=F64)
    return float(law.torque(run.law_state, run.qd, torch.ones_like(run.qd), c).max())


def test_breakaway_force_falls_with_the_force_rate() -> None:
    # Fig. 3 of Canudas de Wit et al.: from nearly F_s = 1.5 N down to nearly F_c = 1 N.
    slow, medium, fast = (breakaway(rate) for rate in (1.0, 10.0, 50.0))
    assert 1.35 < slow < 1.5
    assert 1.15 < medium < 1.3
    assert 0.99 < fast < 1.1


def test_friction_lags_behind_a_changing_velocity() -> None:
    # Higher while the velocity rises than while it falls, as Hess and Soom measured.
    law, c, dt = LUGRE.memory, torch.tensor(CLASSIC, dtype=F64), 1e-4
    assert law is not None
    t = torch.arange(4000, dtype=F64) * dt
    v = (1.5e-3 * (1.0 - 0.9 * torch.cos(2.0 * math.pi * 10.0 * t)))[:, None]
    one, state, found = torch.ones(1, dtype=F64), LUGRE.initial_state(v[0]), []
    for qd in v:
        state = law.advance(state, qd, one, c, dt)
        found.append(law.torque(state, qd, one, c))
    up, down = torch.stack(found[-1000:-500]), torch.stack(found[-500:]).flip(0)
    assert float((up - down)[50:450].min()) > 0.0
    assert float((up - down).max()) > 0.05


def test_true_law_with_memory_scores_well_on_its_recording() -> None:
    model = models()["lugre"]
    run = rollout(CHAIN, model, Q0, REST, sample_time=2e-3, steps=1000)
    recording = Recording(run.time.numpy(), run.q.numpy())
    own = score(CHAIN, model, recording, limit=False).free_run.all
    other = score(CHAIN, LFM(2, [3e-3, 0.03], v_smooth=0.1), recording, limit=False).free_run.all
    assert own < 1e-6
    assert other > 0.01


def test_a_model_file_keeps_the_law(tmp_path) -> None:  # type: ignore[no-untyped-def]
    model = MaxwellSlip(2, elements=3).requires_grad_(False)
    again = load(save(model, tmp_path / "slip.json"))
    assert again.law.name == "maxwell_slip_3"
    runs = [rollout(CHAIN, m, Q0, REST, steps=50).q for m in (model, again)]
    assert torch.equal(*runs)


def test_gradients_reach_the_coefficients() -> None:
    model = LuGre(2, SOFT)
    run = rollout(CHAIN, model, Q0, REST, steps=60, gradients=True, backend="auto")
    weight = torch.linspace(0.0, 1.0, run.q.numel(), dtype=F64).reshape(run.q.shape)
    (found,) = torch.autograd.grad((run.q * weight).sum(), model.schedule.raw)
    for j, k in ((0, 0), (1, 3), (0, 5)):
        values = []
        for sign in (1, -1):
            nudged = LuGre(2, SOFT).requires_grad_(False)
            nudged.schedule.raw[j, k] += sign * 1e-5
            values.append(float((rollout(CHAIN, nudged, Q0, REST, steps=60).q * weight).sum()))
        assert float(found[j, k]) == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-4)


def test_state_of_wrong_shape_is_refused() -> None:
    model = models()["lugre"]
    with pytest.raises(ValueError, match=r"`law_state` must be finite \(\*batch, 2, 1\)"):
        rollout(CHAIN, model, Q0, REST, steps=3, law_state=torch.zeros(2))
    with pytest.raises(ValueError, match="is for a friction law with memory"):
        rollout(CHAIN, LFM(2), Q0, REST, steps=3, law_state=torch.zeros(2, 1))
    with pytest.raises(ValueError, match="holds a joint by itself"):
        rollout(CHAIN, model, Q0, REST, steps=3, scheme="time_stepping")
