"""Friction models: a law with coefficients that follow the motion, `tau_f = model(qd, qdd, load)`.

With f the torque function of a law and c the coefficients that its schedule gives,

    tau_f = f(qd, load, c(qd, qdd), v_smooth).

The next step is `nfriction.simulation.rk4`, the motion of a mechanism with friction.
"""

from collections.abc import Callable, Sequence
from inspect import signature
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from nfriction.friction import laws
from nfriction.friction.coefficients import Constant, Schedule
from nfriction.friction.inputs import require_loads
from nfriction.friction.laws import Law
from nfriction.friction.parameters import as_tensor, positive_number, require_options

# Velocity over which the sign changes [rad/s]; larger values creep, smaller ones make RK4 unstable.
V_SMOOTH = 3e-3


class FrictionModel(nn.Module):
    """Friction torque of the joints of a mechanism.

    Args:
        schedule: its coefficients as a function of the motion.
        v_smooth: velocity over which the sign of the velocity changes, `sgn(v) = tanh(v/v_smooth)`
            [rad/s; m/s for a sliding axis]; a fit of a model given by name chooses it itself.

    Shape:
        qd, qdd, load: (*batch, joint); output (*batch, joint).

    Raises:
        ValueError: if `v_smooth` is not positive, or law and schedule name different coefficients.

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
        if tuple(schedule.coefficient_names) != law.names:
            raise ValueError(
                f"the schedule gives {', '.join(schedule.coefficient_names)}, but the law "
                f"{law.name!r} takes {', '.join(law.names)}; make it for this law."
            )
        self.law = law
        self.schedule = schedule
        self.v_smooth = positive_number("v_smooth", v_smooth, "rad/s")
        self.joints = schedule.joints
        self.state_size = schedule.state_size
        self.law_state_size = law.state_size
        # TorchScript compiles a function held as an attribute; it would refuse the Law itself.
        self.law_torque = law.torque

    def forward(self, qd: Tensor, qdd: Tensor, load: Tensor) -> Tensor:
        """Friction torque [N m] at velocity [rad/s], acceleration [rad/s^2] and load [-].

        Arrays and lists are taken, too.
        """
        if not torch.jit.is_scripting():
            qd, qdd, load = as_tensor("qd", qd), as_tensor("qdd", qdd), as_tensor("load", load)
        # Other widths would silently broadcast to all joints' coefficients.
        for name, given in (("qd", qd), ("qdd", qdd), ("load", load)):
            width = given.shape[-1] if given.ndim else 0
            if width != self.joints:
                shape = f"(*batch, joint) with {self.joints} joints, got last axis {width}"
                raise ValueError(f"`{name}` must be {shape}.")
        return self.torque(qd, load, self.schedule(qd, qdd))

    # A simulation computes the torque in two steps: the coefficients at a sample, which it holds,
    # and the torque by these at every stage of an integration step.

    def coefficients(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Coefficients at a motion, (*batch, joint, coefficient); see `Schedule`."""
        return self.schedule(qd, qdd)

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Hidden state after the first sample, (*batch, joint, state_size)."""
        return self.schedule.initial_state(qd, qdd)

    def advance(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        """Hidden state after a sample, from that after the sample before."""
        return self.schedule.advance(qd, qdd, state)

    def coefficients_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        """Coefficients at a sample, given the hidden state after it."""
        return self.schedule.coefficients_from(qd, qdd, state)

    def torque(self, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
        """Friction torque for given coefficients.

        Raises:
            ValueError: of a law with memory, whose torque depends on the motion before.
        """
        if self.law_state_size:
            raise ValueError(
                "the friction law has an internal state, so there is no torque of a velocity "
                "alone: advance `law.memory` over the samples, or simulate with `rollout`."
            )
        return self.law_torque(qd, load, coefficients, self.v_smooth)

    def steady_torque(self, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
        """Friction torque at a constant velocity, which a law with memory approaches."""
        return self.law_torque(qd, load, coefficients, self.v_smooth)

    def check_loads(self, plant: object) -> None:
        """Refuse a plant with other loads than the friction's, see `require_loads`."""
        require_loads(self.law, plant)

    def zero_velocity_damping(self) -> Tensor:
        """Slope of the torque over velocity at rest under unit load [N m s/rad], (joint,).

        It determines whether an explicit integrator is stable near standstill. If several sets of
        coefficients are possible at rest, it is the largest; for a law with memory, whose steps are
        implicit and stable at any slope, it is zero.
        """
        if self.law_state_size:
            return self.schedule.positive.new_zeros(self.joints, dtype=torch.float64)
        # A caller may have switched gradients off, even for good (`torch.inference_mode`).
        with torch.inference_mode(False), torch.enable_grad():
            held = self.schedule.rest_coefficients().detach().clone()
            qd = held.new_zeros(held.shape[:-1]).requires_grad_()
            # At rest no load exceeds 1, the link's own weight.
            load = torch.ones_like(qd)
            # A law is elementwise, so the sum's gradient is each joint's slope.
            slope = torch.autograd.grad(self.torque(qd, load, held).sum(), qd)[0]
        return slope.reshape(-1, self.joints).amax(0)

    def options(self) -> dict[str, Any]:
        """Constructor arguments beyond joints, initial values and `v_smooth`, as plain JSON."""
        return self.schedule.options()

    def extra_repr(self) -> str:
        return f"law={self.law.name}, joints={self.joints}, v_smooth={self.v_smooth:g}"


class NamedModel(FrictionModel):
    """A law and a kind of schedule under one name.

    Args:
        initial: start values in SI, shape (joint, coefficient) or (coefficient,).
        v_smooth: see `FrictionModel`.
        options: of the schedule, see its class.

    Raises:
        ValueError: for options that the schedule does not have.
    """

    definition: Law
    make_schedule: Callable[..., Schedule]

    def __init__(
        self,
        joints: int,
        initial: Tensor | Sequence | None = None,
        *,
        v_smooth: float = V_SMOOTH,
        **options: Any,
    ) -> None:
        # Keyword arguments of the class itself arrive among the options of the schedule.
        given = signature(type(self)).parameters.values()
        own = [p.name for p in given if p.kind is p.KEYWORD_ONLY and p.name != "v_smooth"]
        require_options(type(self).__name__, self.make_schedule, options, own)
        schedule = self.make_schedule(self.definition, joints, initial, **options)
        super().__init__(self.definition, schedule, v_smooth)


class ConstantModel(NamedModel):
    """A law with constant coefficients; it has no options."""

    make_schedule = Constant


class NCFM(ConstantModel):
    """Viscous friction `C_p qd`, one constant per joint (RTIP paper, Table I)."""

    definition = laws.VISCOUS


class LFM(ConstantModel):
    """Viscous plus load-dependent Coulomb friction, constants B and C (TLRIP paper, (26)-(29))."""

    definition = laws.LINEAR


class CFM(ConstantModel):
    """Coulomb friction F_c alone, as in dry or lightly lubricated bearings."""

    definition = laws.COULOMB


class CVFM(ConstantModel):
    """Coulomb plus viscous friction F_c, F_v independent of the load: of geared drives."""

    definition = laws.COULOMB_VISCOUS


class NLFM(ConstantModel):
    """Five constants f_o, f_c, f_v, f_a, f_b per joint (RTIP paper, Table III)."""

    definition = laws.NONLINEAR


class Stribeck(ConstantModel):
    """Generalised Stribeck friction with constants F_c, F_d, F_v, v_s, delta per joint."""

    definition = laws.STRIBECK
