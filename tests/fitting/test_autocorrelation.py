"""Correlation time of residuals, overall and in each segment of a window."""

import pytest
import torch

from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.shooting.autocorrelation import (
    bandwidth,
    correlation_time,
    hac_sd,
    repetition,
)

F64 = torch.float64
# Motion slower than any of these errors.
SLOW = 1e-4
LEAST_ALIKE = DEFAULTS.min_stationary


def lasting(phi: float, samples: int = 4000, windows: int = 20, seed: int = 0) -> torch.Tensor:
    """First-order autoregressive errors of unit variance with coefficient phi."""
    g = torch.Generator().manual_seed(seed)
    noise = torch.randn(windows, samples, 1, generator=g, dtype=F64)
    rows = [noise[:, 0]]
    for k in range(1, samples):
        rows.append(phi * rows[-1] + (1 - phi**2) ** 0.5 * noise[:, k])
    return torch.stack(rows, 1)


def time_of(phi: float) -> float:
    return (1 + phi) / (1 - phi)


@pytest.mark.parametrize("phi", [0.0, 0.8])
def test_stationary_errors_have_uniform_weights(phi):
    """Rough in each segment, but right overall."""
    found = hac_sd(0.3 * lasting(phi), SLOW)
    assert found.shape == (20, 4000, 1)
    assert float(found.square().mean()) == pytest.approx(0.3**2 * time_of(phi), rel=0.12)


def test_quantisation_is_white_while_a_joint_moves():
    """For a joint that passes a count in about 15 samples; a constant error lasts all along."""
    speed = torch.linspace(0.9, 1.1, 20, dtype=F64)[:, None, None] / 15.3
    q = speed * torch.arange(4000, dtype=F64)[None, :, None]
    residuals = q.round() - q
    sums = residuals.reshape(20, 16, 250).sum(-1)
    found = hac_sd(residuals, SLOW).square().mean()
    assert float(sums.square().mean()) / 250 < float(found) < 0.5 * residuals.square().mean()
    stays = hac_sd(torch.full((1, 500, 1), 0.3, dtype=F64), SLOW)
    assert float(stays.min()) > 0.3 * (0.5 * 500) ** 0.5


def test_correlated_segment_does_not_affect_the_others():
    fast, slow = lasting(0.0), lasting(0.95, seed=1)
    residuals = torch.cat([fast[:, :3000], slow[:, :1000]], 1)
    # Overall, errors seem to last longer than they do in most of the window.
    assert correlation_time(residuals) > 5
    found = hac_sd(residuals, SLOW).square()
    assert float(found[:, : 3000 - LEAST_ALIKE].mean()) == pytest.approx(1.0, rel=0.25)
    assert float(found[:, 3000 + LEAST_ALIKE :].mean()) == pytest.approx(time_of(0.95), rel=0.4)


def test_repeated_motion_does_not_add_information() -> None:
    """Twice in one recording with a period of a non-integer number of windows, thrice in the
    other."""
    once = lasting(0.5, 2600, 1)[0]
    other = lasting(0.8, 1300, 1, seed=1)[0]
    series = torch.cat([once, once, other, other, other])
    found = hac_sd(series.reshape(13, 700, 1), SLOW).square().mean()
    alone = lasting(0.5, 700, 13)
    assert float(repetition(series.reshape(13, 700, 1), 500)) == pytest.approx(2.4, abs=0.3)
    assert float(repetition(alone, 500)) == 1.0
    assert float(found) > 1.6 * float(hac_sd(alone, SLOW).square().mean())


def test_joints_are_treated_separately():
    residuals = torch.cat([lasting(0.0), 3 * lasting(0.0, seed=1)], -1)
    one, three = hac_sd(residuals, SLOW).square().mean((0, 1)).tolist()
    assert three / one == pytest.approx(9.0, rel=0.05)


def test_zero_residual_gets_the_uncertainty_of_others():
    """A free start absorbs the one error of a joint at rest; it stays as uncertain."""
    residuals = torch.cat([lasting(0.0, 3000), torch.zeros(20, 1000, 1, dtype=F64)], 1)
    assert float(hac_sd(residuals, SLOW)[:, -1].min()) > 0.8 * LEAST_ALIKE**0.5
    assert not torch.isnan(hac_sd(torch.zeros(2, 300, 1, dtype=F64), SLOW)).any()


def test_result_is_invariant_to_units_and_accepts_short_windows():
    residuals = lasting(0.5, 1000, 3)
    torch.testing.assert_close(hac_sd(7 * residuals, SLOW), 7 * hac_sd(residuals, SLOW))
    assert hac_sd(residuals[:, :50], SLOW).shape == (3, 50, 1)


@pytest.mark.parametrize(
    "period", [200, *(pytest.param(longer, marks=pytest.mark.slow) for longer in (500, 700))]
)
def test_errors_at_the_motion_frequency_do_not_average_out(period):
    """This concerns the frequency of the motion itself."""
    g = torch.Generator().manual_seed(1)
    time = torch.arange(4000, dtype=F64)[None, :, None] / period
    phase = torch.rand(400, 1, 1, generator=g, dtype=F64)
    residuals = (2 * torch.pi * (time + phase)).sin()
    q = 0.8 * (2 * torch.pi * time).cos()
    assert bandwidth(q) * period == pytest.approx(2.0, rel=0.3)
    weight = (2 * torch.pi * time).sin()
    spread = (residuals * weight).sum(1).square().mean().sqrt()
    noise = hac_sd(residuals, bandwidth(q))
    claimed = (noise[:1] * weight).square().sum().sqrt()
    slow = (hac_sd(residuals, SLOW)[:1] * weight).square().sum().sqrt()
    assert 2.0 * slow < claimed < 1.2 * spread
    assert claimed > 0.7 * spread
