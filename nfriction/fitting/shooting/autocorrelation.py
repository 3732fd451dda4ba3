"""How long the errors of a model last, and for how many independent ones they count."""

import math

import torch
from torch import Tensor

# Samples counted within the time that errors last, and the most that are passed over: a network
# leaves errors that last less long than its constant law's.
CORRELATED, MOST_STRIDE = 8, 20
# Stretches over which errors are taken as alike, in times that they last, and at least so many
# samples: shorter ones tell too little of how long errors last in them.
ALIKE, LEAST_ALIKE = 20, 500
# Lags that tell how long errors last: so many times as far as they seem alike, and no less than
# this share of a stretch.
LAGS, LEAST_LAGS = 20, 0.1
# Share of a motion's power within its band; what it does to friction and inertia has the second
# harmonics, too.
IN_BAND, HARMONICS = 0.999, 2


def correlation_time(residuals: Tensor) -> float:
    """Integrated autocorrelation time of residuals in samples, 1 or more.

    Errors of a model last for many samples; `n` of them weigh like `n / tau` independent ones.

    Args:
        residuals: [rad or m], shape (window, sample, joint).
    """
    centred = residuals - residuals.mean(1, keepdim=True)
    return float(_integrated(_autocovariance(centred).sum((0, 2))[None, :, None]))


def effective_noise(residuals: Tensor) -> float:
    """Standard deviation of residuals, enlarged for their correlation in time.

    Args:
        residuals: [rad or m], shape (window, sample, joint).
    """
    return float(residuals.square().mean().sqrt()) * correlation_time(residuals) ** 0.5


def band_of(q: Tensor) -> float:
    """Highest frequency of what a motion answers to parameters [cycles per sample].

    Args:
        q: positions, shape (window, sample, joint).
    """
    samples = q.shape[1]
    hann = torch.hann_window(samples, periodic=False, dtype=q.dtype)[:, None]
    power = torch.fft.rfft(hann * (q - q.mean(1, keepdim=True)), dim=1).abs().square().sum((0, 2))
    within = power.cumsum(0) <= IN_BAND * power.sum()
    return HARMONICS * float(within.sum()) / samples


def local_noise(residuals: Tensor, band: float) -> Tensor:
    """Standard deviation that each residual counts with, by how long errors last around it.

    Rounding by an encoder makes up for itself from count to count while a joint moves; once it
    hardly does, one and the same error stays for a second. What a model leaves over swings with the
    joints. A sum of residuals times a sensitivity of the same band has at most the variance of
    independent ones of this size, which is that of the band's strongest frequency.

    Args:
        residuals: [rad or m], shape (window, sample, joint).
        band: see `band_of` [cycles per sample].

    Returns:
        Of the same shape.

    References:
        W. K. Newey, K. D. West, Econometrica 55 (1987), 703-708.
    """
    samples = residuals.shape[1]
    length = max(ALIKE * correlation_time(residuals), LEAST_ALIKE)
    stretches = residuals.tensor_split(max(1, int(samples / length)), 1)
    size = torch.stack([part.square().mean(1) for part in stretches])
    # A stretch without error owes that to its window's free start, which is off by as much.
    size = torch.maximum(size, size.flatten(0, 1).median(0).values)
    lasting = torch.stack([_strongest(_autocovariance(part), band) for part in stretches])
    counted = [part.shape[1] for part in stretches]
    return (size * lasting).sqrt().transpose(0, 1).repeat_interleave(torch.tensor(counted), 1)


def stride_of(residuals: Tensor) -> int:
    """Of how many samples one is enough, where errors last as long as these.

    Args:
        residuals: [rad or m], shape (window, sample, joint).
    """
    return int(min(max(correlation_time(residuals) / CORRELATED, 1), MOST_STRIDE))


def _autocovariance(residuals: Tensor) -> Tensor:
    """Sum of the products of residuals so many samples apart, shape (window, lag, joint)."""
    n = residuals.shape[1]
    spectrum = torch.fft.rfft(residuals, n=2 * n, dim=1).abs().square()
    return torch.fft.irfft(spectrum, n=2 * n, dim=1)[:, :n]


def _correlation(covariance: Tensor) -> Tensor:
    """Autocorrelation, (window, lag, joint); 1 all over where there is no error."""
    none = covariance[:, :1] <= 0
    return torch.where(none, 1.0, covariance / covariance[:, :1].clamp_min(1e-300))


def _integrated(covariance: Tensor) -> Tensor:
    """Integrated autocorrelation time in samples, 1 or more, (window, joint)."""
    correlation = _correlation(covariance)
    # Summed up to its first zero, beyond which the estimate is noise.
    kept = (correlation >= 0).to(correlation).cumprod(1)
    return (2 * (correlation * kept).sum(1) - 1).clamp_min(1.0)


def _strongest(covariance: Tensor, band: float) -> Tensor:
    """Largest spectral density up to a frequency, over that of white errors, (window, joint)."""
    samples = covariance.shape[1]
    far = (LAGS * _integrated(covariance)).clamp(LEAST_LAGS * samples, samples)
    lag = torch.arange(samples, dtype=covariance.dtype)
    # Bartlett's weights keep the density from being negative.
    weight = (1 - lag[:, None] / far[:, None]).clamp_min(0.0)
    one_sided = weight * _correlation(covariance)
    density = 2 * torch.fft.rfft(one_sided, n=2 * samples, dim=1).real - one_sided[:, :1]
    return density[:, : math.ceil(2 * samples * band) + 1].amax(1)
