"""Memberships: half-width points, values within [0, 1], sets from ranges."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nfriction.fuzzy.membership import (
    HALF_WIDTH_OF_GAUSSIAN,
    SHAPES,
    FuzzySet,
    bell,
    gaussian,
    left_shoulder,
    log_bell,
    log_gaussian,
    right_shoulder,
    sets_from_ranges,
    trapezoid,
    two_sided_gaussian,
)

FLOAT64 = torch.float64
EXAMPLES = {
    "gaussian": (1.0, 0.5),
    "left_shoulder": (1.0, 0.5),
    "right_shoulder": (1.0, 0.5),
    "two_sided_gaussian": (0.5, 0.3, 1.5, 0.2),
    "bell": (1.0, 0.5, 2.0),
    "triangle": (0.0, 1.0, 3.0),
    "trapezoid": (0.0, 1.0, 2.0, 3.0),
}


def t(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=FLOAT64)


@given(st.floats(-3, 3), st.floats(0.01, 10))
def test_half_width_of_a_gaussian_and_of_a_bell(centre: float, width: float) -> None:
    edge = t(centre + HALF_WIDTH_OF_GAUSSIAN * width)
    assert gaussian(edge, t(centre), t(width)).item() == pytest.approx(0.5, abs=1e-10)
    assert bell(t(centre - width), t(centre), t(width), t(3.0)).item() == pytest.approx(
        0.5, abs=1e-10
    )


def test_log_memberships_agree_and_do_not_underflow() -> None:
    x = torch.linspace(-4, 4, 101, dtype=FLOAT64)
    c, s, b = t(0.3), t(0.7), t(1.7)
    plain_bell = 1 / (1 + ((x - c) / s).abs() ** (2 * b))
    torch.testing.assert_close(log_bell(x, c, s, b), plain_bell.log(), rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(log_gaussian(x, c, s), gaussian(x, c, s).log(), rtol=1e-12, atol=0)
    far = log_gaussian(t(1e3), c, t(1.0))
    assert gaussian(t(1e3), c, t(1.0)) == 0
    assert torch.isfinite(far)


def test_bell_is_smooth_at_its_centre() -> None:
    x = torch.tensor([0.3, 0.5], dtype=FLOAT64, requires_grad=True)
    parameters = [t(v).requires_grad_() for v in (0.3, 0.7, 2.0)]
    assert torch.autograd.gradcheck(bell, (x, *parameters), check_forward_ad=True)
    # 1/(1 + z^2) has the second derivative -2/width^2 at its centre.
    x = t(0.3).requires_grad_()
    (slope,) = torch.autograd.grad(bell(x, t(0.3), t(0.7), t(1.0)), x, create_graph=True)
    (curvature,) = torch.autograd.grad(slope, x)
    assert slope.item() == 0
    assert curvature.item() == pytest.approx(-2 / 0.7**2, rel=1e-12)


@pytest.mark.parametrize("shape", list(SHAPES))
def test_every_shape_stays_in_the_unit_interval_peaks_and_keeps_nan(shape: str) -> None:
    member = FuzzySet("a", shape, EXAMPLES[shape])
    held = member(torch.linspace(-5, 5, 1001, dtype=FLOAT64))
    assert held.min() >= 0
    assert held.max() <= 1
    assert member(t(member.core)).item() == pytest.approx(1.0, abs=1e-2)
    assert torch.isnan(member(t(math.nan)))


def test_shoulders_saturate_outward_and_meet_the_two_sided_gaussian() -> None:
    x = torch.linspace(-3, 3, 61, dtype=FLOAT64)
    left, right = left_shoulder(x, t(0.2), t(0.5)), right_shoulder(x, t(0.2), t(0.5))
    assert (left[x <= 0.2] == 1).all()
    assert (right[x >= 0.2] == 1).all()
    torch.testing.assert_close(left * right, gaussian(x, t(0.2), t(0.5)), rtol=1e-14, atol=0)
    infinite = t(math.inf)
    assert torch.equal(two_sided_gaussian(x, t(0.2), infinite, t(0.2), t(0.5)), left)


def test_trapezoid_may_have_a_vertical_edge() -> None:
    x = torch.tensor([-0.1, 0.0, 0.5, 1.0, 1.5, 2.0, 2.1], dtype=FLOAT64)
    held = trapezoid(x, t(0.0), t(0.0), t(1.0), t(2.0))
    assert held.tolist() == [0, 1, 1, 1, 0.5, 0, 0]


def test_sets_from_ranges_have_equal_membership_at_both_ends() -> None:
    sets = sets_from_ranges(["a", "b", "c"], [(0.0, 4.0), (3.0, 9.0), (8.0, 10.0)])
    at = math.exp(-2)  # two sigma
    inner = [(sets[0], 4.0), (sets[1], 3.0), (sets[1], 9.0), (sets[2], 8.0)]
    for member, end in inner:
        assert member(t(end)).item() == pytest.approx(at, rel=1e-12)
    assert sets[0](t(-1.0)) == 1
    assert sets[2](t(11.0)) == 1


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ([(0, 1), (0, 2)], "ascend"),
        ([(0, 3), (1, 2)], "ascend"),
        ([(1, 0), (2, 3)], "low < high"),
        ([(0, math.nan), (2, 3)], "finite"),
        ([(0, 1)], "names"),
    ],
)
def test_unsound_ranges_are_refused(ranges: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sets_from_ranges(["a", "b"], ranges)


@pytest.mark.parametrize(
    ("shape", "numbers", "message"),
    [
        ("cone", (1.0,), "unknown shape"),
        ("gaussian", (1.0,), "takes 2"),
        ("gaussian", (1.0, 0.0), "positive"),
        ("gaussian", (math.inf, 1.0), "finite"),
        ("triangle", (1.0, 0.0, 2.0), "ascend"),
    ],
)
def test_unsound_sets_are_refused(shape: str, numbers: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FuzzySet("a", shape, numbers)
