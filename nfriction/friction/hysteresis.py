"""Friction with hysteresis for tables of torque: slip elements plus terms in the velocity.

The torque is

    tau_f = f_o + F_v qd + s (f_a tanh(qd / v_a) + F_d z_1 exp(-(qd / v_s)^2) + sum_k F_k z_k) + r,

with s = 1, or the load. Each element follows the displacement up to its width d_k and then slips,
z_k = clip(z_k + qd time_step / d_k, -1, 1). The excess friction after a long rest before the first
sample is the state r, zero unless an observer sets it; it fades over the path d_r travelled,
r exp(-|qd| time_step / d_r). The elements begin undeflected or, if an observer has no better
estimate, as after a displacement of p_0, with which the rows of the fit began.

The torque is linear in all forces, so that least squares estimates them for given widths. Without
elements it is a law of the velocity alone. No force is negative: each element stores and dissipates
energy, and over a closed path the offset does no work. Only the drop F_d may return energy, at most
that stored in the narrowest element.

`NFSlip` lets the torque follow further quantities recorded in a table,

    (1 + sum_i n_i(x_i)) tau_f + a(qd) cos(2 pi q / P) + b(qd) sin(2 pi q / P),

with x_i load, temperature, position q and direction, and the ripple of a motor or gear over the
position. n_i, a and b are fuzzy rules, zero if they do not improve hold-out blocks.

References:
    F. Al-Bender, V. Lampaert and J. Swevers, IEEE Trans. Automatic Control 50 (2005) 1883-1887
    (Maxwell-slip elements); the drop F_d of the first element is Stribeck's.
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial

import torch
from torch import Tensor, nn

from nfriction.friction.coefficients import SMALLEST, Constant
from nfriction.friction.laws import Coefficient, Law, Memory, smooth_sign
from nfriction.friction.memory import Duration
from nfriction.friction.models import ConstantModel, NamedModel
from nfriction.fuzzy import Anfis

ELEMENTS = 12
# Number of fuzzy sets of each input that friction may follow, and of the signed velocity that the
# amplitude of a ripple follows: as many as in other networks.
TERMS = {"load": 5, "temperature": 5, "position": 5, "direction": 2, "ripple": 9}
# Indices of the coefficients: first terms of the velocity, then forces and widths of the elements.
OFFSET, VISCOUS, SATURATING, TURN, DROP, STRIBECK, FADING, START, FIRST = range(9)


def advance_hysteresis(
    state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor, time_step: Duration
) -> Tensor:
    """Deflections over their widths, clipped where elements slip, and the excess of a rest."""
    count = state.shape[-1] - 1
    path = (qd * time_step).unsqueeze(-1)
    # Places are written out here and below, as TorchScript takes no global.
    width = coefficients[..., 8 + count : 8 + 2 * count]
    elements = (state[..., :count] + path / width).clamp(-1.0, 1.0)
    fading = coefficients[..., 6:7]
    excess = state[..., count:] * torch.exp(-path.abs() / fading)
    return torch.cat([elements, excess], -1)


def hysteresis_torque(state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
    """Torque of the elements and of the velocity, at any load."""
    return load_hysteresis_torque(state, qd, torch.ones_like(qd), coefficients)


def load_hysteresis_torque(state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
    """Torque of the elements and of the velocity, in proportion to the load."""
    count = state.shape[-1] - 1
    offset, viscous, saturating, turn, drop, stribeck = coefficients[..., :6].unbind(-1)
    fading = torch.exp(-(qd / stribeck).square())
    friction = (
        saturating * torch.tanh(qd / turn)
        + drop * fading * state.select(-1, 0)
        + (coefficients[..., 8 : 8 + count] * state[..., :count]).sum(-1)
    )
    return offset + viscous * qd + load * friction + state.select(-1, count)


def steady_hysteresis(
    qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float, *, loaded: bool, count: int
) -> Tensor:
    """Torque at a constant velocity, with all elements slipping."""
    sign = smooth_sign(qd, v_smooth).unsqueeze(-1)
    state = torch.cat([sign.expand(*qd.shape, count), torch.zeros_like(sign)], -1)
    torque = load_hysteresis_torque if loaded else hysteresis_torque
    return torque(state, qd, load, coefficients)


def hysteresis_law(name: str, *, loaded: bool, count: int = ELEMENTS) -> Law:
    """The law with so many elements, in proportion to the load or not."""
    velocities = (0.003, 0.01, 0.03, 0.1, 0.3)
    numbers = range(1, count + 1)
    unit = "-" if loaded else "N m"
    return Law(
        name,
        (
            Coefficient("f_o", "N m", positive=False),
            Coefficient("F_v", "N m s/rad"),
            Coefficient("f_a", unit),
            Coefficient("v_a", "rad/s", linear=False, initial_grid=velocities),
            Coefficient("F_d", unit),
            Coefficient("v_s", "rad/s", linear=False, initial_grid=velocities),
            Coefficient("d_r", "rad", linear=False, initial_grid=(1e-3,)),
            Coefficient("p_0", "rad", positive=False, linear=False, initial_grid=(0.0,)),
            *(Coefficient(f"F_{k}", unit) for k in numbers),
            *(
                Coefficient(f"d_{k}", "rad", linear=False, initial_grid=(10.0 ** (0.5 * k - 6),))
                for k in numbers
            ),
        ),
        partial(steady_hysteresis, loaded=loaded, count=count),
        # No partial, which TorchScript would not compile.
        memory=Memory(
            count + 1, advance_hysteresis, load_hysteresis_torque if loaded else hysteresis_torque
        ),
    )


def unused(values: Mapping[str, float]) -> set[str]:
    """Names of coefficients without effect: negligible forces, shapes of their terms, no rest."""
    shapes = {"f_a": "v_a", "F_d": "v_s"} | {f"F_{k}": f"d_{k}" for k in range(1, ELEMENTS + 1)}
    found = {force for force in shapes if values[force] < 2.0 * SMALLEST}
    # An excess that fades within a thousandth of the narrowest element does not count.
    at_once = values["d_r"] < 1e-3 * values["d_1"]
    return found | {shapes[force] for force in found} | ({"d_r"} if at_once else set())


SLIP = hysteresis_law("slip", loaded=False)
LOAD_SLIP = hysteresis_law("load_slip", loaded=True)


class Slip(ConstantModel):
    """Slip elements, viscous and saturating friction, a drop with speed, and an offset."""

    definition = SLIP


class LoadSlip(ConstantModel):
    """The same with all but the viscous friction and the offset in proportion to the load."""

    definition = LOAD_SLIP


class Recorded(Constant):
    """Constant coefficients, and fuzzy rules for quantities recorded in a table; see this module.

    Attributes:
        layers: rules of each input: relative change of the torque by its sets, or the ripple's
            cosine and sine [N m] by sets of the velocity.
        ranges: of each input, (joint, input, 2), beyond which its outermost set applies.
        period: of the ripple [rad; m], (joint,).
    """

    form = "recorded"
    ranges: Tensor
    period: Tensor

    def __init__(self, law: Law, joints: int, initial: Tensor | Sequence | None = None) -> None:
        super().__init__(law, joints, initial)
        made = {
            name: Anfis(joints, 1, (count,), 2 if name == "ripple" else 1, order=0)
            for name, count in TERMS.items()
        }
        for layer in made.values():
            layer.init_grid(0.0, 1.0)
        self.layers = nn.ModuleDict(made)
        one = torch.ones(joints, len(TERMS), dtype=torch.float64)
        self.register_buffer("ranges", torch.stack([-one, one], -1))
        self.register_buffer("period", one[:, 0].clone())

    def followed(self) -> tuple[str, ...]:
        """Inputs that the torque follows."""
        return tuple(name for name in TERMS if self.layer(name).consequents.any())

    def described(self, joint: int, unit: str = "") -> str:
        """Inputs that a joint's torque follows, with ranges and period; empty for none."""
        found = []
        for name, (low, high) in zip(TERMS, self.ranges[joint].tolist(), strict=True):
            if self.layer(name).consequents[joint].any():
                words = f"{name} from {low:.4g} to {high:.4g}"
                if name == "direction":
                    words = name
                elif name == "ripple":
                    words = f"ripple with a period of {float(self.period[joint]):.4g}"
                found.append(f"{words} {unit * (name in ('position', 'ripple'))}".rstrip())
        return ", ".join(found)

    def layer(self, name: str) -> Anfis:
        """Rules of an input."""
        found = self.layers[name]
        assert isinstance(found, Anfis)
        return found

    def within(self, name: str, x: Tensor) -> Tensor:
        """An input (row, joint) over its range, (row, joint, 1)."""
        low, high = self.ranges[:, list(TERMS).index(name)].unbind(-1)
        return ((x - low) / (high - low)).clamp(0.0, 1.0).unsqueeze(-1)

    def corrected(self, torque: Tensor, given: Mapping[str, Tensor]) -> Tensor:
        """Torque of the law corrected for the recorded inputs, (row, joint) [N m; N].

        Args:
            torque: of the law alone.
            given: inputs by name, and `"velocity"`, shaped like `torque`.

        Raises:
            ValueError: if an input that the torque follows is not given.
        """
        change, ripple = torch.ones_like(torque), torch.zeros_like(torque)
        for name in self.followed():
            own = "position" if name == "ripple" else name
            if own not in given:
                column = "q" if own == "position" else own
                raise ValueError(
                    f"this friction follows the {own}, and the table has no column {column}; add "
                    "one, or take slip."
                )
            if name == "ripple":
                a, b = self.layer(name)(self.within(name, given["velocity"])).unbind(-1)
                angle = 2.0 * math.pi * given[own] / self.period
                ripple = a * torch.cos(angle) + b * torch.sin(angle)
            else:
                change = change + self.layer(name)(self.within(name, given[own]))[..., 0]
        return change * torque + ripple


class NFSlip(NamedModel):
    """Slip elements whose friction follows recorded columns by fuzzy rules, for tables only."""

    definition = SLIP
    make_schedule = Recorded

    def check_loads(self, plant: object) -> None:
        """Refuse simulations and controllers, which have no such columns."""
        assert isinstance(self.schedule, Recorded)
        if followed := self.schedule.followed():
            raise ValueError(
                f"this friction follows {', '.join(followed)} as a table records them, which a "
                "simulation or a controller does not give; take slip."
            )
