"""ANFIS: a Takagi-Sugeno layer with learnable memberships, groups (joints) stacked."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from nfriction.fuzzy import anfis_jacobian
from nfriction.fuzzy.factored_jacobian import dense_jacobian
from nfriction.fuzzy.layout import to_columns, to_rows
from nfriction.fuzzy.least_squares import ridge
from nfriction.fuzzy.membership import HALF_WIDTH_OF_GAUSSIAN, log_bell, log_gaussian
from nfriction.fuzzy.partition import FreePartition, OrderedPartition
from nfriction.fuzzy.placement import crossing_half_widths, even_centres, quantile_centres

MAX_RULES = 100_000

Range = float | Sequence[float] | Tensor
"""A bound of each input: what broadcasts to (groups, inputs)."""


class Anfis(nn.Module):
    """First-order (or zero-order) Takagi-Sugeno layer, several independent groups in one tensor.

    Each input has its own sets, shared by the rules; a rule picks one set of each input, so there
    are prod(terms) of them, the last input's set running fastest. Memberships multiply, firing
    strengths are normalised in the log domain, and the output is the strength-weighted mean of
    the rules' linear functions of the inputs.

    Args:
        groups: independent layers of the same shape, e.g. one a joint.
        inputs: inputs of a group.
        terms: number of sets of each input.
        outputs: outputs of a group.
        order: 1 for linear consequents, 0 for constant ones.
        kind: "gaussian", or "bell" for generalised bells.
        interpretable: keep the sets ordered, in range and overlapping at 0.5 or more.

    Parameters, by name: `partition.*` (centres and log-widths, or their ordered form), `log_slopes`
    (groups, sets; bells only), `consequents` (groups, outputs, rules, inputs + 1) with the
    constant last, or (groups, outputs, rules, 1).

    References:
        Jang (1993), ANFIS: Adaptive-Network-Based Fuzzy Inference System. Takagi and Sugeno (1985).
    """

    terms: list[int]

    def __init__(
        self,
        groups: int,
        inputs: int,
        terms: Sequence[int],
        outputs: int,
        *,
        order: int = 1,
        kind: str = "gaussian",
        interpretable: bool = False,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        self.terms = [int(count) for count in terms]
        _check_sizes(groups, inputs, self.terms, outputs, order, kind)
        self.groups, self.inputs, self.outputs, self.order = groups, inputs, outputs, order
        self.kind, self.interpretable = kind, interpretable
        self.rules = 1
        for count in self.terms:
            self.rules *= count
        partition: FreePartition | OrderedPartition = FreePartition(groups, self.terms, dtype)
        if interpretable:
            half_width = HALF_WIDTH_OF_GAUSSIAN if kind == "gaussian" else 1.0
            partition = OrderedPartition(groups, self.terms, half_width, dtype)
        self.partition = partition
        sets = sum(self.terms)
        # An empty parameter would be a trap for optimisers; Gaussians own no slopes at all.
        self.log_slopes = (
            nn.Parameter(torch.full((groups, sets), 2.0, dtype=dtype).log())
            if kind == "bell"
            else None
        )
        columns = inputs + 1 if order == 1 else 1
        self.consequents = nn.Parameter(
            torch.zeros(groups, outputs, self.rules, columns, dtype=dtype)
        )
        self.init_grid(-1.0, 1.0)

    def extra_repr(self) -> str:
        return (
            f"groups={self.groups}, inputs={self.inputs}, terms={self.terms}, "
            f"outputs={self.outputs}, order={self.order}, kind={self.kind!r}, "
            f"interpretable={self.interpretable}"
        )

    def forward(self, x: Tensor) -> Tensor:
        """Outputs of the layer.

        Args:
            x: inputs, shape (*batch, groups, inputs).
        Returns:
            Shape (*batch, groups, outputs).
        """
        columns = to_columns(x)
        weights = self.consequents.transpose(2, 3).flatten(1, 2)
        blended = torch.bmm(weights, self.strength_columns(columns))
        if self.order == 1:
            # The rules' planes are blended first, then evaluated once.
            planes = blended.unflatten(1, (self.outputs, self.inputs + 1))
            slopes, constants = planes[:, :, :-1], planes[:, :, -1]
            blended = (slopes * columns.unsqueeze(1)).sum(2) + constants
        return to_rows(blended, x)

    def firing_strength(self, x: Tensor) -> Tensor:
        """Normalised firing strengths, shape (*batch, groups, rules).

        They sum to 1 even where every rule underflows.
        """
        return to_rows(self.strength_columns(to_columns(x)), x)

    def regressors(self, x: Tensor) -> Tensor:
        """Features in which the layer is linear, shape (*batch, groups, rules * columns).

        The output is their product with `consequents`, flattened over its last two dimensions.
        """
        strength = self.firing_strength(x)
        if self.order == 0:
            return strength
        terms = torch.cat([x, torch.ones_like(x[..., :1])], -1)
        return (strength.unsqueeze(-1) * terms.unsqueeze(-2)).flatten(-2)

    def rule_outputs(self, x: Tensor) -> Tensor:
        """What each rule says on its own, shape (*batch, groups, outputs, rules)."""
        batch = x.shape[:-2]
        constants = self.consequents[..., -1].expand(batch + self.consequents.shape[:-1])
        if self.order == 0:
            return constants
        slopes = self.consequents[..., :-1]
        return (slopes * x.unsqueeze(-2).unsqueeze(-2)).sum(-1) + constants

    def sets(self) -> tuple[Tensor, Tensor]:
        """Centres and widths (sigma, or `a` of a bell), each (groups, sets), input by input."""
        centres, widths = self.partition()
        return centres, widths

    def memberships(self, x: Tensor) -> list[Tensor]:
        """Membership of every set, one tensor (*batch, groups, terms) for each input."""
        columns = to_columns(x)
        return [to_rows(log.exp(), x) for log in self._log_memberships(columns)]

    def _log_memberships(self, columns: Tensor) -> list[Tensor]:
        """Log memberships, one tensor (groups, terms, samples) for each input."""
        centres, widths = self.partition()
        centres, widths = centres.unsqueeze(-1), widths.unsqueeze(-1)
        logs: list[Tensor] = []
        start = 0
        for i, count in enumerate(self.terms):
            u = columns[:, i : i + 1]
            c = centres[:, start : start + count]
            width = widths[:, start : start + count]
            log_slopes = self.log_slopes
            if log_slopes is not None:
                slope = torch.exp(log_slopes[:, start : start + count]).unsqueeze(-1)
                logs.append(log_bell(u, c, width, slope))
            else:
                logs.append(log_gaussian(u, c, width))
            start += count
        return logs

    def strength_columns(self, columns: Tensor) -> Tensor:
        """Normalised firing strengths, shape (groups, rules, samples).

        On a full grid the softmax of the summed log memberships is the product of one softmax for
        each input: the same numbers with sum(terms) exponentials instead of prod(terms).
        """
        return self.strengths_of(self.set_shares(columns))

    def set_shares(self, columns: Tensor) -> list[Tensor]:
        """Memberships over their sum, one tensor (groups, terms, samples) for each input."""
        return [torch.softmax(log, 1) for log in self._log_memberships(columns)]

    def strengths_of(self, shares: list[Tensor]) -> Tensor:
        """Product of one share of each input for every rule, shape (groups, rules, samples)."""
        strengths = shares[0]
        for own in shares[1:]:
            strengths = (strengths.unsqueeze(2) * own.unsqueeze(1)).flatten(1, 2)
        return strengths

    def jacobian(self, x: Tensor) -> Tensor:
        """Derivative of every output by every trained parameter, as solvers ask for it.

        Args:
            x: inputs, shape (samples, groups, inputs).
        Returns:
            Shape (samples, groups * outputs, parameters), parameters in the order of
            `named_parameters`.
        """
        return dense_jacobian(self.jacobian_columns(x), self.jacobian_maps(), self.outputs)

    def input_jacobian(self, x: Tensor) -> Tensor:
        """Derivative of every output by the inputs of its group.

        Args:
            x: inputs, shape (samples, groups, inputs).
        Returns:
            Shape (groups, outputs, inputs, samples).
        """
        return anfis_jacobian.input_jacobian(self, x)[1]

    def regressor_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor:
        """`regressors` with the samples last, (groups, regressors, samples), written to `out`."""
        return anfis_jacobian.regressor_columns(self, x, out)

    def jacobian_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor:
        """What the derivatives of all outputs combine, first the regressors.

        Args:
            x: inputs, shape (samples, groups, inputs).
            out: where to write the result, its shape; fresh memory costs more than the arithmetic.
        Returns:
            Shape (groups, columns, samples).
        """
        return anfis_jacobian.jacobian_columns(self, x, out)

    def readout(self) -> Tensor:
        """The consequents as (groups, outputs, regressors): outputs of the first columns."""
        return self.consequents.flatten(2)

    def jacobian_maps(self) -> dict[str, Tensor]:
        """How `jacobian_columns` combine, (groups, outputs, columns, entries of a group)."""
        return anfis_jacobian.jacobian_maps(self)

    def init_grid(self, lower: Range, upper: Range) -> None:
        """Evenly spaced sets from `lower` to `upper`, neighbours crossing at 0.5.

        Interpretable sets start a few percent off these, since their bounds are open.

        Args:
            lower, upper: range of each input, broadcastable to (groups, inputs).
        """
        low, high = self._range(lower, upper)
        self._take_crossing(even_centres(self.terms, low, high), low, high)

    def init_from_data(self, x: Tensor) -> None:
        """Sets where the samples are: centres half way between quantiles and an even grid.

        Quantiles alone would pile the sets up where a recording rests. Neighbours cross at 0.5 or
        a little more.

        Args:
            x: samples, shape (*batch, groups, inputs).
        """
        samples = x.detach().reshape(-1, self.groups, self.inputs)
        low, high = self._range(samples.amin(0), samples.amax(0))
        grid = even_centres(self.terms, low, high)
        quantiles = quantile_centres(self.terms, samples)
        centres = [0.5 * (a + b) for a, b in zip(grid, quantiles, strict=True)]
        self._take_crossing(centres, low, high)

    def init_from_sets(
        self,
        centres: Sequence[Tensor],
        widths: Sequence[Tensor],
        slopes: Sequence[Tensor] | None = None,
        *,
        lower: Range | None = None,
        upper: Range | None = None,
    ) -> None:
        """Take given sets over, such as a controller's.

        Args:
            centres: for each input the ascending centres, shape (terms,) or (groups, terms).
            widths: sigma of each Gaussian, or `a` of each bell; same shapes.
            slopes: `b` of each bell; same shapes.
            lower, upper: range that interpretable sets must stay in; default the outer centres.
        """
        packed_centres = self._pack("centres", centres)
        packed_widths = self._pack("widths", widths)
        if not bool((packed_widths > 0).all()):
            raise ValueError("`widths` must be positive.")
        pieces = packed_centres.split(self.terms, 1)
        low, high = self._range(
            torch.stack([c.amin(1) for c in pieces], 1) if lower is None else lower,
            torch.stack([c.amax(1) for c in pieces], 1) if upper is None else upper,
            allow_equal=not self.interpretable,
        )
        self.partition.assign(packed_centres, packed_widths, low, high)
        if slopes is not None:
            if self.log_slopes is None:
                raise ValueError("`slopes` belong to bells; this layer has Gaussian sets.")
            with torch.no_grad():
                self.log_slopes.copy_(self._pack("slopes", slopes).log())

    @torch.no_grad()
    def init_constant(self, values: Tensor) -> None:
        """Make every rule say `values`, broadcastable to (groups, outputs): a constant layer."""
        self.consequents.zero_()
        self.consequents[..., -1] = values.unsqueeze(-1)

    @torch.no_grad()
    def solve_consequents(
        self,
        x: Tensor,
        y: Tensor,
        prior_precision: float | Tensor = 1e-6,
        prior: Tensor | None = None,
    ) -> None:
        """Set the consequents to the least-squares optimum for the present sets, in place.

        Args:
            x: inputs, shape (*batch, groups, inputs).
            y: wanted outputs, shape (*batch, groups, outputs).
            prior_precision: over the noise precision, a number or broadcastable to (groups,
                rules * columns). The default is that of the recursive least squares of Jang's
                paper, which starts from a covariance of 1e6. With 0, what the samples do not
                determine stays at the prior.
            prior: consequents to shrink toward, broadcastable to theirs; default zero.
        Raises:
            ValueError: if the samples are none or not finite.
        """
        features = self.regressors(x).reshape(-1, self.groups, self.consequents[0, 0].numel())
        targets = y.reshape(-1, self.groups, self.outputs)
        start = torch.zeros_like(self.consequents) if prior is None else prior
        start = start.expand_as(self.consequents).flatten(2).mT
        weights = ridge(features, targets, prior_precision, start)
        self.consequents.copy_(weights.mT.reshape(self.consequents.shape))

    def _range(
        self,
        lower: Range,
        upper: Range,
        allow_equal: bool = False,
    ) -> tuple[Tensor, Tensor]:
        like = self.consequents.detach()
        low = torch.as_tensor(lower, dtype=like.dtype, device=like.device)
        high = torch.as_tensor(upper, dtype=like.dtype, device=like.device)
        low, high = low.expand(self.groups, self.inputs), high.expand(self.groups, self.inputs)
        sound = (high >= low) if allow_equal else (high > low)
        if not bool((sound & torch.isfinite(high - low)).all()):
            raise ValueError(
                f"every input needs a finite range with `lower` < `upper`, got {low.tolist()} and "
                f"{high.tolist()}; an input that never varies should be left out."
            )
        return low, high

    def _pack(self, name: str, pieces: Sequence[Tensor]) -> Tensor:
        shapes = [tuple(piece.shape) for piece in pieces]
        fits = len(pieces) == self.inputs and all(
            shape in ((count,), (self.groups, count))
            for shape, count in zip(shapes, self.terms, strict=True)
        )
        if not fits:
            raise ValueError(
                f"`{name}` needs one tensor for each input with {self.terms} sets (or (groups, "
                f"sets)), got {shapes}."
            )
        packed = torch.cat(
            [piece.expand(self.groups, n) for piece, n in zip(pieces, self.terms, strict=True)], 1
        )
        return packed.to(self.consequents)

    def _take_crossing(self, centres: list[Tensor], low: Tensor, high: Tensor) -> None:
        """Give the sets these centres and widths by which neighbours cross at 0.5 or more."""
        half = torch.cat(crossing_half_widths(centres, high - low), 1)
        widths = half if self.kind == "bell" else half / HALF_WIDTH_OF_GAUSSIAN
        self.partition.assign(torch.cat(centres, 1), widths, low, high)


def _check_sizes(
    groups: int, inputs: int, terms: list[int], outputs: int, order: int, kind: str
) -> None:
    if min(groups, inputs, outputs) < 1:
        raise ValueError(
            f"`groups`, `inputs` and `outputs` must be at least 1, got {groups}, {inputs}, "
            f"{outputs}."
        )
    if len(terms) != inputs or min(terms) < 1:
        raise ValueError(
            f"`terms` needs a positive number of sets for each of {inputs} inputs, got {terms}."
        )
    rules = 1
    for count in terms:
        rules *= count
    if rules > MAX_RULES:
        raise ValueError(f"{terms} sets make {rules} rules, more than {MAX_RULES}; use fewer sets.")
    if order not in (0, 1):
        raise ValueError(f"`order` is 0 (constant consequents) or 1 (linear ones), got {order}.")
    if kind not in ("gaussian", "bell"):
        raise ValueError(f'`kind` is "gaussian" or "bell", got {kind!r}.')
