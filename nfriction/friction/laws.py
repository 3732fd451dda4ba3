"""Friction laws: elementwise functions of velocity, load and coefficients.

A law gives the friction torque tau_f on the left-hand side of

    M(q) qdd + bias(q, qd) + tau_f = tau.

Every law here is a function `(qd, load, coefficients, v_smooth) -> tau_f` of

    qd            joint velocity [rad/s], shape (*batch, joint)
    load          normal force |N| on the joint's bearing divided by the weight m g of its link
                  [-], same shape as `qd`; used only by load-dependent laws
    coefficients  shape (*batch, joint, coefficient), in the order of the law's description
    v_smooth      velocity over which the sign of the velocity changes [rad/s]
    tau_f         friction torque [N m], shape (*batch, joint)

which can be compiled by TorchScript, exported and broadcast. For a sliding axis, read m for rad and
N for N m. To define your own law, write such a function and describe its coefficients in a `Law`.
The next step is `nfriction.friction.coefficients`: the coefficients as a function of the motion.

References:
    Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994), for Coulomb, viscous and
    Stribeck friction; the two papers (see docs/from_the_papers.md) for the others.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

TorqueFunction = Callable[[Tensor, Tensor, Tensor, float], Tensor]
StateTorqueFunction = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
AdvanceFunction = Callable[[Tensor, Tensor, Tensor, Tensor, "float | Tensor"], Tensor]


@dataclass(frozen=True)
class Coefficient:
    """One coefficient of a law.

    Attributes:
        name: symbol, e.g. `"B"`.
        unit: SI unit for a revolute joint.
        positive: physically positive, and therefore kept positive by construction.
        linear: the torque is linear in it, so linear least squares estimates it.
        initial_grid: start values to try if the torque is not linear in it.
        fitted: estimated by default; otherwise kept at its initial value.
        prior_scale: standard deviation of a prior around zero, relative to the RMS of the joint's
            friction torque (absolute if the coefficient has no unit); infinite for no prior.
            Intended for effects that are small in most joints.
        stores: belongs to a hidden state, such as the energy in a law's memory or a joint's heat,
            so that networks keep it constant.

    Raises:
        ValueError: if a nonlinear coefficient has no initial grid or has a prior, or if a start
            value has a forbidden sign or is not finite.
    """

    name: str
    unit: str
    positive: bool = True
    linear: bool = True
    initial_grid: tuple[float, ...] = ()
    fitted: bool = True
    prior_scale: float = math.inf
    stores: bool = False

    def __post_init__(self) -> None:
        if not self.linear and not self.initial_grid:
            raise ValueError(
                f"coefficient {self.name!r} is not linear, so `initial_grid` needs values to try."
            )
        if not all((0 if self.positive else -math.inf) < x < math.inf for x in self.initial_grid):
            rule = "positive and finite" if self.positive else "finite"
            raise ValueError(
                f"`initial_grid` of {self.name!r} must be {rule}, got {self.initial_grid}."
            )
        if not self.prior_scale > 0 or (self.prior_scale < math.inf and not self.linear):
            raise ValueError(
                f"`prior_scale` of {self.name!r} must be positive, and is for coefficients in "
                f"which the torque is linear; got {self.prior_scale}."
            )


@dataclass(frozen=True)
class Memory:
    """Internal state of a law; see `nfriction.friction.memory` for the contract and such laws.

    Attributes:
        size: of each joint's state.
        advance: `(state, qd, load, coefficients, time_step) -> state` over one sample.
        torque: `(state, qd, load, coefficients) -> tau_f` at the end of a sample.
        transmitted: the load is the torque that the drive transmits [N m] instead of a normal load.
    """

    size: int
    advance: AdvanceFunction
    torque: StateTorqueFunction
    transmitted: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.size, int) or self.size < 1:
            raise ValueError(f"`size` must be a whole number of at least 1, got {self.size!r}.")
        if not callable(self.advance) or not callable(self.torque):
            raise TypeError("`advance` and `torque` of a memory must be functions.")


@dataclass(frozen=True)
class Law:
    """A friction law: its torque function and a description of its coefficients.

    Attributes:
        coefficients: in the order of the coefficients' last axis.
        torque: `(qd, load, coefficients, v_smooth) -> tau_f`, elementwise and scriptable; for a
            law with memory, the steady-state torque at constant velocity.
        nested_law: a simpler law that this one contains: the torque is the same if all
            coefficients except `nested_coefficients` are zero or only shape a term that is zero. A
            law with several minima is also fitted starting from the fit of its nested law.
        nested_coefficients: names that the nested law's coefficients have here, in its order.
        memory: internal state of a law whose torque depends on more than the current motion; None
            for a law without memory.

    Raises:
        TypeError: if a coefficient, the torque or the nested law has the wrong type.
        ValueError: if there is no coefficient, two have the same name, or the nested coefficients
            do not match the nested law.

    Examples:
        >>> def drag(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
        ...     return coefficients[..., 0] * qd * qd.abs()
        >>> DRAG = Law("drag", (Coefficient("D", "N m s^2/rad^2"),), drag)
    """

    name: str
    coefficients: tuple[Coefficient, ...]
    torque: TorqueFunction
    nested_law: "Law | None" = None
    nested_coefficients: tuple[str, ...] = ()
    memory: Memory | None = None

    def __post_init__(self) -> None:
        given = self.coefficients
        if not isinstance(given, tuple) or not all(isinstance(c, Coefficient) for c in given):
            raise TypeError(
                f"`coefficients` of law {self.name!r} must be a tuple of Coefficient, got {given}."
            )
        if not callable(self.torque):
            raise TypeError(
                f"`torque` of law {self.name!r} must be a function, got {self.torque!r}."
            )
        if not self.names or len(set(self.names)) < len(self.names):
            raise ValueError(
                f"law {self.name!r} needs coefficients, each with its own name, got {self.names}."
            )
        if not isinstance(self.nested_law, Law | None):
            raise TypeError(f"`nested_law` must be a Law, got {self.nested_law!r}.")
        wanted = self.nested_law.coefficients if self.nested_law else ()
        own, named = {c.name: c for c in self.coefficients}, self.nested_coefficients
        if not len(set(named)) == len(named) == len(wanted) or not set(named) <= set(own):
            raise ValueError(
                f"law {self.name!r} must name the {len(wanted)} of its coefficients {self.names} "
                f"that its nested law has, got `nested_coefficients`={named}."
            )
        for name, other in zip(named, wanted, strict=True):
            if own[name].positive and not other.positive:
                raise ValueError(
                    f"{name!r} of law {self.name!r} is positive, {other.name!r} of the nested law "
                    "may be negative; give both the same `positive`."
                )

    def __deepcopy__(self, memo: object) -> "Law":
        return self  # immutable, and fits copy their models for every search

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients, in order."""
        return tuple(c.name for c in self.coefficients)

    @property
    def reads_drive(self) -> bool:
        """True for a law whose load is the torque that the drive transmits."""
        return self.memory is not None and self.memory.transmitted

    @property
    def state_size(self) -> int:
        """Size of each joint's internal state; 0 for a law without memory."""
        return self.memory.size if self.memory else 0

    def initial_state(self, qd: Tensor) -> Tensor:
        """Internal state before the first sample, undeflected, (*batch, joint, state)."""
        return qd.new_zeros((*qd.shape, self.state_size))


def smooth_sign(qd: Tensor, v_smooth: float) -> Tensor:
    """Sign of the velocity with a smooth transition through zero: `tanh(qd / v_smooth)`.

    Written sgn below. An explicit integrator cannot follow the jump of the exact sign function.
    """
    return torch.tanh(qd / v_smooth)


def viscous(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Viscous friction `C_p qd` (NCFM; TLRIP paper, viscous model; RTIP paper, Table I)."""
    return coefficients.select(-1, 0) * qd


def coulomb(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Coulomb friction `F_c sgn(qd)` (CFM)."""
    return coefficients.select(-1, 0) * smooth_sign(qd, v_smooth)


def coulomb_viscous(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Coulomb plus viscous friction `F_c sgn(qd) + F_v qd` (CVFM)."""
    f_c, f_v = coefficients.unbind(-1)
    return f_c * smooth_sign(qd, v_smooth) + f_v * qd


def linear(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Viscous plus load-dependent Coulomb friction `B qd + C load sgn(qd)` (LFM).

    TLRIP paper, eqs. (26)-(29), with the load taken as |N|/(m g) so that C is a torque.
    """
    b, c = coefficients.unbind(-1)
    return b * qd + c * load * smooth_sign(qd, v_smooth)


def nonlinear(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Offset, Coulomb, viscous and arctangent friction (NLFM; RTIP paper, Table III).

    `f_o + f_c sgn(qd) + f_v qd + f_a arctan(f_b qd)`; passive where `f_o = 0`.
    """
    f_o, f_c, f_v, f_a, f_b = coefficients.unbind(-1)
    return f_o + f_c * smooth_sign(qd, v_smooth) + f_v * qd + f_a * torch.atan(f_b * qd)


def stribeck(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Generalised Stribeck friction: `(F_c + F_d exp(-|qd/v_s|^delta)) sgn(qd) + F_v qd`.

    `F_d = F_s - F_c` is the excess of breakaway over Coulomb friction, so positive coefficients
    make the law passive (eq. (8) of Armstrong-Helouvry et al.).
    """
    f_c, f_d, f_v, v_s, delta = coefficients.unbind(-1)
    # A millionth of v_s is added in quadrature, so that the slope of the power is finite at qd = 0
    # for every delta. The power is limited to e^7, where the exponential underflows; otherwise 0
    # times its infinite slope would be NaN.
    log_ratio = 0.5 * torch.log((qd / v_s).square() + 1e-12)
    drop = torch.exp(-torch.exp((delta * log_ratio).clamp(max=7.0)))
    return (f_c + f_d * drop) * smooth_sign(qd, v_smooth) + f_v * qd


VISCOUS = Law("viscous", (Coefficient("C_p", "N m s/rad"),), viscous)

COULOMB = Law("coulomb", (Coefficient("F_c", "N m"),), coulomb)

COULOMB_VISCOUS = Law(
    "coulomb_viscous", (Coefficient("F_c", "N m"), Coefficient("F_v", "N m s/rad")), coulomb_viscous
)

LINEAR = Law("linear", (Coefficient("B", "N m s/rad"), Coefficient("C", "N m")), linear)

NONLINEAR = Law(
    "nonlinear",
    (
        # Most joints have hardly any offset, but sparse data may suggest one.
        Coefficient("f_o", "N m", positive=False, prior_scale=0.03),
        Coefficient("f_c", "N m"),
        Coefficient("f_v", "N m s/rad"),
        Coefficient("f_a", "N m"),
        # The reciprocal of the velocity at which the arctangent reaches half of its limit: 0.1 to
        # 10 rad/s, the range in which joints move.
        Coefficient("f_b", "s/rad", linear=False, initial_grid=(0.1, 0.3, 1.0, 3.0, 10.0)),
    ),
    nonlinear,
    nested_law=COULOMB_VISCOUS,
    nested_coefficients=("f_c", "f_v"),
)

STRIBECK = Law(
    "stribeck",
    (
        Coefficient("F_c", "N m"),
        # A peak at rest that is narrower than the smoothed sign is hardly visible in the data.
        Coefficient("F_d", "N m", prior_scale=1.0),
        Coefficient("F_v", "N m s/rad"),
        Coefficient("v_s", "rad/s", linear=False, initial_grid=(0.03, 0.1, 0.3, 1.0, 3.0)),
        Coefficient("delta", "-", linear=False, initial_grid=(2.0,), fitted=False),
    ),
    stribeck,
    nested_law=COULOMB_VISCOUS,
    nested_coefficients=("F_c", "F_v"),
)
