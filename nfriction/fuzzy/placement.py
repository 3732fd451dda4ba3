"""Where the sets of a partition start: even grids, quantiles, widths that make neighbours cross."""

import torch
from torch import Tensor


def even_centres(terms: list[int], lower: Tensor, upper: Tensor) -> list[Tensor]:
    """Centres from `lower` to `upper` (groups, inputs); for each input (groups, terms)."""
    centres = []
    for i, count in enumerate(terms):
        low, span = lower[:, i, None], (upper - lower)[:, i, None]
        centres.append(low + span * _fractions(count).to(lower))
    return centres


def quantile_centres(terms: list[int], samples: Tensor) -> list[Tensor]:
    """Evenly spaced quantiles of samples (samples, groups, inputs), extremes included."""
    centres = []
    for i, count in enumerate(terms):
        # By sorting, since `torch.quantile` refuses large inputs.
        ascending = samples[:, :, i].sort(0).values
        ranks = (_fractions(count) * (len(ascending) - 1)).round().long()
        centres.append(ascending[ranks.to(samples.device)].T)
    return centres


def crossing_half_widths(centres: list[Tensor], span: Tensor) -> list[Tensor]:
    """Half-widths by which neighbours overlap at 0.5 or more: half of the wider adjacent gap.

    Args:
        centres: for each input, ascending, shape (groups, terms).
        span: of each input (groups, inputs); a set alone gets half of it.
    """
    half_widths = []
    for i, c in enumerate(centres):
        if c.shape[1] == 1:
            half_widths.append(0.5 * span[:, i, None])
        else:
            gaps = c.diff(dim=1)
            padded = torch.cat([gaps[:, :1], gaps, gaps[:, -1:]], 1)
            half_widths.append(0.5 * torch.maximum(padded[:, :-1], padded[:, 1:]))
    return half_widths


def _fractions(count: int) -> Tensor:
    if count == 1:
        return torch.full((1,), 0.5, dtype=torch.float64)
    return torch.linspace(0, 1, count, dtype=torch.float64)
