"""Layers of independent groups (joints): memory layout, input Jacobian, output layer.

Layers take and return rows, (*batch, groups, size). Internally samples come last, (groups, size,
samples), so that every kernel is vectorised over them.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

# A block and its triangle then fit into the cache.
_ROWS_AT_ONCE = 8192


def to_columns(x: Tensor) -> Tensor:
    """(*batch, groups, size) → (groups, size, samples); can be scripted and exported."""
    return x.reshape(-1, x.shape[-2], x.shape[-1]).movedim(0, -1)


def to_rows(columns: Tensor, like: Tensor) -> Tensor:
    """(groups, size, samples) → (*batch, groups, size) with the batch of `like`."""
    return columns.movedim(-1, 0).reshape(like.shape[:-1] + columns.shape[1:2])


def input_range(
    lower: float | Sequence[float] | Tensor,
    upper: float | Sequence[float] | Tensor,
    like: Tensor,
    *,
    allow_equal: bool = False,
) -> tuple[Tensor, Tensor]:
    """Bounds of every input, finite and ascending, broadcast to `like` (groups, inputs)."""
    low, high = (
        torch.as_tensor(end, dtype=like.dtype, device=like.device).expand_as(like)
        for end in (lower, upper)
    )
    sound = (high >= low) if allow_equal else (high > low)
    if not bool((sound & torch.isfinite(high - low)).all()):
        raise ValueError(
            f"every input needs a finite range with `lower` < `upper`, got {low.tolist()} and "
            f"{high.tolist()}; an input that never varies should be left out."
        )
    return low, high


class LinearOutputModule(nn.Module):
    """Layer from (*batch, groups, inputs) to (*batch, groups, outputs), linear in its regressors.

    The outputs share hidden units, so their derivatives are combinations of fewer columns than
    there are parameters. With F = jacobian_columns(x)[g] and M = jacobian_maps()[name][g, k],

        d y_k(sample) / d parameter = F[:, sample] . M[:, parameter],

    and least squares needs one product F F^T for all outputs, which is five times faster than the
    product of full Jacobians (`nfriction.papers.nffem.jacobian`). The first columns are the
    regressors, from which `readout` computes the outputs.
    """

    groups: int
    inputs: int
    outputs: int

    @abstractmethod
    def input_jacobian(self, x: Tensor) -> Tensor:
        """Derivatives (groups, outputs, inputs, samples) at x (samples, groups, inputs)."""

    @abstractmethod
    def regressor_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor:
        """Regressors (groups, regressors, samples) of x (samples, groups, inputs), into `out`."""

    @abstractmethod
    def jacobian_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor:
        """Columns (groups, columns, samples) of x (samples, groups, inputs), into `out`."""

    @abstractmethod
    def jacobian_maps(self) -> dict[str, Tensor]:
        """Map of each trained parameter by name, (groups, outputs, columns, entries of a group)."""

    @abstractmethod
    def readout(self) -> Tensor:
        """The output layer, (groups, outputs, regressors)."""

    def regressors(self, x: Tensor) -> Tensor:
        """Features in which the layer is linear, shape (*batch, groups, regressors)."""
        return to_rows(self.regressor_columns(x.reshape(-1, *x.shape[-2:])), x)

    def _placed(self, blocks: Mapping[str, tuple[int, Tensor]], columns: int) -> dict[str, Tensor]:
        """Maps of the trained parameters, given the first column and the entries of each."""
        maps = {}
        for name, value in self.named_parameters():
            if value.requires_grad:
                start, block = blocks[name]
                shape = (self.groups, self.outputs, columns, block.shape[-1])
                maps[name] = block.new_zeros(shape)
                maps[name][:, :, start : start + block.shape[-2]] = block
        return maps


def targets_of(x: Tensor, y: Tensor, outputs: int) -> Tensor:
    """Targets as (samples, groups, outputs); ValueError unless finite and of the batch of `x`."""
    if y.shape != (*x.shape[:-1], outputs):
        raise ValueError(
            f"targets of inputs {tuple(x.shape)} must be of shape {(*x.shape[:-1], outputs)}, "
            f"got {tuple(y.shape)}."
        )
    if not bool(torch.isfinite(y).all()):
        raise ValueError("targets must be finite, got NaN or infinity; drop those samples.")
    return y.reshape(-1, *y.shape[-2:])


def ridge(features: Tensor, targets: Tensor, prior_precision: float | Tensor) -> Tensor:
    """Minimiser of `|targets - features w|^2 + prior_precision |w|^2`.

    The rows are reduced to a triangle by Householder QR, one block at a time, so that the condition
    number is not squared and memory does not grow with the number of samples. Directions determined
    by neither data nor prior are zero (minimum-norm solution).

    Args:
        features: shape (samples, groups, features).
        targets: shape (samples, groups, outputs).
        prior_precision: not negative, a number or broadcastable to (groups, features); relative to
            the noise precision, so that 1 has the weight of one sample with unit feature.
    Returns:
        Weights, shape (groups, features, outputs).
    Raises:
        ValueError: if there are no samples, some are not finite, or a precision is negative.
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
    rows = torch.cat([features, targets], -1).transpose(0, 1)
    triangle = rows[:, :0]
    for block in rows.split(_ROWS_AT_ONCE, dim=1):
        triangle = torch.linalg.qr(torch.cat([triangle, block], 1), mode="r").R
    if not bool(torch.isfinite(triangle).all()):
        raise ValueError("samples must be finite; drop the rows with NaN or infinity first.")
    upper, rhs = triangle[..., :count], triangle[..., count:]
    scale = precision.expand(groups, count).sqrt()
    rows = torch.cat([upper, torch.diag_embed(scale)], 1)
    # The prior adds rows whose targets are zero.
    rhs = torch.cat([rhs, rhs.new_zeros(groups, count, targets.shape[-1])], 1)
    U, singular, Vh = torch.linalg.svd(rows, full_matrices=False)
    # Smaller singular values are round-off, and their inverses would be noise.
    floor = singular[:, :1] * count * torch.finfo(rows.dtype).eps
    inverse = torch.where(singular > floor, 1.0 / singular, torch.zeros_like(singular))
    return Vh.mT @ (inverse.unsqueeze(-1) * (U.mT @ rhs))
