"""Jacobian of a layer as columns that depend on the sample, times maps that do not.

The outputs of a layer share its units, so that their derivatives are combinations of fewer columns
than there are parameters. With F = columns[g] and M = maps[name][g, k],

    d y_k(sample) / d parameter = F[:, sample] . M[:, parameter],

and least squares needs one product F F^T whatever the number of outputs.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn


@torch.no_grad()
def dense_jacobian(columns: Tensor, maps: Mapping[str, Tensor], outputs: int) -> Tensor:
    """The Jacobian itself.

    Args:
        columns: shape (groups, columns, samples).
        maps: for each parameter (groups, outputs, columns, entries of a group).
        outputs: of a group; no parameter might tell it.
    Returns:
        Shape (samples, groups * outputs, parameters), lying (output, parameter, sample) in memory,
        which products of matrices want.
    """
    groups, _, samples = columns.shape
    blocks = list(maps.values())
    entries = [block.shape[-1] for block in blocks]
    J = columns.new_zeros(groups, outputs, groups * sum(entries), samples)
    start = 0
    for block, count in zip(blocks, entries, strict=True):
        for g in range(groups):
            rows = J[g, :, start : start + count]
            torch.matmul(block[g].mT, columns[g], out=rows)
            start += count
    return J.flatten(0, 1).permute(2, 0, 1)


def trained(module: nn.Module) -> list[str]:
    """Names of the parameters to differentiate by, in order.

    Under `torch.func.functional_call` a plain tensor stands in for each trained parameter; what
    still is a parameter there without a gradient is frozen.
    """
    return [
        name
        for name, value in module.named_parameters()
        if value.requires_grad or not isinstance(value, nn.Parameter)
    ]
