"""A friction model: a law times a schedule, `tau_f = model(qd, qdd, load)`."""

import math
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from nfriction.friction.coefficients import Schedule
from nfriction.friction.laws import Law

# Velocity over which the sign turns [rad/s]; larger values creep, smaller ones make RK4 unstable.
V_SMOOTH = 3e-3


class FrictionModel(nn.Module):
    """Friction torque of the joints of a mechanism.

    Args:
        law: the friction law.
        schedule: its coefficients as a function of the motion.
        v_smooth: velocity over which the sign of the velocity turns, `sgn(v) = tanh(v/v_smooth)`
            [rad/s; m/s for a sliding axis].

    Shape:
        qd, qdd, load: (*batch, joint); output (*batch, joint).

    Raises:
        ValueError: if `v_smooth` is not positive, or law and schedule name other coefficients.

    Examples:
        >>> model = LFM(joints=3, initial=[1e-3, 2e-3])
        >>> qd = torch.ones(3, dtype=torch.float64)
        >>> model(qd, torch.zeros_like(qd), torch.ones_like(qd))
        tensor([0.0030, 0.0030, 0.0030], dtype=torch.float64, grad_fn=<AddBackward0>)
    """

    # A joint's coefficients follow that joint's own motion alone, as schedules promise.
    joint_wise: ClassVar[bool] = True

    def __init__(self, law: Law, schedule: Schedule, v_smooth: float = V_SMOOTH) -> None:
        super().__init__()
        if not 0 < v_smooth < math.inf:
            raise ValueError(f"`v_smooth` must be positive and finite [rad/s], got {v_smooth}.")
        if tuple(schedule.coefficient_names) != law.names:
            raise ValueError(
                f"the schedule gives {', '.join(schedule.coefficient_names)}, but the law "
                f"{law.name!r} takes {', '.join(law.names)}; make it for this law."
            )
        self.law = law
        self.schedule = schedule
        self.v_smooth = float(v_smooth)
        self.joints = schedule.joints
        self.state_size = schedule.state_size
        # TorchScript compiles a function held as an attribute; the Law itself it would refuse.
        self.law_torque = law.torque

    def forward(self, qd: Tensor, qdd: Tensor, load: Tensor) -> Tensor:
        """Friction torque [N m] at velocity [rad/s], acceleration [rad/s^2] and load [-]."""
        if qd.shape[-1] != self.joints:
            raise ValueError(
                f"`qd` must be (*batch, joint) with {self.joints} joints, got last axis "
                f"{qd.shape[-1]}."
            )
        return self.law_torque(qd, load, self.schedule(qd, qdd), self.v_smooth)

    def coefficients(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Coefficients of the law at a motion, shape (*batch, joint, coefficient).

        The batch is left out where they do not depend on the motion.
        """
        return self.schedule(qd, qdd)

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Memory of the schedule after the first sample, (*batch, joint, state_size)."""
        return self.schedule.initial_state(qd, qdd)

    def advance(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        """Memory of the schedule after a sample, from that after the sample before."""
        return self.schedule.advance(qd, qdd, state)

    def coefficients_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        """Coefficients of the law at a sample and the memory after it."""
        return self.schedule.coefficients_from(qd, qdd, state)

    def torque(self, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
        """Friction torque with coefficients given, as a simulation holds them over a step."""
        return self.law_torque(qd, load, coefficients, self.v_smooth)

    def zero_velocity_damping(self) -> Tensor:
        """Slope of the torque over velocity at rest under unit load [N m s/rad], (joint,).

        What decides whether an explicit integrator stays stable near standstill; the steepest,
        where the coefficients at rest depend on what went before.
        """
        held = self.schedule.rest_coefficients().detach()
        rest = held.new_zeros(held.shape[:-1])
        load = torch.ones_like(rest)
        with torch.enable_grad():
            qd = rest.requires_grad_()
            # A law is elementwise, so the sum's gradient is each joint's slope.
            slope = torch.autograd.grad(self.torque(qd, load, held).sum(), qd)[0]
        return slope.reshape(-1, self.joints).amax(0)

    def options(self) -> dict[str, Any]:
        """Constructor arguments beyond `joints` and `v_smooth`, as plain JSON."""
        return self.schedule.options()

    def extra_repr(self) -> str:
        return f"law={self.law.name}, joints={self.joints}, v_smooth={self.v_smooth:g}"
