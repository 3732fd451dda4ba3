"""Where radial basis functions stand: k-means, nearest spread, orthogonal least squares."""

from __future__ import annotations

import torch
from torch import Tensor

_CANDIDATES = 500
_SAMPLES = 5000


def kmeans_centres(samples: Tensor, units: int, seed: int) -> Tensor:
    """Centres of `units` clusters, shape (units, inputs), inputs weighed by their deviation.

    Args:
        samples: shape (samples, inputs).
        seed: of the k-means++ start; the same seed gives the same centres.
    """
    from scipy.cluster.vq import kmeans2  # slow to import, and seldom needed

    scale = samples.std(0)
    centres, _ = kmeans2((samples / scale).cpu().numpy(), units, iter=50, minit="++", seed=seed)
    return torch.as_tensor(centres).to(samples) * scale


def nearest_spread(centres: Tensor, samples: Tensor, overlap: float, nearest: int = 2) -> Tensor:
    """Widths proportional to the mean distance to the `nearest` other centres, (units, inputs).

    Distances are measured, and widths given, in the standard deviations of each input.
    """
    scale = samples.std(0)
    if len(centres) == 1:
        return overlap * scale.expand_as(centres)
    distance = torch.cdist(centres / scale, centres / scale)
    # The smallest distance is that of a centre to itself.
    spread = distance.sort(1).values[:, 1 : nearest + 1].mean(1, keepdim=True)
    return overlap * spread.clamp(min=1e-3) * scale


def selected_centres(samples: Tensor, targets: Tensor, units: int, widths: Tensor) -> Tensor:
    """Samples chosen one by one so that each explains the most of what is left of the targets.

    Args:
        samples, targets: shapes (samples, inputs) and (samples, outputs); long records are thinned
            evenly.
        widths: of every unit, shape (inputs).
    Returns:
        Centres, shape (units, inputs), the most useful first.
    References:
        Chen, Cowan and Grant (1991), Orthogonal least squares learning algorithm for radial basis
        function networks, IEEE Transactions on Neural Networks 2(2), eqs. (22)-(30).
    """
    samples, targets = _thin(samples, _SAMPLES), _thin(targets, _SAMPLES)
    candidates = _thin(samples, _CANDIDATES)
    columns = torch.exp(-0.5 * torch.cdist(samples / widths, candidates / widths) ** 2)
    power = (columns**2).sum(0)
    columns, left = columns - columns.mean(0), targets - targets.mean(0)
    left = left / left.norm(dim=0).clamp(min=torch.finfo(left.dtype).tiny)
    chosen: list[int] = []
    for _ in range(units):
        energy = (columns**2).sum(0)
        gain = ((columns.T @ left) ** 2).sum(1) / energy.clamp(min=torch.finfo(left.dtype).tiny)
        # What the chosen units already span is rounding noise.
        gain[energy < 1e-10 * power] = -1.0
        gain[chosen] = -2.0
        best = int(gain.argmax())
        chosen.append(best)
        direction = columns[:, best : best + 1] / energy[best].sqrt()
        columns = columns - direction @ (direction.T @ columns)
        left = left - direction @ (direction.T @ left)
    return candidates[chosen]


def _thin(rows: Tensor, most: int) -> Tensor:
    """At most `most` rows, evenly spaced."""
    if len(rows) <= most:
        return rows
    picks = torch.linspace(0, len(rows) - 1, most, dtype=torch.float64, device=rows.device)
    return rows[picks.round().long()]
