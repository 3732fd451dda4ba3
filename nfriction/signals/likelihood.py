"""How noisy a record is and how fast its joints change, by maximum likelihood."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nfriction.signals.constant_jerk import (
    ORDER,
    constant_jerk,
    covariances,
    filtered_means,
    priors,
)

Array = NDArray[np.float64]


def most_likely(
    steps: Array, q: Array, sigma: Array | None, density: Array | None
) -> tuple[Array, Array]:
    """Measurement noise and the smoother's bandwidth [1/s] of every joint by maximum likelihood.

    The bandwidth is (density / (sigma² step))^(1/8), the rate at which the smoother forgets. It is
    searched on a grid, up to eight stretches of the record serving as independent series.
    """
    step = float(np.median(steps))
    length = min(len(q), 1000)
    first = np.linspace(0, len(q) - length, min(8, len(q) // length)).astype(int)
    grid = np.geomspace(2e-3, 2.0, 19)  # bandwidth · step
    stretches = first + np.arange(length)[:, None]
    delta = steps[stretches[:-1], None] / step * grid
    y = q[stretches]
    if np.all(delta == delta[:1, :1]):
        # Equal steps: one set of covariances serves all stretches.
        delta, y = delta[:, :1], y.reshape(length, 1, -1)
    misfit, volume = _innovations(delta, y)
    misfit = misfit.reshape(len(grid), -1, q.shape[1]).sum(axis=1)
    volume = volume * (len(first) / delta.shape[1])
    count = (length - 1) * len(first)
    floor = _quantum_seen(q) ** 2 / 12
    if sigma is not None:
        variance = np.broadcast_to(sigma**2, misfit.shape)
    elif density is not None:
        variance = density * step ** (2 * ORDER - 1) / grid[:, None] ** (2 * ORDER)
        variance = np.maximum(variance, floor)
    else:
        variance = np.maximum(misfit / count, floor)
    cost = count * np.log(variance) + volume[:, None] + misfit / variance
    best = _lowest(cost)
    rows = np.arange(len(grid))
    bandwidth = np.exp(np.interp(best, rows, np.log(grid))) / step
    log_variance = [
        np.interp(row, rows, column) for row, column in zip(best, np.log(variance).T, strict=True)
    ]
    return np.exp(0.5 * np.array(log_variance)), bandwidth


def _innovations(delta: Array, y: Array) -> tuple[Array, Array]:
    """Squared innovations over their variance (grid, joint), and the variances' logarithms (grid,).

    Args:
        delta: steps times bandwidth, (time - 1, stretch, grid).
        y: positions, (time, stretch, joint), in units of their noise up to a factor.
    """
    transition, diffusion = constant_jerk(delta, np.median(delta, axis=(0, 1)))
    spans = np.concatenate([np.zeros((1, *delta.shape[1:])), np.cumsum(delta, axis=0)])
    series = np.broadcast_to(y[:, :, None], (*y.shape[:2], delta.shape[2], y.shape[2]))
    mean, covariance = priors(spans, series)
    predicted, _, _ = covariances(transition, diffusion, covariance)
    means = filtered_means(transition, predicted, mean, series)
    ahead = (transition[..., :1, :] @ means[:-1])[..., 0, :]
    variance = predicted[1:, ..., 0, 0] + 1
    misfit = ((series[1:] - ahead) ** 2 / variance[..., None]).sum(axis=(0, 1))
    return misfit, np.log(variance).sum(axis=(0, 1))


def _lowest(cost: Array) -> Array:
    """Fractional row of every column's minimum: the vertex of a parabola through three rows."""
    row = np.argmin(cost, axis=0)
    inner = np.clip(row, 1, len(cost) - 2)
    below, here, above = (cost[inner + k, np.arange(cost.shape[1])] for k in (-1, 0, 1))
    bend = below - 2 * here + above
    shift = 0.5 * (below - above) / np.where(bend > 0, bend, np.inf)
    return np.where(row == inner, inner + shift, row)


def _quantum_seen(q: Array) -> Array:
    """Smallest change of position between two samples of every joint, at least rounding error."""
    change = np.abs(np.diff(q, axis=0))
    smallest = np.where(change > 0, change, np.inf).min(axis=0)
    rounding = np.finfo(np.float64).eps * np.maximum(np.abs(q).max(axis=0), 1.0)
    return np.where(np.isfinite(smallest), np.maximum(smallest, rounding), rounding)
