"""From encoder positions to motion: quantisation, causal velocity, smoothing.

Velocity and acceleration are computed causally, as in a controller, by period counting and a
second-order IIR filter (`causal_motion`), or by smoothing the whole record (`kalman_smoother`).

Arrays are (time, joint); time is (time,) in seconds; positions are in radians (or metres).
"""

from nfriction.signals.causal import (
    SecondOrderLowPass,
    causal_motion,
    count_seen,
    frequency_counting,
    period_counting,
    quantise,
)
from nfriction.signals.kalman import Motion, kalman_smoother

__all__ = [
    "Motion",
    "SecondOrderLowPass",
    "causal_motion",
    "count_seen",
    "frequency_counting",
    "kalman_smoother",
    "period_counting",
    "quantise",
]
