"""Friction models: a law with coefficients, `tau_f = model(qd, qdd, load)`.

The next step is `nfriction.simulation.rk4`, the motion of a mechanism with friction.
"""

import math
from collections.abc import Callable, Sequence
from pkgutil import resolve_name
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from nfriction.friction import laws
from nfriction.friction.coefficients import Constant, Schedule
from nfriction.friction.laws import Law

# Velocity over which the sign changes [rad/s]; larger values creep, smaller ones make RK4 unstable.
V_SMOOTH = 3e-3


class FrictionModel(nn.Module):
    """Friction torque of the joints of a mechanism.

    Args:
        law: the friction law.
        schedule: its coefficients as a function of the motion.
        v_smooth: velocity over which the sign of the velocity changes, `sgn(v) = tanh(v/v_smooth)`
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
        # TorchScript compiles a function held as an attribute; it would refuse the Law itself.
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
        """Coefficients of the law at a motion, (*batch, joint, coefficient); see `Schedule`."""
        return self.schedule(qd, qdd)

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Hidden state after the first sample, (*batch, joint, state_size); see `Schedule`."""
        return self.schedule.initial_state(qd, qdd)

    def advance(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        """Hidden state after a sample, from that after the sample before."""
        return self.schedule.advance(qd, qdd, state)

    def coefficients_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        """Coefficients of the law at a sample, given the hidden state after it."""
        return self.schedule.coefficients_from(qd, qdd, state)

    def torque(self, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
        """Friction torque for given coefficients, which a simulation holds over a step."""
        return self.law_torque(qd, load, coefficients, self.v_smooth)

    def zero_velocity_damping(self) -> Tensor:
        """Slope of the torque over velocity at rest under unit load [N m s/rad], (joint,).

        It decides whether an explicit integrator is stable near standstill. The largest, where
        several sets of coefficients are possible at rest.
        """
        # A copy, because tensors made in inference mode cannot be differentiated through.
        held = self.schedule.rest_coefficients().detach().clone()
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


class NamedModel(FrictionModel):
    """A law and a kind of coefficients under one name.

    Args:
        joints: number of joints.
        initial: start values in SI, shape (joint, coefficient) or (coefficient,).
        v_smooth: see `FrictionModel`.
        options: of the coefficients, see their class.
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
        schedule = self.make_schedule(self.definition, joints, initial, **options)
        super().__init__(self.definition, schedule, v_smooth)


class ConstantModel(NamedModel):
    """A law with constant coefficients; it has no options."""

    make_schedule = Constant


class NCFM(ConstantModel):
    """Viscous friction `C_p qd`, one constant a joint (second paper, Table I)."""

    definition = laws.VISCOUS


class LFM(ConstantModel):
    """Viscous plus load-dependent Coulomb friction, constants B and C (TLRIP paper, (26)-(29))."""

    definition = laws.LINEAR


class CFM(ConstantModel):
    """Coulomb friction with a constant F_c and no viscous term.

    The law of ball bearings whose links swing in air: there, only air drag grows with velocity.
    """

    definition = laws.COULOMB


class CVFM(ConstantModel):
    """Coulomb plus viscous friction with constants F_c and F_v, independent of the load.

    The usual law of geared drives, whose dry friction is that of the gear and not of the joint's
    own bearing.
    """

    definition = laws.COULOMB_VISCOUS


class NLFM(ConstantModel):
    """Five constants f_o, f_c, f_v, f_a, f_b a joint (second paper, Table III)."""

    definition = laws.NONLINEAR


class Stribeck(ConstantModel):
    """Generalised Stribeck friction with constants F_c, F_d, F_v, v_s, delta a joint."""

    definition = laws.STRIBECK


# Coefficients by networks, as model files name them. The papers' own are resolved by name, because
# the core does not import them.
NETWORKS = {
    "anfis": "nfriction.friction.neurofuzzy:NeuroFuzzy",
    "by_class": "nfriction.papers.nffem.adaptive_neurofuzzy:AdaptiveNeuroFuzzy",
    "rbf": "nfriction.papers.nffem.rbf_coefficients:RBFCoefficients",
}


class NeuroFuzzyModel(NamedModel):
    """A law with coefficients from an ANFIS layer with a radial basis head, `NeuroFuzzy`.

    Args:
        joints, initial, v_smooth: see `NamedModel`; training starts from constants `initial`.
        network: `"anfis"`; `"rbf"`: the papers' network alone, see `RBFCoefficients`; `"by_class"`:
            a network that corrects coefficients by class, see `AdaptiveNeuroFuzzy`.
        options: of the coefficients, e.g. `terms=(7, 5)`.
    """

    @staticmethod
    def make_schedule(*args: Any, network: str = "anfis", **options: Any) -> Schedule:
        if network not in NETWORKS:
            raise ValueError(f"`network` must be one of {sorted(NETWORKS)}, got {network!r}.")
        schedule: Schedule = resolve_name(NETWORKS[network])(*args, **options)
        return schedule


class NFNCFM(NeuroFuzzyModel):
    """Viscous friction with a neuro-fuzzy coefficient (TLRIP paper)."""

    definition = laws.VISCOUS


class NFCFM(NeuroFuzzyModel):
    """Coulomb friction with a neuro-fuzzy F_c: any curve over velocity that is odd."""

    definition = laws.COULOMB


class NFCVFM(NeuroFuzzyModel):
    """Coulomb plus viscous friction with neuro-fuzzy F_c and F_v."""

    definition = laws.COULOMB_VISCOUS


class NFLFM(NeuroFuzzyModel):
    """Viscous plus load-dependent Coulomb friction with neuro-fuzzy B and C (TLRIP paper)."""

    definition = laws.LINEAR


class NFNLFM(NeuroFuzzyModel):
    """Offset, Coulomb, viscous and arctangent friction, neuro-fuzzy coefficients (TLRIP paper)."""

    definition = laws.NONLINEAR


class NFStribeck(NeuroFuzzyModel):
    """Generalised Stribeck friction with neuro-fuzzy F_c, F_d, F_v, v_s and delta."""

    definition = laws.STRIBECK
