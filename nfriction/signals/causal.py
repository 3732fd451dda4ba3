"""Encoders and causal motion, as in a controller: counts, edges, and a low-pass filter."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from nfriction.signals.kalman import Array, Motion, check_motion

# Smallest share of one-count changes among all changes of a moving joint.
REPEATED = 0.01
# Positions written with few digits make the size of one count vary by this fraction.
ALIKE = 0.05
# Share of a joint's range: no encoder resolves as much, so smaller changes are round-off.
ROUNDING = 1e-9


def quantise(q: ArrayLike, counts_per_revolution: float) -> Array:
    """Position of an incremental encoder: the nearest of its evenly spaced counts.

    Args:
        q: position [rad], any shape.
        counts_per_revolution: counts after quadrature; an encoder of 2048 lines has 8192.
    Returns:
        Quantised position [rad], shape like `q`.
    """
    quantum = _quantum(counts_per_revolution)
    return np.asarray(quantum * np.rint(np.asarray(q, dtype=np.float64) / quantum))


def count_seen(q: ArrayLike) -> Array:
    """Estimate one count of each joint's encoder, (joint,), NaN if positions do not show it.

    It is the smallest change from one sample to the next if 1 % of the changes equal it: the
    smallest change of noise, or of numbers with many digits, hardly recurs. A joint that never
    stops changes by many counts at once, so for it the differences of changes are taken instead.
    Positions (..., time, joint) are as read from the encoder.
    """
    q = np.asarray(q, dtype=np.float64)
    found = np.full(q.shape[-1], np.nan)
    for joint in range(q.shape[-1]):
        least = ROUNDING * np.ptp(q[..., joint])
        for n in (1, 2):
            change = np.abs(np.diff(q[..., joint], n=n, axis=-1))
            moved = change[change > least]
            # A joint that never stops, or a smooth motion, changes by more than a count each time.
            if 0 < len(moved) < change.size:
                if np.mean(moved <= (1 + ALIKE) * moved.min()) >= REPEATED:
                    found[joint] = moved.min()
                break
    return found


def period_counting(time: ArrayLike, q: ArrayLike, counts_per_revolution: float) -> Array:
    """Causal velocity from the time between encoder edges, accurate at low speed.

    The velocity is the distance between the last two edges over the time between them. Without a
    further edge the joint cannot have moved by more than a count, so the speed falls as one count
    over the time since the last edge. An edge crossed back and forth counts as no distance. Before
    the second edge the velocity is zero.

    Args:
        time: sample times [s], shape (time,).
        q: position [rad], shape (time, joint); quantised here, which leaves counts as they are.
        counts_per_revolution: counts after quadrature.
    Returns:
        Velocity [rad/s], shape (time, joint).
    """
    time, q = check_motion(time, q)
    quantum = _quantum(counts_per_revolution)
    counts = np.rint(q / quantum)
    velocity = np.zeros_like(q)
    for joint in range(q.shape[1]):
        step = np.diff(counts[:, joint])
        edges = np.flatnonzero(step) + 1
        # One edge gives a position but no velocity.
        if len(edges) < 2:
            continue
        # An edge lies half a count before the new count, on the side it came from.
        place = counts[edges, joint] - 0.5 * np.sign(step[edges - 1])
        moment = time[edges]
        at_edge = quantum * np.diff(place) / np.diff(moment)
        # For every sample the number of the last edge, counted from the second one on.
        last = np.searchsorted(edges, np.arange(len(q)), side="right") - 2
        known = last >= 0
        v = at_edge[last[known]]
        # |v| · waited is the distance since the edge at that speed; beyond one count it is less.
        waited = time[known] - moment[last[known] + 1]
        way = np.abs(v) * waited
        velocity[known, joint] = v * quantum / np.maximum(way, quantum)
    return velocity


def _quantum(counts_per_revolution: float) -> float:
    if not 0 < counts_per_revolution < math.inf:
        raise ValueError(
            f"`counts_per_revolution` must be positive and finite, got {counts_per_revolution}; "
            f"an encoder of 2048 lines has 8192 counts after quadrature."
        )
    return 2 * math.pi / counts_per_revolution


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

    def __call__(self, values: ArrayLike) -> Array:
        """Filter an array (time, ...), at rest at its first sample."""
        from scipy.signal import lfilter  # slow to import

        values = np.asarray(values, dtype=np.float64)
        b, a = self.coefficients
        rest = np.stack([(1 - b[0]) * values[0], (b[2] - a[2]) * values[0]])
        filtered, _ = lfilter(b, a, values, axis=0, zi=rest)
        return np.asarray(filtered)


def causal_motion(
    time: ArrayLike, q: ArrayLike, counts_per_revolution: float, cutoff_hz: float = 20.0
) -> Motion:
    """Motion from past and present samples alone, as in a controller.

    Velocity is period counting through the low-pass filter; acceleration is the difference of
    that velocity through the same filter again. The filter uses the median step even if the time
    stamps jitter, as in a controller.

    Args:
        time: [s], shape (time,).
        q: position [rad], shape (time, joint).
        counts_per_revolution: counts after quadrature.
        cutoff_hz: cut-off of both filters [Hz].
    Returns:
        The quantised position with velocity and acceleration.
    References:
        TLRIP paper: frequency counting, then a second-order IIR filter; `period_counting` is
            coarse at low speed, so edges are timed here.
    """
    time, q = check_motion(time, q)
    low_pass = SecondOrderLowPass(cutoff_hz, float(np.median(np.diff(time))))
    qd = low_pass(period_counting(time, q, counts_per_revolution))
    # A difference needs a past sample; the first has none.
    rate = np.zeros_like(qd)
    rate[1:] = np.diff(qd, axis=0) / np.diff(time)[:, None]
    measured = quantise(q, counts_per_revolution)
    return Motion(time, measured, qd, low_pass(rate))


def frequency_counting(
    time: ArrayLike, q: ArrayLike, counts_per_revolution: float, *, interval: float = 0.01
) -> Array:
    """Causal velocity from the counts within a fixed interval, poor at low speed.

    Its resolution is one count over the interval, 0.08 rad/s for 8192 counts and 10 ms, at any
    speed, and it lags by half the interval; `period_counting` resolves low speeds.

    Args:
        time: sample times [s], shape (time,).
        q: position [rad], shape (time, joint); quantised here, which leaves counts as they are.
        counts_per_revolution: counts after quadrature.
        interval: over which counts are taken [s]; at the start, the time since the first sample.
    Returns:
        Velocity [rad/s], shape (time, joint); zero at the first sample.
    Raises:
        ValueError: if the interval is not positive.
    References:
        TLRIP paper, friction experiment (frequency counting, then a filter).
    """
    time, q = check_motion(time, q)
    if not interval > 0:
        raise ValueError(f"`interval` must be positive [s], got {interval}.")
    quantum = _quantum(counts_per_revolution)
    counts = np.rint(q / quantum)
    # Time stamps are rounded, but a sample exactly at the start of the interval must count.
    begins = time - (1.0 - 1e-6) * interval
    first = np.maximum(np.searchsorted(time, begins, side="right") - 1, 0)
    elapsed = np.maximum(time - time[first], np.finfo(np.float64).tiny)
    return quantum * (counts - counts[first]) / elapsed[:, None]
