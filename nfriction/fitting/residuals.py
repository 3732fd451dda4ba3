"""How long the errors of a model last, and for how many independent ones they count."""

import torch
from torch import Tensor

# Samples counted within the time that errors last, and the most that are passed over: a network
# leaves errors that last less long than its constant law's.
CORRELATED, MOST_STRIDE = 8, 20


def correlation_time(residuals: Tensor) -> float:
    """Integrated autocorrelation time of residuals in samples, 1 or more.

    Errors of a model last for many samples; `n` of them weigh like `n / tau` independent ones.

    Args:
        residuals: [rad or m], shape (window, sample, joint).
    """
    centred = residuals - residuals.mean(1, keepdim=True)
    n = centred.shape[1]
    spectrum = torch.fft.rfft(centred, n=2 * n, dim=1).abs().square()
    correlation = torch.fft.irfft(spectrum, dim=1)[:, :n].sum((0, 2))
    correlation = correlation / correlation[0].clamp_min(1e-300)
    # Summed up to its first zero, beyond which the estimate is noise.
    negative = (correlation < 0).nonzero()
    end = int(negative[0]) if len(negative) else n
    return max(1.0, 1.0 + 2.0 * float(correlation[1:end].sum()))


def effective_noise(residuals: Tensor) -> float:
    """Standard deviation of residuals, enlarged for their correlation in time.

    Args:
        residuals: [rad or m], shape (window, sample, joint).
    """
    return float(residuals.square().mean().sqrt()) * correlation_time(residuals) ** 0.5


def stride_of(residuals: Tensor) -> int:
    """Of how many samples one is enough, where errors last as long as these.

    Args:
        residuals: [rad or m], shape (window, sample, joint).
    """
    return int(min(max(correlation_time(residuals) / CORRELATED, 1), MOST_STRIDE))
