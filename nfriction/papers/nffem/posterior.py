"""Gauss-Laplace posterior of a least-squares fit with one prior precision per parameter group.

Convention (Foresee and Hagan): E_D = sum e^2 and E_g = sum (w - w0)^2 over group g, without
halves. Minus the log posterior is beta E_D + sum_g alpha_g E_g, so the noise has the variance
1 / (2 beta), a parameter of group g the prior variance 1 / (2 alpha_g), the posterior the
covariance S^-1 / 2 with S = beta J^T J + diag(alpha), and at the maximum of the evidence

    alpha_g = gamma_g / (2 E_g),    beta = (n - gamma) / (2 E_D).

References:
    D. J. C. MacKay, Neural Computation 4 (1992) 415-472; F. D. Foresee and M. T. Hagan,
    Gauss-Newton approximation to Bayesian learning, ICNN 1997.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from nfriction.optim.group_evidence import factorise, group_sums
from nfriction.papers.nffem.jacobian import NormalEquations

# A group whose prior outweighs its data by this factor is switched off; alpha stops there.
LARGEST_RATIO = 1e12


class Posterior(NamedTuple):
    """Gauss-Laplace posterior at given parameters, alpha and beta.

    Args:
        covariance: of the parameters, (2 S)^-1, shape (p, p).
        gamma: effective (well determined) parameters of each group, shape (groups,).
        log_evidence: log p(data | alpha, beta) in nats, with all its constants.
        newton_decrement: gain of a full Gauss-Newton step in log posterior, in nats.
        parameter_squares: E_g, shape (groups,).
    """

    covariance: Tensor
    gamma: Tensor
    log_evidence: float
    newton_decrement: float
    parameter_squares: Tensor


def posterior(
    local: NormalEquations,
    offset: Tensor,
    groups: Tensor,
    samples: int,
    alpha: Tensor,
    beta: float,
) -> Posterior:
    """Posterior, effective parameters and log evidence; exact where the model is linear.

    Args:
        local: J^T J, J^T e and E_D at the parameters w.
        offset: w - w0, shape (p,).
        groups: group of each parameter, 0 ... groups - 1, int64, shape (p,).
        samples: number n of errors that E_D sums.
        alpha: prior precision (halved) of each group, shape (groups,), positive.
        beta: noise precision (halved), positive.
    """
    count, precision = len(alpha), alpha[groups]
    # Scaled to a unit diagonal, so that the units of the parameters cost no digits.
    scale, factor = factorise(beta * local.JtJ + precision.diag())
    inverse = scale[:, None] * torch.cholesky_inverse(factor) * scale
    slope = beta * local.Jte + precision * offset
    squares = group_sums(offset.square(), groups, count)
    # The diagonal of S^-1 (beta J^T J) equals 1 - alpha (S^-1)_ii, but keeps its digits where the
    # prior dominates and the difference would be rounding.
    determined = beta * (inverse * local.JtJ).sum(1)
    sizes = group_sums(torch.ones_like(offset), groups, count)
    log_determinant = 2 * factor.diagonal().log().sum() - 2 * scale.log().sum()
    log_evidence = (
        -beta * local.squares
        - alpha @ squares
        + 0.5 * samples * math.log(beta / math.pi)
        + 0.5 * sizes @ alpha.log()
        - 0.5 * log_determinant
    )
    return Posterior(
        covariance=inverse / 2,
        gamma=group_sums(determined, groups, count).clamp(min=0),
        log_evidence=float(log_evidence),
        newton_decrement=float(slope @ (inverse @ slope)),
        parameter_squares=squares,
    )


def reestimate(
    known: Posterior,
    local: NormalEquations,
    groups: Tensor,
    samples: int,
    alpha: Tensor,
    largest_beta: float = math.inf,
) -> tuple[Tensor, float]:
    """MacKay's fixed-point update: alpha_g = gamma_g / (2 E_g), beta = (n - gamma) / (2 E_D).

    A group that has not left its prior's centre keeps its alpha: it has no information yet.

    Args:
        known: `posterior` at the present alpha and beta.
        local, groups, samples, alpha: those of this posterior.
        largest_beta: limit by a known noise floor.
    Returns:
        The new alpha, shape (groups,), and beta.
    """
    curvature = group_sums(local.JtJ.diagonal(), groups, len(alpha))
    # As many parameters as samples would leave no noise at all.
    beta = float((samples - known.gamma.sum()).clamp(min=1e-3) / (2 * local.squares))
    beta = min(beta, largest_beta)
    limit = LARGEST_RATIO * beta * curvature
    # A group without curvature has no scale for a limit.
    limit = torch.where(limit > 0, limit, alpha)
    estimate = torch.minimum(known.gamma / (2 * known.parameter_squares), limit)
    # At the centre of its prior the estimate divides zero by zero.
    usable = (known.parameter_squares > 0) & (estimate > 0)
    return torch.where(usable, estimate, alpha), beta
