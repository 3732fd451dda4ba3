"""Laws with memory: exact, passive, without drift at rest, with closed hysteresis loops."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from torch import Tensor

from nfriction.fitting.fit import fit
from nfriction.friction import memory_names, model_by_name, model_name, plain_name
from nfriction.friction.laws import Law, Memory
from nfriction.friction.memory import DAHL, ELASTO_PLASTIC, GEAR, LUGRE, LuGre, maxwell_slip
from nfriction.plant.rigs import multiarm_single
from nfriction.recording import Recording

LAWS = (DAHL, GEAR, LUGRE, ELASTO_PLASTIC, maxwell_slip(1), maxwell_slip(4))
every_law = pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
# F_c, F_d, v_s, sigma_0, sigma_1, sigma_2 of the LuGre paper, in N m and rad.
CLASSIC = [1.0, 0.5, 0.001, 1e5, math.sqrt(1e5), 0.4]
TYPICAL = {
    "dahl": [1.0, 0.1, 1e3],
    "gear": [0.6, 0.4, 0.9, 0.1, 1e3],
    "lugre": CLASSIC,
    "elasto_plastic": [*CLASSIC, 0.7],
    "maxwell_slip_1": [500.0, 2e-3, 0.1, 0.5, 0.01],
    "maxwell_slip_4": [400.0, 200.0, 100.0, 50.0, 1e-4, 3e-4, 1e-3, 3e-3, 0.1, 0.5, 0.01],
}


def memory(law: Law) -> Memory:
    assert law.memory is not None
    return law.memory


def typical(law: Law) -> Tensor:
    return torch.tensor(TYPICAL[law.name], dtype=torch.float64)


def stored(law: Law, state: Tensor, coefficients: Tensor) -> Tensor:
    """Energy of the deflections."""
    at = law.names.index("k_1" if "k_1" in law.names else "sigma_0")
    stiffness = coefficients[..., at : at + law.state_size]
    return (0.5 * stiffness * state.square()).sum(-1)


def driven(law: Law, path: Tensor, coefficients: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """States and torques along positions (sample,)."""
    own, load = memory(law), torch.ones(1, dtype=torch.float64)
    state = law.initial_state(load)
    states, torques = [state], []
    for qd in (path.diff() / dt)[:, None]:
        state = own.advance(state, qd, load, coefficients, dt)
        states.append(state)
        torques.append(own.torque(state, qd, load, coefficients))
    return torch.stack(states)[:, 0], torch.stack(torques)[:, 0]


def held(law: Law, state: Tensor, qd: float, dt: float, c: Tensor) -> Tensor:
    v = torch.full(state.shape[:-1], qd, dtype=torch.float64)
    return memory(law).advance(state, v, torch.ones_like(v), c, dt)


@every_law
def test_no_energy_is_injected_from_a_million_random_states(law: Law) -> None:
    generator = torch.Generator().manual_seed(0)
    count = 1_000_000

    def spread(low: float, high: float, *shape: int) -> Tensor:
        x = torch.rand(count, 1, *shape, generator=generator, dtype=torch.float64)
        return 10.0 ** (low + (high - low) * x)

    coefficients = spread(-4.0, 4.0, len(law.names))
    sign = torch.rand(count, 1, generator=generator, dtype=torch.float64).sub(0.5).sign()
    qd, dt = sign * spread(-6.0, 3.0), spread(-6.0, 0.0)
    state = spread(-8.0, 2.0, law.state_size) * torch.randn(
        count, 1, law.state_size, generator=generator, dtype=torch.float64
    )
    # Of either sign, as a gear's load is: it may change arbitrarily from sample to sample.
    load = sign.roll(1) * spread(-3.0, 3.0)
    after = memory(law).advance(state, qd, load, coefficients, dt)
    work = memory(law).torque(after, qd, load, coefficients) * qd * dt
    before, now = stored(law, state, coefficients), stored(law, after, coefficients)
    excess = work - (now - before)
    assert (excess >= -1e-12 * (work.abs() + now + before)).all()


@every_law
@given(data=st.data())
def test_no_energy_is_injected_along_a_motion(law: Law, data: st.DataObject) -> None:
    c = torch.tensor(
        [[10.0 ** data.draw(st.floats(-6, 6)) for _ in law.names]], dtype=torch.float64
    )
    deflections = [data.draw(st.floats(-1e3, 1e3)) for _ in range(law.state_size)]
    state = torch.tensor([deflections], dtype=torch.float64)
    qd = torch.tensor([data.draw(st.floats(-1e4, 1e4))], dtype=torch.float64)
    dt, load = 10.0 ** data.draw(st.floats(-6, 0)), torch.full_like(qd, data.draw(st.floats(-9, 9)))
    after = memory(law).advance(state, qd, load, c, dt)
    work = memory(law).torque(after, qd, load, c) * qd * dt
    before, now = stored(law, state, c), stored(law, after, c)
    assert torch.isfinite(after).all()
    assert work - (now - before) >= -1e-12 * (work.abs() + now + before)


@every_law
@pytest.mark.parametrize("qd", [2e-3, -2e-3, 1e-5, 0.5])
def test_constant_velocity_within_a_sample_is_solved_exactly(law: Law, qd: float) -> None:
    # From a deflection against the motion, through the elastic range into sliding.
    c, own = typical(law), memory(law)
    start = torch.full((1, law.state_size), -2e-6 * math.copysign(1.0, qd), dtype=torch.float64)
    one, v = torch.ones(1, dtype=torch.float64), torch.full((1,), qd, dtype=torch.float64)
    count = law.state_size

    def rate(t: float, z: np.ndarray) -> np.ndarray:
        if law.name.startswith("maxwell"):
            d, rise, v_s = (c[count : 2 * count].numpy(), float(c[-2]), float(c[-1]))
            limit = d * (1.0 + rise * math.exp(-((qd / v_s) ** 2)))
            return np.where(z * math.copysign(1.0, qd) >= limit, 0.0, qd)
        if law.name == "dahl":
            return qd - float(c[2]) * abs(qd) * z / float(c[0])
        if law is GEAR:
            bound = float(c[0] + (c[1] if qd > 0 else c[2]))
            return qd - float(c[4]) * abs(qd) * z / bound
        f_c, f_d, v_s, stiffness = (float(x) for x in c[:4])
        settled = (f_c + f_d * math.exp(-((qd / v_s) ** 2))) / stiffness
        y = z * math.copysign(1.0, qd)
        share = 1.0
        if law is ELASTO_PLASTIC:
            elastic = float(c[6]) * f_c / stiffness
            share = np.maximum((y - elastic) / (settled - elastic), 0.0)
        return qd * (1.0 - share * y / settled)

    duration = 3e-5 / abs(qd)
    solved = solve_ivp(
        rate, (0.0, duration), start[0].numpy(), method="Radau", rtol=1e-10, atol=1e-14,
        max_step=duration / 50,
    )  # fmt: skip
    once = own.advance(start, v, one, c, duration)
    np.testing.assert_allclose(once[0].numpy(), solved.y[:, -1], rtol=1e-6)
    # A sample cut in pieces is the same motion.
    state = start
    for _ in range(7):
        state = own.advance(state, v, one, c, duration / 7)
    torch.testing.assert_close(state, once, rtol=1e-10, atol=1e-18)


@every_law
def test_a_joint_at_rest_keeps_its_state(law: Law) -> None:
    c = typical(law)
    state = torch.full((1, law.state_size), 3e-6, dtype=torch.float64)
    assert torch.equal(held(law, state, 0.0, 10.0, c), state)


@every_law
def test_constant_velocity_converges_to_the_steady_torque(law: Law) -> None:
    c, own, one = typical(law), memory(law), torch.ones(1, dtype=torch.float64)
    for qd in (-0.3, 1e-3, 0.02):
        v = torch.full((1,), qd, dtype=torch.float64)
        state = own.advance(law.initial_state(v), v, one, c, 100.0)
        torch.testing.assert_close(
            own.torque(state, v, one, c), law.torque(v, one, c, 1e-9), rtol=1e-9, atol=0.0
        )


@pytest.mark.parametrize(
    "law", [pytest.param(ELASTO_PLASTIC, marks=pytest.mark.slow), maxwell_slip(4)],
    ids=lambda law: law.name,
)  # fmt: skip
def test_oscillating_load_below_breakaway_does_not_creep(law: Law) -> None:
    # Slowly to half the smallest breakaway, then sixty small swings: an elastic contact ends where
    # it began, a LuGre bristle slips a little with each swing.
    reach = 0.5 * (0.7e-5 if law is ELASTO_PLASTIC else 1e-4)
    swing = 0.5 * torch.sin(2.0 * math.pi * torch.arange(1, 41, dtype=torch.float64) / 40)
    rise = torch.linspace(0.0, 1.0, 100, dtype=torch.float64)
    path = reach * torch.cat([rise, 1.0 + swing.repeat(60)])
    states, _ = driven(law, path, typical(law), 1.0)
    torch.testing.assert_close(states[-1], states[99], rtol=1e-9, atol=1e-15)
    slipped, _ = driven(LUGRE, path, typical(LUGRE), 1.0)
    assert float(slipped[99] - slipped[-1]) > 0.05 * float(slipped[99])


def test_closed_inner_loops_return_to_the_point_they_left() -> None:
    # Non-local memory: after an inner loop the outer branch continues as if there were none.
    law = maxwell_slip(4)
    outer = torch.linspace(0.0, 4e-3, 401, dtype=torch.float64)
    inner = torch.cat([outer[:201], outer[120:200].flip(0), outer[121:201], outer[201:]])
    _, plain = driven(law, outer, typical(law), 1.0)
    _, looped = driven(law, inner, typical(law), 1.0)
    torch.testing.assert_close(looped[-200:], plain[-200:], rtol=1e-9, atol=1e-12)
    assert (looped[200:280] < plain[119:199].flip(0)).all()  # below: the loop dissipates


@every_law
def test_a_stiff_contact_is_stable_at_a_millisecond(law: Law) -> None:
    # An explicit step has an amplification of sigma_0 |qd| dt / g, here 500.
    c, dt = typical(law), 1e-3
    t = torch.arange(2000, dtype=torch.float64) * dt
    path = 0.05 * torch.sin(2 * math.pi * 2 * t)
    states, torques = driven(law, path, c, dt)
    v = path.diff() / dt
    most = law.torque(torch.full((1,), 1e-9), torch.ones(1), c, 1e-15).abs() + 3.0 * v.abs().max()
    assert torch.isfinite(states).all()
    assert (torques.abs() <= most).all()


@every_law
def test_zero_coefficients_give_finite_torques(law: Law) -> None:
    c = torch.full((1, len(law.names)), 1e-12, dtype=torch.float64)
    for qd in (-1.0, 0.0, 1e-9, 5.0):
        v, one = torch.full((1,), qd, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
        state = memory(law).advance(law.initial_state(v), v, one, c, 1e-3)
        assert torch.isfinite(memory(law).torque(state, v, one, c)).all()


@every_law
def test_batches_broadcast_and_gradients_are_finite_at_rest(law: Law) -> None:
    c = typical(law).expand(3, -1).clone().requires_grad_()
    state = torch.zeros(5, 2, 3, law.state_size, dtype=torch.float64, requires_grad=True)
    qd = torch.tensor([0.0, 1e-3, -2.0], dtype=torch.float64).expand(5, 2, 3).clone()
    qd.requires_grad_()
    load = torch.ones_like(qd)
    after = memory(law).advance(state, qd, load, c, 1e-3)
    assert after.shape == state.shape
    torque = memory(law).torque(after, qd, load, c)
    assert torque.shape == qd.shape
    slopes = torch.autograd.grad(torque.sum(), (state, qd, c))
    assert all(torch.isfinite(x).all() for x in slopes)
    # At rest the contact is a spring: over a sample its slope is the stiffness times the sample
    # time.
    stiffness = stored(law, torch.ones(law.state_size), typical(law)) * 2.0
    assert (slopes[1][..., 0] >= 0.99e-3 * stiffness).all()


def test_invalid_number_of_elements_is_refused() -> None:
    for elements in (0, 2.5, 101):
        with pytest.raises(ValueError, match="`elements` must be a whole number from 1 to 100"):
            maxwell_slip(elements)  # type: ignore[arg-type]


def test_models_with_memory_have_names() -> None:
    for name in memory_names():
        kind = model_by_name(name)
        assert kind.__name__ == name
        assert kind is model_by_name(plain_name(name))
        assert model_name(plain_name(name).upper()) == name
        assert kind(3).law.state_size == kind(3).law_state_size > 0


def test_parts_without_hidden_state_refuse_laws_with_memory() -> None:
    model, rest = LuGre(1), torch.zeros(1, dtype=torch.float64)
    with pytest.raises(ValueError, match="has an internal state"):
        model(rest, rest, rest)
    recording = Recording(np.arange(100) * 0.01, np.zeros((100, 1)))
    with pytest.raises(ValueError, match=r"is for tables of torque.*to motions fit maxwell-slip"):
        fit("slip", multiarm_single(), recording)
