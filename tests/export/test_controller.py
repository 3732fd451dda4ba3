"""The contract: model within range, its edge outside, NaN for broken inputs, limits, states."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from nfriction.export.controller import NOT_FINITE, OUTSIDE, SATURATED, controller_of
from nfriction.friction.models import LFM
from nfriction.friction.neurofuzzy import NFLFM
from nfriction.io.model_file import ModelInfo
from nfriction.signals import SecondOrderLowPass
from tests.export.artefacts import INFO, rising
from tests.friction.samples import motion, named_models

MODELS = named_models()
STATELESS = [name for name, model in MODELS.items() if not model.state_size]
ADAPTIVE = [name for name in MODELS if name not in STATELESS]


@pytest.mark.parametrize("name", STATELESS)
def test_controller_equals_the_model_at_clamped_inputs(name: str) -> None:
    model = MODELS[name]
    qd, qdd, load = motion(500, 3)
    tau_f, coefficients, status = controller_of(model, INFO)(qd, qdd, load)
    torch.testing.assert_close(tau_f, model(qd, qdd, load), rtol=0, atol=0)
    expected = model.coefficients(qd, qdd).expand_as(coefficients)
    torch.testing.assert_close(coefficients, expected, rtol=0, atol=0)
    ranges = {key: torch.tensor(INFO.input_ranges[key]) for key in ("qd", "qdd")}
    outside = torch.zeros_like(status, dtype=torch.bool)
    for x, edges in ((qd, ranges["qd"]), (qdd, ranges["qdd"])):
        outside |= (x < edges[:, 0]) | (x > edges[:, 1])
    assert torch.equal(status == OUTSIDE, outside)
    assert torch.equal(status == 0, ~outside)


def test_only_schedule_inputs_are_clamped_not_those_of_the_law() -> None:
    model = rising()
    controller = controller_of(model, INFO)
    qd, qdd, load = motion(500, 3, seed=2)
    tau_f, coefficients, status = controller(3 * qd, 3 * qdd, load)
    low, high = torch.tensor(INFO.input_ranges["qd"], dtype=qd.dtype).unbind(-1)
    edge = model.coefficients((3 * qd).clamp(low, high), (3 * qdd).clamp(-150.0, 150.0))
    torch.testing.assert_close(coefficients, edge)
    torch.testing.assert_close(tau_f, model.torque(3 * qd, load, edge))
    assert (status == OUTSIDE).any()
    # Without ranges nothing is clamped.
    free, _, status = controller_of(model)(3 * qd, 3 * qdd, load)
    torch.testing.assert_close(free, model(3 * qd, 3 * qdd, load))
    assert not status.any()


@pytest.mark.parametrize("name", STATELESS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("which", range(3))
def test_non_finite_inputs_affect_only_their_joint(name: str, bad: float, which: int) -> None:
    inputs = motion(4, 3)
    controller = controller_of(MODELS[name], INFO, torque_limit=100.0)
    sound = controller(*inputs)
    inputs[which][2, 1] = bad
    tau_f, coefficients, status = controller(*inputs)
    hit = torch.zeros_like(tau_f, dtype=torch.bool)
    hit[2, 1] = True
    assert torch.equal(torch.isnan(tau_f), hit)
    assert torch.equal(torch.isnan(coefficients).all(-1), hit)
    assert torch.equal(status == NOT_FINITE, hit)
    for ours, theirs in zip((tau_f, coefficients, status), sound, strict=True):
        torch.testing.assert_close(ours[~hit], theirs[~hit])
    torque = controller.torque(*inputs)
    torch.testing.assert_close(torque, tau_f, equal_nan=True)


def test_overflowing_torque_is_not_returned() -> None:
    model = LFM(1, [1.0, 1.0])
    huge = torch.full((1,), 1e308, dtype=torch.float64)
    tau_f, _, status = controller_of(model)(10 * huge / 10, 0 * huge, huge)
    assert torch.isnan(tau_f).all()
    assert status == NOT_FINITE


def test_torque_saturates_and_sets_the_status_bit() -> None:
    model = MODELS["NFLFM"]
    inputs = motion(500, 3)
    free = model(*inputs)
    limit = free.abs().median(0).values
    tau_f, _, status = controller_of(model, torque_limit=limit.tolist())(*inputs)
    torch.testing.assert_close(tau_f, torch.clamp(free, -limit, limit))
    assert torch.equal(status == SATURATED, free.abs() > limit)


def test_any_batch_shape() -> None:
    controller = controller_of(MODELS["NFNLFM"], INFO)
    flat = controller(*motion(24, 3))
    shaped = controller(*(x.reshape(2, 3, 4, 3) for x in motion(24, 3)))
    for a, b in zip(flat, shaped, strict=True):
        torch.testing.assert_close(b.flatten(0, 2), a)
    assert flat[2].dtype == torch.int32


@pytest.mark.parametrize("name", ADAPTIVE)
def test_hidden_state_advances_and_survives_nan(name: str) -> None:
    model = MODELS[name]
    schedule = model.schedule
    controller = controller_of(model)
    assert controller.inputs == ("qd", "qdd", "load")
    qd, qdd, load = motion(60, 3)
    state = memory = controller.start(qd[0], qdd[0], load[0])
    torch.testing.assert_close(state, schedule.initial_state(qd[0], qdd[0]))
    for k in range(60):
        tau_f, coefficients, _, state = controller(qd[k], qdd[k], load[k], state)
        memory = schedule.advance(qd[k], qdd[k], memory)
        expected = schedule.coefficients_from(qd[k], qdd[k], memory)
        torch.testing.assert_close(coefficients, expected)
        torch.testing.assert_close(tau_f, model.torque(qd[k], load[k], expected))
        broken = qdd[k].clone()
        broken[1] = math.nan
        tau_f, _, status, after = controller(qd[k], broken, load[k], state)
        assert status.tolist() == [0, NOT_FINITE, 0]
        torch.testing.assert_close(after[1], state[1])


def test_filter_equals_that_of_signals_on_differences() -> None:
    model = MODELS["NFLFM"]
    controller = controller_of(model, INFO, with_filter=True, cutoff_hz=30.0)
    assert controller.inputs == ("q", "load")
    time = 1e-3 * np.arange(400)
    q = np.sin(9 * time)[:, None] * [1.0, 0.5, 2.0]
    load = torch.ones(400, 3, dtype=torch.float64)
    low_pass = SecondOrderLowPass(30.0, 1e-3)

    def difference(x: np.ndarray, before: np.ndarray) -> np.ndarray:
        return np.diff(x, axis=0, prepend=before) / 1e-3

    qd = low_pass(difference(q, q[:1]))
    qdd = low_pass(difference(qd, np.zeros((1, 3))))
    expected = model(torch.as_tensor(qd), torch.as_tensor(qdd), load)
    state = controller.start(torch.as_tensor(q[0]), load[0])
    for k in range(400):
        tau_f, _, _, state = controller(torch.as_tensor(q[k]), load[k], state)
        # Accelerations are differences of differences over 1e-6 s^2.
        torch.testing.assert_close(tau_f, expected[k], rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("name", ["LFM", "ALFM"])
@pytest.mark.parametrize("lost", [1, 100])
def test_the_filter_survives_lost_samples(name: str, lost: int) -> None:
    """At a constant velocity, which is the same before and after the gap."""
    controller = controller_of(MODELS[name], INFO, with_filter=True)
    assert controller.inputs == ("q", "load")
    qd = torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64)
    q = math.pi + qd * INFO.sample_time * torch.arange(600, dtype=torch.float64).unsqueeze(-1)
    q[400 : 400 + lost, 0] = math.inf
    q[0, 1] = math.nan  # an encoder that is not ready yet
    tau_f, _, status = controller.run(q, torch.ones_like(q))
    # A velocity needs two successive positions.
    bad = torch.zeros_like(status, dtype=torch.bool)
    bad[400 : 401 + lost, 0] = bad[:2, 1] = True
    assert torch.equal(status == NOT_FINITE, bad)
    assert torch.equal(torch.isnan(tau_f), bad)
    settled = tau_f[399]
    torch.testing.assert_close(tau_f[401 + lost :], settled.expand(599 - lost - 400, 3))
    # A lost load does not stop the filter.
    state = controller.start(q[300], settled)
    *_, after = controller(q[301], settled * math.nan, state)
    *_, sound = controller(q[301], settled, state)
    torch.testing.assert_close(after, sound)


def test_model_is_copied_and_not_modified() -> None:
    model = NFLFM(2).to(torch.float32).train()
    controller = controller_of(model)
    assert model.training
    assert all(p.requires_grad and p.dtype == torch.float32 for p in model.parameters())
    assert all(p.dtype == torch.float64 for p in controller.parameters())


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"qd": [[-1.0, 1.0]]}, "each of 2 joints"),
        ({"qdd": [[1.0, -1.0]] * 2}, "lowest, highest"),
        ({"qd": [[math.nan, 1.0]] * 2}, "lowest, highest"),
        ({"qd": "wide"}, "must be numbers"),
        ({"qd": [[False, True]] * 2}, "must be numbers"),
        ({"qd": [[-(10**400), 1.0]] * 2}, "too large"),
        ({"qd": [[1.0]] * 2}, "lowest, highest"),
    ],
)
def test_malformed_ranges_are_refused(ranges: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        controller_of(LFM(2), ModelInfo(input_ranges=ranges))


LIMITS = [0.0, -1.0, math.nan, math.inf, [1.0, 2.0, 3.0], True, [1.0, True], 10**400, "1"]


@pytest.mark.parametrize("limit", LIMITS)
def test_malformed_limits_are_refused(limit: Any) -> None:
    with pytest.raises(ValueError, match="torque_limit"):
        controller_of(LFM(2), torque_limit=limit)


@pytest.mark.parametrize("step", [0, 0.0, -1e-3, math.nan, math.inf, True, "1", 10**400])
def test_malformed_sample_times_and_cutoffs_are_refused(step: Any) -> None:
    with pytest.raises(ValueError, match="sample_time"):
        ModelInfo(sample_time=step)
    with pytest.raises(ValueError, match="cutoff_hz"):
        controller_of(LFM(2), ModelInfo(sample_time=1e-3), with_filter=True, cutoff_hz=step)


@pytest.mark.parametrize("name", ["LFM", "NFLFM", "ALFM"])
@pytest.mark.parametrize("with_filter", [False, True])
def test_empty_batch_gives_no_torques(name: str, with_filter: bool) -> None:
    controller = controller_of(MODELS[name], INFO, with_filter=with_filter)
    none = torch.zeros(0, 3, dtype=torch.float64)
    found = controller.run(*[none] * len(controller.inputs))
    assert [len(x) for x in found] == [0, 0, 0]


def test_missing_sample_time_and_wrong_joint_counts_are_refused() -> None:
    with pytest.raises(ValueError, match="sample_time"):
        controller_of(LFM(2), with_filter=True)
    with pytest.raises(ValueError, match="with 2 joints, got last axis 3"):
        controller_of(LFM(2))(*motion(4, 3))
