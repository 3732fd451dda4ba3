"""Mechanics of the twins in plain floats: three hinged links, their friction, an integrator.

Deliberately independent of `nfriction.plant` and `nfriction.simulation`, so that an error in these
cannot hide in the recordings that test them; they share only the numbers of the rig. Angles are
absolute, from upright, inside this file; its interface uses joint angles.

Friction is a law that none of the models can express exactly:

    tau_f = S(v) (F_c + r_mu |R|) (1 + d s) s + w(t) B v (1 + (v / v_t)^2)^((n - 1) / 2)
    s = tanh(v / v_smooth),  S(v) = 1 + k exp(-(v / v_s)^2),  w(t) = 1 - p (1 - exp(-t / T))

A lip seal drags with F_c at any load; a bearing with its friction coefficient times its radius,
r_mu, times the force |R| that it carries. Both drag 1 + k times as much at rest, before a film of
lubricant builds up over the Stribeck velocity v_s, and differ with direction (d). Grease resists
with B v and thins with the shear rate (Carreau's law, exponent n) and as it warms.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nfriction.plant import PendulumChain

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Progress = Callable[[float], object]


@dataclass(frozen=True)
class Links:
    """Constants of three links on a fixed pivot.

    Numbered as in the paper, couplings in kg m^2.
    """

    mass: Vector  # of each link [kg]
    com: Vector  # distance to its mass centre [m]
    length: Vector  # distance to the next joint [m]
    coupling: tuple[float, float, float, float, float, float]  # a22, a33, a44, a23, a24, a34
    gravity: float  # [m/s^2]
    moment: Vector  # g b_i [N m]

    @classmethod
    def of(cls, plant: PendulumChain) -> Links:
        """The constants of a rig with three links and a fixed arm."""
        rig = plant.to_dict()
        # Rejected rather than ignored: the recordings would not match the rig that is written.
        if plant.joints != 3 or rig.get("arm") or rig.get("buffers") or rig.get("armature"):
            raise ValueError("a twin has three links on a fixed pivot, without drag or rotors.")
        (m2, m3, m4), (l2, l3, l4), (length2, length3, _) = rig["mass"], rig["com"], rig["length"]
        i2, i3, i4 = rig.get("inertia") or (0.0, 0.0, 0.0)
        b2, b3, b4 = m2 * l2 + (m3 + m4) * length2, m3 * l3 + m4 * length3, m4 * l4
        coupling = (
            m2 * l2**2 + (m3 + m4) * length2**2 + i2,
            m3 * l3**2 + m4 * length3**2 + i3,
            m4 * l4**2 + i4,
            length2 * b3,
            length2 * b4,
            length3 * b4,
        )
        g = rig["gravity"]
        return cls(
            mass=(m2, m3, m4),
            com=(l2, l3, l4),
            length=tuple(rig["length"]),
            coupling=coupling,
            gravity=g,
            moment=(g * b2, g * b3, g * b4),
        )


@dataclass(frozen=True)
class HiddenFriction:
    """Parameters of the true friction, one value per joint where the joints differ."""

    seal: Vector  # F_c, dry drag of the seal [N m]
    bearing_arm: Vector  # r_mu, coefficient of friction times radius [m]
    stribeck_rise: Vector  # k, ratio of dry friction at standstill to that in motion, minus one [-]
    stribeck_velocity: Vector  # v_s [rad/s]
    asymmetry: Vector  # d, dry friction is (1 + d) times as much for positive velocities [-]
    viscous: Vector  # B of cold, unsheared grease [N m s/rad]
    shear_velocity: Vector  # v_t, above which the grease thins [rad/s]
    shear_exponent: float = 0.7  # n, 1 for a Newtonian fluid [-]
    warming: float = 0.175  # p, long-term relative loss of the grease's viscosity [-]
    warming_time: float = 20.0  # T [s]
    v_smooth: float = 3e-3  # velocity over which the sign changes, for the integrator [rad/s]

    def viscosity(self, time: float) -> float:
        """Viscosity of the grease relative to its initial value, w(t) [-]."""
        return 1.0 - self.warming * (1.0 - math.exp(-time / self.warming_time))

    def joint(self, index: int) -> Callable[[float, float, float], float]:
        """Friction torque of one joint: (v [rad/s], |R| [N], viscosity [-]) -> tau_f [N m]."""
        # Plain local floats: the integrator calls this about a million times.
        seal, arm = self.seal[index], self.bearing_arm[index]
        rise, v_s = self.stribeck_rise[index], self.stribeck_velocity[index]
        asymmetry, v_smooth = self.asymmetry[index], self.v_smooth
        viscous, v_t = self.viscous[index], self.shear_velocity[index]
        # The square root in Carreau's law, merged with its exponent.
        power = 0.5 * (self.shear_exponent - 1.0)
        tanh, exp = math.tanh, math.exp

        def torque(v: float, reaction: float, viscosity: float) -> float:
            sign = tanh(v / v_smooth)
            slow, fast = v / v_s, v / v_t
            dry = (1.0 + rise * exp(-slow * slow)) * (seal + arm * reaction)
            grease = viscosity * viscous * v * (1.0 + fast * fast) ** power
            # Asymmetry multiplies the smooth sign, so that friction vanishes at rest.
            return dry * (1.0 + asymmetry * sign) * sign + grease

        return torque


@dataclass(frozen=True, eq=False)
class TrueMotion:
    """The true motion in joint coordinates, each (sample, joint)."""

    q: Array  # [rad]
    qd: Array  # [rad/s]
    qdd: Array  # [rad/s^2]
    tau_f: Array  # of friction, on the left of M(q) qdd + bias + tau_f = 0 [N m]


_State = tuple[float, float, float, float, float, float]
# (time, absolute angles and velocities) -> absolute accelerations, joint friction torques
_Rates = Callable[[float, _State], tuple[Vector, Vector]]


def rates_of(links: Links, friction: HiddenFriction | None) -> _Rates:
    """Absolute accelerations and joint friction torques as a function of time and state."""
    a22, a33, a44, a23, a24, a34 = links.coupling
    g2, g3, g4 = links.moment
    sin, cos = math.sin, math.cos
    drag = None if friction is None else _drag(links, friction)

    def rates(time: float, state: _State) -> tuple[Vector, Vector]:
        p2, p3, p4, w2, w3, w4 = state
        s2, s3, s4, c2, c3, c4 = sin(p2), sin(p3), sin(p4), cos(p2), cos(p3), cos(p4)
        # M and the centrifugal terms, by the addition theorems.
        m23, k23 = a23 * (c2 * c3 + s2 * s3), a23 * (s2 * c3 - c2 * s3)
        m24, k24 = a24 * (c2 * c4 + s2 * s4), a24 * (s2 * c4 - c2 * s4)
        m34, k34 = a34 * (c3 * c4 + s3 * s4), a34 * (s3 * c4 - c3 * s4)
        # M = L D L^T, factored once for the motions with and without friction.
        l32, l42 = m23 / a22, m24 / a22
        d3, n34 = a33 - l32 * m23, m34 - l32 * m24
        l43 = n34 / d3
        d4 = a44 - l42 * m24 - l43 * n34

        f2 = g2 * s2 - k23 * w3 * w3 - k24 * w4 * w4
        f3 = g3 * s3 + k23 * w2 * w2 - k34 * w4 * w4 - l32 * f2
        f4 = g4 * s4 + k24 * w2 * w2 + k34 * w3 * w3 - l42 * f2 - l43 * f3
        x4 = f4 / d4
        x3 = f3 / d3 - l43 * x4
        x2 = f2 / a22 - l32 * x3 - l42 * x4
        if drag is None:
            return (x2, x3, x4), (0.0, 0.0, 0.0)

        torque = drag(time, (s2, s3, s4), (c2, c3, c4), (w2, w3, w4), (x2, x3, x4))
        t2, t3, t4 = torque
        # A joint torque acts on its link and, reversed, on the link before it.
        f2 = t3 - t2
        f3 = t4 - t3 - l32 * f2
        f4 = -t4 - l42 * f2 - l43 * f3
        y4 = f4 / d4
        y3 = f3 / d3 - l43 * y4
        y2 = f2 / a22 - l32 * y3 - l42 * y4
        return (x2 + y2, x3 + y3, x4 + y4), torque

    return rates


def _drag(links: Links, friction: HiddenFriction) -> Callable[..., Vector]:
    """Friction torques of the joints under the forces that their bearings carry.

    The forces are those of frictionless motion from the same state: friction torques of a few
    hundredths of a newton metre hardly change them, so no implicit equation has to be solved.
    """
    (m2, m3, m4), (l2, l3, l4), (length2, length3, _) = links.mass, links.com, links.length
    gravity = links.gravity
    joint2, joint3, joint4 = (friction.joint(index) for index in range(3))
    viscosity_at, sqrt = friction.viscosity, math.sqrt

    def drag(
        time: float, sines: Vector, cosines: Vector, rates: Vector, accelerations: Vector
    ) -> Vector:
        (s2, s3, s4), (c2, c3, c4) = sines, cosines
        (w2, w3, w4), (a2, a3, a4) = rates, accelerations
        # Acceleration minus gravity of the hinges and mass centres; x across, y up.
        x2, y2 = c2 * a2 - s2 * w2 * w2, -s2 * a2 - c2 * w2 * w2
        x3, y3 = c3 * a3 - s3 * w3 * w3, -s3 * a3 - c3 * w3 * w3
        x4, y4 = c4 * a4 - s4 * w4 * w4, -s4 * a4 - c4 * w4 * w4
        hinge3x, hinge3y = length2 * x2, length2 * y2 + gravity
        hinge4x, hinge4y = hinge3x + length3 * x3, hinge3y + length3 * y3
        r4x, r4y = m4 * (hinge4x + l4 * x4), m4 * (hinge4y + l4 * y4)
        r3x, r3y = r4x + m3 * (hinge3x + l3 * x3), r4y + m3 * (hinge3y + l3 * y3)
        r2x, r2y = r3x + m2 * l2 * x2, r3y + m2 * (l2 * y2 + gravity)
        # One temperature for all joints.
        viscosity = viscosity_at(time)
        return (
            joint2(w2, sqrt(r2x * r2x + r2y * r2y), viscosity),
            joint3(w3 - w2, sqrt(r3x * r3x + r3y * r3y), viscosity),
            joint4(w4 - w3, sqrt(r4x * r4x + r4y * r4y), viscosity),
        )

    return drag


def simulate(
    links: Links,
    friction: HiddenFriction | None,
    q0: Vector,
    qd0: Vector = (0.0, 0.0, 0.0),
    *,
    samples: int,
    rate: int = 1000,
    substeps: int = 2,
    advance: Progress | None = None,
) -> TrueMotion:
    """The motion from a release, by classical Runge-Kutta steps finer than the sampling.

    Args:
        friction: None for none.
        q0, qd0: joint angles and velocities at the release [rad, rad/s].
        samples: number of samples; the first is at the release.
        rate: samples per second [1/s].
        advance: called after every simulated second.
    """
    rates = rates_of(links, friction)
    step = 1.0 / (rate * substeps)
    # With absolute angles, entries of the mass matrix are constants times cosines of differences.
    state: _State = (*np.cumsum(q0).tolist(), *np.cumsum(qd0).tolist())
    rows = []
    for sample in range(samples):
        for substep in range(substeps):
            time = (sample * substeps + substep) * step
            acceleration, torque = rates(time, state)
            # The first stage of a step is at the sample itself, so its acceleration is exact there.
            if substep == 0:
                rows.append((*state, *acceleration, *torque))
            state = _runge_kutta(rates, time, state, acceleration, step)
        if advance is not None and (sample + 1) % rate == 0:
            advance(1.0)
    angles, speeds, accelerations, tau_f = np.split(np.array(rows), 4, axis=1)
    return TrueMotion(_joint(angles), _joint(speeds), _joint(accelerations), tau_f)


def _runge_kutta(rates: _Rates, time: float, state: _State, a: Vector, h: float) -> _State:
    """One classical step, given the accelerations `a` at its start."""
    # Written out: NumPy calls on arrays of three cost more than the arithmetic.
    p, q, r, u, v, w = state
    half, sixth = 0.5 * h, h / 6.0
    a1, b1, c1 = a
    u2, v2, w2 = u + half * a1, v + half * b1, w + half * c1
    (a2, b2, c2), _ = rates(time + half, (p + half * u, q + half * v, r + half * w, u2, v2, w2))
    u3, v3, w3 = u + half * a2, v + half * b2, w + half * c2
    (a3, b3, c3), _ = rates(time + half, (p + half * u2, q + half * v2, r + half * w2, u3, v3, w3))
    u4, v4, w4 = u + h * a3, v + h * b3, w + h * c3
    (a4, b4, c4), _ = rates(time + h, (p + h * u3, q + h * v3, r + h * w3, u4, v4, w4))
    return (
        p + sixth * (u + 2.0 * (u2 + u3) + u4),
        q + sixth * (v + 2.0 * (v2 + v3) + v4),
        r + sixth * (w + 2.0 * (w2 + w3) + w4),
        u + sixth * (a1 + 2.0 * (a2 + a3) + a4),
        v + sixth * (b1 + 2.0 * (b2 + b3) + b4),
        w + sixth * (c1 + 2.0 * (c2 + c3) + c4),
    )


def _joint(absolute: Array) -> Array:
    """Joint coordinates from absolute ones."""
    return np.diff(absolute, axis=1, prepend=0.0)
