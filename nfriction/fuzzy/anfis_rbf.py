"""ANFIS with a radial basis head: the layer carries the fit, the head refines it."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from nfriction.fuzzy import anfis_jacobian
from nfriction.fuzzy.anfis import Anfis
from nfriction.fuzzy.layout import to_columns
from nfriction.fuzzy.rbf import RBFHead


class AnfisRBF(nn.Module):
    """ANFIS layer plus an RBF head on [inputs, ANFIS outputs] that adds a correction.

    The ANFIS carries the fit, the head refines it; a fresh head is zero.

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
        self.head = RBFHead(groups, inputs + outputs, units, outputs, seed=seed, dtype=dtype)

    def forward(self, x: Tensor) -> Tensor:
        """Outputs, shape (*batch, groups, outputs), of inputs (*batch, groups, inputs)."""
        y = self.anfis(x)
        return y + self.head(torch.cat([x, y], -1))

    @torch.no_grad()
    def jacobian(self, x: Tensor) -> Tensor:
        """Derivative of every output by every trained parameter, as solvers ask for it.

        Args:
            x: inputs, shape (samples, groups, inputs).
        Returns:
            Shape (samples, groups * outputs, parameters), parameters in the order of
            `named_parameters`.
        """
        y = self.anfis(x)
        seen = torch.cat([x, y], -1)
        # (groups, outputs, parameter, sample): what the layer says, and through the head again.
        said = self.anfis.jacobian(x).permute(1, 2, 0).unflatten(0, (self.groups, self.outputs))
        by_input = self.head.input_jacobian(seen)[:, :, self.inputs :]
        J = said.clone()
        for j in range(self.outputs):
            J.addcmul_(by_input[:, :, j].unsqueeze(2), said[:, j].unsqueeze(1))
        head = self.head.jacobian(seen).permute(1, 2, 0)
        return torch.cat([J.flatten(0, 1), head], 1).permute(2, 0, 1)

    @torch.no_grad()
    def input_jacobian(self, x: Tensor) -> Tensor:
        """Derivative of every output by the inputs of its group.

        Args:
            x: inputs, shape (samples, groups, inputs).
        Returns:
            Shape (groups, outputs, inputs, samples).
        """
        y, said = anfis_jacobian.input_jacobian(self.anfis, x)
        through = self.head.input_jacobian(torch.cat([to_columns(x), y], 1).movedim(-1, 0))
        found = said + through[:, :, : self.inputs]
        for j in range(self.outputs):
            found.addcmul_(through[:, :, self.inputs + j].unsqueeze(2), said[:, j].unsqueeze(1))
        return found

    def init_grid(self, lower: float | Tensor, upper: float | Tensor, seed: int = 0) -> None:
        """Even sets over the inputs' range, the head's centres drawn from it (outputs: ±1).

        Args:
            lower, upper: range of each input, broadcastable to (groups, inputs).
            seed: of the head's centres.
        """
        self.anfis.init_grid(lower, upper)
        like = self.anfis.consequents.detach()
        ones = like.new_ones(self.groups, self.outputs)
        low = torch.as_tensor(lower, dtype=like.dtype, device=like.device).expand(
            self.groups, self.inputs
        )
        high = torch.as_tensor(upper, dtype=like.dtype, device=like.device).expand(
            self.groups, self.inputs
        )
        self.head.init_range(torch.cat([low, -ones], 1), torch.cat([high, ones], 1), seed)

    @torch.no_grad()
    def init_head(self, x: Tensor, seed: int = 0) -> None:
        """Place the head's units where the samples `x` lead; its output stays as it is."""
        self.head.init_kmeans(torch.cat([x, self.anfis(x)], -1), seed)

    @torch.no_grad()
    def solve_head(self, x: Tensor, y: Tensor, prior_precision: float | Tensor = 1e-6) -> None:
        """Least squares of the head's output layer on what the ANFIS leaves of `y`."""
        carried = self.anfis(x)
        self.head.solve_output(torch.cat([x, carried], -1), y - carried, prior_precision)
