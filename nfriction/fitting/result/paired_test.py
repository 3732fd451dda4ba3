"""Paired test: errors of two models on the same windows or blocks, beyond their scatter."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.options import DEFAULTS


def improves(
    new: Tensor, old: Tensor, chance: float = DEFAULTS.gain_chance, least: float = 1.0
) -> bool:
    """True if squared errors on windows (window,) fell by more than their scatter would by chance.

    The mean gain must differ from zero by Student's test, because there may be few windows. The
    ratio of the old to the new root mean square must be above `least`.
    """
    if not old.isfinite().all():
        return bool(new.isfinite().all())
    gain, spread = mean_gain(new, old)
    sure = gain > spread * student_quantile(len(new) - 1, 1 - chance)
    return sure and float(old.sum()) > least**2 * float(new.sum())


def mean_gain(new: Tensor, old: Tensor) -> tuple[float, float]:
    """Mean over windows (window,) of (old - new) / (old + new), and its standard error.

    That is half the logarithm of the ratio of squares if this is small. It is bounded, since a few
    windows of lively motion would outweigh all others in a sum of squares. It is -1 where the new
    motion diverges. The error is infinite for a single window.
    """
    both = old + new.nan_to_num(nan=math.inf)
    gains = torch.where(both > 0, 2 * old / both - 1, torch.zeros_like(both))
    freedom = len(gains) - 1
    spread = math.sqrt(float(gains.var(correction=0)) / freedom) if freedom else math.inf
    return float(gains.mean()), spread


def total_gain(new: Tensor, old: Tensor) -> tuple[float, float]:
    """Half the logarithm of the ratio of sums over windows (window,), old to new, and its error.

    The error is the jackknife's, because residuals are correlated within windows, not across them.
    """
    gain = 0.5 * float(torch.log(old.sum() / new.sum()))
    without = 0.5 * torch.log((old.sum() - old) / (new.sum() - new))
    return gain, jackknife_sd(without.tolist()) if len(new) > 1 else math.inf


def jackknife_sd(without: Sequence[float]) -> float:
    """Standard error of an estimate, from those with each piece of the data left out in turn."""
    return math.sqrt((len(without) - 1) * float(np.var(without)))


def student_quantile(freedom: int, level: float) -> float:
    """Quantile of Student's distribution; infinite without a degree of freedom."""
    from scipy.special import stdtrit  # slow to import

    return float(stdtrit(freedom, level)) if freedom > 0 else math.inf
