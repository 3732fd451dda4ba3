"""Normal equations of a module whose outputs share the columns of their Jacobian.

The outputs of a network with a common hidden layer have derivatives that are combinations of fewer
columns than there are parameters, so one product of matrices serves all outputs. A module offers
this by three methods, for inputs x of shape (samples, groups, inputs) and groups that share no
parameter:

    jacobian_columns(x, out=None): shape (groups, columns, samples), written to `out`;
    jacobian_maps(): by the name of each trained parameter (groups, outputs, columns, entries of a
        group), with d y_k / d parameter = maps[name][g, k].T @ columns[g];
    readout(): shape (groups, outputs, n), the outputs as combinations of the first n columns.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, cast

import torch
from torch import Tensor, nn
from torch.func import functional_call

# 4 MiB of columns at a time: fewer samples cost more calls, more fall out of the cache and into
# memory that the system has to hand out anew for every call.
CHUNK_ENTRIES = 2**19


class SharedColumns(Protocol):
    """A module that offers the columns; see the head of this file."""

    def jacobian_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor: ...
    def jacobian_maps(self) -> dict[str, Tensor]: ...
    def readout(self) -> Tensor: ...


def shares_columns(model: object) -> bool:
    """Whether a module offers the columns that its outputs share."""
    return all(
        callable(getattr(model, name, None))
        for name in ("jacobian_columns", "jacobian_maps", "readout")
    )


@torch.no_grad()
def accumulate_columns(
    model: nn.Module,
    parameters: Mapping[str, Tensor],
    inputs: Tensor,
    targets: Tensor,
    weights: Tensor | None = None,
    chunk: int | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """J^T J, J^T e and sum e^2 of the errors e = model(inputs) - targets, all weighted.

    Args:
        model: offers its columns (`shares_columns`).
        parameters: all that the module trains, in its order, with the values to take.
        inputs: shape (n, groups, inputs).
        targets: shape (n, groups, outputs).
        weights: factors of the squared errors, shape (n,) or that of `targets`.
        chunk: samples at once; by default as many as fit a few megabytes.
    Returns:
        Shapes (p, p), (p,) and ().
    """
    prefixed = {f"model.{name}": value for name, value in parameters.items()}
    arguments = (inputs, targets, None if weights is None else weights.sqrt(), chunk)
    grams, maps = functional_call(_Grams(model), prefixed, arguments)
    count = sum(value.numel() for value in parameters.values())
    JtJ, Jte = inputs.new_zeros(count, count), inputs.new_zeros(count)
    squares = inputs.new_zeros(())
    for group, gram in enumerate(grams.unbind(0)):
        where = _entries(parameters, len(grams), group).to(inputs.device)
        map_ = torch.cat([maps[name][group] for name in parameters], -1)
        outputs, columns = map_.shape[:2]
        # With weights that differ between the outputs each has a Gram matrix of its own.
        own = gram.expand(outputs, *gram.shape[1:])
        JtJ[where[:, None], where] = (map_.mT @ own[:, :columns, :columns] @ map_).sum(0)
        errors = own[:, columns:].diagonal(dim1=0, dim2=1)
        Jte[where] = torch.einsum("kcp,ck->p", map_, errors[:columns])
        squares += errors[columns:].diagonal().sum()
    return JtJ, Jte, squares


class _Grams(nn.Module):
    """Products of all columns and errors, in a module that `functional_call` can reach through."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(
        self, inputs: Tensor, targets: Tensor, roots: Tensor | None, chunk: int | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Gram matrices (groups, 1 or outputs, rows, rows) of [columns, errors], and the maps."""
        model = cast(SharedColumns, self.model)
        readout, maps = model.readout(), model.jacobian_maps()
        groups, outputs, used = readout.shape
        columns = next(iter(maps.values())).shape[2]
        rows = columns + outputs
        chunk = CHUNK_ENTRIES // (groups * rows) if chunk is None else chunk
        chunk = min(len(inputs), max(1, chunk))
        # Written again and again: the first touch of fresh memory costs more than the arithmetic.
        buffer = inputs.new_empty(groups, rows, chunk)
        own = outputs if roots is not None and roots.ndim > 1 else 1
        grams = inputs.new_zeros(groups, own, rows, rows)
        for start in range(0, len(inputs), chunk):
            part = slice(start, start + chunk)
            wanted = targets[part].permute(1, 2, 0)
            F = buffer[:, :, : wanted.shape[-1]]
            model.jacobian_columns(inputs[part], F[:, :columns])
            torch.bmm(readout, F[:, :used], out=F[:, columns:])
            F[:, columns:].sub_(wanted)
            if roots is None:
                grams[:, 0].baddbmm_(F, F.mT)
                continue
            root = roots[part].reshape(wanted.shape[-1], -1, own if own > 1 else 1)
            for k, factor in enumerate(root.permute(2, 1, 0)):
                G = F * factor.unsqueeze(1)
                grams[:, k].baddbmm_(G, G.mT)
        return grams, maps


def _entries(parameters: Mapping[str, Tensor], groups: int, group: int) -> Tensor:
    """Where a group's entries of every parameter lie in the flat vector of all."""
    places, start = [], 0
    for value in parameters.values():
        count = value.numel() // groups
        places.append(torch.arange(count) + start + group * count)
        start += value.numel()
    return torch.cat(places)
