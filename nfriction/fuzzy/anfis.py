"""ANFIS: a Takagi-Sugeno layer with learnable memberships, with groups (joints) stacked."""

import math
import operator
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from nfriction.fuzzy.grouped import (
    LinearOutputModule,
    input_range,
    ridge,
    targets_of,
    to_columns,
    to_rows,
)
from nfriction.fuzzy.membership import HALF_WIDTH_OF_GAUSSIAN, log_bell, log_gaussian
from nfriction.fuzzy.partition import (
    FreePartition,
    OrderedPartition,
    crossing_half_widths,
    even_centres,
)

# The number of rules is the product of the terms; a mistyped count would exhaust the memory.
MAX_RULES = 100_000

Range = float | Sequence[float] | Tensor
"""A bound of each input, broadcastable to (groups, inputs)."""


class Anfis(LinearOutputModule):
    """First-order (or zero-order) Takagi-Sugeno layer of several independent groups in one tensor.

    Each input has its own sets, shared by the rules; a rule picks one set of each input, so there
    are prod(terms) rules, and the last input's set varies fastest. Memberships are multiplied,
    firing strengths are normalised in the log domain, and the output is the strength-weighted mean
    of the rules' linear functions of the inputs.

    Args:
        groups: independent layers of the same shape, e.g. one per joint.
        terms: number of sets of each input.
        order: 1 for linear consequents, 0 for constant ones.
        kind: "gaussian", or "bell" for generalised bells.
        interpretable: keep the sets ordered, in range and crossing at a membership of 0.5 or more.

    Parameters, by name: `partition.*` (centres and log-widths, or their ordered form), `log_slopes`
    (groups, sets; bells only), `consequents` (groups, outputs, rules, inputs + 1) with the
    constant last, or (groups, outputs, rules, 1) for order 0.

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
    ) -> None:
        super().__init__()
        self.terms = [operator.index(count) for count in terms]
        if min(groups, inputs, outputs) < 1:
            raise ValueError(
                f"`groups`, `inputs` and `outputs` must be at least 1, got {groups}, {inputs}, "
                f"{outputs}."
            )
        if len(self.terms) != inputs or min(self.terms) < 1:
            raise ValueError(
                f"`terms` needs a positive number of sets for each of {inputs} inputs, got "
                f"{self.terms}."
            )
        self.rules = math.prod(self.terms)
        if self.rules > MAX_RULES:
            raise ValueError(
                f"{self.terms} sets make {self.rules} rules, more than {MAX_RULES}; use fewer sets."
            )
        if order not in (0, 1):
            raise ValueError(
                f"`order` is 0 (constant consequents) or 1 (linear ones), got {order}."
            )
        if kind not in ("gaussian", "bell"):
            raise ValueError(f'`kind` is "gaussian" or "bell", got {kind!r}.')
        self.groups, self.inputs, self.outputs, self.order = groups, inputs, outputs, order
        self.kind, self.interpretable = kind, interpretable
        partition: FreePartition | OrderedPartition = FreePartition(groups, self.terms)
        if interpretable:
            half_width = HALF_WIDTH_OF_GAUSSIAN if kind == "gaussian" else 1.0
            partition = OrderedPartition(groups, self.terms, half_width)
        self.partition = partition
        sets = sum(self.terms)
        # Gaussians have no slopes; an empty parameter would trip up optimisers.
        self.log_slopes = (
            nn.Parameter(torch.full((groups, sets), 2.0, dtype=torch.float64).log())
            if kind == "bell"
            else None
        )
        # Linear coefficients and a constant, or only the constant.
        columns = inputs + 1 if order == 1 else 1
        self.consequents = nn.Parameter(
            torch.zeros(groups, outputs, self.rules, columns, dtype=torch.float64)
        )
        # A valid partition from the start, before the sets are placed from data.
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
        # (groups, outputs * columns, rules): one matrix product blends all consequents.
        weights = self.consequents.transpose(2, 3).flatten(1, 2)
        blended = torch.bmm(weights, self.strength_columns(columns))
        if self.order == 1:
            # The rules' planes are blended first, then evaluated once.
            planes = blended.unflatten(1, (self.outputs, self.inputs + 1))
            slopes, constants = planes[:, :, :-1], planes[:, :, -1]
            blended = (slopes * columns.unsqueeze(1)).sum(2) + constants
        return to_rows(blended, x)

    def sets(self) -> tuple[Tensor, Tensor]:
        """Centres and widths (sigma, or `a` of a bell), each (groups, sets), input by input."""
        found: tuple[Tensor, Tensor] = self.partition()
        return found

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
                # Training their logarithms keeps slopes and widths positive.
                slope = torch.exp(log_slopes[:, start : start + count]).unsqueeze(-1)
                logs.append(log_bell(u, c, width, slope))
            else:
                logs.append(log_gaussian(u, c, width))
            start += count
        return logs

    def strength_columns(self, columns: Tensor) -> Tensor:
        """Normalised firing strengths, shape (groups, rules, samples).

        They sum to 1 even if every rule underflows.
        On a full grid, the softmax of the summed log memberships equals the product of one softmax
        per input, which needs sum(terms) exponentials instead of prod(terms).
        """
        shares = [torch.softmax(log, 1) for log in self._log_memberships(columns)]
        strengths = shares[0]
        for own in shares[1:]:
            strengths = (strengths.unsqueeze(2) * own.unsqueeze(1)).flatten(1, 2)
        return strengths

    @torch.no_grad()
    def regressor_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor:
        """Each rule's strength times the inputs and 1, (groups, rules * columns, samples)."""
        u = to_columns(x)
        count = self.rules * self.consequents.shape[-1]
        out = u.new_empty(u.shape[0], count, u.shape[2]) if out is None else out
        self._write_regressors(out, self.strength_columns(u), self._terms(u))
        return out

    @torch.no_grad()
    def jacobian_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor:
        """The regressors, then for each output Q h, Q h z and, for bells, Q dlog m / dlog b.

        With normalised strengths s_r = prod_i p_i[t_i(r)] and rule outputs f_kr, the derivative of
        the output y_k with respect to the log membership of set t of input i is

            Q_kit = (sum of s_r f_kr over the rules r that use the set) - p_i[t] y_k,

        and that of a log membership with respect to z = (x - c)/a is -h; h = z for Gaussians.

        Args:
            x: inputs, shape (samples, groups, inputs).
            out: buffer of the result's shape; allocating memory costs more than the arithmetic.
        Returns:
            Shape (groups, regressors + outputs * (2 or 3) sets, samples).
        """
        u = to_columns(x)
        shared, own = self._column_counts
        shape = (u.shape[0], shared + self.outputs * own, u.shape[2])
        F = u.new_empty(shape) if out is None else out
        strengths, terms = self.strength_columns(u), self._terms(u)
        self._write_regressors(F[:, :shared], strengths, terms)
        # z, h and, for bells, dlog m/dlog b, each (groups, sets, samples).
        centres, widths = (part.unsqueeze(-1) for part in self.sets())
        z = torch.repeat_interleave(u, torch.tensor(self.terms, device=u.device), 1)
        h = z = z.sub_(centres).div_(widths)
        by_slope = None
        if self.log_slopes is not None:
            slope = torch.exp(self.log_slopes).unsqueeze(-1)
            one = torch.ones_like(slope)
            outside = -slope * torch.expm1(log_bell(z, 0.0 * one, one, slope))
            # The same tiny offset from zero as in the membership.
            square = z * z + 1e-37
            h, by_slope = 2.0 * outside * z / square, -outside * square.log()
        # Summing the strengths over the rules that use a set gives the set's share p.
        choice = torch.cartesian_prod(*(torch.arange(n) for n in self.terms))
        choice = choice.reshape(-1, len(self.terms))
        pairs = zip(choice.T, self.terms, strict=True)
        uses = torch.cat([torch.nn.functional.one_hot(c, n).T for c, n in pairs]).to(u)
        shares = uses @ strengths
        sets = F[:, shared:].unflatten(1, (self.outputs, own // z.shape[1], z.shape[1]))
        for k in range(self.outputs):
            # s_r f_kr of every rule.
            weighted = torch.bmm(self.consequents[:, k], terms).mul_(strengths)
            Q = (uses @ weighted).addcmul_(shares, weighted.sum(1, keepdim=True), value=-1.0)
            torch.mul(Q, h, out=sets[:, k, 0])
            torch.mul(sets[:, k, 0], z, out=sets[:, k, 1])
            if by_slope is not None:
                torch.mul(Q, by_slope, out=sets[:, k, 2])
        return F

    @torch.no_grad()
    def input_jacobian(self, x: Tensor, columns: Tensor | None = None) -> Tensor:
        """In closed form: the rules' slopes, and Q dlog m / dx of the sets.

        `columns` are `jacobian_columns` of the same inputs, if they are known.
        """
        shared, own = self._column_counts
        columns = self.jacobian_columns(x) if columns is None else columns
        rules, by_set = columns.tensor_split([shared], 1)
        # An input has the opposite effect of the centres of its sets.
        by_centre = by_set.unflatten(1, (self.outputs, own))[:, :, : sum(self.terms)]
        by_input = (by_centre / self.sets()[1][:, None, :, None]).split(self.terms, 2)
        found = -torch.stack([part.sum(2) for part in by_input], 2)
        if self.order == 1:
            strengths = rules[:, self.inputs :: self.inputs + 1]
            found += torch.einsum("gkri,grs->gkis", self.consequents[..., :-1], strengths)
        return found

    @torch.no_grad()
    def jacobian_maps(self) -> dict[str, Tensor]:
        """Map of each trained parameter by name, (groups, outputs, columns, entries of a group)."""
        shared, own = self._column_counts
        output, regressor = (torch.eye(n).to(self.consequents) for n in (self.outputs, shared))
        blocks = {"consequents": (0, torch.einsum("ab,uv->aubv", output, regressor).flatten(2))}
        sets = {f"partition.{name}": rows for name, rows in self.partition.jacobian().items()}
        slopes = torch.eye(sum(self.terms)).to(output).expand(self.groups, -1, -1)
        # d (centres, widths, slopes); each output has its own columns of these.
        if self.log_slopes is not None:
            sets["log_slopes"] = torch.cat([torch.zeros_like(slopes).repeat(1, 2, 1), slopes], 1)
        for name, rows in sets.items():
            # Bells have columns for slopes, Gaussians do not.
            padded = torch.nn.functional.pad(rows, (0, 0, 0, own - rows.shape[1]))
            block = torch.einsum("ab,gce->gabce", output, padded).flatten(2, 3)
            blocks[name] = shared, block
        return self._placed(blocks, shared + self.outputs * own)

    def readout(self) -> Tensor:
        """The consequents as (groups, outputs, regressors)."""
        # In the same order as the regressors: rule by rule, inputs then 1.
        return self.consequents.flatten(2)

    @property
    def _column_counts(self) -> tuple[int, int]:
        """Number of columns shared by all outputs, and of columns of the sets for each output."""
        shared = self.rules * self.consequents.shape[-1]
        return shared, (2 if self.log_slopes is None else 3) * sum(self.terms)

    def _terms(self, u: Tensor) -> Tensor:
        """Factors of a rule's consequents: the inputs and 1, or 1."""
        one = torch.ones_like(u[:, :1])
        return torch.cat([u, one], 1) if self.order == 1 else one

    def _write_regressors(self, out: Tensor, strengths: Tensor, terms: Tensor) -> None:
        by_rule = out.unflatten(1, (strengths.shape[1], terms.shape[1]))
        torch.mul(strengths.unsqueeze(2), terms.unsqueeze(1), out=by_rule)

    def init_grid(self, lower: Range, upper: Range) -> None:
        """Evenly spaced sets from `lower` to `upper`, with neighbours crossing at 0.5.

        Interpretable sets start a few percent off these, because their bounds are open intervals.

        Args:
            lower, upper: range of each input, broadcastable to (groups, inputs).
        """
        low, high = self._range(lower, upper)
        centres = even_centres(self.terms, low, high)
        # Half-widths for which neighbours cross at 0.5 or more.
        half = torch.cat(crossing_half_widths(centres, high - low), 1)
        widths = half if self.kind == "bell" else half / HALF_WIDTH_OF_GAUSSIAN
        self.partition.assign(torch.cat(centres, 1), widths, low, high)

    def init_from_sets(
        self,
        centres: Sequence[Tensor],
        widths: Sequence[Tensor],
        slopes: Sequence[Tensor] | None = None,
        *,
        lower: Range | None = None,
        upper: Range | None = None,
    ) -> None:
        """Adopt given sets, such as those of a controller.

        Args:
            centres: ascending centres for each input, shape (terms,) or (groups, terms).
            widths: sigma of each Gaussian, or `a` of each bell; same shapes.
            slopes: `b` of each bell; same shapes.
            lower, upper: range in which interpretable sets must stay; default: the outer centres.
        """
        packed_centres = self._pack("centres", centres)
        packed_widths = self._pack("widths", widths)
        # Because their logarithms are stored.
        if not bool((packed_widths > 0).all()):
            raise ValueError("`widths` must be positive.")
        pieces = packed_centres.split(self.terms, 1)
        low, high = self._range(
            torch.stack([c.amin(1) for c in pieces], 1) if lower is None else lower,
            torch.stack([c.amax(1) for c in pieces], 1) if upper is None else upper,
            # Free sets ignore their range; a single set has none.
            allow_equal=not self.interpretable,
        )
        self.partition.assign(packed_centres, packed_widths, low, high)
        if slopes is not None:
            packed_slopes = self._pack("slopes", slopes)
            if self.log_slopes is None or not bool((packed_slopes > 0).all()):
                raise ValueError("`slopes` must be positive, and belong to bells only.")
            with torch.no_grad():
                self.log_slopes.copy_(packed_slopes.log())

    @torch.no_grad()
    def solve_consequents(
        self, x: Tensor, y: Tensor, prior_precision: float | Tensor = 1e-6
    ) -> None:
        """Set the consequents to the least-squares optimum for the current sets, in place.

        Args:
            x: inputs, shape (*batch, groups, inputs).
            y: desired outputs, shape (*batch, groups, outputs).
            prior_precision: relative to the noise precision, a number or broadcastable to (groups,
                rules * columns). The default is that of the recursive least squares in Jang's
                paper, which start from a covariance of 1e6. With 0, undetermined directions are
                zero.
        Raises:
            ValueError: if there are no samples, some are not finite, or shapes do not fit.
        """
        features = self.regressors(x).reshape(-1, self.groups, self.consequents[0, 0].numel())
        weights = ridge(features, targets_of(x, y, self.outputs), prior_precision)
        self.consequents.copy_(weights.mT.reshape(self.consequents.shape))

    def _range(
        self, lower: Range, upper: Range, *, allow_equal: bool = False
    ) -> tuple[Tensor, Tensor]:
        like = self.consequents.detach().new_empty(self.groups, self.inputs)
        return input_range(lower, upper, like, allow_equal=allow_equal)

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
