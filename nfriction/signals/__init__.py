"""From encoder positions to motion: quantisation, causal velocity, smoothing, initial states.

Velocity and acceleration come causally (`causal_motion`), as in a controller, by period counting
and a second-order IIR filter, or for a fit from smoothers of the whole record (`savitzky_golay`,
`kalman_smoother`).

Arrays are (time, joint); time is (time,) in seconds; positions are in radians (or metres).
"""

from nfriction.signals.causal import SecondOrderLowPass, causal_motion
from nfriction.signals.encoder import count_seen, frequency_counting, period_counting, quantise
from nfriction.signals.kalman import kalman_smoother
from nfriction.signals.motion import Motion
from nfriction.signals.polynomial import initial_state, savitzky_golay

__all__ = [
    "Motion",
    "SecondOrderLowPass",
    "causal_motion",
    "count_seen",
    "frequency_counting",
    "initial_state",
    "kalman_smoother",
    "period_counting",
    "quantise",
    "savitzky_golay",
]
