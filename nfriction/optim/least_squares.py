"""Local quadratic models of least-squares problems, and the result of a minimisation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

Status = Literal[
    "converged_gradient",
    "converged_cost",
    "converged_step",
    "converged_interval",
    "max_steps",
    "creeping",
    "stalled",
    "not_finite",
    "stopped",
]

MESSAGES: dict[str, str] = {
    "converged_gradient": "Converged: the gradient is zero to tolerance, or the residuals are.",
    "converged_cost": "Converged.",
    "converged_step": "Converged: the parameters no longer move.",
    "converged_interval": "Converged to within the intervals, which include the step that remains.",
    "max_steps": "The step limit was reached; allow more steps.",
    "creeping": "Stalled before reaching a minimum (a kink or a narrow valley in the cost).",
    "stalled": "No step lowers the cost although the gradient is not small: gradient and cost "
    "disagree (a kink, noise or a wrong derivative).",
    "not_finite": "Cost or derivatives are not finite, at the start or at every step from `x`.",
    "stopped": "Stopped by the callback or an interrupt; `x` is the best point reached.",
}


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Second-order model of a sum of squares at one point."""

    cost: float | Tensor  # half the sum of squared residuals
    gradient: Tensor  # J^T r, (p,)
    hessian: Tensor  # J^T J or any positive semidefinite curvature, (p, p)
    blocks: tuple[int, int] | None = None  # first row, block size of the block-diagonal last part

    @property
    def finite(self) -> bool:
        """True if every entry is a finite number."""
        return math.isfinite(float(self.cost)) and bool(
            torch.isfinite(self.gradient).all() and torch.isfinite(self.hessian).all()
        )

    def checked(self, p: int) -> Quadratic:
        """The model detached from autograd.

        Raises:
            ValueError: if it does not have `p` parameters.
        """
        if self.gradient.shape != (p,) or self.hessian.shape != (p, p):
            raise ValueError(
                f"The model of {p} parameters must give a gradient of shape ({p},) and a Hessian "
                f"of shape ({p}, {p}), got {tuple(self.gradient.shape)} and "
                f"{tuple(self.hessian.shape)}."
            )
        gradient, hessian = self.gradient.detach(), self.hessian.detach()
        return Quadratic(float(self.cost), gradient, hessian, self.blocks)


class Step(NamedTuple):
    """An accepted step: cost after it, its damping, and norm of the scaled step.

    `step_norm` is measured in residual units (each parameter times the norm of its Jacobian
    column), so it does not depend on the parameters' units.
    """

    cost: float
    damping: float
    step_norm: float


@dataclass(frozen=True, eq=False)
class LeastSquaresResult:
    """Outcome of a least-squares fit; check `converged` before using `x`."""

    x: Tensor  # best parameters, (p,)
    cost: float  # half the sum of squares at `x`
    gradient: Tensor  # at `x`, (p,), not projected
    hessian: Tensor  # of Gauss and Newton at `x`, (p, p)
    status: Status  # reason why the search ended; `message` describes it in words
    steps: int
    evaluations: int  # costs evaluated, including rejected trials
    at_lower: Tensor  # which parameters lie on a bound, (p,), bool
    at_upper: Tensor
    history: list[Step]  # one per accepted step

    @property
    def converged(self) -> bool:
        """True if the search ended at a (possibly constrained) stationary point."""
        return self.status.startswith("converged")

    @property
    def message(self) -> str:
        """The status in words."""
        return MESSAGES[self.status]


def positive_diagonal(diagonal: Tensor) -> Tensor:
    """Replace zeros by 1, since the scale of a parameter without influence is arbitrary."""
    return torch.where(diagonal > 0, diagonal, 1.0)


def scaled_spectrum(matrix: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """1/sqrt(diagonal), and eigenvalues (ascending) and vectors after scaling to unit diagonal."""
    scale = positive_diagonal(matrix.diagonal()).rsqrt()
    values, vectors = torch.linalg.eigh(scale[:, None] * matrix * scale)
    return scale, values, vectors
