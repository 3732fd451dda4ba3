"""Regularised linear least squares for output layers, groups stacked in one tensor."""

from __future__ import annotations

import torch
from torch import Tensor

_ROWS_AT_ONCE = 8192


def ridge(
    features: Tensor, targets: Tensor, prior_precision: float | Tensor, prior: Tensor
) -> Tensor:
    """Minimiser of `|targets - features w|^2 + prior_precision |w - prior|^2`.

    The rows are reduced to a triangle by Householder QR, a block at a time, so that the condition
    of the problem is not squared and memory does not grow with the samples. What neither data nor
    prior determine stays at the prior (least change).

    Args:
        features: shape (samples, groups, features).
        targets: shape (samples, groups, outputs).
        prior_precision: not negative, a number or broadcastable to (groups, features); over the
            noise precision, so that 1 weighs like one sample with unit feature.
        prior: broadcastable to (groups, features, outputs).
    Returns:
        Weights, shape (groups, features, outputs).
    Raises:
        ValueError: if the samples are none or not finite, or the precision is negative.
    References:
        Golub and Van Loan, Matrix Computations, 4th ed., sections 5.2 and 5.5.
    """
    samples, groups, count = features.shape
    if targets.shape[:2] != features.shape[:2]:
        raise ValueError(
            f"`features` {tuple(features.shape)} and `targets` {tuple(targets.shape)} must agree "
            "in samples and groups."
        )
    if samples == 0:
        raise ValueError("least squares needs at least one sample.")
    precision = torch.as_tensor(prior_precision, dtype=features.dtype, device=features.device)
    if not bool((precision >= 0).all()):
        raise ValueError(f"`prior_precision` must not be negative, got {prior_precision}.")
    prior = prior.expand(groups, count, targets.shape[-1])
    triangle = _triangle(torch.cat([features, targets], -1).transpose(0, 1))
    if not bool(torch.isfinite(triangle).all()):
        raise ValueError("samples must be finite; drop the rows with NaN or infinity first.")
    upper, rhs = triangle[..., :count], triangle[..., count:]
    scale = precision.expand(groups, count).sqrt()
    rows = torch.cat([upper, torch.diag_embed(scale)], 1)
    residual = torch.cat([rhs - upper @ prior, torch.zeros_like(prior)], 1)
    U, singular, Vh = torch.linalg.svd(rows, full_matrices=False)
    floor = singular[:, :1] * count * torch.finfo(rows.dtype).eps
    inverse = torch.where(singular > floor, 1.0 / singular, torch.zeros_like(singular))
    return prior + Vh.mT @ (inverse.unsqueeze(-1) * (U.mT @ residual))


def _triangle(rows: Tensor) -> Tensor:
    """R of the QR of `rows`, shape (groups, samples, columns)."""
    triangle = rows[:, :0]
    for block in rows.split(_ROWS_AT_ONCE, dim=1):
        triangle = torch.linalg.qr(torch.cat([triangle, block], 1), mode="r").R
    return triangle
