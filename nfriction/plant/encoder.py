"""What an encoder that is not centred on its shaft reads, as a change of joint coordinates.

A disc that is off by e in the direction delta reads q + e sin(q + delta). Written relative to
hanging, `reading = q + c (cos u - 1) + s sin u` with u the reading from hanging, the error is zero
there, so that it does not mix with the encoder's zero. That u is of the reading and not of q
matters to second order in e only, and gives q in closed form.
"""

from typing import NamedTuple

from torch import Tensor


class Turned(NamedTuple):
    """The true angle of readings, and its first and second derivative by them, (*batch, joint)."""

    angle: Tensor
    slope: Tensor
    curvature: Tensor

    def acceleration(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """True acceleration of a reading's rate and acceleration."""
        return self.slope * qdd + self.curvature * qd * qd

    def reading(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """The reading's acceleration, of its rate and the true acceleration."""
        return (qdd - self.curvature * qd * qd) / self.slope


def true_angle(q: Tensor, zero: Tensor, cosine: Tensor, sine: Tensor) -> Turned:
    """True angles of readings of eccentric encoders.

    Args:
        q: readings [rad], (*batch, joint).
        zero: the cosine of each joint's coordinate where the mechanism hangs: -1 for a first link
            measured from upright, 1 for the others, (joint,).
        cosine, sine: c and s [rad], (joint,); the eccentricity is sqrt(c^2 + s^2).
    """
    cos, sin = zero * q.cos(), zero * q.sin()
    angle = q - cosine * (cos - 1) - sine * sin
    slope = 1 + cosine * sin - sine * cos
    return Turned(angle, slope, cosine * cos + sine * sin)
