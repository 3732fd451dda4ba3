"""One group of a network, and its change between own and scaled units."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from nfriction.fuzzy import Anfis, AnfisRBF, RBFNetwork
from nfriction.fuzzy.partition import FreePartition

FuzzyNetwork = Anfis | AnfisRBF | RBFNetwork


def one_group(network: FuzzyNetwork, group: int) -> FuzzyNetwork:
    """A network of its own with the values of one group of `network`."""
    single: FuzzyNetwork = deepcopy(network)
    for module in single.modules():
        if isinstance(module, Anfis | AnfisRBF | RBFNetwork):
            module.groups = 1
        for name, value in list(module.named_parameters(recurse=False)):
            part = value.detach()[group : group + 1].clone()
            setattr(module, name, nn.Parameter(part, requires_grad=value.requires_grad))
        for name, buffer in list(module.named_buffers(recurse=False)):
            setattr(module, name, buffer[group : group + 1].clone())
    return single


@dataclass(frozen=True, eq=False)
class Scaling:
    """Affine map of inputs and outputs onto [-1, 1]: own = middle + half * scaled.

    Args:
        x_middle, x_half: shape (groups, inputs).
        y_middle, y_half: shape (groups, outputs).
    """

    x_middle: Tensor
    x_half: Tensor
    y_middle: Tensor
    y_half: Tensor

    @classmethod
    def of(cls, x: Tensor, y: Tensor) -> Scaling:
        """From the ranges of samples, shapes (samples, groups, inputs) and (..., outputs).

        Raises:
            ValueError: if an input never varies; an output that never varies keeps its unit.
        """
        x_middle, x_half = _range(x)
        if not bool((x_half > 0).all()):
            raise ValueError(
                f"every input must vary, got half-ranges {x_half.tolist()}; leave one that does "
                "not out of the network."
            )
        y_middle, y_half = _range(y)
        # A constant output has no range to be scaled by.
        return cls(x_middle, x_half, y_middle, torch.where(y_half > 0, y_half, 1.0))

    def inverse(self) -> Scaling:
        """The map from own to scaled, as if own were scaled."""
        x_half, y_half = 1.0 / self.x_half, 1.0 / self.y_half
        return Scaling(-self.x_middle * x_half, x_half, -self.y_middle * y_half, y_half)

    def inputs(self, x: Tensor) -> Tensor:
        """Scaled inputs of own ones, (*batch, groups, inputs)."""
        return (x - self.x_middle) / self.x_half

    def outputs(self, y: Tensor) -> Tensor:
        """Scaled outputs of own ones, (*batch, groups, outputs)."""
        return (y - self.y_middle) / self.y_half


@torch.no_grad()
def to_own_units(network: FuzzyNetwork, scaling: Scaling) -> None:
    """Rewrite a network of scaled inputs and outputs as the same one in own units, in place.

    Exact: centres, widths and output layers are rewritten. `scaling.inverse()` reverts it.
    """
    if isinstance(network, AnfisRBF):
        # The head reads inputs and the layer's outputs, and adds to these without a middle.
        head = Scaling(
            torch.cat([scaling.x_middle, scaling.y_middle], 1),
            torch.cat([scaling.x_half, scaling.y_half], 1),
            torch.zeros_like(scaling.y_middle),
            scaling.y_half,
        )
        _rescale_anfis(network.anfis, scaling)
        _rescale_rbf(network.head, head)
    elif isinstance(network, Anfis):
        _rescale_anfis(network, scaling)
    else:
        _rescale_rbf(network, scaling)


def _rescale_rbf(network: RBFNetwork, scaling: Scaling) -> None:
    # Widths scale with the inputs, so that every unit responds exactly as before.
    half = scaling.x_half.unsqueeze(1)
    network.centres.mul_(half).add_(scaling.x_middle.unsqueeze(1))
    network.log_widths.add_(half.log())
    network.output_weight.mul_(scaling.y_half.unsqueeze(-1))
    network.output_bias.mul_(scaling.y_half).add_(scaling.y_middle)


def _rescale_anfis(anfis: Anfis, scaling: Scaling) -> None:
    # Free sets lie one after the other in a row, input by input.
    counts = torch.tensor(anfis.terms, device=scaling.x_half.device)
    if isinstance(anfis.partition, FreePartition):
        half = scaling.x_half.repeat_interleave(counts, 1)
        anfis.partition.centres.mul_(half).add_(scaling.x_middle.repeat_interleave(counts, 1))
        anfis.partition.log_widths.add_(half.log())
    else:
        for bound in (anfis.partition.lower, anfis.partition.upper):
            bound.mul_(scaling.x_half).add_(scaling.x_middle)
    consequents = anfis.consequents
    if anfis.order == 1:
        # A plane of scaled inputs: slopes absorb the ranges, the offset absorbs the middles.
        consequents[..., :-1].div_(scaling.x_half[:, None, None])
        moved = consequents[..., :-1] * scaling.x_middle[:, None, None]
        consequents[..., -1].sub_(moved.sum(-1))
    consequents.mul_(scaling.y_half[..., None, None])
    consequents[..., -1].add_(scaling.y_middle.unsqueeze(-1))


def _range(values: Tensor) -> tuple[Tensor, Tensor]:
    """Middle and half-range over the samples, each (groups, size)."""
    # Extremes, not deviations: sets then lie on [-1, 1] whatever the distribution.
    low, high = values.amin(0), values.amax(0)
    return 0.5 * (low + high), 0.5 * (high - low)
