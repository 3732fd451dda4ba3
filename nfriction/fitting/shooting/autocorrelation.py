"""Noise of signals, and autocorrelation of residuals: the effective number of samples."""

import math

import torch
from torch import Tensor

from nfriction.fitting.options import DEFAULTS, FitOptions

# Weights of a third difference: smooth motion cancels, white noise of sd 1 has an sd of √20.
GAIN = 20**0.5
# Median of the absolute value of a normal variable of sd 1.
NORMAL_MEDIAN = 0.674490


def correlation_time(residuals: Tensor) -> float:
    """Integrated autocorrelation time of residuals (window, sample, joint) in samples, 1 or more.

    n residuals carry as much information as n over this time independent ones.
    """
    centred = residuals - residuals.mean(1, keepdim=True)
    return float(_integrated(_autocovariance(centred).sum((0, 2))[None, :, None]))


def white_noise(values: Tensor, weight: Tensor | None = None) -> Tensor:
    """Standard deviation of the noise in signals (window, sample, joint) by joint, (joint,).

    From the median of third differences, which steps and kinks of the signal do not raise; zero for
    a signal that is held over several samples. Where the `weight` is 0, (window, sample), samples
    are padding.
    """
    size = torch.diff(values, n=3, dim=1).abs().flatten(0, 1)
    if weight is not None:
        size = size[weight[:, 3:].flatten() > 0]
    if not len(size):
        return values.new_zeros(values.shape[-1])
    return size.median(0).values / (NORMAL_MEDIAN * GAIN)


def effective_noise(residuals: Tensor) -> float:
    """Standard deviation of residuals (window, sample, joint), inflated for autocorrelation."""
    return float(residuals.square().mean().sqrt()) * correlation_time(residuals) ** 0.5


def bandwidth(q: Tensor, options: FitOptions = DEFAULTS) -> float:
    """Highest frequency at which a motion (window, sample, joint) responds [cycles per sample]."""
    samples = q.shape[1]
    hann = torch.hann_window(samples, periodic=False, dtype=q.dtype)[:, None]
    power = torch.fft.rfft(hann * (q - q.mean(1, keepdim=True)), dim=1).abs().square().sum((0, 2))
    within = power.cumsum(0) <= options.band_power * power.sum()
    return options.band_harmonics * float(within.sum()) / samples


def hac_sd(residuals: Tensor, band: float, options: FitOptions = DEFAULTS) -> Tensor:
    """Heteroscedasticity- and autocorrelation-consistent sd of each residual.

    The noise level is the residuals' peak spectral density within the motion's bandwidth, which
    bounds the variance of their sum times a sensitivity of that bandwidth. It is estimated segment
    by segment: quantisation error is white while a joint moves and constant while it is nearly at
    rest. Errors that recur later, such as rounding in a periodic motion, count once.

    Args:
        residuals: [rad; m], shape (window, sample, joint), like the result.
        band: see `bandwidth` [cycles per sample].

    References:
        W. K. Newey, K. D. West, Econometrica 55 (1987), 703-708.
    """
    samples = residuals.shape[1]
    length = max(options.stationary_times * correlation_time(residuals), options.min_stationary)
    stretches = residuals.tensor_split(max(1, int(samples / length)), 1)
    power = torch.stack([part.square().mean(1) for part in stretches])
    # A segment has no error if its window's free initial state absorbed it.
    power = torch.maximum(power, power.flatten(0, 1).median(0).values)
    density = torch.stack(
        [_max_spectral_density(_autocovariance(part), band, options) for part in stretches]
    )
    lengths = torch.tensor([part.shape[1] for part in stretches])
    level, spread = (
        x.sqrt().transpose(0, 1).repeat_interleave(lengths, 1) for x in (power, power * density)
    )
    return spread * repetition(residuals / level.clamp_min(1e-300), int(length)).sqrt()


def repetition(residuals: Tensor, length: int) -> Tensor:
    """Number of times that errors (window, sample, joint) in order of time recur, (joint,).

    From their autocorrelation at lags of more than `length` samples, if it exceeds the level that
    errors which last no longer than a window reach by chance at one of all lags.

    References:
        M. S. Bartlett, J. Royal Statistical Society Suppl. 8 (1946), 27-41 (variance at a lag).
    """
    # The last sample of a window is the first of the next.
    series = residuals[:, :-1].flatten(0, 1)
    count = len(series)
    if count <= length:
        return torch.ones_like(residuals[0, 0])
    correlation = _correlation(_autocovariance(series[None]))[0]
    variance = (2 * correlation[: residuals.shape[1]].square().sum(0) - 1) / count
    highest = torch.stack([part.amax(0) for part in correlation[length:].split(length)])
    found = highest.square() > 2 * math.log(count) * variance
    return 1 + 2 * torch.where(found, highest, 0.0).clamp_min(0.0).sum(0)


def decimation(residuals: Tensor, options: FitOptions = DEFAULTS) -> int:
    """Decimation that the correlation of residuals (window, sample, joint) allows."""
    found = correlation_time(residuals) / options.samples_per_correlation
    return int(min(max(found, 1), options.max_decimation))


def _autocovariance(residuals: Tensor) -> Tensor:
    """Sum of the products of residuals at each lag, shape (window, lag, joint)."""
    n = residuals.shape[1]
    spectrum = torch.fft.rfft(residuals, n=2 * n, dim=1).abs().square()
    return torch.fft.irfft(spectrum, n=2 * n, dim=1)[:, :n]


def _correlation(covariance: Tensor) -> Tensor:
    """Autocorrelation, (window, lag, joint); 1 at all lags if there is no error."""
    none = covariance[:, :1] <= 0
    return torch.where(none, 1.0, covariance / covariance[:, :1].clamp_min(1e-300))


def _integrated(covariance: Tensor) -> Tensor:
    """Integrated autocorrelation time in samples, 1 or more, (window, joint)."""
    correlation = _correlation(covariance)
    # Summed up to the first zero, beyond which the estimate is noise.
    kept = (correlation >= 0).to(correlation).cumprod(1)
    return (2 * (correlation * kept).sum(1) - 1).clamp_min(1.0)


def _max_spectral_density(covariance: Tensor, band: float, options: FitOptions) -> Tensor:
    """Largest spectral density up to a frequency, relative to white noise, (window, joint)."""
    samples = covariance.shape[1]
    lags = options.lag_times * _integrated(covariance)
    lags = lags.clamp(options.min_lag_share * samples, samples)
    lag = torch.arange(samples, dtype=covariance.dtype)
    # Bartlett's weights keep the density from being negative.
    weight = (1 - lag[:, None] / lags[:, None]).clamp_min(0.0)
    one_sided = weight * _correlation(covariance)
    density = 2 * torch.fft.rfft(one_sided, n=2 * samples, dim=1).real - one_sided[:, :1]
    return density[:, : math.ceil(2 * samples * band) + 1].amax(1)
