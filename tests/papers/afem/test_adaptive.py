"""Classes follow the acceleration with hysteresis and without look-ahead."""

import json

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nfriction.friction.laws import LINEAR, NONLINEAR
from nfriction.papers.afem.adaptive import ALFM, Adaptive, peak_envelope
from tests.friction.samples import motion, normal

F64 = torch.float64
LOW, MEDIUM, HIGH = 0, 1, 2


def schedule(joints: int = 1, **options) -> Adaptive:
    """Coefficients whose digits identify their class; thresholds at 10 and 100 rad/s^2."""
    table = torch.tensor([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0]], dtype=F64)
    made = Adaptive(LINEAR, joints, table.expand(joints, 3, 2), **options)
    made.set_classes([10.0, 100.0])
    return made


def stepped(made: Adaptive, qd: torch.Tensor, qdd: torch.Tensor) -> torch.Tensor:
    """Hidden state after every sample by successive calls of `advance`."""
    return super(Adaptive, made).states(qd, qdd)


@pytest.mark.parametrize(("size", "known"), [(0.0, LOW), (9.9, LOW), (10.1, MEDIUM), (101.0, HIGH)])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_class_contains_the_acceleration(size: float, known: int, sign: float) -> None:
    made, qd = schedule(), torch.zeros(1, dtype=F64)
    qdd = torch.tensor([sign * size], dtype=F64)
    expected = torch.tensor([[known + 1.0, 10.0 * (known + 1)]], dtype=F64)
    torch.testing.assert_close(made(qd, qdd).detach(), expected)
    # The first sample is reached forwards.
    state = made.initial_state(qd, qdd)
    assert torch.equal(made.coefficients_from(qd, qdd, state), made(qd, qdd))


def test_vectorised_states_equal_stepped_ones() -> None:
    made = schedule(3, time_constant=0.02, sample_time=1e-3)
    made.set_classes([[3.0, 30.0], [10.0, 10.0], [1.0, 200.0]], [2.0, 0.0, 5.0])
    qd, qdd, _ = motion(2000, 3)
    qdd[300:700] *= 1e-3
    found, expected = made.states(qd, qdd), stepped(made, qd, qdd)
    # A running maximum of logarithms rounds like its largest term.
    torch.testing.assert_close(found[..., 0], expected[..., 0], rtol=1e-11, atol=0)
    assert torch.equal(found[..., 1], expected[..., 1])
    assert set(found[..., 1].unique().tolist()) == {0.0, 1.0, 2.0}


def test_peak_decays_with_the_time_constant() -> None:
    made = schedule(time_constant=0.5, sample_time=0.01)
    qdd = torch.zeros(101, 1, dtype=F64)
    qdd[0] = 90.0
    envelope = made.states(torch.zeros_like(qdd), qdd)[:, 0, 0]
    exact = 90.0 * torch.exp(-0.01 / 0.5 * torch.arange(101, dtype=F64))
    torch.testing.assert_close(envelope, exact, rtol=1e-12, atol=0)
    torch.testing.assert_close(peak_envelope(qdd.abs(), made.fading)[:, 0], exact)


def test_hysteresis_prevents_chatter() -> None:
    ripple = 10.0 + torch.sin(torch.arange(400, dtype=F64))[:, None]
    changes = {}
    for hysteresis in (0.0, 0.2):
        # The memory is shorter than the ripple, so the envelope contains all of it.
        made = schedule(hysteresis=hysteresis, time_constant=1e-4)
        known = made.classes(torch.zeros_like(ripple), ripple)
        changes[hysteresis] = int((known[1:] != known[:-1]).sum())
    assert changes[0.0] > 50
    assert changes[0.2] == 0


def test_a_class_is_entered_above_and_left_below_its_threshold() -> None:
    made = schedule(hysteresis=0.2, time_constant=1e-4)
    sizes = [5.0, 11.9, 12.1, 11.0, 9.0, 8.4, 8.2, 119.0, 121.0, 90.0, 84.0, 83.0, 1.0]
    qdd = torch.tensor(sizes, dtype=F64)[:, None]
    known = made.classes(torch.zeros_like(qdd), qdd)[:, 0].tolist()
    assert known == [0, 0, 1, 1, 1, 1, 0, 1, 2, 2, 2, 1, 0]


@given(cut=st.integers(1, 299))
def test_classes_do_not_depend_on_future_samples(cut: int) -> None:
    made = schedule(2, time_constant=0.05)
    qd, qdd, _ = motion(300, 2)
    other = torch.cat([qdd[:cut], 1e3 * normal(300 - cut, 2, seed=9)])
    before, after = made.states(qd, qdd)[:cut], made.states(qd, other)[:cut]
    assert torch.equal(before[..., 1], after[..., 1])


def test_single_outlier_does_not_hold_the_class_for_long() -> None:
    made = schedule(time_constant=1.0, sample_time=1e-2)
    qdd = torch.full((400, 1), 1.0, dtype=F64)
    qdd[0] = torch.inf
    known = made.classes(torch.zeros_like(qdd), qdd)[:, 0]
    # From four thresholds down to one over the band: ln(4 * 1.2) time constants.
    assert int((known == HIGH).sum()) == pytest.approx(157, abs=2)


def test_lost_sample_keeps_the_hidden_state() -> None:
    made, zero = schedule(), torch.zeros(1, dtype=F64)
    state = made.initial_state(zero, torch.tensor([50.0], dtype=F64))
    nan = torch.tensor([torch.nan], dtype=F64)
    after = made.advance(zero, nan, state)
    torch.testing.assert_close(after[0], torch.tensor([50.0 * float(made.fading), 1.0], dtype=F64))
    assert torch.isfinite(made.initial_state(nan, nan)).all()


def test_start_at_full_speed_is_classified_by_the_swing_rate() -> None:
    made = schedule()
    zero, fast = torch.zeros(1, dtype=F64), torch.tensor([8.0], dtype=F64)
    assert float(made.initial_state(fast, zero)[0, 1]) == LOW
    made.set_classes([10.0, 100.0], [5.0])
    assert float(made.initial_state(fast, zero)[0, 1]) == MEDIUM
    assert float(made.initial_state(zero, zero)[0, 1]) == LOW


def test_sensitivities_are_those_of_the_coefficients() -> None:
    made = Adaptive(NONLINEAR, 2, [0.1, 0.2, 0.3, 0.4, 0.5])
    made.set_classes([[5.0, 80.0], [20.0, 150.0]])
    qd, qdd, _ = motion(40, 2)
    found, start = made.sensitivities(qd, qdd), made.parameter_vector()
    with torch.no_grad():
        for p in range(len(start)):
            step = 1e-4 * torch.eye(len(start), dtype=F64)[p]
            made.set_parameter_vector(start + step)
            above = made(qd, qdd)
            made.set_parameter_vector(start - step)
            slope = (above - made(qd, qdd)) / 2e-4  # exact except for rounding: linear
            expected = torch.zeros(40, 2, 5, dtype=F64)
            expected[:, found.joint[p]] = found.parameters[..., p]
            torch.testing.assert_close(slope, expected, rtol=0, atol=1e-9)
    assert not found.qd.any()
    assert not found.qdd.any()


def test_names_match_the_parameter_vector() -> None:
    made = schedule(2)
    names = made.parameter_names(["a", "b"])
    table = dict(zip(names, made.parameter_vector().tolist(), strict=True))
    assert table["C of b, medium"] == pytest.approx(20.0)
    assert table["B of a, high"] == pytest.approx(3.0)


def test_damping_at_rest_includes_every_class() -> None:
    values = torch.tensor([[[0.0, 1e-3], [0.0, 9e-3], [0.0, 2e-3]]], dtype=F64)
    model = ALFM(1, values, v_smooth=0.1)
    assert float(model.zero_velocity_damping()) == pytest.approx(9e-3 / 0.1, rel=1e-6)


def test_options_restore_the_hidden_state() -> None:
    made = ALFM(2, hysteresis=0.1, time_constant=3.0, sample_time=2e-3)
    again = ALFM(2, **json.loads(json.dumps(made.schedule.options())))
    assert torch.equal(made.schedule.fading, again.schedule.fading)
    assert torch.equal(made.schedule.band, again.schedule.band)
    assert "medium B=" in repr(made)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hysteresis": -0.1}, "hysteresis"),
        ({"time_constant": 0.0}, "time_constant"),
        ({"time_constant": None}, "time_constant"),
        ({"sample_time": float("nan")}, "sample_time"),
        ({"initial": [[1.0, 1.0]] * 3}, "whole table"),
        ({"initial": [1.0, -1.0]}, "not negative"),
    ],
)
def test_bad_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Adaptive(LINEAR, 2, **options)


@pytest.mark.parametrize("thresholds", [[10.0, 5.0], [0.0, 5.0], [1.0, torch.inf], [1.0]])
def test_bad_thresholds_are_refused(thresholds: list) -> None:
    made = schedule(2)
    before = made.thresholds.clone()
    with pytest.raises(ValueError, match="thresholds"):
        made.set_classes(thresholds)
    with pytest.raises(ValueError, match="swing_rate"):
        made.set_classes([1.0, 2.0], [-1.0, 0.0])
    assert torch.equal(made.thresholds, before)
