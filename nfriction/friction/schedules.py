"""Schedules: how the coefficients of a law follow the motion.

A schedule is a module that maps joint velocity and acceleration to the coefficients of a law,
shape (*batch, joint) -> (*batch, joint, coefficient). Fits see it through `parameter_vector`,
`bounds` and `sensitivities`, so any schedule can be estimated from torques or trajectories.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from nfriction.friction.laws import Law

# Smallest value a positive coefficient takes: far below any torque that a sensor can tell.
SMALLEST = 1e-12


class Sensitivity(NamedTuple):
    """Derivatives of the coefficients at given motions.

    A parameter acts on one joint's coefficients only, which `joint` names, so the derivative with
    respect to the parameters needs no joint axis.

    Attributes:
        parameters: with respect to the parameter vector, (sample, coefficient, parameter).
        joint: the joint that each parameter acts on, (parameter,).
        qd: with respect to the joint's own velocity, (sample, joint, coefficient).
        qdd: with respect to the joint's own acceleration, (sample, joint, coefficient).
    """

    parameters: Tensor
    joint: Tensor
    qd: Tensor
    qdd: Tensor


class Schedule(nn.Module, ABC):
    """Coefficients as a function of the motion.

    Args:
        law: the law whose coefficients are scheduled.
        joints: number of joints.
    """

    joints: int

    def __init__(self, law: Law, joints: int) -> None:
        super().__init__()
        if joints < 1:
            raise ValueError(f"`joints` must be at least 1, got {joints}.")
        self.joints = joints
        self.coefficient_names = list(law.names)
        self.positive_mask = [c.positive for c in law.coefficients]
        self.fitted_mask = [c.fitted for c in law.coefficients]

    @abstractmethod
    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Coefficients (*batch, joint, coefficient) at velocity and acceleration (*batch, joint)."""

    @abstractmethod
    def parameter_vector(self) -> Tensor:
        """What a fit varies, flat; a copy."""

    @abstractmethod
    def set_parameter_vector(self, vector: Tensor) -> None:
        """Write a vector of the form that `parameter_vector` gives."""

    @abstractmethod
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds of the parameter vector."""

    def prior(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the parameter vector; infinite where nothing is known."""
        vector = self.parameter_vector()
        return torch.zeros_like(vector), torch.full_like(vector, torch.inf)

    @abstractmethod
    def sensitivities(self, qd: Tensor, qdd: Tensor) -> Sensitivity:
        """Derivatives of the coefficients at motions of shape (sample, joint)."""


class Constant(Schedule):
    """Coefficients that do not depend on the motion.

    Positive coefficients live in log space. A fit varies the coefficients themselves, bounded
    below by zero, because the logarithm's gradient dies where a coefficient belongs at zero.

    Args:
        law: the law whose coefficients these are.
        joints: number of joints.
        initial: start values in SI, shape (joint, coefficient) or (coefficient,);
            default 1e-3 (search middle where the torque is not linear in it, zero where signed).
    """

    def __init__(self, law: Law, joints: int, initial: Tensor | Sequence | None = None) -> None:
        super().__init__(law, joints)
        self.raw = nn.Parameter(torch.zeros(joints, len(law.names), dtype=torch.float64))
        self.register_buffer("positive", torch.tensor(self.positive_mask), persistent=False)
        default = [
            c.search[len(c.search) // 2] if c.search else (1e-3 if c.positive else 0.0)
            for c in law.coefficients
        ]
        self.set_coefficients(default if initial is None else initial)

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return torch.where(self.positive, torch.exp(self.raw), self.raw)

    @property
    def values(self) -> Tensor:
        """The coefficients, shape (joint, coefficient)."""
        return torch.where(self.positive, torch.exp(self.raw), self.raw).detach()

    @torch.no_grad()
    def set_coefficients(self, values: Tensor | Sequence) -> None:
        """Set the coefficients in SI, shape (joint, coefficient) or (coefficient,).

        Raises:
            ValueError: if the shape does not fit, or a coefficient that is positive by physics
                is negative or not finite.
        """
        given = torch.as_tensor(values, dtype=torch.float64)
        try:
            given = given.broadcast_to(self.raw.shape)
        except RuntimeError:
            raise ValueError(
                f"coefficients must be (joint, coefficient) = {tuple(self.raw.shape)} "
                f"({', '.join(self.coefficient_names)}), got shape {tuple(given.shape)}."
            ) from None
        bad = ~torch.isfinite(given) | (self.positive & (given < 0))
        if bad.any():
            joint, k = (int(i) for i in bad.nonzero()[0])
            raise ValueError(
                f"`{self.coefficient_names[k]}` of joint {joint + 1} must be finite"
                f"{' and not negative' if self.positive_mask[k] else ''}, got {given[joint, k]:g}."
            )
        log = torch.log(given.clamp_min(SMALLEST))
        self.raw.copy_(torch.where(self.positive, log, given))

    def parameter_vector(self) -> Tensor:
        return self.values.reshape(-1).clone()

    def set_parameter_vector(self, vector: Tensor) -> None:
        self.set_coefficients(vector.reshape(self.raw.shape))

    def bounds(self) -> tuple[Tensor, Tensor]:
        lower = torch.where(self.positive, SMALLEST, -torch.inf).expand(self.raw.shape)
        upper = torch.full_like(self.raw, torch.inf)
        fixed = ~torch.tensor(self.fitted_mask).expand(self.raw.shape)
        lower = torch.where(fixed, self.values, lower.to(self.raw))
        upper = torch.where(fixed, self.values, upper.detach())
        return lower.reshape(-1), upper.reshape(-1)

    def sensitivities(self, qd: Tensor, qdd: Tensor) -> Sensitivity:
        joints, k = self.raw.shape
        samples = qd.shape[0]
        identity = torch.eye(k, dtype=self.raw.dtype).repeat(1, joints)
        zero = torch.zeros((), dtype=self.raw.dtype).expand(samples, joints, k)
        joint = torch.arange(joints).repeat_interleave(k)
        return Sensitivity(identity.expand(samples, -1, -1), joint, zero, zero)

    def extra_repr(self) -> str:
        columns = [f"{v:.4g}" for v in self.values.mean(0)]
        mean = ", ".join(f"{n}={v}" for n, v in zip(self.coefficient_names, columns, strict=True))
        return f"joints={self.joints}, mean {mean}"
