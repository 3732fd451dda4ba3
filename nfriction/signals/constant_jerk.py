"""The Kalman filter of a joint whose jerk stays constant but for white noise on its rate."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# State of the model: position, velocity, acceleration, jerk.
ORDER = 4
# Time constants after which a state tells nothing of the next: a longer gap between samples counts
# as this long, for its own powers would leave nothing but rounding.
FARTHEST = 1000.0


def constant_jerk(delta: Array, process: Array) -> tuple[Array, Array]:
    """Transition matrices and process noise of steps `delta`, its shape + (order, order)."""
    if np.all(delta == delta[:1]) and len(delta) > 1:
        one = constant_jerk(delta[:1], process)
        shape = (*delta.shape, ORDER, ORDER)
        return np.broadcast_to(one[0], shape), np.broadcast_to(one[1], shape)
    delta = np.minimum(delta, FARTHEST)
    order = np.arange(ORDER)
    factorial = np.array([math.factorial(k) for k in range(ORDER)])
    ahead = order - order[:, None]
    powers = delta[..., None, None] ** np.maximum(ahead, 0)
    transition = np.where(ahead >= 0, powers / factorial[np.maximum(ahead, 0)], 0.0)
    last = ORDER - 1 - order
    exponent = last + last[:, None] + 1
    share = 1 / (factorial[last] * factorial[last][:, None] * exponent)
    diffusion = process[..., None, None] * share * delta[..., None, None] ** exponent
    return transition, diffusion


def priors(spans: Array, y: Array) -> tuple[Array, Array]:
    """Mean (..., order, series) and covariance of the first state, from a cubic through the start.

    The covariance is a hundredfold of the fit's own: weak beside the record, yet well scaled.

    Args:
        spans: time from the first sample times bandwidth, (time, ...).
        y: positions over their noise, (time, ..., series).
    """
    factorial = np.array([math.factorial(k) for k in range(ORDER)])
    mean = np.empty((*y.shape[1:-1], ORDER, y.shape[-1]))
    covariance = np.empty((*spans.shape[1:], ORDER, ORDER))
    for index in np.ndindex(*spans.shape[1:]):
        span = spans[(slice(None), *index)]
        # Within three time constants the model is close to a cubic.
        near = max(int(np.searchsorted(span, 3.0, side="right")), 2 * ORDER)
        # A sample errs by its noise and by how far the motion may have left the cubic since, which
        # is all that counts behind a gap.
        weight = 1 / np.sqrt(1 + constant_jerk(span[:near], np.ones(1))[1][..., 0, 0])
        basis = span[:near, None] ** np.arange(ORDER) / factorial
        inverse = np.linalg.pinv(basis * weight[:, None])
        mean[index] = inverse @ (y[(slice(near), *index)] * weight[:, None])
        covariance[index] = 100 * inverse @ inverse.T
    return mean, covariance


def covariances(transition: Array, diffusion: Array, first: Array) -> tuple[Array, Array, int]:
    """Covariances (time, ..., order, order) for unit measurement noise.

    Returns:
        Predicted and filtered covariances, and the sample from which both stay as they are.
    """
    n = len(transition) + 1
    predicted = np.empty((n, *first.shape))
    filtered = np.empty_like(predicted)
    repeats = np.all(transition[1:] == transition[:1])
    identity = np.eye(ORDER)
    predicted[0] = first
    for k in range(n):
        if k:
            before = transition[k - 1] @ filtered[k - 1] @ transition[k - 1].swapaxes(-1, -2)
            predicted[k] = before + diffusion[k - 1]
        gain = _gain(predicted[k])
        # Joseph's form keeps the covariance positive.
        keep = identity - gain * identity[0]
        filtered[k] = keep @ predicted[k] @ keep.swapaxes(-1, -2) + gain @ gain.swapaxes(-1, -2)
        if repeats and k and same(filtered[k], filtered[k - 1]):
            predicted[k:], filtered[k:] = predicted[k], filtered[k]
            return predicted, filtered, k
    return predicted, filtered, n


def same(new: Array, old: Array) -> bool:
    size = np.abs(old).max(axis=(-2, -1), keepdims=True)
    return bool((np.abs(new - old) <= 1e-9 * size).all())


def _gain(predicted: Array) -> Array:
    """Kalman gain (..., order, 1) of a position measured with unit noise."""
    return predicted[..., :1] / (predicted[..., :1, :1] + 1)


def filtered_means(transition: Array, predicted: Array, mean: Array, y: Array) -> Array:
    """Filtered means (time, ..., order, series) of positions `y` (time, ..., series)."""
    gain = _gain(predicted)
    keep = np.eye(ORDER) - gain * np.eye(ORDER)[0]
    carry = keep[1:] @ transition
    means = gain * y[..., None, :]
    means[0] += keep[0] @ mean
    for k in range(1, len(y)):
        means[k] += carry[k - 1] @ means[k - 1]
    return means
