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

    Uses Student's distribution, because there may be few windows. The ratio of the old to the new
    root mean square must be above `least`.
    """
    if not old.isfinite().all():
        return bool(new.isfinite().all())
    ratio, spread = log_ratio(new, old)
    by_chance = spread * student_quantile(len(new) - 1, 1 - chance)
    return ratio + max(by_chance, math.log(least)) < 0


def log_ratio(new: Tensor, old: Tensor) -> tuple[float, float]:
    """Log of the ratio of two sums over windows (window,), and its standard deviation.

    Jackknife over the windows, because residuals are correlated within and not across them;
    infinite for a single window.

    References:
        B. Efron, C. Stein, Annals of Statistics 9 (1981), 586-596.
    """
    count = len(new)
    ratio = 0.5 * float(torch.log(new.sum() / old.sum()))
    if count < 2:
        return ratio, math.inf
    without = 0.5 * torch.log((new.sum() - new) / (old.sum() - old))
    return ratio, jackknife_sd(without.tolist())


def jackknife_sd(without: Sequence[float]) -> float:
    """Standard error of an estimate, from those with each piece of the data left out in turn."""
    return math.sqrt((len(without) - 1) * float(np.var(without)))


def student_quantile(freedom: int, level: float) -> float:
    """Quantile of Student's distribution; infinite without a degree of freedom."""
    from scipy.special import stdtrit  # slow to import

    return float(stdtrit(freedom, level)) if freedom > 0 else math.inf
