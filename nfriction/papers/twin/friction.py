"""Friction of the twins: what the models have to learn and none of them is.

The formula and where it comes from:

    tau_f = S(v) (F_c + r_mu |R|) (1 + d s) s + w(t) B v (1 + (v / v_t)^2)^((n - 1) / 2)
    s = tanh(v / v_smooth),  S(v) = 1 + k exp(-(v / v_s)^2),  w(t) = 1 - p (1 - exp(-t / T))

A lip seal drags with F_c at any load; a bearing with its coefficient of friction times its radius,
r_mu, times the force |R| that it carries. Both drag k times more before a film of lubricant builds
up over the Stribeck velocity v_s, and a little more one way round than the other (d). Grease
resists with B v, thins with the rate of shear (Carreau's law, exponent n) and with its warming.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

Vector = tuple[float, float, float]
JointTorque = Callable[[float, float, float], float]


@dataclass(frozen=True)
class HiddenFriction:
    """Parameters of the truth, a value per joint where the joints differ.

    Attributes:
        seal: F_c, dry drag of the seal [N m].
        bearing_arm: r_mu, coefficient of friction times radius [m].
        stribeck_rise: k, dry friction at standstill over that in motion, less one [-].
        stribeck_velocity: v_s [rad/s].
        asymmetry: d, dry friction is (1 + d) times as much for positive velocities [-].
        viscous: B of cold, unsheared grease [N m s/rad].
        shear_velocity: v_t, above which the grease thins [rad/s].
        shear_exponent: n, 1 for a Newtonian fluid [-].
        warming: p, what the grease loses of its viscosity in the long run [-].
        warming_time: T [s].
        v_smooth: velocity over which the sign turns, for the integrator's sake [rad/s].
    """

    seal: Vector
    bearing_arm: Vector
    stribeck_rise: Vector
    stribeck_velocity: Vector
    asymmetry: Vector
    viscous: Vector
    shear_velocity: Vector
    shear_exponent: float = 0.7
    warming: float = 0.175
    warming_time: float = 20.0
    v_smooth: float = 3e-3

    def viscosity(self, time: float) -> float:
        """Viscosity of the grease over that at the start, w(t) [-]."""
        return 1.0 - self.warming * (1.0 - math.exp(-time / self.warming_time))

    def joint(self, index: int) -> JointTorque:
        """Friction torque of one joint: (v [rad/s], |R| [N], viscosity [-]) -> tau_f [N m]."""
        # Plain local floats: the integrator calls this some million times.
        seal, arm = self.seal[index], self.bearing_arm[index]
        rise, v_s = self.stribeck_rise[index], self.stribeck_velocity[index]
        asymmetry, v_smooth = self.asymmetry[index], self.v_smooth
        viscous, v_t = self.viscous[index], self.shear_velocity[index]
        power = 0.5 * (self.shear_exponent - 1.0)
        tanh, exp = math.tanh, math.exp

        def torque(v: float, reaction: float, viscosity: float) -> float:
            sign = tanh(v / v_smooth)
            slow, fast = v / v_s, v / v_t
            dry = (1.0 + rise * exp(-slow * slow)) * (seal + arm * reaction)
            grease = viscosity * viscous * v * (1.0 + fast * fast) ** power
            return dry * (1.0 + asymmetry * sign) * sign + grease

        return torque
