"""Friction laws with memory: the torque depends on an internal state driven by the motion.

Below breakaway the contact of a joint yields like a spring: the torque follows the displacement
(*presliding*), with hysteresis, before it follows the velocity (*sliding*). A law with memory
therefore has a state z of each joint, deflections of bristles or of elements that slip, and two
functions in its `Memory`:

    advance(state, qd, load, coefficients, time_step) -> state
    torque(state, qd, load, coefficients) -> tau_f

of

    state         shape (*batch, joint, state)
    qd            joint velocity [rad/s], held over the sample, (*batch, joint)
    load          normal load over the load at rest [-], shaped like `qd`
    coefficients  (*batch, joint, coefficient), in the order of the law's description
    time_step     length of the sample [s], a number or shaped like `qd`
    tau_f         friction torque at the end of the sample [N m], (*batch, joint)

A sample is advanced first, then its torque is read; the initial state is zero, undeflected. The
update is the exact solution for a held velocity, so that it is stable at any stiffness and time
step, a joint at rest keeps its state (no drift), and splitting a sample in two changes nothing.

Every law here is passive, in continuous time and sampled: the work `tau_f qd time_step` is at least
the energy stored in the deflection, for all states, velocities, time steps and positive
coefficients. For bristles this requires a limit on damping: at most 2 g(v) / |v| with the steady
friction g(v). Constant damping injects energy if it exceeds `sigma_2 F_c / F_d` (Barahanov,
Ortega).

`Law.torque` of such a law is its steady torque, approached at a constant velocity.

References:
    P. R. Dahl, A solid friction model, Aerospace Corporation TOR-0158(3107-18)-1, 1968.
    C. Canudas de Wit, H. Olsson, K. J. Åström and P. Lischinsky, IEEE Trans. Automatic Control
    40 (1995) 419-425 (LuGre).
    N. Barahanov and R. Ortega, IEEE Trans. Automatic Control 45 (2000) 832-836 (passivity).
    P. Dupont, V. Hayward, B. Armstrong and F. Altpeter, IEEE Trans. Automatic Control 47 (2002)
    787-792 (elasto-plastic).
    F. Al-Bender, V. Lampaert and J. Swevers, IEEE Trans. Automatic Control 50 (2005) 1883-1887
    (generalised Maxwell-slip).
"""

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from nfriction.friction.laws import Coefficient, Law, Memory, smooth_sign
from nfriction.friction.models import V_SMOOTH, ConstantModel, FrictionModel, NamedModel
from nfriction.friction.neurofuzzy import NeuroFuzzy

# TorchScript has no arithmetic on unions: it compiles these functions for tensors.
if TYPE_CHECKING:
    Duration = float | Tensor
else:
    Duration = Tensor
# 1e-12 keeps 0/0 away where a coefficient is zero; written out, as TorchScript takes no global.


@torch.no_grad()
def states_along(
    memory: Memory, start: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor, step: Tensor
) -> Tensor:
    """States after every sample of a given motion, (sample, *batch, joint, state).

    Args:
        memory: of the law.
        start: state before the first sample, (*batch, joint, state).
        qd: velocity held over the sample [rad/s], (sample, joint) or with a batch.
        load: likewise [-].
        coefficients: held over the sample, (sample, *batch, joint, coefficient).
        step: lengths of the samples [s], (sample,) or of the joints of a batch.
    """
    state, states = start, []
    shape = start.shape[:-1]
    for v, s, c, h in zip(qd, load, coefficients, step, strict=True):
        state = memory.advance(state, v.expand(shape), s.expand(shape), c, h)
        states.append(state)
    return torch.stack(states)


def deflections(
    model: FrictionModel,
    time: Tensor,
    qd: Tensor,
    qdd: Tensor,
    load: Tensor,
    start: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """States of a law with memory along a motion, and its coefficients.

    `time` is (sample,), the motion (sample, joint), `start` the state before it, (joint, state), by
    default not deflected; the results are (sample, joint, any).
    """
    assert model.law.memory is not None
    held = model.coefficients(qd, qdd).expand(*qd.shape, -1)
    step = torch.diff(time, prepend=time[:1])
    start = model.law.initial_state(qd[0]) if start is None else start
    return states_along(model.law.memory, start, qd, load, held, step), held


def reference_coefficients(model: FrictionModel) -> Tensor:
    """Constants to which deflections refer: for a network those from which it deviates."""
    return [*model.schedule.coefficient_sets().values()][-1].clone()


def load_of(law: Law, plant: Any, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
    """Load that a law reads along a motion: that of a plant, or the drive's torque."""
    load: Tensor = tau if law.reads_drive else plant.load(q, qd)
    return load


def load_at_rest(law: Law, qd: Tensor) -> Tensor:
    """Load that a law reads at rest, shaped like `qd`: 1, or zero drive torque."""
    return torch.zeros_like(qd) if law.reads_drive else torch.ones_like(qd)


def slipping_state(memory: Memory, coefficients: Tensor) -> Tensor:
    """Largest state by magnitude, that of a contact that slips slowly, (*batch, joint, state)."""
    ahead = torch.ones_like(coefficients[..., 0])
    start = ahead.new_zeros((*ahead.shape, memory.size))
    # After a long path at a velocity below that of any Stribeck curve.
    return memory.advance(start, 1e-9 * ahead, ahead, coefficients, 1e15 * ahead).abs()


def holding_share(model: FrictionModel, torque: Tensor) -> tuple[Tensor, Tensor]:
    """Share of its largest torque with which friction holds a joint, and the state of the largest.

    Args:
        model: of a law with memory.
        torque: to be held [N m], (*batch, joint).

    Returns:
        The share in [-1, 1], shaped like `torque`, and the state of a contact that slips slowly,
        (joint, state).
    """
    assert model.law.memory is not None
    coefficients = reference_coefficients(model)
    still, unit = torch.zeros_like(coefficients[..., 0]), torch.ones_like(coefficients[..., 0])
    slipping = slipping_state(model.law.memory, coefficients)
    largest = model.law.memory.torque(slipping, still, unit, coefficients)
    return (torque / largest.clamp(min=1e-12)).clamp(-1.0, 1.0), slipping


def growth(x: Tensor) -> Tensor:
    """Share `(1 - exp(-x)) / x` of a held input that a decaying state retains, 1 at x = 0."""
    # The quotient cancels at small x, where four terms of its series are exact to rounding.
    series = 1.0 - x * (1 / 2 - x * (1 / 6 - x / 24))
    return torch.where(x < 1e-3, series, (1.0 - torch.exp(-x)) / x.clamp(min=1e-3))


def steady_friction(qd: Tensor, f_c: Tensor, f_d: Tensor, v_s: Tensor) -> Tensor:
    """Stribeck curve `g(v) = F_c + F_d exp(-(v/v_s)^2)` without sign and viscous part [N m]."""
    return (f_c + f_d * torch.exp(-(qd / v_s).square())).clamp(min=1e-12)


def bristle_torque(
    z: Tensor, slipping: Tensor, qd: Tensor, steady: Tensor, coefficients: Tensor
) -> Tensor:
    """Torque `sigma_0 z + sigma_1 dz/dt + sigma_2 qd` of a bristle, with its damping limited.

    Args:
        z: deflection [rad].
        slipping: share of the velocity at which the bristle slips, `1 - (dz/dt) / qd` [-]; above 1
            it relaxes.
        qd: velocity [rad/s].
        steady: the Stribeck curve there [N m].
        coefficients: sigma_0, sigma_1 and sigma_2 on the last axis.
    """
    stiffness, damping, viscous = coefficients.unbind(-1)
    # Damping may return at most the energy that slipping dissipates.
    most = 2.0 * steady / (qd.abs() * slipping.abs().clamp(min=1.0)).clamp(min=1e-12)
    return stiffness * z + torch.minimum(damping, most) * (1.0 - slipping) * qd + viscous * qd


# Dahl: dz/dt = qd - sigma_0 |qd| z / F_c.


def advance_dahl(
    state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor, time_step: Duration
) -> Tensor:
    """Deflection after a sample; exponential in the displacement."""
    f_c, _, stiffness = coefficients.unbind(-1)
    return _relaxed(state, qd, f_c.clamp(min=1e-12), stiffness, time_step)


def dahl_torque(state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
    """Torque `sigma_0 z + F_v qd`."""
    _, f_v, stiffness = coefficients.unbind(-1)
    return stiffness * state.select(-1, 0) + f_v * qd


def steady_dahl(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Steady torque of Dahl's law: Coulomb plus viscous friction."""
    f_c, f_v, _ = coefficients.unbind(-1)
    return f_c * smooth_sign(qd, v_smooth) + f_v * qd


# Gear loss: dz/dt = qd - sigma_0 |qd| z / g, with g = F_c + mu |load| of the transmitted torque, mu
# one where it drives the joint and another where the joint drives it back.


def advance_gear(
    state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor, time_step: Duration
) -> Tensor:
    """Deflection after a sample; exponential in the displacement."""
    return _relaxed(
        state, qd, gear_friction(qd, load, coefficients), coefficients.select(-1, 4), time_step
    )


def gear_torque(state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
    """Torque `sigma_0 z + F_v qd`."""
    return coefficients.select(-1, 4) * state.select(-1, 0) + coefficients.select(-1, 3) * qd


def steady_gear(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Steady torque `g sgn(qd) + F_v qd` of a gear under load."""
    viscous = coefficients.select(-1, 3) * qd
    return gear_friction(qd, load, coefficients) * smooth_sign(qd, v_smooth) + viscous


def gear_friction(qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
    """Friction of teeth that slide, `F_c + mu |load|` without sign [N m]."""
    f_c, driving, driven = coefficients[..., :3].unbind(-1)
    share = torch.where(load * qd > 0.0, driving, driven)
    return (f_c + share * load.abs()).clamp(min=1e-12)


# LuGre: dz/dt = qd - sigma_0 |qd| z / g(qd), tau_f = sigma_0 z + sigma_1 dz/dt + sigma_2 qd.


def advance_lugre(
    state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor, time_step: Duration
) -> Tensor:
    """Deflection after a sample; exponential in the displacement."""
    f_c, f_d, v_s, stiffness = coefficients[..., :4].unbind(-1)
    return _relaxed(state, qd, steady_friction(qd, f_c, f_d, v_s), stiffness, time_step)


def lugre_torque(state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
    """Torque `sigma_0 z + sigma_1 dz/dt + sigma_2 qd`."""
    f_c, f_d, v_s, stiffness = coefficients[..., :4].unbind(-1)
    z, steady = state.select(-1, 0), steady_friction(qd, f_c, f_d, v_s)
    slipping = stiffness * z * torch.sign(qd) / steady
    return bristle_torque(z, slipping, qd, steady, coefficients[..., 3:6])


def steady_lugre(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    """Steady torque `g(qd) sgn(qd) + sigma_2 qd` of bristles."""
    f_c, f_d, v_s = coefficients[..., :3].unbind(-1)
    viscous = coefficients.select(-1, 5) * qd
    return steady_friction(qd, f_c, f_d, v_s) * smooth_sign(qd, v_smooth) + viscous


def _relaxed(
    state: Tensor, qd: Tensor, steady: Tensor, stiffness: Tensor, time_step: Duration
) -> Tensor:
    """Solution of dz/dt = qd - stiffness |qd| z / steady after a time step, (..., 1)."""
    path = qd * time_step
    x = stiffness * path.abs() / steady
    return (state.select(-1, 0) * torch.exp(-x) + path * growth(x)).unsqueeze(-1)


# Elasto-plastic: dz/dt = qd (1 - alpha(z) z sgn(qd) / z_ss), with z_ss = g(qd) / sigma_0 and alpha
# rising from 0 at z_b = rho F_c / sigma_0 to 1 at z_ss. It rises linearly here, which makes the
# exact update a closed form; Dupont et al. let it rise as a sine.


def advance_elasto_plastic(
    state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor, time_step: Duration
) -> Tensor:
    """Deflection after a sample: elastic up to z_b, from there on logistic in the displacement."""
    elastic, settled = _elastic_range(qd, coefficients)
    path = qd.abs() * time_step
    direction = torch.sign(qd)
    # Along the motion; a deflection against it lies below the elastic limit.
    y = state.select(-1, 0) * direction
    stretch = torch.minimum((elastic - y).clamp(min=0.0), path)
    moved, path = y + stretch, path - stretch
    plastic = settled - elastic
    x = (settled + plastic) * path / (plastic * settled)
    kept = torch.exp(-x)
    lost = x * growth(x)
    # Sums of positive terms alone, which do not cancel; against the motion y is not used.
    y = moved.clamp(min=1e-12 * settled)
    slid = (settled * y + plastic * (y * kept + settled * lost)) / (
        y * lost + plastic + settled * kept
    )
    after = torch.where(path > 0.0, slid, moved) * direction
    return torch.where(qd == 0.0, state.select(-1, 0), after).unsqueeze(-1)


def elasto_plastic_torque(state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
    """Torque `sigma_0 z + sigma_1 dz/dt + sigma_2 qd`."""
    f_c, f_d, v_s = coefficients[..., :3].unbind(-1)
    elastic, settled = _elastic_range(qd, coefficients)
    z = state.select(-1, 0)
    y = z * torch.sign(qd)
    slipping = ((y - elastic) / (settled - elastic)).clamp(min=0.0) * y / settled
    steady = steady_friction(qd, f_c, f_d, v_s)
    return bristle_torque(z, slipping, qd, steady, coefficients[..., 3:6])


def _elastic_range(qd: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Deflections at which slipping begins, and at which the bristle has settled [rad]."""
    f_c, f_d, v_s, stiffness = coefficients[..., :4].unbind(-1)
    # Beyond 1 the bristle would never slip.
    share = coefficients.select(-1, 6).clamp(max=0.99)
    stiffness = stiffness.clamp(min=1e-12)
    settled = steady_friction(qd, f_c, f_d, v_s) / stiffness
    return share * f_c / stiffness, settled


# Maxwell-slip: elements in parallel, each a spring that slips at its own deflection d_i:
# z_i = clip(z_i + qd time_step, +-d_i s(qd)),  tau_f = sum_i k_i z_i + F_v qd.


def advance_slip(
    state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor, time_step: Duration
) -> Tensor:
    """Deflections after a sample: moved along, and clipped where elements slip."""
    count = state.shape[-1]
    limit = coefficients[..., count : 2 * count] * _weakening(qd, coefficients).unsqueeze(-1)
    moved = state + (qd * time_step).unsqueeze(-1)
    return torch.minimum(torch.maximum(moved, -limit), limit)


def slip_torque(state: Tensor, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
    """Torque `sum_i k_i z_i + F_v qd`."""
    count = state.shape[-1]
    spring = (coefficients[..., :count] * state).sum(-1)
    return spring + coefficients.select(-1, 2 * count) * qd


def steady_slip(
    qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float, *, count: int
) -> Tensor:
    """Steady torque of elements that all slip."""
    stiffness, limit = coefficients[..., :count], coefficients[..., count : 2 * count]
    force = (stiffness * limit).sum(-1) * _weakening(qd, coefficients)
    return force * smooth_sign(qd, v_smooth) + coefficients.select(-1, 2 * count) * qd


def _weakening(qd: Tensor, coefficients: Tensor) -> Tensor:
    """Limits of the deflections over those at high speed, `1 + rise exp(-(v/v_s)^2)` [-]."""
    rise, v_s = coefficients[..., -2:].unbind(-1)
    return 1.0 + rise * torch.exp(-(qd / v_s).square())


_F_C = Coefficient("F_c", "N m")
_F_D = Coefficient("F_d", "N m", prior_scale=1.0)
_V_S = Coefficient("v_s", "rad/s", linear=False, initial_grid=(0.003, 0.01, 0.03, 0.1, 0.3))
# From hobby servos to machine tools; a fit looks for its start relative to the data.
_STIFFNESS = Coefficient(
    "sigma_0", "N m/rad", linear=False, initial_grid=(0.3, 3e3, 3e7), stores=True
)
_DAMPING = Coefficient("sigma_1", "N m s/rad", linear=False, initial_grid=(1e-5, 0.1, 1e3))
_VISCOUS = Coefficient("sigma_2", "N m s/rad")

DAHL = Law(
    "dahl",
    (_F_C, Coefficient("F_v", "N m s/rad"), _STIFFNESS),
    steady_dahl,
    memory=Memory(1, advance_dahl, dahl_torque),
)

GEAR = Law(
    "gear",
    (
        _F_C,
        Coefficient("mu_d", "-"),
        Coefficient("mu_b", "-"),
        Coefficient("F_v", "N m s/rad"),
        _STIFFNESS,
    ),
    steady_gear,
    memory=Memory(1, advance_gear, gear_torque, transmitted=True),
)

LUGRE = Law(
    "lugre",
    (_F_C, _F_D, _V_S, _STIFFNESS, _DAMPING, _VISCOUS),
    steady_lugre,
    memory=Memory(1, advance_lugre, lugre_torque),
)

ELASTO_PLASTIC = Law(
    "elasto_plastic",
    (
        *(_F_C, _F_D, _V_S, _STIFFNESS, _DAMPING, _VISCOUS),
        # Share of the Coulomb friction below which the bristle does not slip at all.
        Coefficient("rho", "-", linear=False, initial_grid=(0.5,), fitted=False),
    ),
    steady_lugre,
    memory=Memory(1, advance_elasto_plastic, elasto_plastic_torque),
)


def maxwell_slip(elements: int) -> Law:
    """Generalised Maxwell-slip law with so many elements.

    Its coefficients are the stiffnesses k_i, in which the torque is linear, the deflections d_i at
    which elements slip at high speed, viscous friction F_v, the relative rise of the friction at
    rest over that at high speed, and the velocity v_s at which it fades. A fit seeks the scale of
    the deflections and keeps their ratios.

    Raises:
        ValueError: if `elements` is not a whole number from 1 to 100.
    """
    if not isinstance(elements, int) or not 1 <= elements <= 100:
        raise ValueError(f"`elements` must be a whole number from 1 to 100, got {elements!r}.")
    numbers = range(1, elements + 1)
    # Three decades of deflections, in which presliding of gears and guides lies.
    spread = [10.0 ** (-5 + 3 * (i - 0.5) / elements) for i in numbers]
    return Law(
        f"maxwell_slip_{elements}",
        (
            *(Coefficient(f"k_{i}", "N m/rad", stores=True) for i in numbers),
            *(
                Coefficient(f"d_{i}", "rad", linear=False, initial_grid=(d,), fitted=False)
                for i, d in zip(numbers, spread, strict=True)
            ),
            Coefficient("F_v", "N m s/rad"),
            Coefficient("rise", "-", linear=False, initial_grid=(1e-3, 0.1, 1.0)),
            _V_S,
        ),
        partial(steady_slip, count=elements),
        memory=Memory(elements, advance_slip, slip_torque),
    )


class Dahl(ConstantModel):
    """Dahl's law: hysteresis of a stiffness sigma_0 below the Coulomb friction F_c, and F_v."""

    definition = DAHL


class Gear(ConstantModel):
    """Gear loss with hysteresis, in proportion to the torque that the drive transmits.

    Constants: F_c; shares mu_d and mu_b of the transmitted torque that are lost where the drive
    moves the joint and where the joint moves the drive; F_v and the stiffness sigma_0.
    """

    definition = GEAR


class LuGre(ConstantModel):
    """LuGre bristles with constants F_c, F_d, v_s, sigma_0, sigma_1, sigma_2 a joint."""

    definition = LUGRE


class ElastoPlastic(ConstantModel):
    """LuGre bristles that do not drift at rest: elastic up to a share rho of F_c."""

    definition = ELASTO_PLASTIC


# With a network the stiffness stays constant, because energy stored at one stiffness would be
# returned at another. Dissipation may follow the motion, so that these are passive like their laws.


class NFDahl(NamedModel):
    """Dahl's law with neuro-fuzzy F_c and F_v, and a constant stiffness."""

    definition = DAHL
    make_schedule = NeuroFuzzy


class NFLuGre(NamedModel):
    """LuGre bristles of constant stiffness, with neuro-fuzzy friction and damping."""

    definition = LUGRE
    make_schedule = NeuroFuzzy


class NFElastoPlastic(NamedModel):
    """Bristles that do not drift at rest, with neuro-fuzzy friction and damping."""

    definition = ELASTO_PLASTIC
    make_schedule = NeuroFuzzy


class MaxwellSlip(ConstantModel):
    """Generalised Maxwell-slip law of elements in parallel, see `maxwell_slip`.

    Args:
        joints, initial, v_smooth: see `NamedModel`.
        elements: their number.
    """

    definition = maxwell_slip(5)

    def __init__(
        self,
        joints: int,
        initial: Tensor | Sequence | None = None,
        *,
        elements: int = 5,
        v_smooth: float = V_SMOOTH,
        **options: Any,
    ) -> None:
        # A law of this object's own, in place of the class's.
        self.definition = maxwell_slip(elements)
        super().__init__(joints, initial, v_smooth=v_smooth, **options)

    def options(self) -> dict[str, Any]:
        return {"elements": self.law.state_size}
