"""Uncertainty of a schedule's coefficients at any motion."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nfriction.friction.coefficients import Schedule

# Motions at which derivatives are multiplied out at a time; a network has many parameters.
PIECE = 500


@dataclass(frozen=True, eq=False, repr=False)
class CoefficientUncertainty:
    """Posterior of a schedule's parameters, carried over to its coefficients.

    Linear theory around the fitted parameters, with the plant's terms and the windows' states
    free besides.

    Attributes:
        schedule: whose parameters these are.
        root: R of their covariance R R^T, (parameter, any); rows are infinite for
            unidentifiable parameters, zero for parameters that were not fitted.
        law: of the constant law that a network corrects. Evidence may hold a network so close to
            its law that its own parameters are sure of what the law is not; the variances add.
    """

    schedule: Schedule
    root: Tensor
    law: "CoefficientUncertainty | None" = None

    @torch.no_grad()
    def sd(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Standard deviation of the coefficients at motions, (*batch, joint, coefficient).

        Outside the trained range it is that at the range's edge: a network fades there, but not
        because it is known better. `qd` [rad/s] and `qdd` [rad/s^2] are (*batch, joint).
        """
        shape = qd.shape
        flat = (x.reshape(-1, shape[-1]).split(PIECE) for x in (qd, qdd))
        found = torch.cat([self._sd(v, a) for v, a in zip(*flat, strict=True)])
        found = found.reshape(*shape, -1)
        return found if self.law is None else torch.hypot(found, self.law.sd(qd, qdd))

    def _sd(self, qd: Tensor, qdd: Tensor) -> Tensor:
        by = self.schedule.sensitivities(*self.schedule.within_range(qd, qdd))
        slopes, joint = by.parameters, by.joint
        unknown = torch.isinf(self.root).any(1)
        root = torch.where(unknown[:, None], 0.0, self.root)
        columns = []
        for j in range(qd.shape[-1]):
            own = (joint == j).nonzero().squeeze(-1)
            part = slopes[..., own]
            spread = (part @ root[own]).norm(dim=-1)
            lost = (part[..., unknown[own]] != 0).any(-1)
            columns.append(torch.where(lost, torch.inf, spread))
        return torch.stack(columns, 1)
