"""Uncertainty of a schedule's coefficients at any motion."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nfriction.friction.coefficients import Schedule
from nfriction.friction.models import FrictionModel

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

    def torque_sd(self, model: FrictionModel, qd: Tensor) -> Tensor:
        """Standard deviation of a model's torque at velocities, (sample, joint).

        At the load at rest and without acceleration. `model` has this schedule; its `v_smooth` is
        taken for known.
        """
        rest, load = torch.zeros_like(qd), torch.ones_like(qd)
        with torch.enable_grad():
            held = model.coefficients(qd, rest).detach().expand(*qd.shape, -1).clone()
            held.requires_grad_()
            # A law is elementwise, so the sum's gradient is each joint's slope.
            (slopes,) = torch.autograd.grad(model.torque(qd, load, held).sum(), held)
        with torch.no_grad():
            pieces = (x.split(PIECE) for x in (qd, rest, slopes))
            return torch.cat([self._sd(*piece) for piece in zip(*pieces, strict=True)])[..., 0]

    def _sd(self, qd: Tensor, qdd: Tensor, weights: Tensor | None = None) -> Tensor:
        """That of each coefficient, or of their sum with weights, (sample, joint, 1)."""
        by = self.schedule.sensitivities(*self.schedule.within_range(qd, qdd))
        slopes, joint = by.parameters, by.joint
        unknown = torch.isinf(self.root).any(1)
        root = torch.where(unknown[:, None], 0.0, self.root)
        columns = []
        for j in range(qd.shape[-1]):
            own = (joint == j).nonzero().squeeze(-1)
            part = slopes[..., own].expand(len(qd), -1, -1)
            if weights is not None:
                part = (weights[:, j, :, None] * part).sum(1, keepdim=True)
            spread = (part @ root[own]).norm(dim=-1)
            lost = (part[..., unknown[own]] != 0).any(-1)
            columns.append(torch.where(lost, torch.inf, spread))
        return torch.stack(columns, 1)
