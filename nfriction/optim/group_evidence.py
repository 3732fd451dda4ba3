"""Evidence for the prior precisions of groups of parameters, and MacKay's update of them."""

from typing import NamedTuple

import torch
from torch import Tensor


class GroupEvidence(NamedTuple):
    """Evidence for the prior precisions of groups, and updated precisions.

    `occam` minus the cost at the optimum is the log evidence up to a constant.
    """

    occam: float  # log of the ratio of posterior to prior volume, in nats
    gamma: Tensor  # number of parameters of each group that the data determine, (groups,)
    slope: Tensor  # derivative of the log evidence by the log precision of each group, (groups,)
    precision: Tensor  # new precision of each group, (groups,)


def group_evidence(
    data: Tensor, known: Tensor, offset: Tensor, groups: Tensor, precision: Tensor
) -> GroupEvidence:
    """MacKay's update of the precisions alpha of groups of parameters, given a known prior.

    With A = data + known + diag(alpha) at the optimum, the log evidence is stationary where

        alpha_g |offset_g|^2 = gamma_g = alpha_g tr_g((known + diag(alpha))^-1 - A^-1).

    Args:
        data: curvature of the errors with other variables marginalised, (p, p).
        known: curvature of a fixed prior, (p, p).
        offset: parameters minus the mean of the prior, at the optimum, (p,).
        groups: group of each parameter, -1 for parameters with only the known prior, (p,).
        precision: alpha of each group, (groups,).
    """
    count, mine = len(precision), groups >= 0
    prior = known + torch.diag(torch.where(mine, precision[groups.clamp_min(0)], 0.0))
    variances, volumes = [], []
    for system in (prior, prior + data):
        # Scaled to a unit diagonal, so that the parameters' units do not affect precision.
        scale, factor = factorise(system)
        variances.append(scale.square() * torch.cholesky_inverse(factor).diagonal())
        volumes.append(float(scale.log().sum() - factor.diagonal().log().sum()))
    reduced = (variances[0] - variances[1])[mine]
    squares = group_sums(offset[mine].square(), groups[mine], count)
    # Round-off may make this negative for a group that the data do not determine.
    gamma = (precision * group_sums(reduced, groups[mine], count)).clamp_min(0.0)
    # Uninformative data cannot set a precision, and a group at its centre would divide by zero.
    usable = (gamma > torch.finfo(gamma.dtype).eps ** 0.5) & (squares > 0)
    return GroupEvidence(
        occam=volumes[1] - volumes[0],
        gamma=gamma,
        slope=0.5 * (gamma - precision * squares),
        precision=torch.where(usable, gamma / squares, precision),
    )


def factorise(system: Tensor) -> tuple[Tensor, Tensor]:
    """Scale s and lower Cholesky factor L: diag(s) S diag(s) = L L^T has a unit diagonal."""
    scale = system.diagonal().clamp(min=torch.finfo(system.dtype).tiny).rsqrt()
    scaled = scale[:, None] * system * scale
    factor, failed = torch.linalg.cholesky_ex(scaled)
    if failed:
        # Singular to within round-off: raise the eigenvalues by the size of that round-off.
        lift = 10 * len(system) * torch.finfo(system.dtype).eps
        factor, _ = torch.linalg.cholesky_ex(scaled + lift * torch.eye(len(system)).to(scaled))
    return scale, factor


def group_sums(values: Tensor, groups: Tensor, count: int) -> Tensor:
    """Sum of `values` over each group, shape (count,)."""
    return values.new_zeros(count).index_add_(0, groups, values)
