"""Causal motion, as in a controller: period counting and a second-order low-pass filter."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfriction.signals.encoder import period_counting, quantise
from nfriction.signals.motion import Motion, check_motion

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SecondOrderLowPass:
    """Causal second-order low-pass filter, discretised by the bilinear transform.

    The natural frequency is prewarped, so the gain at `cutoff_hz` is exactly 1 / (2 damping) at
    any sample time; with the default damping (Butterworth) that is -3 dB.

    Args:
        cutoff_hz: natural frequency [Hz], below half the sampling frequency.
        sample_time: [s].
        damping: damping ratio [-].
    """

    cutoff_hz: float
    sample_time: float
    damping: float = math.sqrt(0.5)

    def __post_init__(self) -> None:
        if not (self.sample_time > 0 and self.damping > 0):
            raise ValueError(
                f"`sample_time` and `damping` must be positive, got {self.sample_time} "
                f"and {self.damping}."
            )
        if not 0 < self.cutoff_hz * self.sample_time < 0.5:
            raise ValueError(
                f"`cutoff_hz` must lie between 0 and half the sampling frequency "
                f"({0.5 / self.sample_time:g} Hz), got {self.cutoff_hz}."
            )

    @property
    def coefficients(self) -> tuple[Array, Array]:
        """Numerator and denominator in powers of z⁻¹, the denominator starting with 1."""
        warped = math.tan(math.pi * self.cutoff_hz * self.sample_time)
        a0 = 1 + 2 * self.damping * warped + warped**2
        b0 = warped**2 / a0
        a1 = 2 * (warped**2 - 1) / a0
        a2 = (1 - 2 * self.damping * warped + warped**2) / a0
        return np.array([b0, 2 * b0, b0]), np.array([1.0, a1, a2])

    def init(self, value: ArrayLike) -> Array:
        """State (2, *value) of a filter at rest at `value`."""
        b, a = self.coefficients
        value = np.asarray(value, dtype=np.float64)
        return np.stack([(1 - b[0]) * value, (b[2] - a[2]) * value])

    def step(self, state: Array, value: ArrayLike) -> tuple[Array, Array]:
        """Next state and output for one sample."""
        b, a = self.coefficients
        value = np.asarray(value, dtype=np.float64)
        output = b[0] * value + state[0]
        following = np.stack(
            [b[1] * value - a[1] * output + state[1], b[2] * value - a[2] * output]
        )
        return following, output

    def __call__(self, values: ArrayLike, state: Array | None = None) -> Array:
        """Filter a whole array (time, ...), at rest at its first sample unless `state` is given."""
        values = np.asarray(values, dtype=np.float64)
        state = self.init(values[0]) if state is None else state
        from scipy.signal import lfilter  # slow to import

        filtered, _ = lfilter(*self.coefficients, values, axis=0, zi=state)
        return np.asarray(filtered)


def causal_motion(
    time: ArrayLike,
    q: ArrayLike,
    counts_per_revolution: float,
    cutoff_hz: float = 20.0,
    *,
    offset: float = 0.0,
    damping: float = math.sqrt(0.5),
) -> Motion:
    """Motion from past and present samples alone, as in a controller.

    Velocity is period counting through the low-pass filter; acceleration is the difference of
    that velocity through the same filter again. The filter runs at the median step even if the
    stamps jitter, as a controller's does.

    Args:
        time: [s], shape (time,).
        q: position [rad], shape (time, joint).
        counts_per_revolution: counts after quadrature.
        cutoff_hz: cut-off of both filters [Hz].
        offset: position of one count's centre [rad].
        damping: damping ratio of the filters [-].
    Returns:
        The quantised position with velocity and acceleration.
    References:
        TLRIP paper: frequency counting, then a second-order IIR filter; `frequency_counting` is
            coarse at low speed, so edges are timed here.
    """
    time, q = check_motion(time, q)
    low_pass = SecondOrderLowPass(cutoff_hz, float(np.median(np.diff(time))), damping)
    qd = low_pass(period_counting(time, q, counts_per_revolution, offset=offset))
    # A difference needs a past sample; the first has none.
    rate = np.zeros_like(qd)
    rate[1:] = np.diff(qd, axis=0) / np.diff(time)[:, None]
    measured = quantise(q, counts_per_revolution, offset=offset)
    return Motion(time, measured, qd, low_pass(rate))
