"""Friction laws: pure elementwise functions of velocity, load and coefficients.

A law maps joint velocity, normal load and a stack of coefficients (last axis) to the friction
torque on the left-hand side of `M(q) qdd + bias(q, qd) + tau_f = tau`. Every law here scripts,
exports and broadcasts; a user's own law is one such function wrapped in `Law`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

TorqueFunction = Callable[[Tensor, Tensor, Tensor, float], Tensor]


@dataclass(frozen=True)
class Coefficient:
    """One coefficient of a law, as the papers name it.

    Attributes:
        name: symbol, e.g. `"B"`.
        unit: SI unit for a revolute joint; for a sliding axis read N for N m and m for rad.
        positive: positive by physics, hence kept positive by construction.
        linear: the torque is linear in it, so least squares finds it directly.
        search: candidate values tried by the torque fit where the torque is not linear in it.
        fitted: estimated by default; otherwise kept at its initial value.
        share: how much of the joint's friction a fit expects of it, as the standard deviation of a
            prior around zero over the root mean square of the friction that the torques tell;
            infinite for no prior. For what most joints have little of, and short recordings seem
            to show.

    Raises:
        ValueError: if the torque is not linear in it and there is nothing to search, or a prior.
    """

    name: str
    unit: str
    positive: bool = True
    linear: bool = True
    search: tuple[float, ...] = ()
    fitted: bool = True
    share: float = math.inf

    def __post_init__(self) -> None:
        if not self.linear and not self.search:
            raise ValueError(
                f"coefficient {self.name!r} is not linear, so `search` needs values to try for it."
            )
        if not self.share > 0 or (self.share < math.inf and not self.linear):
            raise ValueError(
                f"`share` of {self.name!r} must be positive, and is for coefficients in which the "
                f"torque is linear; got {self.share}."
            )


@dataclass(frozen=True)
class Law:
    """A friction law: its torque function and what its coefficients are.

    Attributes:
        name: name of the law.
        coefficients: description of each entry of the coefficients' last axis, in order.
        torque: `(qd, load, coefficients, v_smooth) -> tau_f`, elementwise and scriptable.
        simpler: a law that this one contains: the same torque where all but the coefficients
            `shared` with it are zero, or shape what is zero then. For laws that are not linear
            and have several minima: a fit also starts from where the simpler one ended.
        shared: names here of the simpler law's coefficients, in its order.

    Raises:
        ValueError: if there is no coefficient, two bear the same name, or what is shared does not
            fit the simpler law.

    Examples:
        >>> def drag(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
        ...     return coefficients[..., 0] * qd * qd.abs()
        >>> DRAG = Law("drag", (Coefficient("D", "N m s^2/rad^2"),), drag)
    """

    name: str
    coefficients: tuple[Coefficient, ...]
    torque: TorqueFunction
    simpler: "Law | None" = None
    shared: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.names or len(set(self.names)) < len(self.names):
            raise ValueError(
                f"law {self.name!r} needs coefficients with names of their own, got {self.names}."
            )
        if not isinstance(self.simpler, Law | None):
            raise TypeError(f"`simpler` must be a Law, got {self.simpler!r}.")
        wanted = self.simpler.coefficients if self.simpler else ()
        own = {c.name: c for c in self.coefficients}
        once = len(set(self.shared)) == len(self.shared) == len(wanted)
        if not once or not set(self.shared) <= set(own):
            raise ValueError(
                f"law {self.name!r} must name its own {len(wanted)} of {self.names} that a simpler "
                f"law has, got `shared`={self.shared}."
            )
        for name, other in zip(self.shared, wanted, strict=True):
            if own[name].positive and not other.positive:
                raise ValueError(
                    f"{name!r} of law {self.name!r} is positive, {other.name!r} of the simpler one "
                    "may be negative; let both be the same."
                )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients, in order."""
        return tuple(c.name for c in self.coefficients)


def smooth_sign(qd: Tensor, v_smooth: float) -> Tensor:
    """Sign of the velocity with a linear passage through zero: `tanh(qd / v_smooth)`."""
    return torch.tanh(qd / v_smooth)


def viscous(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Viscous friction `C_p qd` (NCFM).

    Args:
        qd: joint velocity [rad/s], shape (*batch, joint).
        load: normal load over its value at rest [-]; not used by this law.
        coefficients: C_p [N m s/rad], shape (*batch, joint, 1).
        v_smooth: velocity over which the sign turns [rad/s]; not used by this law.

    Returns:
        Friction torque [N m], shape (*batch, joint).

    References:
        TLRIP paper, viscous model; second paper's NCFM (Table I).
    """
    return coefficients.select(-1, 0) * qd


def coulomb(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Coulomb friction `F_c sgn(qd)` (CFM).

    Args:
        qd: joint velocity [rad/s], shape (*batch, joint).
        load: normal load over its value at rest [-]; not used by this law.
        coefficients: F_c [N m], shape (*batch, joint, 1).
        v_smooth: velocity over which the sign turns [rad/s].

    Returns:
        Friction torque [N m], shape (*batch, joint).

    References:
        Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994), section 2.
    """
    return coefficients.select(-1, 0) * smooth_sign(qd, v_smooth)


def coulomb_viscous(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Coulomb plus viscous friction `F_c sgn(qd) + F_v qd` (CVFM).

    Args:
        qd: joint velocity [rad/s], shape (*batch, joint).
        load: normal load over its value at rest [-]; not used by this law.
        coefficients: F_c [N m] and F_v [N m s/rad], shape (*batch, joint, 2).
        v_smooth: velocity over which the sign turns [rad/s].

    Returns:
        Friction torque [N m], shape (*batch, joint).

    References:
        Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994), section 2.
    """
    f_c, f_v = coefficients.unbind(-1)
    return f_c * smooth_sign(qd, v_smooth) + f_v * qd


def linear(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Viscous plus load-dependent Coulomb friction `B qd + C load sgn(qd)` (LFM).

    Args:
        qd: joint velocity [rad/s], shape (*batch, joint).
        load: `|N| / (m g)` [-], shape like `qd`.
        coefficients: B [N m s/rad] and C [N m], shape (*batch, joint, 2).
        v_smooth: velocity over which the sign turns [rad/s].

    Returns:
        Friction torque [N m], shape (*batch, joint).

    References:
        TLRIP paper, eqs. (26)-(29), with the load taken as |N|/(m g) so that C is a torque.
    """
    b, c = coefficients.unbind(-1)
    return b * qd + c * load * smooth_sign(qd, v_smooth)


def nonlinear(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Offset, Coulomb, viscous and arctangent friction (NLFM).

    `f_o + f_c sgn(qd) + f_v qd + f_a arctan(f_b qd)`; passive where `f_o = 0`.

    Args:
        qd: joint velocity [rad/s], shape (*batch, joint).
        load: normal load over its value at rest [-]; not used by this law.
        coefficients: f_o [N m], f_c [N m], f_v [N m s/rad], f_a [N m], f_b [s/rad],
            shape (*batch, joint, 5).
        v_smooth: velocity over which the sign turns [rad/s].

    Returns:
        Friction torque [N m], shape (*batch, joint).

    References:
        Second paper's NLFM (Table III); TLRIP paper's NLFM.
    """
    f_o, f_c, f_v, f_a, f_b = coefficients.unbind(-1)
    return f_o + f_c * smooth_sign(qd, v_smooth) + f_v * qd + f_a * torch.atan(f_b * qd)


def stribeck(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Generalised Stribeck friction: `(F_c + F_d exp(-|qd/v_s|^delta)) sgn(qd) + F_v qd`.

    `F_d = F_s - F_c` is what breakaway adds to Coulomb friction, so positive coefficients make
    the law passive.

    Args:
        qd: joint velocity [rad/s], shape (*batch, joint).
        load: normal load over its value at rest [-]; not used by this law.
        coefficients: F_c [N m], F_d [N m], F_v [N m s/rad], v_s [rad/s], delta [-],
            shape (*batch, joint, 5).
        v_smooth: velocity over which the sign turns [rad/s].

    Returns:
        Friction torque [N m], shape (*batch, joint).

    References:
        Armstrong-Helouvry, Dupont and Canudas de Wit, Automatica 30 (1994), eq. (8).
    """
    f_c, f_d, f_v, v_s, delta = coefficients.unbind(-1)
    # A millionth of v_s is added in quadrature, so that the power's slope is finite at qd = 0 for
    # every delta. The power stops at e^7, where the exponential underflows: 0 times its infinite
    # slope would be NaN.
    log_ratio = 0.5 * torch.log((qd / v_s).square() + 1e-12)
    drop = torch.exp(-torch.exp((delta * log_ratio).clamp(max=7.0)))
    return (f_c + f_d * drop) * smooth_sign(qd, v_smooth) + f_v * qd


VISCOUS = Law("viscous", (Coefficient("C_p", "N m s/rad"),), viscous)

COULOMB = Law("coulomb", (Coefficient("F_c", "N m"),), coulomb)

COULOMB_VISCOUS = Law(
    "coulomb_viscous",
    (Coefficient("F_c", "N m"), Coefficient("F_v", "N m s/rad")),
    coulomb_viscous,
)

LINEAR = Law("linear", (Coefficient("B", "N m s/rad"), Coefficient("C", "N m")), linear)

NONLINEAR = Law(
    "nonlinear",
    (
        Coefficient("f_o", "N m", positive=False, share=0.03),
        Coefficient("f_c", "N m"),
        Coefficient("f_v", "N m s/rad"),
        Coefficient("f_a", "N m"),
        Coefficient("f_b", "s/rad", linear=False, search=(0.1, 0.3, 1.0, 3.0, 10.0)),
    ),
    nonlinear,
    simpler=COULOMB_VISCOUS,
    shared=("f_c", "f_v"),
)

STRIBECK = Law(
    "stribeck",
    (
        Coefficient("F_c", "N m"),
        # Of a spike at rest that is narrower than the sign's passage data tell next to nothing.
        Coefficient("F_d", "N m", share=1.0),
        Coefficient("F_v", "N m s/rad"),
        Coefficient("v_s", "rad/s", linear=False, search=(0.03, 0.1, 0.3, 1.0, 3.0)),
        Coefficient("delta", "-", linear=False, search=(2.0,), fitted=False),
    ),
    stribeck,
    simpler=COULOMB_VISCOUS,
    shared=("F_c", "F_v"),
)
