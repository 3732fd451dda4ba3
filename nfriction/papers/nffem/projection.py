"""Variable projection: least-squares placement of sets (or units), the output layer eliminated.

One group of a network is searched at a time, in scaled units.

Only the sets have to be searched, which takes fewer steps and is better conditioned than a search
over all parameters.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from nfriction.fuzzy import Anfis, AnfisRBF, RBFNetwork
from nfriction.fuzzy.partition import FreePartition
from nfriction.optim.least_squares import Quadratic
from nfriction.optim.levenberg_marquardt import LevenbergMarquardt
from nfriction.papers.nffem.jacobian import CHUNK_ENTRIES, assign, flatten, trainable

FuzzyNetwork = Anfis | AnfisRBF | RBFNetwork


def one_group(network: FuzzyNetwork, group: int) -> FuzzyNetwork:
    """A separate network with the values of one group of `network`."""
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
    """Affine map of inputs and outputs onto [-1, 1]: own = middle + half * scaled."""

    x_middle: Tensor  # (groups, inputs)
    x_half: Tensor  # (groups, inputs)
    y_middle: Tensor  # (groups, outputs)
    y_half: Tensor  # (groups, outputs)

    @classmethod
    def of(cls, x: Tensor, y: Tensor) -> Scaling:
        """Scaling from sample ranges, shapes (samples, groups, inputs) and (..., outputs).

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
        # A constant output has no range for scaling.
        return cls(x_middle, x_half, y_middle, torch.where(y_half > 0, y_half, 1.0))

    def inverse(self) -> Scaling:
        """The inverse map, from own to scaled units."""
        x_half, y_half = 1.0 / self.x_half, 1.0 / self.y_half
        return Scaling(-self.x_middle * x_half, x_half, -self.y_middle * y_half, y_half)

    def inputs(self, x: Tensor) -> Tensor:
        """Scaled inputs from inputs in own units, (*batch, groups, inputs)."""
        return (x - self.x_middle) / self.x_half

    def outputs(self, y: Tensor) -> Tensor:
        """Scaled outputs from outputs in own units, (*batch, groups, outputs)."""
        return (y - self.y_middle) / self.y_half


@torch.no_grad()
def to_own_units(network: FuzzyNetwork, scaling: Scaling) -> None:
    """Convert a network with scaled inputs and outputs to own units, in place.

    Exact: centres, widths and output layers are rewritten. `scaling.inverse()` reverts it.
    """
    if isinstance(network, AnfisRBF):
        # The head reads inputs and the layer's outputs; its correction has no offset.
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
    # Widths scale with the inputs, so every unit responds exactly as before.
    half = scaling.x_half.unsqueeze(1)
    network.centres.mul_(half).add_(scaling.x_middle.unsqueeze(1))
    network.log_widths.add_(half.log())
    network.output_weight.mul_(scaling.y_half.unsqueeze(-1))
    network.output_bias.mul_(scaling.y_half).add_(scaling.y_middle)


def _rescale_anfis(anfis: Anfis, scaling: Scaling) -> None:
    # Free sets are stored one after another in a row, input by input.
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
        # A plane over scaled inputs: slopes absorb the ranges, the offset absorbs the middles.
        consequents[..., :-1].div_(scaling.x_half[:, None, None])
        moved = consequents[..., :-1] * scaling.x_middle[:, None, None]
        consequents[..., -1].sub_(moved.sum(-1))
    consequents.mul_(scaling.y_half[..., None, None])
    consequents[..., -1].add_(scaling.y_middle.unsqueeze(-1))


def _range(values: Tensor) -> tuple[Tensor, Tensor]:
    """Middle and half-range over the samples, each (groups, size)."""
    # Extremes, not standard deviations, so sets lie in [-1, 1] for any distribution.
    low, high = values.amin(0), values.amax(0)
    return 0.5 * (low + high), 0.5 * (high - low)


LINEAR = ("consequents", "output_weight", "output_bias")
"""Parameters in which a layer is linear; its leading columns are their regressors."""


def project(layer: Anfis | RBFNetwork, x: Tensor, y: Tensor, steps: int) -> None:
    """Place the sets (or units) by least squares with the output layer eliminated, in place.

    Args:
        layer: of one group; left alone if its output layer or all of its sets are frozen.
        x, y: samples, shapes (samples, 1, inputs) and (samples, 1, outputs).
        steps: limit on Levenberg-Marquardt steps.
    Raises:
        KeyboardInterrupt: if interrupted; the best sets so far are in the layer.
    """
    problem = Projection(layer, x, y)
    if not problem.separable:
        return
    # Only a start for the regularised fit, so a tighter tolerance would be wasted.
    solver = LevenbergMarquardt(max_steps=steps, cost_tolerance=1e-6)
    result = solver.minimise(problem.quadratic, problem.theta, cost=problem.cost)
    # The solver's last trial may not be its best; evaluating it writes the layer.
    problem.cost(result.x)
    if result.status == "stopped":
        raise KeyboardInterrupt


class Projection:
    """Squared errors of a layer as a function of its sets alone; evaluations overwrite the layer.

    `ridge` is the precision of the output layer around zero, relative to that of the errors.
    """

    def __init__(
        self, layer: Anfis | RBFNetwork, x: Tensor, y: Tensor, ridge: float = 1e-6
    ) -> None:
        if layer.groups != 1:
            raise ValueError(f"`layer` must be of one group, got {layer.groups}.")
        self.layer, self.x, self.y, self.ridge = layer, x, y, ridge
        parts = [torch.full_like(p, n in LINEAR).flatten() for n, p in trainable(layer).items()]
        self.linear = torch.cat(parts).bool()
        self.moving = ~self.linear
        self.shared = layer.readout().shape[2]
        self.total = layer.jacobian_columns(x[:1]).shape[1]
        # Fixed size, so that memory does not grow with the number of samples.
        rows = min(len(x), max(1, CHUNK_ENTRIES // self.total))
        # Reused, because first access to new memory costs more than the arithmetic.
        self.buffer = x.new_empty(1, self.total, rows)
        self.target_squares = y.square().sum()

    @property
    def theta(self) -> Tensor:
        """The layer's current sets (or units) as one vector."""
        return flatten(trainable(self.layer))[self.moving].clone()

    @property
    def separable(self) -> bool:
        """True if there are sets to place and the whole output layer can be eliminated."""
        whole = not any(
            name.endswith(LINEAR) and not p.requires_grad
            for name, p in self.layer.named_parameters()
        )
        return whole and bool(self.moving.any())

    def cost(self, theta: Tensor) -> Tensor:
        """Half the sum of squares (with ridge) for the best output layer, which is then set."""
        return self._eliminate(theta)[0]

    @torch.no_grad()
    def _eliminate(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost, best output layer (regressors, outputs), and Cholesky factor of the Gram matrix."""
        w = flatten(trainable(self.layer)).clone()
        w[self.moving] = theta
        assign(self.layer, w)
        G = self.x.new_zeros(self.shared, self.shared)
        b = self.x.new_zeros(self.shared, self.y.shape[-1])
        for rows in self._chunks():
            out = self.buffer[:, : self.shared, : rows.stop - rows.start]
            R = self.layer.regressor_columns(self.x[rows], out)[0]
            G.addmm_(R, R.T)
            b.addmm_(R, self.y[rows, 0])
        # The ridge keeps the Gram matrix positive definite if sets coincide or a rule never fires.
        factor = torch.linalg.cholesky_ex(G + self.ridge * torch.eye(self.shared).to(G)).L
        weights = torch.cholesky_solve(b, factor)
        # An output layer's maps select regressors, so their transpose scatters weights.
        placed = _pulled_back(self._maps()[:, : self.shared], weights)
        w[self.linear] = placed[self.linear]
        assign(self.layer, w)
        return 0.5 * (self.target_squares - (b * weights).sum()), weights, factor

    @torch.no_grad()
    def quadratic(self, theta: Tensor) -> Quadratic:
        """Local quadratic of `cost`, with Kaufman's approximation of its Hessian.

        References:
            Golub and Pereyra (1973); L. Kaufman, BIT 15 (1975) 49-57.
        """
        cost, weights, factor = self._eliminate(theta)
        shared = self.shared
        A = self.x.new_zeros(self.total - shared, self.total)
        b = self.x.new_zeros(self.total - shared, self.y.shape[-1])
        for rows in self._chunks():
            out = self.buffer[:, :, : rows.stop - rows.start]
            F = self.layer.jacobian_columns(self.x[rows], out)[0]
            A.addmm_(F[shared:], F.T)
            b.addmm_(F[shared:], F[:shared].T @ weights - self.y[rows, 0])
        # Schur complement: curvature removed by re-optimising the output layer.
        explained = A[:, :shared] @ torch.cholesky_solve(A[:, :shared].T, factor)
        maps = self._maps()[:, shared:, self.moving]
        hessian = (maps.mT @ (A[:, shared:] - explained) @ maps).sum(0)
        return Quadratic(cost, _pulled_back(maps, b), hessian)

    def _maps(self) -> Tensor:
        """Shape (outputs, columns, parameters)."""
        return torch.cat(list(self.layer.jacobian_maps().values()), -1)[0]

    def _chunks(self) -> Iterator[slice]:
        n = len(self.x)
        for start in range(0, n, self.buffer.shape[-1]):
            yield slice(start, min(start + self.buffer.shape[-1], n))


def _pulled_back(maps: Tensor, columns: Tensor) -> Tensor:
    """Sum over the outputs k of M_k^T b_k, for b of shape (columns, outputs)."""
    return (maps.mT @ columns.T.unsqueeze(-1)).sum(0)[:, 0]
