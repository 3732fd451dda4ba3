"""Jang's hybrid learning of ANFIS: least squares forward, one short gradient step back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from nfriction.fuzzy.anfis import Anfis
from nfriction.fuzzy.partition import FreePartition

# Jang's heuristic: epochs that a step size is kept at least, and factors of its change.
_INTERVAL, _INCREASE, _DECREASE = 4, 1.1, 0.9


@dataclass(frozen=True)
class HybridResult:
    """Course of a hybrid training, each of shape (epochs, groups).

    Attributes:
        rmse: root of the mean squared error over samples and outputs, after the least squares and
            before the premises moved.
        step: length of the premises' step.
    """

    rmse: Tensor
    step: Tensor


def hybrid_step(
    anfis: Anfis, x: Tensor, y: Tensor, step: float | Tensor, *, prior_precision: float = 1e-6
) -> Tensor:
    """One epoch: consequents by least squares, then a gradient step of length `step` for the sets.

    The gradient is taken in centres, widths and slopes themselves (not their logarithms), over all
    sets of a group together.

    Args:
        anfis: layer with free sets, changed in place.
        x: inputs, shape (samples, groups, inputs).
        y: wanted outputs, shape (samples, groups, outputs).
        step: length of the step, a number or shape (groups).
    Returns:
        RMSE of each group before the sets moved, shape (groups).
    References:
        Jang (1993), ANFIS: Adaptive-Network-Based Fuzzy Inference System, section III, eq. (17).
    """
    if not isinstance(anfis.partition, FreePartition):
        raise ValueError(
            "the hybrid step moves centres and widths freely; train an interpretable layer by "
            "gradients instead."
        )
    anfis.solve_consequents(x, y, prior_precision)
    logs = [anfis.partition.log_widths]
    if anfis.log_slopes is not None:
        logs.append(anfis.log_slopes)
    with torch.enable_grad():
        error = ((anfis(x) - y) ** 2).transpose(0, 1).flatten(1).mean(1)
        gradients = torch.autograd.grad(error.sum(), [anfis.partition.centres, *logs])
    with torch.no_grad():
        values = [anfis.partition.centres, *(log.exp() for log in logs)]
        # d/dv = (d/dlog v) / v.
        natural = [gradients[0]] + [
            gradient / value for gradient, value in zip(gradients[1:], values[1:], strict=True)
        ]
        length = torch.cat(natural, 1).norm(dim=1)
        # The length is of the step, not a rate: it does not depend on the units of the error.
        wanted = torch.as_tensor(step, dtype=length.dtype, device=length.device)
        rate = wanted / length.clamp(min=torch.finfo(length.dtype).tiny)
        anfis.partition.centres.sub_(rate.unsqueeze(1) * natural[0])
        for log, value, gradient in zip(logs, values[1:], natural[1:], strict=True):
            # A step toward zero or beyond stops at a tenth of the value.
            log.copy_(torch.maximum(value - rate.unsqueeze(1) * gradient, 0.1 * value).log())
    return error.detach().sqrt()


def train_hybrid(
    anfis: Anfis,
    x: Tensor,
    y: Tensor,
    epochs: int = 20,
    *,
    step: float = 0.01,
    prior_precision: float = 1e-6,
    callback: Callable[[int, Tensor], None] | None = None,
) -> HybridResult:
    """Train by `hybrid_step` with Jang's step-size heuristic; the best epoch's layer is kept.

    The step grows by 10 % after four falls of the error in a row and shrinks by 10 % after two
    oscillations (up, down, up, down), each group for itself.

    Args:
        anfis: layer with free sets, trained in place.
        x, y: samples, shapes (samples, groups, inputs) and (samples, groups, outputs).
        callback: called with the epoch and the RMSE of each group.
    References:
        Jang (1993), section V-A, figure 11.
    """
    if epochs < 1:
        raise ValueError(f"`epochs` must be at least 1, got {epochs}.")
    length = x.new_full((anfis.groups,), step)
    changed = torch.zeros(2, anfis.groups, dtype=torch.long)
    errors: list[Tensor] = []
    lengths: list[Tensor] = []
    best = x.new_full((anfis.groups,), torch.inf)
    kept: dict[str, Tensor] = {}
    for epoch in range(epochs):
        before = {name: value.detach().clone() for name, value in anfis.named_parameters()}
        error = hybrid_step(anfis, x, y, length, prior_precision=prior_precision)
        # The error is that of the sets before the step with consequents solved for them.
        before["consequents"] = anfis.consequents.detach().clone()
        better = error < best
        best = torch.where(better, error, best)
        # Groups are independent: each keeps its own best epoch.
        kept = {
            name: torch.where(
                better.view(-1, *[1] * (value.dim() - 1)), value, kept.get(name, value)
            )
            for name, value in before.items()
        }
        errors.append(error)
        lengths.append(length)
        length = _adapt(length, errors, changed, epoch)
        if callback is not None:
            callback(epoch, error)
    with torch.no_grad():
        for name, parameter in anfis.named_parameters():
            parameter.copy_(kept[name])
    return HybridResult(torch.stack(errors), torch.stack(lengths))


def _adapt(length: Tensor, errors: list[Tensor], changed: Tensor, epoch: int) -> Tensor:
    """Next step length of each group; `changed` keeps the epochs of the last fall and growth."""
    # Four changes take five errors.
    if len(errors) <= _INTERVAL:
        return length
    change = torch.stack(errors[-_INTERVAL - 1 :]).diff(dim=0)
    signs = change.new_tensor([1.0, -1.0, 1.0, -1.0]).unsqueeze(1)
    due = epoch - changed.to(length.device) >= _INTERVAL
    shrink = (change * signs > 0).all(0) & due[0]
    grow = (change < 0).all(0) & due[1] & ~shrink
    changed[0, shrink.cpu()] = epoch
    changed[1, grow.cpu()] = epoch
    change = (_INCREASE - 1.0) * grow.to(length) + (_DECREASE - 1.0) * shrink.to(length)
    return length * (1.0 + change)
