"""Smoothed motion: Rauch-Tung-Striebel smoother of a joint whose jerk is integrated white noise.

Noise and bandwidth are estimated by maximum likelihood from the innovations of its Kalman filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from nfriction.recording import Array, is_uniform


@dataclass(frozen=True, eq=False, repr=False)
class Motion:
    """Position, velocity and acceleration of every joint over time.

    Args:
        time: [s], shape (time,).
        q: position [rad], shape (time, joint).
        qd: velocity [rad/s], shape like `q`.
        qdd: acceleration [rad/s²], shape like `q`.
        std: standard deviations of `q`, `qd` and `qdd` if the method provides them.
    """

    time: Array
    q: Array
    qd: Array
    qdd: Array
    std: Motion | None = None

    def __repr__(self) -> str:
        known = "" if self.std is None else ", with std"
        duration = self.time[-1] - self.time[0]
        samples, joints = self.q.shape
        return f"Motion(joints={joints}, samples={samples}, duration={duration:.6g} s{known})"


def check_motion(time: ArrayLike, q: ArrayLike) -> tuple[Array, Array]:
    """Time (time,) and positions (time, joint) as float64, checked."""
    time, q = np.asarray(time, dtype=np.float64), np.asarray(q, dtype=np.float64)
    if q.ndim != 2 or time.shape != q.shape[:1]:
        raise ValueError(
            f"`time` must be (time,) and `q` (time, joint), got {time.shape} and {q.shape}; "
            f"a single joint is `q[:, None]`."
        )
    if len(time) < 8:
        raise ValueError(f"at least 8 samples are needed, got {len(time)}.")
    if not (np.isfinite(q).all() and np.isfinite(time).all() and np.all(np.diff(time) > 0)):
        raise ValueError(
            "`time` and `q` must be finite and `time` increasing; `Recording` shows where not."
        )
    return time, q


# State: position, velocity, acceleration, jerk.
ORDER = 4
# Time constants after which a state carries no information about the next. Longer gaps between
# samples count as this long, because their powers would leave nothing but round-off.
FARTHEST = 1000.0
# Candidate bandwidths times the step.
BANDWIDTHS = np.geomspace(2e-3, 2.0, 19)
_FACTORIAL = np.array([math.factorial(k) for k in range(ORDER)])


def kalman_smoother(
    time: ArrayLike,
    q: ArrayLike,
    noise: ArrayLike | None = None,
    jerk_density: ArrayLike | None = None,
) -> Motion:
    """Motion from a Rauch-Tung-Striebel smoother with a constant-jerk model (non-causal).

    The jerk's rate is white noise, and so is the error of the positions. Parameters that are not
    given are estimated joint by joint: the ratio of the two noises by maximum likelihood, and with
    it the measurement noise, at least the quantisation error quantum/√12 of the encoder. Irregular
    time stamps are used exactly.

    Args:
        time: [s], shape (time,).
        q: position [rad], shape (time, joint).
        noise: standard deviation of the measured position [rad], a number or (joint,).
        jerk_density: spectral density of the jerk's rate [rad²/s⁷], a number or (joint,).
    Returns:
        Smoothed motion; `std` has the standard deviations under the model.
    References:
        Rauch, Tung, Striebel, AIAA Journal 3 (1965) 1445; Bar-Shalom, Li, Kirubarajan, Estimation
        with Applications to Tracking and Navigation (2001), ch. 6 (kinematic models driven by
        white noise).
    """
    time, q = check_motion(time, q)
    step = float(np.median(np.diff(time)))
    # Steps that differ only by rounding are taken as equal, because steady gains are fast.
    steps = np.full(len(time) - 1, step) if is_uniform(time) else np.diff(time)
    joints = q.shape[1]
    sigma = None if noise is None else _per_joint(noise, joints, "noise")
    density = None if jerk_density is None else _per_joint(jerk_density, joints, "jerk_density")
    # Far from zero, digits of the position would be lost in the smoother's products.
    centred = q - q[0]
    if sigma is None or density is None:
        sigma, bandwidth = _most_likely(steps, centred, sigma, density)
    if density is not None:
        bandwidth = (density / (sigma**2 * step)) ** (1 / (2 * ORDER))
    # In units of 1/bandwidth and sigma every joint has the same well-scaled problem.
    mean, variance = _smooth(steps[:, None] * bandwidth, bandwidth * step, centred / sigma)
    powers = bandwidth[:, None] ** np.arange(ORDER)
    mean = mean * sigma[:, None] * powers
    std = np.sqrt(variance) * sigma[:, None] * powers
    spread = Motion(time, std[..., 0], std[..., 1], std[..., 2])
    return Motion(time, mean[..., 0] + q[0], mean[..., 1], mean[..., 2], spread)


def _smooth(delta: Array, process: Array, y: Array) -> tuple[Array, Array]:
    """Means and variances (time, joint, order) of the smoothed state, in units of the noise.

    Steps `delta` (time - 1, joint) are times the bandwidth, `process` (joint,) is the density of
    the driving noise in those units.
    """
    transition, diffusion = _model(delta, process)
    spans = np.concatenate([np.zeros((1, delta.shape[1])), np.cumsum(delta, axis=0)])
    series = y[..., None]
    mean, covariance = _initial(spans, series)
    predicted, filtered, settled = _covariances(transition, diffusion, covariance)
    means = _filter(transition, predicted, mean, series)
    # Smoother gain C = P F^T (F P F^T + Q)^-1, from its transpose: the predictions are symmetric.
    gain = np.linalg.solve(predicted[1:], transition @ filtered[:-1]).swapaxes(-1, -2)
    means[:-1] -= gain @ (transition @ means[:-1])
    for k in range(len(y) - 2, -1, -1):
        means[k] += gain[k] @ means[k + 1]
    # A sum of squares, because a difference of covariances could become negative after a long gap.
    keep = np.eye(ORDER) - gain @ transition
    filtered[:-1] = keep @ filtered[:-1] @ keep.swapaxes(-1, -2)
    filtered[:-1] += gain @ diffusion @ gain.swapaxes(-1, -2)
    k = len(y) - 2
    while k >= 0:
        filtered[k] += gain[k] @ filtered[k + 1] @ gain[k].swapaxes(-1, -2)
        # Far from both ends the covariance of a uniform record is constant.
        if k > settled and _settled(filtered[k], filtered[k + 1]):
            filtered[settled:k] = filtered[k]
            k = settled
        k -= 1
    # After a gap round-off may exceed a variance.
    return means[..., 0], np.maximum(np.diagonal(filtered, axis1=-2, axis2=-1), 0.0)


def _most_likely(
    steps: Array, q: Array, sigma: Array | None, density: Array | None
) -> tuple[Array, Array]:
    """Measurement noise and the smoother's bandwidth [1/s] of every joint by maximum likelihood.

    The bandwidth is (density / (sigma² step))^(1/8), the reciprocal of the smoother's memory. The
    search is on a grid, with up to eight parts of the record as independent series.
    """
    step = float(np.median(steps))
    # Parts of 1000 samples determine two noise parameters well; more only cost time.
    length = min(len(q), 1000)
    first = np.linspace(0, len(q) - length, min(8, len(q) // length)).astype(int)
    stretches = first + np.arange(length)[:, None]
    delta = steps[stretches[:-1], None] / step * BANDWIDTHS
    y = q[stretches]
    if np.all(delta == BANDWIDTHS):
        # With equal steps all parts share their covariances.
        delta, y = delta[:, :1], y.reshape(length, 1, -1)
    misfit, volume = _innovations(delta, y)
    misfit = misfit.reshape(len(BANDWIDTHS), -1, q.shape[1]).sum(axis=1)
    volume = volume * (len(first) / delta.shape[1])
    count = (length - 1) * len(first)
    # The smallest change of a position between two samples, at least round-off, is its resolution.
    change = np.abs(np.diff(q, axis=0))
    smallest = np.where(change > 0, change, np.inf).min(axis=0)
    rounding = np.finfo(np.float64).eps * np.maximum(np.abs(q).max(axis=0), 1.0)
    resolution = np.where(np.isfinite(smallest), np.maximum(smallest, rounding), rounding)
    floor = resolution**2 / 12
    if sigma is not None:
        variance = np.broadcast_to(sigma**2, misfit.shape)
    elif density is not None:
        variance = density * step ** (2 * ORDER - 1) / BANDWIDTHS[:, None] ** (2 * ORDER)
        variance = np.maximum(variance, floor)
    else:
        variance = np.maximum(misfit / count, floor)
    cost = count * np.log(variance) + volume[:, None] + misfit / variance
    best = _lowest(cost)
    rows = np.arange(len(BANDWIDTHS))
    bandwidth = np.exp(np.interp(best, rows, np.log(BANDWIDTHS))) / step
    log_variance = [
        np.interp(row, rows, column) for row, column in zip(best, np.log(variance).T, strict=True)
    ]
    return np.exp(0.5 * np.array(log_variance)), bandwidth


def _innovations(delta: Array, y: Array) -> tuple[Array, Array]:
    """Squared innovations over their variance (grid, joint), and the variances' logarithms (grid,).

    Steps are (time - 1, stretch, grid), positions `y` (time, stretch, joint) in units of their
    noise up to a factor.
    """
    transition, diffusion = _model(delta, np.median(delta, axis=(0, 1)))
    spans = np.concatenate([np.zeros((1, *delta.shape[1:])), np.cumsum(delta, axis=0)])
    series = np.broadcast_to(y[:, :, None], (*y.shape[:2], delta.shape[2], y.shape[2]))
    mean, covariance = _initial(spans, series)
    if np.all(delta == BANDWIDTHS):
        predicted = _of_equal_steps(len(y))
    else:
        predicted = _covariances(transition, diffusion, covariance)[0]
    means = _filter(transition, predicted, mean, series)
    ahead = (transition[..., :1, :] @ means[:-1])[..., 0, :]
    # At least that of the noise, even if round-off destroys the prediction's after a gap.
    variance = np.maximum(predicted[1:, ..., 0, 0], 0.0) + 1
    misfit = ((series[1:] - ahead) ** 2 / variance[..., None]).sum(axis=(0, 1))
    return misfit, np.log(variance).sum(axis=(0, 1))


@lru_cache(maxsize=4)
def _of_equal_steps(samples: int) -> Array:
    """Predicted covariances (time, 1, grid, order, order) of all records with equal steps."""
    delta = np.broadcast_to(BANDWIDTHS, (samples - 1, 1, len(BANDWIDTHS)))
    spans = np.cumsum(np.concatenate([np.zeros_like(delta[:1]), delta]), axis=0)
    _, first = _initial(spans, np.zeros((*spans.shape, 1)))
    return _covariances(*_model(delta, BANDWIDTHS), first)[0]


def _lowest(cost: Array) -> Array:
    """Fractional row of every column's minimum: the vertex of a parabola through three rows."""
    row = np.argmin(cost, axis=0)
    inner = np.clip(row, 1, len(cost) - 2)
    below, here, above = (cost[inner + k, np.arange(cost.shape[1])] for k in (-1, 0, 1))
    bend = below - 2 * here + above
    shift = 0.5 * (below - above) / np.where(bend > 0, bend, np.inf)
    return np.where(row == inner, inner + shift, row)


def _model(delta: Array, process: Array) -> tuple[Array, Array]:
    """Transition matrices and process noise of steps `delta`, each delta.shape + (order, order)."""
    if np.all(delta == delta[:1]) and len(delta) > 1:
        one = _model(delta[:1], process)
        shape = (*delta.shape, ORDER, ORDER)
        return np.broadcast_to(one[0], shape), np.broadcast_to(one[1], shape)
    # Powers of a long gap would swamp all other entries.
    delta = np.minimum(delta, FARTHEST)
    order = np.arange(ORDER)
    ahead = order - order[:, None]
    powers = delta[..., None, None] ** np.maximum(ahead, 0)
    transition = np.where(ahead >= 0, powers / _FACTORIAL[np.maximum(ahead, 0)], 0.0)
    last = ORDER - 1 - order
    exponent = last + last[:, None] + 1
    share = 1 / (_FACTORIAL[last] * _FACTORIAL[last][:, None] * exponent)
    diffusion = process[..., None, None] * share * delta[..., None, None] ** exponent
    return transition, diffusion


def _initial(spans: Array, y: Array) -> tuple[Array, Array]:
    """Prior mean (..., order, series) and covariance of the first state, from a cubic at the start.

    The covariance is a hundred times that of the fit: weak relative to the data, but well scaled.
    """
    mean = np.empty((*y.shape[1:-1], ORDER, y.shape[-1]))
    covariance = np.empty((*spans.shape[1:], ORDER, ORDER))
    for index in np.ndindex(*spans.shape[1:]):
        span = spans[(slice(None), *index)]
        # Within three time constants the model is close to a cubic.
        near = max(int(np.searchsorted(span, 3.0, side="right")), 2 * ORDER)
        # The error of a sample is its noise plus the motion's deviation from the cubic, which
        # dominates after a gap.
        weight = 1 / np.sqrt(1 + _model(span[:near], np.ones(1))[1][..., 0, 0])
        basis = span[:near, None] ** np.arange(ORDER) / _FACTORIAL
        inverse = np.linalg.pinv(basis * weight[:, None])
        mean[index] = inverse @ (y[(slice(near), *index)] * weight[:, None])
        covariance[index] = 100 * inverse @ inverse.T
    return mean, covariance


def _covariances(transition: Array, diffusion: Array, first: Array) -> tuple[Array, Array, int]:
    """Predicted and filtered covariances (time, ..., order, order) for unit measurement noise.

    The third value is the sample from which both are constant.
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
        if repeats and k and _settled(filtered[k], filtered[k - 1]):
            predicted[k:], filtered[k:] = predicted[k], filtered[k]
            return predicted, filtered, k
    return predicted, filtered, n


def _settled(new: Array, old: Array) -> bool:
    size = np.abs(old).max(axis=(-2, -1), keepdims=True)
    return bool((np.abs(new - old) <= 1e-9 * size).all())


def _gain(predicted: Array) -> Array:
    """Kalman gain (..., order, 1) of a position with unit noise."""
    return predicted[..., :1] / (predicted[..., :1, :1] + 1)


def _filter(transition: Array, predicted: Array, mean: Array, y: Array) -> Array:
    """Filtered means (time, ..., order, series) of positions `y` (time, ..., series)."""
    gain = _gain(predicted)
    keep = np.eye(ORDER) - gain * np.eye(ORDER)[0]
    carry = keep[1:] @ transition
    means = gain * y[..., None, :]
    means[0] += keep[0] @ mean
    for k in range(1, len(y)):
        means[k] += carry[k - 1] @ means[k - 1]
    return means


def _per_joint(value: ArrayLike, joints: int, name: str) -> Array:
    value = np.asarray(value, dtype=np.float64)
    if value.shape not in ((), (joints,)) or not np.all(value > 0):
        raise ValueError(f"`{name}` must be one positive number or {joints}, got {value}.")
    return np.broadcast_to(value, (joints,))
