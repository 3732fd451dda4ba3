"""Variable projection: least-squares placement of sets (or units), the output layer eliminated.

Only the sets remain to be searched, which is shorter and better conditioned than a search over all
parameters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from nfriction.fuzzy import Anfis, RBFNetwork
from nfriction.optim.jacobian import CHUNK_ENTRIES, flatten, trainable, unflatten
from nfriction.optim.least_squares import Quadratic
from nfriction.optim.levenberg_marquardt import LevenbergMarquardt

LINEAR = ("consequents", "output_weight", "output_bias")
"""Parameters in which a layer is linear; its leading columns are their regressors."""


def project(layer: Anfis | RBFNetwork, x: Tensor, y: Tensor, steps: int) -> None:
    """Place the sets (or units) by least squares with the output layer eliminated, in place.

    Args:
        layer: of one group; left alone if its output layer or all of its sets are frozen.
        x, y: samples, shapes (samples, 1, inputs) and (samples, 1, outputs).
        steps: limit of Levenberg-Marquardt's steps.
    Raises:
        KeyboardInterrupt: if interrupted; the best sets so far are in the layer.
    """
    problem = Projection(layer, x, y)
    if not problem.separable:
        return
    # Only a start for the regularised fit: a tighter tolerance would be wasted.
    solver = LevenbergMarquardt(max_steps=steps, cost_tolerance=1e-6)
    result = solver.minimise(problem.quadratic, problem.theta, cost=problem.cost)
    # The solver's last trial may not be its best; evaluating it writes the layer.
    problem.cost(result.x)
    if result.status == "stopped":
        raise KeyboardInterrupt


class Projection:
    """Squared errors of a layer as a function of its sets alone; evaluations overwrite the layer.

    Args:
        layer, x, y: as in `project`.
        ridge: precision of the output layer around zero, over that of the errors.
    """

    def __init__(
        self, layer: Anfis | RBFNetwork, x: Tensor, y: Tensor, ridge: float = 1e-6
    ) -> None:
        if layer.groups != 1:
            raise ValueError(f"`layer` must be of one group, got {layer.groups}.")
        self.layer, self.x, self.y, self.ridge = layer, x, y, ridge
        self.parameters = {n: p for n, p in layer.named_parameters() if p.requires_grad}
        sizes = torch.tensor([p.numel() for p in self.parameters.values()])
        linear = torch.tensor([n in LINEAR for n in self.parameters]).repeat_interleave(sizes)
        self.linear, self.moving = linear.to(x.device), ~linear.to(x.device)
        self.shared = layer.readout().shape[2]
        self.total = layer.jacobian_columns(x[:1]).shape[1]
        # Of a fixed size, so that memory does not grow with the samples.
        rows = min(len(x), max(1, CHUNK_ENTRIES // self.total))
        # Written again and again: the first touch of fresh memory costs more than the arithmetic.
        self.buffer = x.new_empty(1, self.total, rows)
        self.target_squares = y.square().sum()
        self._eliminated: _Eliminated | None = None

    @property
    def theta(self) -> Tensor:
        """The layer's present sets (or units) in one vector."""
        return flatten(trainable(self.layer))[self.moving].clone()

    @property
    def separable(self) -> bool:
        """True if there are sets to place, and a whole output layer to eliminate for them."""
        whole = not any(
            name.endswith(LINEAR) and not p.requires_grad
            for name, p in self.layer.named_parameters()
        )
        return whole and bool(self.moving.any())

    @torch.no_grad()
    def cost(self, theta: Tensor) -> Tensor:
        """Half the squares, with the ridge's, of the best output layer, which the layer takes."""
        w = flatten(trainable(self.layer)).clone()
        w[self.moving] = theta
        self._assign(w)
        G = self.x.new_zeros(self.shared, self.shared)
        b = self.x.new_zeros(self.shared, self.y.shape[-1])
        for rows in self._chunks():
            out = self.buffer[:, : self.shared, : rows.stop - rows.start]
            R = self.layer.regressor_columns(self.x[rows], out)[0]
            G.addmm_(R, R.T)
            b.addmm_(R, self.y[rows, 0])
        # The ridge keeps the Gram matrix definite where sets coincide or no sample fires a rule.
        factor = torch.linalg.cholesky_ex(G + self.ridge * torch.eye(self.shared).to(G)).L
        weights = torch.cholesky_solve(b, factor)
        # In a regressor's coordinates an output layer's maps pick, so that their transpose places.
        placed = _pulled_back(self._maps()[:, : self.shared], weights)
        w[self.linear] = placed[self.linear]
        self._assign(w)
        cost = 0.5 * (self.target_squares - (b * weights).sum())
        self._eliminated = _Eliminated(theta.clone(), weights, factor, cost)
        return cost

    @torch.no_grad()
    def quadratic(self, theta: Tensor) -> Quadratic:
        """Local quadratic of `cost`, with Kaufman's approximation of its Hessian.

        References:
            Golub and Pereyra (1973); L. Kaufman, BIT 15 (1975) 49-57.
        """
        known = self._eliminated
        # The solver has just evaluated the cost there, except at its start.
        if known is None or not torch.equal(known.theta, theta):
            self.cost(theta)
            known = self._eliminated
        assert known is not None
        shared = self.shared
        A = self.x.new_zeros(self.total - shared, self.total)
        b = self.x.new_zeros(self.total - shared, self.y.shape[-1])
        for rows in self._chunks():
            out = self.buffer[:, :, : rows.stop - rows.start]
            F = self.layer.jacobian_columns(self.x[rows], out)[0]
            A.addmm_(F[shared:], F.T)
            b.addmm_(F[shared:], F[:shared].T @ known.weights - self.y[rows, 0])
        # Schur complement: curvature that the re-optimised output layer removes.
        explained = A[:, :shared] @ torch.cholesky_solve(A[:, :shared].T, known.factor)
        maps = self._maps()[:, shared:, self.moving]
        hessian = (maps.mT @ (A[:, shared:] - explained) @ maps).sum(0)
        return Quadratic(known.cost, _pulled_back(maps, b), hessian)

    def _assign(self, w: Tensor) -> None:
        for name, value in unflatten(w, self.parameters).items():
            self.parameters[name].copy_(value)

    def _maps(self) -> Tensor:
        """Shape (outputs, columns, parameters)."""
        return torch.cat(list(self.layer.jacobian_maps().values()), -1)[0]

    def _chunks(self) -> Iterator[slice]:
        n = len(self.x)
        for start in range(0, n, self.buffer.shape[-1]):
            yield slice(start, min(start + self.buffer.shape[-1], n))


@dataclass(frozen=True, eq=False)
class _Eliminated:
    """The best output layer at `theta`: weights (regressors, outputs), factor of their Gram."""

    theta: Tensor
    weights: Tensor
    factor: Tensor
    cost: Tensor


def _pulled_back(maps: Tensor, columns: Tensor) -> Tensor:
    """Sum over the outputs k of M_k^T b_k, for b of shape (columns, outputs)."""
    return (maps.mT @ columns.T.unsqueeze(-1)).sum(0)[:, 0]
