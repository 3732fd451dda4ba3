"""Positive maps, and fading outside a range: monotone, and smooth as specified."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nfriction.friction.neurofuzzy import smooth_relu, smooth_relu_inverse, taper, taper_slope
from tests.friction.samples import normal


@given(st.floats(-1e100, 1e100), st.floats(1e-6, 1.0))
def test_positive_map_hardly_changes_positive_values(u: float, roundness: float):
    y = smooth_relu(torch.tensor(u, dtype=torch.float64), roundness)
    assert y >= 0
    assert y >= u
    assert abs(float(y) - max(u, 0.0)) <= roundness * (1 + 1e-9) + 1e-15 * abs(u)


@given(st.floats(1e-2, 1e6))
def test_positive_map_is_invertible(y: float) -> None:
    u = smooth_relu_inverse(torch.tensor(y, dtype=torch.float64), 0.05)
    # For y below the rounding width, u is negative and up to 25 times as large: two digits are
    # lost.
    assert float(smooth_relu(u, 0.05)) == pytest.approx(y, rel=1e-13)


@pytest.mark.parametrize("reach", [0.5, 2.0])
def test_taper_is_smooth_from_one_to_zero(reach: float) -> None:
    direction = torch.tensor([0.6, -0.8], dtype=torch.float64)
    distance = torch.linspace(0.0, 2 * reach, 4001, dtype=torch.float64)[:, None]
    weight = taper(distance * direction, reach)
    assert weight[0] == 1
    assert float(weight[1000]) == pytest.approx((1 - 0.25) ** 2)
    assert (weight[2000:] == 0).all()
    assert (weight[:2001].diff() <= 0).all()
    # The largest second derivative is 8 / reach^2; the slope of 1 - |e| / reach would jump.
    step = 2 * reach / 4000
    assert (weight.diff().diff().abs() <= 8.01 * (step / reach) ** 2).all()
    assert weight[1] > 1 - 2.1 * (step / reach) ** 2


def test_derivative_of_the_taper_equals_automatic_differentiation() -> None:
    beyond = (0.4 * normal(200, 3)).requires_grad_()
    (expected,) = torch.autograd.grad(taper(beyond, 0.7).sum(), beyond)
    found = taper_slope(beyond, 0.7).detach()
    torch.testing.assert_close(found, expected)
    assert 20 < (expected.norm(dim=1) > 0).sum() < 180
