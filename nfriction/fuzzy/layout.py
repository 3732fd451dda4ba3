"""Between rows (*batch, groups, size) and columns (groups, size, samples).

Layers take and give rows; inside, samples run last, so that every kernel is vectorised over them.
"""

from __future__ import annotations

from torch import Tensor


def to_columns(x: Tensor) -> Tensor:
    """(*batch, groups, size) → (groups, size, samples); scripts and exports."""
    return x.reshape(-1, x.shape[-2], x.shape[-1]).movedim(0, -1)


def to_rows(columns: Tensor, like: Tensor) -> Tensor:
    """(groups, size, samples) → (*batch, groups, size) with the batch of `like`."""
    return columns.movedim(-1, 0).reshape(like.shape[:-1] + columns.shape[1:2])
