"""State and result of a fit by evidence: what was learnt, how sure it is, how the fit ended."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor, nn

from nfriction.optim import jacobian as jac

Status = Literal["converged", "noise_floor", "max_steps", "stalled", "not_finite", "stopped"]

MESSAGES: dict[str, str] = {
    "converged": "Weights, alpha, beta and gamma have settled at a maximum of the evidence.",
    "noise_floor": "The residuals have come down to the given noise floor.",
    "max_steps": "The step limit was reached before weights, alpha and beta had settled.",
    "stalled": "No step lowers the objective although its gradient is not small.",
    "not_finite": "The errors or their Jacobian are not finite, at the start or at every step.",
    "stopped": "Stopped by the callback or by an interrupt; the weights are the best reached.",
}


@dataclass(frozen=True, eq=False)
class EvidenceState:
    """All that a run needs to go on exactly where it stood.

    Args:
        w: parameters, shape (p,).
        alpha: prior precisions, shape (groups,); None before the first step.
        beta: noise precision.
        damping: mu of the next step.
        step: accepted steps so far.
    """

    w: Tensor
    alpha: Tensor | None = None
    beta: float = 1.0
    damping: float = 0.005
    step: int = 0

    def state_dict(self) -> dict[str, Any]:
        """Plain dictionary for `torch.save`; loads with `weights_only=True`."""
        return asdict(self)

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> EvidenceState:
        """Inverse of `state_dict`."""
        return cls(**state)


@dataclass(frozen=True, eq=False)
class EvidenceResult:
    """Outcome of a fit by evidence; read `converged` before believing it.

    Args:
        status: why the fit ended; `message` says it in words.
        w: parameters in one vector, shape (p,).
        alpha, gamma: prior precision and effective parameters, by group.
        beta: noise precision; the noise has the standard deviation `noise_std`.
        error_squares: E_D, weighted.
        parameter_squares: E_g = sum (w - w0)^2, by group.
        samples: n, how many errors E_D sums.
        log_evidence: in nats with all constants: models of the same data can be compared by it.
        covariance: posterior covariance of the parameters, shape (p, p).
        steps: accepted steps.
        history: log evidence before each step.
        state: for resuming.
        model, parameters: what `predictive_std` differentiates, and where.
    """

    status: Status
    w: Tensor
    alpha: dict[str, float]
    beta: float
    gamma: dict[str, float]
    error_squares: float
    parameter_squares: dict[str, float]
    samples: int
    log_evidence: float
    covariance: Tensor
    steps: int
    history: list[float]
    state: EvidenceState
    model: nn.Module | jac.Function | None = None
    parameters: dict[str, Tensor] = field(default_factory=dict)

    @property
    def converged(self) -> bool:
        """Whether the fit ended because there was nothing left to learn."""
        return self.status in ("converged", "noise_floor")

    @property
    def message(self) -> str:
        """The status in words."""
        return MESSAGES[self.status]

    @property
    def noise_std(self) -> float:
        """Standard deviation of the noise on an error of weight 1, in the targets' unit."""
        return math.sqrt(0.5 / self.beta)

    @property
    def effective_parameters(self) -> float:
        """Sum of gamma over the groups."""
        return sum(self.gamma.values())

    def predictive_std(self, x: Tensor, noise: bool = True, chunk: int | None = None) -> Tensor:
        """Standard deviation of the outputs at `x` that parameters and noise leave open.

        Args:
            x: inputs, shape (m, ...).
            noise: include that of a new measurement (of weight 1), or only that of the function.
            chunk: samples differentiated at once.
        Returns:
            Shape of the outputs, (m, *outputs).
        """
        if self.model is None:
            raise ValueError(
                "This fit was made from normal equations and knows no model; use `covariance` "
                "with the Jacobian of your outputs."
            )
        floor = 0.5 / self.beta if noise else 0.0
        deviations = []
        for _, output, jacobians in jac.jacobian_pieces(self.model, self.parameters, x, chunk):
            variance = torch.stack([((J @ self.covariance) * J).sum(-1) for J in jacobians], -1)
            deviations.append((variance.clamp(min=0) + floor).sqrt().view_as(output))
        return torch.cat(deviations)
