"""Motion from a Rauch-Tung-Striebel smoother."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nfriction.recording import is_uniform
from nfriction.signals.constant_jerk import (
    ORDER,
    constant_jerk,
    covariances,
    filtered_means,
    priors,
    same,
)
from nfriction.signals.likelihood import most_likely
from nfriction.signals.motion import Motion, checked

Array = NDArray[np.float64]


def kalman_smoother(
    time: ArrayLike,
    q: ArrayLike,
    noise: ArrayLike | None = None,
    jerk_density: ArrayLike | None = None,
) -> Motion:
    """Motion from a Rauch-Tung-Striebel smoother with a constant-jerk model (non-causal).

    Between samples the jerk would stay constant but for white noise on its rate; positions carry
    white measurement noise. What is not given is taken from the record, joint by joint: the ratio
    of the two noises by maximum likelihood, the measurement noise with it, at least the
    uncertainty quantum/√12 of the encoder. Irregular stamps are followed exactly.

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
    time, q = checked(time, q)
    step = float(np.median(np.diff(time)))
    # Stamps that differ by rounding are taken as equal: steady gains are fast.
    steps = np.full(len(time) - 1, step) if is_uniform(time) else np.diff(time)
    joints = q.shape[1]
    sigma = None if noise is None else _per_joint(noise, joints, "noise")
    density = None if jerk_density is None else _per_joint(jerk_density, joints, "jerk_density")
    centred = q - q[0]
    if sigma is None or density is None:
        sigma, bandwidth = most_likely(steps, centred, sigma, density)
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
    """Means and variances (time, joint, order) of the smoothed state of every joint.

    Args:
        delta: steps times bandwidth, (time - 1, joint).
        process: spectral density of the driving noise in those units, (joint,).
        y: positions over their noise, (time, joint).
    """
    transition, diffusion = constant_jerk(delta, process)
    spans = np.concatenate([np.zeros((1, delta.shape[1])), np.cumsum(delta, axis=0)])
    series = y[..., None]
    mean, covariance = priors(spans, series)
    predicted, filtered, settled = covariances(transition, diffusion, covariance)
    means = filtered_means(transition, predicted, mean, series)
    gain = np.linalg.solve(predicted[1:], transition @ filtered[:-1]).swapaxes(-1, -2)
    means[:-1] -= gain @ (transition @ means[:-1])
    for k in range(len(y) - 2, -1, -1):
        means[k] += gain[k] @ means[k + 1]
    filtered[:-1] -= gain @ predicted[1:] @ gain.swapaxes(-1, -2)
    k = len(y) - 2
    while k >= 0:
        filtered[k] += gain[k] @ filtered[k + 1] @ gain[k].swapaxes(-1, -2)
        if k > settled and same(filtered[k], filtered[k + 1]):
            filtered[settled:k] = filtered[k]
            k = settled
        k -= 1
    return means[..., 0], np.diagonal(filtered, axis1=-2, axis2=-1)


def _per_joint(value: ArrayLike, joints: int, name: str) -> Array:
    value = np.asarray(value, dtype=np.float64)
    if value.shape not in ((), (joints,)) or not np.all(value > 0):
        raise ValueError(f"`{name}` must be one positive number or {joints}, got {value}.")
    return np.broadcast_to(value, (joints,))
