"""Radial basis functions: the paper's 2-10-2 network, and a head that refines an ANFIS."""

from collections.abc import Sequence
from typing import Any, Final

import torch
from torch import Tensor, nn

from nfriction.fuzzy import grouped
from nfriction.fuzzy.anfis import Anfis

# Numbers of evenly thinned candidates and samples for orthogonal least squares.
_CANDIDATES, _SAMPLES = 500, 5000


class RBFNetwork(grouped.LinearOutputModule):
    """Gaussian units with one width per axis and a linear output layer, with groups stacked.

    `y = output_weight · exp(-Σ_i ((x_i - c_i)/s_i)^2 / 2) + output_bias`. A new network has
    centres drawn from [-1, 1] and small random output weights; `init_kmeans` or `init_ols` place
    the centres using data, and `solve_output` finds the best output layer for them.

    Parameters: `centres` and `log_widths` (groups, units, inputs), `output_weight` (groups,
    outputs, units), `output_bias` (groups, outputs).

    Args:
        groups: independent networks of the same shape, e.g. one per joint.
        inputs, units, outputs: the paper's network is 2-10-2.

    References:
        Moody and Darken (1989), Fast learning in networks of locally-tuned processing units.
        TLRIP paper, section on the neuro-fuzzy models (2-10-2).
    """

    # A unit 24 widths away returns 5e-131, practically zero. Numbers that underflow
    # would make the exponential and every later product fifty times slower.
    least_exponent: Final[float] = -300.0

    def __init__(
        self,
        groups: int,
        inputs: int = 2,
        units: int = 10,
        outputs: int = 2,
        *,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if min(groups, inputs, units, outputs) < 1:
            raise ValueError(
                "`groups`, `inputs`, `units` and `outputs` must be at least 1, got "
                f"{groups}, {inputs}, {units}, {outputs}."
            )
        self.groups, self.inputs, self.units, self.outputs = groups, inputs, units, outputs
        random = torch.Generator().manual_seed(seed)
        weight = torch.randn(groups, outputs, units, generator=random, dtype=torch.float64)
        self.centres = nn.Parameter(torch.empty(groups, units, inputs, dtype=torch.float64))
        self.log_widths = nn.Parameter(torch.empty(groups, units, inputs, dtype=torch.float64))
        # Small, so that a new network is nearly flat; with zero, centres would have no gradient.
        self.output_weight = nn.Parameter(0.1 * weight)
        self.output_bias = nn.Parameter(torch.zeros(groups, outputs, dtype=torch.float64))
        self.init_range(-1.0, 1.0, seed)

    def extra_repr(self) -> str:
        return (
            f"groups={self.groups}, inputs={self.inputs}, units={self.units}, "
            f"outputs={self.outputs}"
        )

    def forward(self, x: Tensor) -> Tensor:
        """Outputs, shape (*batch, groups, outputs), of inputs (*batch, groups, inputs)."""
        y = torch.baddbmm(self.output_bias.unsqueeze(-1), self.output_weight, self._activations(x))
        return grouped.to_rows(y, x)

    def activations(self, x: Tensor) -> Tensor:
        """Outputs of the Gaussian units, shape (*batch, groups, units)."""
        return grouped.to_rows(self._activations(x), x)

    @torch.no_grad()
    def input_jacobian(self, x: Tensor) -> Tensor:
        """In closed form, in float64 from the expanded exponents."""
        if x.dtype != torch.float64:
            apart = self._apart(x)
            slopes = self._activations(x).unsqueeze(2) * apart / self.log_widths.exp().unsqueeze(-1)
            return -torch.einsum("gku,guin->gkin", self.output_weight, slopes)
        _, quadratic, powers = self._expanded(x)
        weights = self.output_weight.unsqueeze(2) * quadratic.mT.unsqueeze(1)
        slopes = weights.flatten(1, 2) @ self._activations(x)
        square, linear = slopes.unflatten(1, (self.outputs, 2, self.inputs)).unbind(2)
        return 2.0 * square * powers[:, self.inputs :].unsqueeze(1) + linear

    @torch.no_grad()
    def regressor_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor:
        """The units and 1, (groups, units + 1, samples), written to `out`."""
        if x.dtype != torch.float64:
            found = nn.functional.pad(self._activations(x), (0, 0, 0, 1), value=1.0)
            return found if out is None else out.copy_(found)
        constant, quadratic, powers = self._expanded(x)
        if out is None:
            out = powers.new_empty(len(powers), self.units + 1, powers.shape[2])
        # Always in place: these are the largest arrays of a fit.
        phi = torch.baddbmm(constant, quadratic, powers, out=out[:, :-1])
        phi.clamp_(min=self.least_exponent).exp_()
        out[:, -1] = 1.0
        return out

    @torch.no_grad()
    def jacobian_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor:
        """The regressors, phi d and phi d^2 with d = x - c.

        Args:
            x: inputs, shape (samples, groups, inputs).
            out: buffer of the result's shape; allocating memory costs more than the arithmetic.
        Returns:
            Shape (groups, units + 1 + 2 units inputs, samples).
        """
        columns, shared = grouped.to_columns(x), self.units + 1
        shape = (len(columns), shared + 2 * self.units * self.inputs, columns.shape[-1])
        F = columns.new_empty(shape) if out is None else out
        moving = F[:, shared:].unflatten(1, (2, self.units, self.inputs))
        d = torch.sub(columns.unsqueeze(1), self.centres.unsqueeze(-1), out=moving[:, 0])
        squares = torch.mul(d, d, out=moving[:, 1])
        # The exponents need only these differences.
        factor = -0.5 * torch.exp(-2.0 * self.log_widths).unsqueeze(-1)
        phi = torch.mul(squares[:, :, 0], factor[:, :, 0], out=F[:, : self.units])
        for i in range(1, self.inputs):
            phi.addcmul_(squares[:, :, i], factor[:, :, i])
        phi.clamp_(min=self.least_exponent).exp_()
        F[:, self.units] = 1.0
        moving.mul_(phi[:, None, :, None])
        return F

    def readout(self) -> Tensor:
        """Weights and bias, (groups, outputs, units + 1)."""
        return torch.cat([self.output_weight, self.output_bias.unsqueeze(-1)], -1)

    @torch.no_grad()
    def jacobian_maps(self) -> dict[str, Tensor]:
        """d y_k = sum_u w_ku (phi d / s^2 dc + phi d^2 / s^2 dlog s) + phi_u dw_ku + db_k."""
        units, inputs = self.units, self.inputs
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
        return self._placed(blocks, columns)

    def _activations(self, x: Tensor) -> Tensor:
        """Outputs of the units, shape (groups, units, samples)."""
        if x.dtype != torch.float64:
            # The expansion loses the digits of narrow units in single precision.
            return torch.exp(-0.5 * self._apart(x).square().sum(2))
        constant, quadratic, powers = self._expanded(x)
        exponents = torch.baddbmm(constant, quadratic, powers).clamp(min=self.least_exponent)
        return torch.exp(exponents)

    def _apart(self, x: Tensor) -> Tensor:
        """Distances from the centres in widths, (groups, units, inputs, samples)."""
        apart = grouped.to_columns(x).unsqueeze(1) - self.centres.unsqueeze(-1)
        return apart * torch.exp(-self.log_widths).unsqueeze(-1)

    def _expanded(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Constants, coefficients and powers of the inputs, whose product gives the exponents.

        Expanding the square into a product of matrices is 12 times faster on 40,000 samples than
        differences of every sample and centre. Expanded about the mean centre, the loss of digits
        depends only on (range/width)^2, not on the location of the inputs.

        Returns:
            Shapes (groups, units, 1), (groups, units, 2 inputs) and (groups, 2 inputs, samples).
        """
        columns = grouped.to_columns(x)
        # Expanding about zero would cancel digits for inputs far from it.
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
        """Draw the centres from a range and set the widths to half of it.

        Args:
            lower, upper: range of each input, broadcastable to (groups, inputs).
        """
        low, high = grouped.input_range(lower, upper, self.centres[:, 0].detach())
        low, span = low.unsqueeze(1), (high - low).unsqueeze(1)
        random = torch.Generator().manual_seed(seed)
        drawn = torch.rand(self.centres.shape, generator=random, dtype=torch.float64).to(low)
        self.centres.copy_(low + span * drawn)
        self.log_widths.copy_((0.5 * span).log().expand_as(self.centres))

    @torch.no_grad()
    def init_kmeans(self, x: Tensor, seed: int = 0) -> None:
        """Place centres by k-means; widths are twice the mean distance to the two nearest centres.

        Distances are in units of each input's standard deviation.

        Args:
            x: samples, shape (*batch, groups, inputs).
        """
        from scipy.cluster.vq import kmeans2  # slow to import and rarely needed

        for group, own in enumerate(self._samples(x).unbind(1)):
            # k-means depends on the units of its inputs.
            scale = own.std(0)
            given = (own / scale).cpu().numpy()
            found, _ = kmeans2(given, self.units, iter=50, minit="++", seed=seed)
            self.centres[group] = centres = torch.as_tensor(found).to(own) * scale
            spread = torch.ones(1, 1).to(scale)  # of a single unit
            if self.units > 1:
                distance = torch.cdist(centres / scale, centres / scale)
                # The smallest distance is that from a centre to itself.
                spread = distance.sort(1).values[:, 1:3].mean(1, keepdim=True)
            # Two centres may coincide if k-means had too few distinct samples.
            self.log_widths[group] = (2 * spread.clamp(min=1e-3) * scale).log()

    @torch.no_grad()
    def init_ols(self, x: Tensor, y: Tensor, width: float = 1.5) -> None:
        """Place centres by orthogonal least squares: greedily at the samples that explain `y` best.

        Args:
            x: inputs, shape (*batch, groups, inputs).
            y: desired outputs, shape (*batch, groups, outputs).
            width: of every unit, relative to the standard deviation of each input.
        Raises:
            ValueError: if samples are too few, an input never varies, or targets or width is wrong.
        """
        if not 0 < width < torch.inf:
            raise ValueError(f"`width` must be positive and finite, got {width}.")
        samples = self._samples(x)
        targets = grouped.targets_of(x, y, self.outputs)
        for group in range(self.groups):
            scale = width * samples[:, group].std(0)
            centres = _selected(samples[:, group], targets[:, group], self.units, scale)
            self.centres[group] = centres
            self.log_widths[group] = scale.log().expand_as(centres)

    @torch.no_grad()
    def solve_output(self, x: Tensor, y: Tensor, prior_precision: float | Tensor = 1e-6) -> None:
        """Set weights and bias to the least-squares optimum for the current units, in place.

        Args:
            x: inputs, shape (*batch, groups, inputs).
            y: desired outputs, shape (*batch, groups, outputs).
            prior_precision: relative to the noise precision; a number or broadcastable to (groups,
                units + 1).
        Raises:
            ValueError: if targets are not finite or do not fit the inputs.
        """
        features = self.regressors(x).reshape(-1, self.groups, self.units + 1)
        targets = grouped.targets_of(x, y, self.outputs)
        layer = grouped.ridge(features, targets, prior_precision).mT
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


class AnfisRBF(nn.Module):
    """ANFIS layer plus an RBF head on [inputs, ANFIS outputs] that adds a correction.

    The ANFIS provides the main fit and the head refines it; the output of a new head is zero.

    Args:
        groups, inputs, terms, outputs: of the layer, see `Anfis`.
        units: of the head.
        options: of the layer: order, kind, interpretable.
    """

    def __init__(
        self,
        groups: int,
        inputs: int,
        terms: Sequence[int],
        outputs: int,
        *,
        units: int = 10,
        seed: int = 0,
        **options: Any,
    ) -> None:
        super().__init__()
        self.groups, self.inputs, self.outputs = groups, inputs, outputs
        self.anfis = Anfis(groups, inputs, terms, outputs, **options)
        self.head = RBFNetwork(groups, inputs + outputs, units, outputs, seed=seed)
        # A new head changes nothing.
        nn.init.zeros_(self.head.output_weight)

    def forward(self, x: Tensor) -> Tensor:
        """Outputs, shape (*batch, groups, outputs), of inputs (*batch, groups, inputs)."""
        y = self.anfis(x)
        return y + self.head(torch.cat([x, y], -1))

    def init_grid(self, lower: float | Tensor, upper: float | Tensor, seed: int = 0) -> None:
        """Spread the sets evenly over the range, and draw the head's centres from it (outputs: ±1).

        Args:
            lower, upper: range of each input, broadcastable to (groups, inputs).
        """
        self.anfis.init_grid(lower, upper)
        centres = self.head.centres[:, 0].detach()
        low, high = grouped.input_range(lower, upper, centres[:, : self.inputs])
        ones = torch.ones_like(centres[:, self.inputs :])
        self.head.init_range(torch.cat([low, -ones], 1), torch.cat([high, ones], 1), seed)

    @torch.no_grad()
    def init_head(self, x: Tensor, seed: int = 0) -> None:
        """Place the head's units using the samples `x`; its output layer stays unchanged."""
        self.head.init_kmeans(torch.cat([x, self.anfis(x)], -1), seed)

    @torch.no_grad()
    def solve_head(self, x: Tensor, y: Tensor, prior_precision: float | Tensor = 1e-6) -> None:
        """Fit the head's output layer to the ANFIS's residual of `y` by least squares."""
        carried = self.anfis(x)
        # On the residual, so that the rules keep their meaning.
        left = grouped.targets_of(x, y, self.outputs).view_as(carried) - carried
        self.head.solve_output(torch.cat([x, carried], -1), left, prior_precision)


def _selected(samples: Tensor, targets: Tensor, units: int, widths: Tensor) -> Tensor:
    """Samples chosen one by one, each explaining as much of the targets' residual as possible.

    References:
        Chen, Cowan and Grant (1991), Orthogonal least squares learning algorithm for radial basis
        function networks, IEEE Transactions on Neural Networks 2(2), eqs. (22)-(30).
    """
    samples, targets = _thin(samples, _SAMPLES), _thin(targets, _SAMPLES)
    candidates = _thin(samples, _CANDIDATES)
    columns = torch.exp(-0.5 * torch.cdist(samples / widths, candidates / widths) ** 2)
    power = (columns**2).sum(0)
    # The output bias explains the means.
    columns, left = columns - columns.mean(0), targets - targets.mean(0)
    left = left / left.norm(dim=0).clamp(min=torch.finfo(left.dtype).tiny)
    chosen: list[int] = []
    for _ in range(units):
        energy = (columns**2).sum(0)
        gain = ((columns.T @ left) ** 2).sum(1) / energy.clamp(min=torch.finfo(left.dtype).tiny)
        # If the chosen units already span a direction, its remainder is round-off.
        gain[energy < 1e-10 * power] = -1.0
        gain[chosen] = -2.0
        best = int(gain.argmax())
        chosen.append(best)
        direction = columns[:, best : best + 1] / energy[best].sqrt()
        columns = columns - direction @ (direction.T @ columns)
        left = left - direction @ (direction.T @ left)
    return candidates[chosen]


def _thin(rows: Tensor, most: int) -> Tensor:
    if len(rows) <= most:
        return rows
    # Spread over the whole recording, since it may begin at rest.
    picks = torch.linspace(0, len(rows) - 1, most, dtype=torch.float64, device=rows.device)
    return rows[picks.round().long()]
