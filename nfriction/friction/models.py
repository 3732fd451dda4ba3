"""Friction models: a law times a schedule, `tau_f = model(qd, qdd, load)`."""

import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from nfriction.friction import laws
from nfriction.friction.laws import Law
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.friction.schedules import Constant, Schedule

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

    def torque(self, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
        """Friction torque with coefficients given, as a simulation holds them over a step."""
        return self.law_torque(qd, load, coefficients, self.v_smooth)

    def slope_at_rest(self) -> Tensor:
        """Slope of the torque over velocity at rest under unit load [N m s/rad], (joint,).

        What decides whether an explicit integrator stays stable near standstill.
        """
        like = next(self.parameters(), torch.zeros((), dtype=torch.float64))
        rest = torch.zeros(self.joints, dtype=like.dtype, device=like.device)
        load = torch.ones_like(rest)
        held = self.coefficients(rest, torch.zeros_like(rest)).detach()
        with torch.enable_grad():
            qd = rest.requires_grad_()
            # A law is elementwise, so the sum's gradient is each joint's slope.
            return torch.autograd.grad(self.torque(qd, load, held).sum(), qd)[0]

    def options(self) -> dict[str, Any]:
        """Constructor arguments beyond `joints` and `v_smooth`, as plain JSON."""
        return self.schedule.options()

    def extra_repr(self) -> str:
        return f"law={self.law.name}, joints={self.joints}, v_smooth={self.v_smooth:g}"


class ConstantModel(FrictionModel):
    """A law with constant coefficients; the named models below are its public forms.

    Args:
        joints: number of joints.
        initial: start values in SI, shape (joint, coefficient) or (coefficient,).
        v_smooth: see `FrictionModel`.
    """

    definition: Law

    def __init__(
        self,
        joints: int,
        initial: Tensor | Sequence | None = None,
        *,
        v_smooth: float = V_SMOOTH,
    ) -> None:
        super().__init__(self.definition, Constant(self.definition, joints, initial), v_smooth)


class NCFM(ConstantModel):
    """Viscous friction `C_p qd`, one constant a joint (second paper, Table I)."""

    definition = laws.VISCOUS


class LFM(ConstantModel):
    """Viscous plus load-dependent Coulomb friction, constants B and C (TLRIP paper, (26)-(29))."""

    definition = laws.LINEAR


class NLFM(ConstantModel):
    """Five constants f_o, f_c, f_v, f_a, f_b a joint (second paper, Table III)."""

    definition = laws.NONLINEAR


class Stribeck(ConstantModel):
    """Generalised Stribeck friction with constants F_c, F_d, F_v, v_s, delta a joint."""

    definition = laws.STRIBECK


class NeuroFuzzyModel(FrictionModel):
    """A law whose coefficients an ANFIS layer with a radial basis head gives.

    Args:
        joints: number of joints.
        initial: constant reference from which training starts, as in `ConstantModel`.
        v_smooth: see `FrictionModel`.
        terms, head_units, acceleration, interpretable, prior_sd: see `NeuroFuzzy`.
    """

    definition: Law

    def __init__(
        self,
        joints: int,
        initial: Tensor | Sequence | None = None,
        *,
        v_smooth: float = V_SMOOTH,
        terms: Sequence[int] = (5, 5),
        head_units: int = 10,
        acceleration: Literal["along_motion", "signed"] = "along_motion",
        interpretable: bool = False,
        prior_sd: float = 0.3,
    ) -> None:
        schedule = NeuroFuzzy(
            self.definition,
            joints,
            initial,
            terms=terms,
            head_units=head_units,
            acceleration=acceleration,
            interpretable=interpretable,
            prior_sd=prior_sd,
        )
        super().__init__(self.definition, schedule, v_smooth)


class NFNCFM(NeuroFuzzyModel):
    """Viscous friction with a neuro-fuzzy coefficient (TLRIP paper)."""

    definition = laws.VISCOUS


class NFLFM(NeuroFuzzyModel):
    """Viscous plus load-dependent Coulomb friction with neuro-fuzzy B and C (TLRIP paper)."""

    definition = laws.LINEAR


class NFNLFM(NeuroFuzzyModel):
    """Offset, Coulomb, viscous and arctangent friction, neuro-fuzzy coefficients (TLRIP paper)."""

    definition = laws.NONLINEAR


MODELS: dict[str, type[ConstantModel] | type[NeuroFuzzyModel]] = {
    model.__name__: model for model in (NCFM, LFM, NLFM, Stribeck, NFNCFM, NFLFM, NFNLFM)
}


def model_by_name(name: str) -> type[ConstantModel] | type[NeuroFuzzyModel]:
    """The named model's class.

    Raises:
        ValueError: if no model has that name; the message lists the names.
    """
    if name not in MODELS:
        raise ValueError(f"no friction model is called {name!r}; there are {', '.join(MODELS)}.")
    return MODELS[name]
