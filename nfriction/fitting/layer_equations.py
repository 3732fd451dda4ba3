"""Least squares of a fuzzy layer, by the columns that the derivatives of its outputs share.

Two views of one problem: normal equations of all parameters, for Bayesian regularisation, and the
problem left for the sets (or units) once the output layer is eliminated, for a good start.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from nfriction.fuzzy import Anfis, RBFNetwork
from nfriction.solve import NormalEquations, Quadratic
from nfriction.solve.jacobian import flatten, trainable, unflatten

LINEAR = ("consequents", "output_weight", "output_bias")
"""Parameters in which a layer is linear; its leading columns are their regressors."""

# 4 MiB of columns at a time: fewer samples cost more calls, more fall out of the cache.
CHUNK_ENTRIES = 2**19


class LayerEquations:
    """Errors of one layer on samples, as a function of the layer's parameters.

    The layer's parameters are overwritten by every evaluation.

    Args:
        layer: of one group.
        x: inputs, shape (samples, 1, inputs).
        y: targets, shape (samples, 1, outputs).
        ridge: precision of the output layer around zero, over that of the errors, while it is
            eliminated.
    """

    def __init__(
        self, layer: Anfis | RBFNetwork, x: Tensor, y: Tensor, ridge: float = 1e-6
    ) -> None:
        if layer.groups != 1:
            raise ValueError(f"`layer` must be of one group, got {layer.groups}.")
        self.layer, self.x, self.y, self.ridge = layer, x, y, ridge
        self.parameters = {n: p for n, p in layer.named_parameters() if p.requires_grad}
        names = list(self.parameters)
        sizes = torch.tensor([p.numel() for p in self.parameters.values()])
        linear = torch.tensor([name in LINEAR for name in names]).repeat_interleave(sizes)
        self.linear, self.moving = linear.to(x.device), ~linear.to(x.device)
        self.shared = layer.regressor_columns(x[:1]).shape[1]
        self.total = layer.jacobian_columns(x[:1]).shape[1]
        rows = min(len(x), max(1, CHUNK_ENTRIES // self.total))
        # Written again and again: the first touch of fresh memory costs more than the arithmetic.
        self.buffer = x.new_empty(1, self.total, rows)
        self.target_squares = y.square().sum()
        # With the whole output layer among the parameters the columns tell the outputs too.
        self.readable = not any(
            name.endswith(LINEAR) and not p.requires_grad for name, p in layer.named_parameters()
        )
        self._eliminated: _Eliminated | None = None

    @property
    def w(self) -> Tensor:
        """The layer's present parameters in one vector."""
        return flatten(trainable(self.layer)).clone()

    @property
    def separable(self) -> bool:
        """Whether there are sets to place, and a whole output layer to eliminate for them."""
        return bool(self.moving.any()) and self.readable

    @torch.no_grad()
    def assign(self, w: Tensor) -> None:
        """Write parameters into the layer."""
        for name, value in unflatten(w, self.parameters).items():
            self.parameters[name].copy_(value)

    @torch.no_grad()
    def squares(self, w: Tensor) -> Tensor:
        """Sum of squared errors."""
        self.assign(w)
        return sum(
            ((self.layer(self.x[rows]) - self.y[rows]).square().sum() for rows in self._chunks()),
            start=self.x.new_zeros(()),
        )

    @torch.no_grad()
    def normal_equations(self, w: Tensor) -> NormalEquations:
        """J^T J, J^T e and sum e^2 of all parameters: one product of the shared columns."""
        self.assign(w)
        maps = self._maps()
        readout = (maps[:, : self.shared] @ w).T
        G = self.x.new_zeros(self.total, self.total)
        b, squares = self.x.new_zeros(self.total, self.y.shape[-1]), self.x.new_zeros(())
        for rows in self._chunks():
            F = self._columns(rows)
            said = F[: self.shared].T @ readout if self.readable else self.layer(self.x[rows])[:, 0]
            error = said - self.y[rows, 0]
            G.addmm_(F, F.T)
            b.addmm_(F, error)
            squares += error.square().sum()
        return NormalEquations(_gathered(maps, G), _pulled_back(maps, b), squares)

    @torch.no_grad()
    def projected_cost(self, theta: Tensor) -> Tensor:
        """Half the squares left at `theta` (what is not linear) by the best output layer for it.

        The ridge's share is counted in. That output layer is written into the layer.
        """
        w = self.w
        w[self.moving] = theta
        self.assign(w)
        G = self.x.new_zeros(self.shared, self.shared)
        b = self.x.new_zeros(self.shared, self.y.shape[-1])
        for rows in self._chunks():
            out = self.buffer[:, : self.shared, : rows.stop - rows.start]
            R = self.layer.regressor_columns(self.x[rows], out)[0]
            G.addmm_(R, R.T)
            b.addmm_(R, self.y[rows, 0])
        factor = torch.linalg.cholesky_ex(G + self.ridge * torch.eye(self.shared).to(G)).L
        weights = torch.cholesky_solve(b, factor)
        # In a regressor's coordinates an output layer's maps pick, so that their transpose places.
        placed = _pulled_back(self._maps()[:, : self.shared], weights)
        w[self.linear] = placed[self.linear]
        self.assign(w)
        cost = 0.5 * (self.target_squares - (b * weights).sum())
        self._eliminated = _Eliminated(theta.clone(), weights, factor, cost)
        return cost

    @torch.no_grad()
    def projected(self, theta: Tensor) -> Quadratic:
        """Local quadratic of `projected_cost`, with Kaufman's approximation of its Hessian.

        References:
            Golub and Pereyra (1973); L. Kaufman, BIT 15 (1975) 49-57.
        """
        known = self._eliminated
        if known is None or not torch.equal(known.theta, theta):
            self.projected_cost(theta)
            known = self._eliminated
        assert known is not None
        shared = self.shared
        A = self.x.new_zeros(self.total - shared, self.total)
        b = self.x.new_zeros(self.total - shared, self.y.shape[-1])
        for rows in self._chunks():
            F = self._columns(rows)
            A.addmm_(F[shared:], F.T)
            b.addmm_(F[shared:], F[:shared].T @ known.weights - self.y[rows, 0])
        explained = A[:, :shared] @ torch.cholesky_solve(A[:, :shared].T, known.factor)
        maps = self._maps()[:, shared:, self.moving]
        gradient = _pulled_back(maps, b)
        return Quadratic(known.cost, gradient, _gathered(maps, A[:, shared:] - explained))

    def _maps(self) -> Tensor:
        """Shape (outputs, columns, parameters)."""
        return torch.cat(list(self.layer.jacobian_maps().values()), -1)[0]

    def _columns(self, rows: slice) -> Tensor:
        out = self.buffer[:, :, : rows.stop - rows.start]
        return self.layer.jacobian_columns(self.x[rows], out)[0]

    def _chunks(self) -> Iterator[slice]:
        n = len(self.x)
        for start in range(0, n, self.buffer.shape[-1]):
            yield slice(start, min(start + self.buffer.shape[-1], n))


class _Eliminated:
    """The best output layer at `theta`: weights (regressors, outputs), factor of their Gram."""

    def __init__(self, theta: Tensor, weights: Tensor, factor: Tensor, cost: Tensor) -> None:
        self.theta, self.weights, self.factor, self.cost = theta, weights, factor, cost


def _gathered(maps: Tensor, gram: Tensor) -> Tensor:
    """Sum over the outputs of M^T G M."""
    return (maps.mT @ gram @ maps).sum(0)


def _pulled_back(maps: Tensor, columns: Tensor) -> Tensor:
    """Sum over the outputs k of M_k^T b_k, for b of shape (columns, outputs)."""
    return (maps.mT @ columns.T.unsqueeze(-1)).sum(0)[:, 0]
