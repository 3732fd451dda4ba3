"""Radial basis functions: the paper's 2-10-2 network, and the head on an ANFIS layer."""

from typing import Final

import torch
from torch import Tensor, nn

from nfriction.fuzzy.factored_jacobian import dense_jacobian, trained
from nfriction.fuzzy.layout import to_columns, to_rows
from nfriction.fuzzy.least_squares import ridge
from nfriction.fuzzy.radial_centres import kmeans_centres, nearest_spread, selected_centres


class RBFNetwork(nn.Module):
    """Gaussian units with a width per axis and a linear output layer, groups stacked.

    `y = output_weight · exp(-Σ_i ((x_i - c_i)/s_i)^2 / 2) + output_bias`. A fresh network has its
    centres drawn from [-1, 1] and small random output weights; `init_kmeans` or `init_ols` place
    the centres by the data, `solve_output` gives the best output layer for them.

    Parameters: `centres` and `log_widths` (groups, units, inputs), `output_weight` (groups,
    outputs, units), `output_bias` (groups, outputs).

    Args:
        groups: independent networks of the same shape, e.g. one a joint.
        inputs, units, outputs: the paper's network is 2-10-2.
        seed: of the fresh centres and weights.

    References:
        Moody and Darken (1989), Fast learning in networks of locally-tuned processing units.
        TLRIP paper, section on the neuro-fuzzy models (2-10-2).
    """

    # A unit 24 widths away says 5e-131, as good as nothing. Numbers that underflow would cost fifty
    # times the arithmetic, in the exponential and again in every product.
    least_exponent: Final[float] = -300.0

    def __init__(
        self,
        groups: int,
        inputs: int = 2,
        units: int = 10,
        outputs: int = 2,
        *,
        seed: int = 0,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        if min(groups, inputs, units, outputs) < 1:
            raise ValueError(
                "`groups`, `inputs`, `units` and `outputs` must be at least 1, got "
                f"{groups}, {inputs}, {units}, {outputs}."
            )
        self.groups, self.inputs, self.units, self.outputs = groups, inputs, units, outputs
        random = torch.Generator().manual_seed(seed)
        weight = torch.randn(groups, outputs, units, generator=random, dtype=dtype)
        self.centres = nn.Parameter(torch.empty(groups, units, inputs, dtype=dtype))
        self.log_widths = nn.Parameter(torch.empty(groups, units, inputs, dtype=dtype))
        self.output_weight = nn.Parameter(0.1 * weight)
        self.output_bias = nn.Parameter(torch.zeros(groups, outputs, dtype=dtype))
        self.init_range(-1.0, 1.0, seed)

    def extra_repr(self) -> str:
        return (
            f"groups={self.groups}, inputs={self.inputs}, units={self.units}, "
            f"outputs={self.outputs}"
        )

    def forward(self, x: Tensor) -> Tensor:
        """Outputs, shape (*batch, groups, outputs), of inputs (*batch, groups, inputs)."""
        y = torch.baddbmm(self.output_bias.unsqueeze(-1), self.output_weight, self._activations(x))
        return to_rows(y, x)

    def activations(self, x: Tensor) -> Tensor:
        """Outputs of the Gaussian units, shape (*batch, groups, units)."""
        return to_rows(self._activations(x), x)

    def regressors(self, x: Tensor) -> Tensor:
        """Features in which the output is linear: the units and 1, (*batch, groups, units + 1)."""
        return torch.cat([self.activations(x), torch.ones_like(x[..., :1])], -1)

    def jacobian(self, x: Tensor) -> Tensor:
        """Derivative of every output by every trained parameter, as solvers ask for it.

        Args:
            x: inputs, shape (samples, groups, inputs).
        Returns:
            Shape (samples, groups * outputs, parameters), parameters in the order of
            `named_parameters`.
        """
        return dense_jacobian(self.jacobian_columns(x), self.jacobian_maps(), self.outputs)

    @torch.no_grad()
    def input_jacobian(self, x: Tensor) -> Tensor:
        """Derivative of every output by the inputs of its group.

        Args:
            x: inputs, shape (samples, groups, inputs).
        Returns:
            Shape (groups, outputs, inputs, samples).
        """
        phi, precision = self._activations(x), torch.exp(-2.0 * self.log_widths)

        def weighted(factor: Tensor) -> Tensor:
            rows = (self.output_weight.unsqueeze(2) * factor.mT.unsqueeze(1)).flatten(1, 2)
            return torch.bmm(rows, phi).unflatten(1, (self.outputs, self.inputs))

        # phi (c - x) / s^2, split so that each part is one product of matrices.
        moved = weighted(precision).mul_(to_columns(x).unsqueeze(1))
        return weighted(self.centres * precision).sub_(moved)

    @torch.no_grad()
    def regressor_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor:
        """`regressors` with the samples last, (groups, units + 1, samples), written to `out`."""
        constant, quadratic, powers = self._expanded(x)
        if out is None:
            out = powers.new_empty(len(powers), self.units + 1, powers.shape[2])
        phi = torch.baddbmm(constant, quadratic, powers, out=out[:, :-1])
        phi.clamp_(min=self.least_exponent).exp_()
        out[:, -1] = 1.0
        return out

    @torch.no_grad()
    def jacobian_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor:
        """What the derivatives of all outputs combine: the regressors, phi d and phi d^2.

        Here d = x - c. `jacobian_maps` says how they combine.

        Args:
            x: inputs, shape (samples, groups, inputs).
            out: where to write the result, its shape; fresh memory costs more than the arithmetic.
        Returns:
            Shape (groups, units + 1 + 2 units inputs, samples).
        """
        columns, shared = to_columns(x), self.units + 1
        shape = (len(columns), shared + 2 * self.units * self.inputs, columns.shape[-1])
        F = columns.new_empty(shape) if out is None else out
        moving = F[:, shared:].unflatten(1, (2, self.units, self.inputs))
        d = torch.sub(columns.unsqueeze(1), self.centres.unsqueeze(-1), out=moving[:, 0])
        squares = torch.mul(d, d, out=moving[:, 1])
        # The differences are asked for anyway, so that the exponents take nothing else.
        factor = -0.5 * torch.exp(-2.0 * self.log_widths).unsqueeze(-1)
        phi = torch.mul(squares[:, :, 0], factor[:, :, 0], out=F[:, : self.units])
        for i in range(1, self.inputs):
            phi.addcmul_(squares[:, :, i], factor[:, :, i])
        phi.clamp_(min=self.least_exponent).exp_()
        F[:, self.units] = 1.0
        moving.mul_(phi[:, None, :, None])
        return F

    def readout(self) -> Tensor:
        """The output layer, (groups, outputs, units + 1): outputs of the first columns."""
        return torch.cat([self.output_weight, self.output_bias.unsqueeze(-1)], -1)

    @torch.no_grad()
    def jacobian_maps(self) -> dict[str, Tensor]:
        """How `jacobian_columns` combine to the derivatives by each trained parameter.

        d y_k = sum_u w_ku (phi d / s^2 dc + phi d^2 / s^2 dlog s) + phi_u dw_ku + db_k.

        Returns:
            For each trained parameter (groups, outputs, columns, entries of a group).
        """
        groups, units, inputs = self.centres.shape
        moving, columns = units * inputs, (2 * inputs + 1) * units + 1
        weight = self.output_weight.detach().repeat_interleave(inputs, 2)
        slope = torch.diag_embed(weight * torch.exp(-2.0 * self.log_widths).flatten(1).unsqueeze(1))
        own, one = (torch.eye(n).to(weight) for n in (self.outputs, units))
        blocks = {
            "centres": (units + 1, slope),
            "log_widths": (units + 1 + moving, slope),
            "output_weight": (0, torch.einsum("ab,uv->aubv", own, one).flatten(2)),
            "output_bias": (units, own.unsqueeze(1)),
        }
        maps = {}
        for name in trained(self):
            start, block = blocks[name]
            maps[name] = weight.new_zeros(groups, self.outputs, columns, block.shape[-1])
            maps[name][:, :, start : start + block.shape[-2]] = block
        return maps

    def _activations(self, x: Tensor) -> Tensor:
        """Units' outputs, shape (groups, units, samples)."""
        return torch.exp(self._exponents(x))

    def _exponents(self, x: Tensor) -> Tensor:
        """Logarithms of the units' outputs, shape (groups, units, samples)."""
        constant, quadratic, powers = self._expanded(x)
        return torch.baddbmm(constant, quadratic, powers).clamp(min=self.least_exponent)

    def _expanded(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Constants, coefficients and powers of the inputs whose product the exponents are.

        The square is expanded into a product of matrices, 12 times faster on 40,000 samples than
        differences of every sample and centre. Taken about the mean centre it costs digits only by
        (range/width)^2, never by where the inputs lie.

        Returns:
            Shapes (groups, units, 1), (groups, units, 2 inputs) and (groups, 2 inputs, samples).
        """
        columns = to_columns(x)
        middle = self.centres.mean(1)
        offset = self.centres - middle.unsqueeze(1)
        v = columns - middle.unsqueeze(-1)
        precision = torch.exp(-2.0 * self.log_widths)
        linear = precision * offset
        constant = -0.5 * (linear * offset).sum(2)
        quadratic = torch.cat([-0.5 * precision.expand_as(linear), linear], 2)
        return constant.unsqueeze(-1), quadratic, torch.cat([v * v, v], 1)

    @torch.no_grad()
    def init_range(self, lower: float | Tensor, upper: float | Tensor, seed: int = 0) -> None:
        """Centres drawn from a range, widths half of it.

        Args:
            lower, upper: range of each input, broadcastable to (groups, inputs).
            seed: of the draw.
        """
        like = self.centres[:, 0].detach()
        low = (
            torch.as_tensor(lower, dtype=like.dtype, device=like.device)
            .expand_as(like)
            .unsqueeze(1)
        )
        span = (
            torch.as_tensor(upper, dtype=like.dtype, device=like.device)
            .expand_as(like)
            .unsqueeze(1)
            - low
        )
        if not bool(((span > 0) & torch.isfinite(span)).all()):
            raise ValueError("every input needs a finite range with `lower` < `upper`.")
        random = torch.Generator().manual_seed(seed)
        drawn = torch.rand(self.centres.shape, generator=random, dtype=torch.float64).to(like)
        self.centres.copy_(low + span * drawn)
        self.log_widths.copy_((0.5 * span).log().expand_as(self.centres))

    @torch.no_grad()
    def init_kmeans(self, x: Tensor, seed: int = 0, overlap: float = 2.0) -> None:
        """Centres by k-means; widths from the distance to the nearest other centres.

        Args:
            x: samples, shape (*batch, groups, inputs).
            seed: of the k-means++ start.
            overlap: width over the mean distance to the two nearest centres.
        """
        samples = self._samples(x)
        for group in range(self.groups):
            centres = kmeans_centres(samples[:, group], self.units, seed)
            self.centres[group] = centres
            self.log_widths[group] = nearest_spread(centres, samples[:, group], overlap).log()

    @torch.no_grad()
    def init_ols(self, x: Tensor, y: Tensor, width: float = 1.5) -> None:
        """Centres by orthogonal least squares: greedily those samples that explain most of `y`.

        Args:
            x: inputs, shape (*batch, groups, inputs).
            y: wanted outputs, shape (*batch, groups, outputs).
            width: of every unit, over the standard deviation of each input.
        """
        samples = self._samples(x)
        targets = y.reshape(-1, self.groups, self.outputs)
        for group in range(self.groups):
            scale = width * samples[:, group].std(0)
            centres = selected_centres(samples[:, group], targets[:, group], self.units, scale)
            self.centres[group] = centres
            self.log_widths[group] = scale.log().expand_as(centres)

    @torch.no_grad()
    def solve_output(
        self,
        x: Tensor,
        y: Tensor,
        prior_precision: float | Tensor = 1e-6,
        prior: Tensor | None = None,
    ) -> None:
        """Set weights and bias to the least-squares optimum for the present units, in place.

        Args:
            x: inputs, shape (*batch, groups, inputs).
            y: wanted outputs, shape (*batch, groups, outputs).
            prior_precision: over the noise precision; a number or broadcastable to (groups,
                units + 1).
            prior: (groups, outputs, units + 1), weight then bias, to shrink toward; default zero.
        """
        features = self.regressors(x).reshape(-1, self.groups, self.units + 1)
        targets = y.reshape(-1, self.groups, self.outputs)
        start = features.new_zeros(1, 1, 1) if prior is None else prior.mT
        layer = ridge(features, targets, prior_precision, start).mT
        self.output_weight.copy_(layer[..., :-1])
        self.output_bias.copy_(layer[..., -1])

    def _samples(self, x: Tensor) -> Tensor:
        samples = x.detach().reshape(-1, self.groups, self.inputs)
        spread = samples.amax(0) - samples.amin(0)
        if len(samples) < self.units or not bool(((spread > 0) & torch.isfinite(spread)).all()):
            raise ValueError(
                f"placing {self.units} units needs at least as many finite samples and inputs that "
                f"vary, got {len(samples)} samples with spreads {spread.tolist()}."
            )
        return samples


class RBFHead(RBFNetwork):
    """An RBF network that begins as zero: adding it to a model changes nothing at the start."""

    def __init__(
        self,
        groups: int,
        inputs: int,
        units: int = 10,
        outputs: int = 2,
        *,
        seed: int = 0,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__(groups, inputs, units, outputs, seed=seed, dtype=dtype)
        nn.init.zeros_(self.output_weight)
