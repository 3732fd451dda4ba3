"""Constant coefficients: positive, validated, passed to fits unchanged."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nfriction.friction.coefficients import SMALLEST, Constant
from nfriction.friction.laws import LINEAR, NONLINEAR, STRIBECK, VISCOUS, Law
from tests.friction.samples import LAWS, QUADRATIC, motion, normal

every_law = pytest.mark.parametrize("law", [*LAWS, QUADRATIC], ids=lambda law: law.name)


def random_values(law: Law, joints: int, seed: int = 0) -> torch.Tensor:
    values = normal(joints, len(law.names), seed=seed)
    return torch.where(torch.tensor([c.positive for c in law.coefficients]), values.exp(), values)


@every_law
@given(raw=st.floats(-1e300, 1e300))
def test_coefficients_are_positive_for_any_parameters(law: Law, raw: float) -> None:
    schedule = Constant(law, 2)
    torch.nn.init.constant_(schedule.raw, raw)
    values = schedule(*motion(2)[:2])
    assert (values[:, schedule.positive] >= 0).all()
    assert (values[:, ~schedule.positive] == raw).all()


@every_law
def test_given_coefficients_are_used(law: Law) -> None:
    values = random_values(law, 3)
    schedule = Constant(law, 3, values)
    # The logarithm and its inverse cost a few last digits.
    torch.testing.assert_close(schedule.values, values, rtol=1e-14, atol=0)
    one_row = Constant(law, 3, values[0].tolist())
    torch.testing.assert_close(one_row.values, values[:1].expand(3, -1), rtol=1e-14, atol=0)
    assert schedule(*motion(3)[:2]).dtype == torch.float64


def test_zero_coefficient_is_practically_zero() -> None:
    schedule = Constant(LINEAR, 1, [0.0, 1.0])
    assert 0 < schedule.values[0, 0] <= 1.001 * SMALLEST


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([1.0, -1e-3], r"`C` of joint 1 .*not negative, got -0\.001"),
        ([[1.0, 1.0], [1.0, float("nan")]], "`C` of joint 2 must be finite"),
        ([float("inf"), 1.0], "`B` of joint 1 must be finite"),
        ([1.0], r"\(2, 2\).*\(B, C\), got shape \(1,\)"),
        (1.0, r"got shape \(\)"),
        ([[1.0], [1.0]], r"got shape \(2, 1\)"),  # one column would silently be used for both
        ([[1.0, 1.0]] * 3, r"got shape \(3, 2\)"),
        ([[1.0, 1.0], [1.0]], "array of numbers"),
        (["a", "b"], "array of numbers"),
    ],
)
def test_wrong_coefficients_are_refused_by_name(values: object, message: str) -> None:
    schedule = Constant(LINEAR, 2, [0.1, 0.2])
    before = schedule.parameter_vector()
    with pytest.raises(ValueError, match=message):
        schedule.set_coefficients(values)
    assert torch.equal(schedule.parameter_vector(), before)


def test_signed_coefficients_may_be_negative_but_finite() -> None:
    assert Constant(NONLINEAR, 1, [-0.5, 0, 0, 0, 1]).values[0, 0] == -0.5
    with pytest.raises(ValueError, match=r"`f_o` of joint 1 must be finite, got nan"):
        Constant(NONLINEAR, 1, [float("nan"), 0, 0, 0, 1])


def test_at_least_one_joint_is_required() -> None:
    with pytest.raises(ValueError, match="at least 1, got 0"):
        Constant(LINEAR, 0)


@every_law
def test_parameter_vector_round_trip_is_exact(law: Law) -> None:
    schedule = Constant(law, 100)
    raw = 5 * normal(100, len(law.names))  # for many of these log(exp(raw)) is not raw
    with torch.no_grad():
        schedule.raw.copy_(raw)
    vector = schedule.parameter_vector()
    assert torch.equal(vector.reshape(100, -1), schedule.values)
    schedule.set_parameter_vector(vector)
    assert torch.equal(schedule.raw, raw)
    vector.zero_()  # a copy: the model must not follow
    assert torch.equal(schedule.raw, raw)
    other = Constant(law, 100)
    other.set_parameter_vector(schedule.parameter_vector())
    torch.testing.assert_close(other.values, schedule.values, rtol=1e-14, atol=0)


@every_law
def test_bounds_fix_unfitted_coefficients_and_the_sign_of_others(law: Law) -> None:
    schedule = Constant(law, 2, random_values(law, 2))
    lower, upper = (b.reshape(2, -1) for b in schedule.bounds())
    for k, c in enumerate(law.coefficients):
        if c.fitted and c.linear:
            assert (lower[:, k] == (SMALLEST if c.positive else -torch.inf)).all()
            assert (upper[:, k] == torch.inf).all()
        elif c.fitted:  # free far outside the initial grid, but bounded
            assert (lower[:, k] > 0).all()
            assert (lower[:, k] < min(c.initial_grid)).all()
            assert (upper[:, k] > max(c.initial_grid)).all()
            assert torch.isfinite(upper[:, k]).all()
        else:
            assert torch.equal(lower[:, k], schedule.values[:, k])
            assert torch.equal(upper[:, k], schedule.values[:, k])


def test_there_is_no_prior_by_default() -> None:
    mean, sd = Constant(LINEAR, 2).prior()
    assert (mean == 0).all()
    assert torch.isinf(sd).all()


@every_law
def test_sensitivities_are_those_of_the_coefficients(law: Law) -> None:
    schedule = Constant(law, 2, random_values(law, 2))
    qd, qdd, _ = motion(4, 2)
    found = schedule.sensitivities(qd, qdd)
    start = schedule.parameter_vector()
    for p in range(len(start)):
        # Central differences of a linear function: exact up to rounding over the step.
        step = 1e-4 * torch.eye(len(start), dtype=torch.float64)[p]
        schedule.set_parameter_vector(start + step)
        above = schedule.values
        schedule.set_parameter_vector(start - step)
        slope = (above - schedule.values) / 2e-4
        expected = torch.zeros(2, len(law.names), dtype=torch.float64)
        expected[found.joint[p]] = found.parameters[0, :, p]
        torch.testing.assert_close(slope, expected, rtol=0, atol=1e-9)
    assert found.parameters.shape == (4, len(law.names), len(start))
    assert (found.parameters == found.parameters[0]).all()
    assert found.qd.shape == found.qdd.shape == (4, 2, len(law.names))
    assert not found.qd.any()
    assert not found.qdd.any()


def test_dtype_follows_the_module() -> None:
    schedule = Constant(STRIBECK, 2).to(torch.float32)
    assert {t.dtype for t in (schedule.values, *schedule.bounds(), *schedule.prior())} == {
        torch.float32
    }
    assert schedule.sensitivities(torch.ones(1, 2), torch.ones(1, 2)).parameters.dtype == (
        torch.float32
    )


def test_repr_shows_the_coefficients() -> None:
    assert "C_p=0.25" in repr(Constant(VISCOUS, 2, [0.25]))


@every_law
def test_parameter_names_match_where_a_parameter_acts(law: Law) -> None:
    schedule = Constant(law, 2)
    names = schedule.parameter_names(["shoulder", "elbow"])
    schedule.set_parameter_vector(torch.arange(1.0, len(names) + 1, dtype=torch.float64))
    for joint, row in zip(["shoulder", "elbow"], schedule.values.tolist(), strict=True):
        for coefficient, value in zip(law.names, row, strict=True):
            assert names[round(value) - 1] == f"{coefficient} of {joint}"
