"""Motion from local least-squares polynomials: Savitzky-Golay, and the state at a start."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfriction.recording import is_uniform
from nfriction.signals.motion import Motion, check_motion

Array = NDArray[np.float64]


def savitzky_golay(time: ArrayLike, q: ArrayLike, window_s: float = 0.06, order: int = 4) -> Motion:
    """Motion from a least-squares polynomial around every sample (non-causal).

    The window holds a fixed odd number of samples; at both ends it stays inside the record and the
    polynomial is read off its side. Irregular stamps get a polynomial of their own each, and none
    reaches over a gap longer than `window_s`: the two sides are separate records.

    Args:
        time: [s], shape (time,).
        q: position [rad], shape (time, joint).
        window_s: time from the window's first sample to its last [s].
        order: of the polynomial, at least 2.
    Returns:
        Smoothed position, velocity and acceleration.
    Raises:
        ValueError: arrays or settings that do not fit, or too few samples between two gaps.
    References:
        Savitzky and Golay, Analytical Chemistry 36 (1964) 1627.
    """
    time, q = check_motion(time, q)
    step = float(np.median(np.diff(time)))
    if order < 2:
        raise ValueError(f"`order` must be at least 2 to have an acceleration, got {order}.")
    if not 0 < window_s < math.inf:
        raise ValueError(f"`window_s` must be positive and finite, got {window_s}.")
    window = 2 * round(window_s / (2 * step)) + 1
    if not order < window <= len(time):
        raise ValueError(
            f"`window_s` of {window_s} s is {window} samples; it must be more than order = {order} "
            f"and at most the record's {len(time)}. Change `window_s`."
        )
    if is_uniform(time):
        from scipy.signal import savgol_filter  # slow to import

        q, qd, qdd = (
            savgol_filter(q, window, order, deriv=k, delta=step, axis=0, mode="interp")
            for k in range(3)
        )
        return Motion(time, q, qd, qdd)
    gaps = np.flatnonzero(np.diff(time) > window_s) + 1
    pieces = zip(np.split(time, gaps), np.split(q, gaps), strict=True)
    smoothed = np.concatenate([_smoothed(*piece, window, order) for piece in pieces], axis=1)
    return Motion(time, smoothed[0], smoothed[1], smoothed[2])


def _smoothed(time: Array, q: Array, window: int, order: int) -> Array:
    """Position, velocity and acceleration (3, time, joint) of samples without a gap."""
    window = min(window, len(time))
    if window <= order:
        raise ValueError(
            f"only {len(time)} samples lie between gaps at {time[0]:g} s, too few for a polynomial "
            f"of order {order}; drop them, or widen `window_s`."
        )
    first = np.clip(np.arange(len(time)) - window // 2, 0, len(time) - window)
    smoothed = np.empty((3, *q.shape))
    # In parts: each sample has a design matrix of its own, which add up to much memory.
    for part in np.array_split(np.arange(len(time)), math.ceil(len(time) / 4096)):
        samples = first[part, None] + np.arange(window)
        coefficients = local_polynomial(time[samples] - time[part, None], q[samples], order)
        smoothed[:, part] = coefficients[:, :3].swapaxes(0, 1)
    return smoothed


def initial_state(
    time: ArrayLike, q: ArrayLike, start: float | None = None, *, duration: float = 0.03
) -> tuple[Array, Array]:
    """Smoothed position and velocity at the start of a free run.

    A cubic is fitted to the samples of `duration` seconds around `start`; where the record begins
    later than half of that before `start`, to the first `duration` seconds instead. Samples from
    before `start` are worth having: at the very edge the velocity is several times less certain.

    Args:
        time: [s], shape (time,).
        q: position [rad], shape (time, joint).
        start: moment of the state [s]; the first sample by default.
        duration: length of the fit [s]; at least four samples are used.
    Returns:
        Position [rad] and velocity [rad/s], each (joint,).
    """
    time, q = check_motion(time, q)
    if not duration > 0:
        raise ValueError(f"`duration` must be positive, got {duration}.")
    start = float(time[0]) if start is None else start
    if not time[0] <= start <= time[-1]:
        raise ValueError(f"`start` must lie in {time[0]:g} … {time[-1]:g} s, got {start:g}.")
    slack = 1e-6 * (time[1] - time[0])
    begin = max(min(start - duration / 2, time[-1] - duration), time[0])
    first = int(np.searchsorted(time, begin - slack))
    stop = int(np.searchsorted(time, begin + duration + slack, side="right"))
    stop = min(max(stop, first + 4), len(time))
    # A cubic needs four samples.
    first = max(min(first, stop - 4), 0)
    coefficients = local_polynomial(time[None, first:stop] - start, q[None, first:stop], 3)
    return coefficients[0, 0], coefficients[0, 1]


def local_polynomial(span: Array, q: Array, order: int) -> Array:
    """Value and derivatives at span 0, (batch, order + 1, joint), of least-squares polynomials.

    Args:
        span: time from the moment asked for [s], (batch, sample).
        q: (batch, sample, joint).
    """
    # Powers of a span scaled to 1 keep the normal equations well conditioned.
    scale = np.abs(span).max(axis=1, keepdims=True)[..., None]
    powers = np.arange(order + 1)
    basis = (span[..., None] / scale) ** powers
    transposed = basis.swapaxes(-1, -2)
    coefficients = np.linalg.solve(transposed @ basis, transposed @ q)
    factorial = np.array([math.factorial(k) for k in powers])
    return np.asarray(coefficients * (factorial / scale**powers).swapaxes(-1, -2))
