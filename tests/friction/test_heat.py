"""Friction that falls with the heat of its joint."""

import math

import pytest
import torch

from nfriction import CVFM, NFCVFM, load, rollout, save
from nfriction.friction.heat import HeatedConstant
from nfriction.friction.inputs import with_inputs
from nfriction.friction.laws import COULOMB_VISCOUS
from nfriction.friction.models import FrictionModel
from nfriction.io.model_file import ModelFileError
from nfriction.simulation.protocols import at_sample_time
from tests.fitting.recordings import pendulum
from tests.friction.samples import motion, warming_network

F64 = torch.float64
LAW = with_inputs(COULOMB_VISCOUS, ["direction", "load", "heat"])
STEP = 2e-3


def warming(fall: float = 0.8) -> FrictionModel:
    values = [[5e-3, 1e-3, 1e-3, 2e-3, fall, 0.0], [2e-3, 5e-4, -5e-4, 1e-3, 0.5 * fall, 0.0]]
    schedule = HeatedConstant(LAW, 2, values)
    schedule.set_heat([2e-2, 1e-2], 3.0, STEP)
    return FrictionModel(LAW, schedule, 0.02).requires_grad_(False)


@pytest.mark.parametrize("make", [warming, warming_network])
def test_heat_along_a_motion_equals_stepping_its_samples(make) -> None:
    model, (qd, qdd, _) = make(), motion(300, 2)
    state = model.initial_state(qd[0], qdd[0])
    assert not state.any()
    rows = [state]
    for k in range(1, len(qd)):
        rows.append(model.advance(qd[k], qdd[k], rows[-1]))
    torch.testing.assert_close(model.schedule.states(qd, qdd), torch.stack(rows))


def test_constant_power_heats_a_joint_to_equilibrium() -> None:
    schedule = HeatedConstant(with_inputs(COULOMB_VISCOUS, ["heat"]), 1, [0.2, 0.1, 0.0, 0.0])
    schedule.set_heat(0.5, 0.3, STEP)
    speed = torch.full((2000, 1), 3.0, dtype=F64)
    power = 3.0 * (0.2 + 0.1 * 3.0)
    heat = schedule.states(speed, 0.0 * speed)[-1]
    # The sum of a geometric series, which tends to P T / C as the step tends to zero.
    expected = STEP / 0.5 * power / (1.0 - math.exp(-STEP / 0.3))
    assert float(heat) == pytest.approx(expected, rel=1e-3)
    assert expected == pytest.approx(power * 0.3 / 0.5, rel=0.01)


@pytest.mark.parametrize("make", [warming, warming_network])
def test_friction_falls_exponentially_with_heat(make) -> None:
    model, (qd, qdd, normal) = make(), motion(50, 2)
    cold = model(qd, qdd, normal)
    heat = torch.full((50, 2, 1), 0.7, dtype=F64)
    held = model.coefficients_from(qd, qdd, heat)
    fall = torch.exp(-0.7 * held[..., -2])
    assert ((fall < 1) & (fall > 0)).all()
    torch.testing.assert_close(model.torque(qd, normal, held), fall * cold)


@pytest.mark.slow
def test_compiled_and_eager_heat_agree_and_dissipate_less_than_cold() -> None:
    start = torch.tensor([2.0, 0.5], dtype=F64)
    plant = pendulum(normal_load="bearing")
    given = {"sample_time": STEP, "steps": 1500, "gradients": False}
    runs = [
        rollout(plant, warming(), start, 0 * start, backend=backend, **given)
        for backend in ("compiled", "torch")
    ]
    torch.testing.assert_close(runs[0].q, runs[1].q, rtol=0, atol=1e-10)
    cold = rollout(plant, warming(0.0), start, 0 * start, **given)
    late = slice(1200, None)
    assert runs[0].qd[late].square().sum() > 1.1 * cold.qd[late].square().sum()


def test_motion_continues_with_its_last_heat() -> None:
    plant, model = pendulum(normal_load="bearing"), warming()
    start = torch.tensor([2.0, 0.5], dtype=F64)
    given = {"sample_time": STEP, "gradients": False}
    whole = rollout(plant, model, start, 0 * start, steps=1000, **given)
    heat = model.schedule.states(whole.qd, whole.qdd)
    half = rollout(plant, model, whole.q[500], whole.qd[500], steps=500,
                   hidden_state=heat[500], **given)  # fmt: skip
    # The acceleration of the first sample differs, and heat does not use it.
    torch.testing.assert_close(half.q[-1], whole.q[-1], rtol=0, atol=1e-9)


def test_heat_uses_the_time_stamps() -> None:
    model, (qd, qdd, _) = warming(), motion(300, 2)
    time = STEP * torch.arange(300, dtype=F64)
    regular = model.schedule.states(qd, qdd)
    torch.testing.assert_close(model.schedule.states(qd, qdd, time), regular)
    # Joints cool in a gap of 4 s.
    late = time + 4.0 * (torch.arange(300) >= 200)
    found = model.schedule.states(qd, qdd, late)
    torch.testing.assert_close(found[:200], regular[:200])
    assert (found[200] < 1.3 * math.exp(-4.0 / 3.0) * regular[199]).all()
    # At half the rate the same samples last twice as long.
    slow = model.schedule.states(qd, qdd, 2 * time)
    torch.testing.assert_close(slow, at_sample_time(model.schedule, 2 * STEP).states(qd, qdd))
    assert (slow[-1] > 1.2 * regular[-1]).all()


def test_simulated_heat_is_independent_of_the_sample_time() -> None:
    plant, model = pendulum(normal_load="bearing"), warming()
    start = torch.tensor([2.0, 0.5], dtype=F64)
    ends = [
        rollout(plant, model, start, 0 * start, sample_time=step, steps=round(2.0 / step)).q[-1]
        for step in (STEP, 0.5 * STEP, 1.25 * STEP)
    ]
    cold = rollout(plant, warming(0.0), start, 0 * start, sample_time=STEP, steps=1000).q[-1]
    assert (cold - ends[0]).abs().max() > 0.05
    for end in ends[1:]:
        torch.testing.assert_close(end, ends[0], rtol=0, atol=2e-3)
    assert model.schedule.sample_time == pytest.approx(STEP)
    model.requires_grad_(True)
    run = rollout(plant, model, start, 0 * start, sample_time=1e-3, steps=50)
    run.q[-1].sum().backward()
    assert sum(p.grad.abs().sum() for p in model.parameters()) > 0


def test_negative_dissipation_does_not_cool() -> None:
    law = with_inputs(COULOMB_VISCOUS, ["direction", "heat"])
    schedule = HeatedConstant(law, 1, [0.02, 0.0, 2.0, 0.5, 0.0])
    schedule.set_heat(0.01, 1.0, STEP)
    backwards = -torch.ones(400, 1, dtype=F64)
    assert not schedule.states(backwards, 0 * backwards).any()
    assert not schedule.advance(backwards[0], backwards[0], torch.zeros(1, 1, dtype=F64)).any()


def test_heat_coefficient_of_a_cold_joint_is_kept() -> None:
    model = NFCVFM(1, inputs=["heat"])
    model.schedule.set_reference(
        torch.tensor([[1.0, 0.1, 1e-12, 0.0]], dtype=F64),
        torch.tensor([[2000.0, 500.0, 0.0, 0.0]], dtype=F64),
    )
    assert float(model.schedule.reference_coefficients()[0, 2]) < 2e-6


def test_model_file_keeps_the_heat_settings(tmp_path) -> None:
    model = warming_network()
    again = load(save(model, tmp_path / "m.json"))
    assert again.schedule.heat_capacity.tolist() == pytest.approx([3.0, 4.0])
    assert again.schedule.cooling_time == pytest.approx(2.0)
    qd, qdd, _ = motion(40, 2)
    assert torch.equal(again.schedule.states(qd, qdd), model.schedule.states(qd, qdd))


def test_a_model_file_whose_heat_overflows_is_refused(tmp_path) -> None:
    model = warming_network()
    model.schedule.log_heat_capacity.fill_(-800.0)
    with pytest.raises(ModelFileError, match="a torque that is not finite"):
        load(save(model, tmp_path / "m.json"))


@pytest.mark.parametrize("given", [(0.0, 1.0, 1.0), (1.0, math.nan, 1.0), (1.0, 1.0, -1.0)])
def test_heat_constants_must_be_positive(given) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        warming().schedule.set_heat(*given)


def test_initial_values_of_heat_coefficients_may_be_omitted() -> None:
    model = NFCVFM(2, [0.1, 0.2], inputs=["load", "heat"])
    expected = torch.tensor([0.1, 0.2, 0.0, 0.0, 0.0], dtype=F64).expand(2, -1)
    found = model.schedule.reference_coefficients()
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match=r"got shape \(1,\)"):
        NFCVFM(2, [0.1], inputs=["heat"])


def test_a_capacity_for_another_number_of_joints_is_refused() -> None:
    with pytest.raises(ValueError, match=r"1 number or 2, got shape \(3,\)"):
        warming().schedule.set_heat([1.0, 2.0, 3.0], 1.0, 1.0)


@pytest.mark.parametrize("name", ["heat", "position"])
def test_paper_network_refuses_inputs_that_need_a_fit(name) -> None:
    with pytest.raises(ValueError, match=f'"{name}" needs `network="anfis"`'):
        NFCVFM(1, network="rbf", inputs=[name])


def test_without_heat_there_is_no_hidden_state() -> None:
    assert NFCVFM(2, inputs=["load"]).state_size == CVFM(2).state_size == 0
