"""ANFIS with a radial basis head: the layer carries the fit, the head refines it."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from nfriction.fuzzy.anfis import Anfis
from nfriction.fuzzy.grouped import GroupedModule, input_range
from nfriction.fuzzy.rbf import RBFNetwork


class AnfisRBF(GroupedModule):
    """ANFIS layer plus an RBF head on [inputs, ANFIS outputs] that adds a correction.

    The ANFIS carries the fit, the head refines it; the output of a fresh head is zero.

    Args:
        groups, inputs, terms, outputs, order, kind, interpretable: of the layer, see `Anfis`.
        units: units of the head.
        seed: of the head's fresh centres.
    """

    def __init__(
        self,
        groups: int,
        inputs: int,
        terms: Sequence[int],
        outputs: int,
        *,
        units: int = 10,
        order: int = 1,
        kind: str = "gaussian",
        interpretable: bool = False,
        seed: int = 0,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        self.groups, self.inputs, self.outputs = groups, inputs, outputs
        self.anfis = Anfis(
            groups,
            inputs,
            terms,
            outputs,
            order=order,
            kind=kind,
            interpretable=interpretable,
            dtype=dtype,
        )
        self.head = RBFNetwork(groups, inputs + outputs, units, outputs, seed=seed, dtype=dtype)
        # A fresh head changes nothing.
        nn.init.zeros_(self.head.output_weight)

    def forward(self, x: Tensor) -> Tensor:
        """Outputs, shape (*batch, groups, outputs), of inputs (*batch, groups, inputs)."""
        y = self.anfis(x)
        return y + self.head(torch.cat([x, y], -1))

    def init_grid(self, lower: float | Tensor, upper: float | Tensor, seed: int = 0) -> None:
        """Even sets over the inputs' range, the head's centres drawn from it (outputs: ±1).

        Args:
            lower, upper: range of each input, broadcastable to (groups, inputs).
            seed: of the head's centres.
        """
        self.anfis.init_grid(lower, upper)
        centres = self.head.centres[:, 0].detach()
        low, high = input_range(lower, upper, centres[:, : self.inputs])
        ones = torch.ones_like(centres[:, self.inputs :])
        self.head.init_range(torch.cat([low, -ones], 1), torch.cat([high, ones], 1), seed)

    @torch.no_grad()
    def init_head(self, x: Tensor, seed: int = 0) -> None:
        """Place the head's units by the samples `x`; its output layer stays unchanged."""
        self.head.init_kmeans(torch.cat([x, self.anfis(x)], -1), seed)

    @torch.no_grad()
    def solve_head(self, x: Tensor, y: Tensor, prior_precision: float | Tensor = 1e-6) -> None:
        """Least squares of the head's output layer on the ANFIS's residual of `y`."""
        carried = self.anfis(x)
        self.head.solve_output(torch.cat([x, carried], -1), y - carried, prior_precision)
