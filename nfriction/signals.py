"""From encoder positions to motion: quantisation, causal velocity, smoothing, initial states.

Two ways lead from positions to velocity and acceleration. The causal way (`causal_motion`) is what
a controller runs: frequency counting and a second-order IIR filter. The smoothers
(`savitzky_golay`, `kalman_smoother`) see the whole record and serve the fit.

Arrays are (time, joint); time is (time,) in seconds; positions are in radians (or metres).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.signal import lfilter, savgol_filter

from nfriction.recording import is_uniform

Array = NDArray[np.float64]

# State of the smoother's model: position, velocity, acceleration, jerk.
_ORDER = 4


@dataclass(frozen=True, eq=False)
class Motion:
    """Position, velocity and acceleration of every joint over time.

    Args:
        time: [s], shape (time,).
        q: position [rad], shape (time, joint).
        qd: velocity [rad/s], shape like `q`.
        qdd: acceleration [rad/s²], shape like `q`.
        std: standard deviations of `q`, `qd` and `qdd` where the method knows them.
    """

    time: Array
    q: Array
    qd: Array
    qdd: Array
    std: Motion | None = None


def quantise(q: ArrayLike, counts_per_revolution: float, *, offset: float = 0.0) -> Array:
    """Position as an incremental encoder reports it: the nearest of its evenly spaced counts.

    Args:
        q: position [rad], any shape.
        counts_per_revolution: counts after quadrature; an encoder of 2048 lines has 8192.
        offset: position of one count's centre [rad].
    Returns:
        Quantised position [rad], shape like `q`.
    """
    quantum = _quantum(counts_per_revolution)
    return offset + quantum * np.rint((np.asarray(q, dtype=np.float64) - offset) / quantum)


def frequency_counting(
    time: ArrayLike,
    q: ArrayLike,
    counts_per_revolution: float,
    *,
    offset: float = 0.0,
    edge_time: ArrayLike | None = None,
) -> Array:
    """Causal velocity from the time between encoder edges.

    The velocity is the way between the last two samples that saw an edge, over the time between
    those edges. While no further edge comes, the joint cannot have moved by more than a count, so
    the speed falls as one count over the time since the last edge. An edge crossed back and forth
    counts as no way at all. Before the second edge the velocity is zero.

    Args:
        time: sample times [s], shape (time,).
        q: position [rad], shape (time, joint); quantised here, which leaves counts as they are.
        counts_per_revolution: counts after quadrature.
        offset: position of one count's centre [rad].
        edge_time: time of the last edge at or before each sample [s], shape like `q`, where the
            hardware latches it; without it edges are known to the sample clock.
    Returns:
        Velocity [rad/s], shape (time, joint).
    """
    time, q = _checked(time, q)
    quantum = _quantum(counts_per_revolution)
    counts = np.rint((q - offset) / quantum)
    latched = np.broadcast_to(time[:, None], q.shape) if edge_time is None else edge_time
    latched = np.asarray(latched, dtype=np.float64)
    if latched.shape != q.shape:
        raise ValueError(f"`edge_time` must be shaped like `q` {q.shape}, got {latched.shape}.")
    velocity = np.zeros_like(q)
    for joint in range(q.shape[1]):
        step = np.diff(counts[:, joint])
        edges = np.flatnonzero(step) + 1
        if len(edges) < 2:
            continue
        place = counts[edges, joint] - 0.5 * np.sign(step[edges - 1])
        moment = latched[edges, joint]
        if np.any(np.diff(moment) <= 0):
            raise ValueError("`edge_time` must increase from edge to edge.")
        at_edge = quantum * np.diff(place) / np.diff(moment)
        # For every sample the number of the last edge, counted from the second one on.
        last = np.searchsorted(edges, np.arange(len(q)), side="right") - 2
        known = last >= 0
        v = at_edge[last[known]]
        # |v| · waited is the way since the edge at that speed: beyond one count it slows down.
        waited = time[known] - moment[last[known] + 1]
        way = np.abs(v) * waited
        velocity[known, joint] = v * quantum / np.maximum(way, quantum)
    return velocity


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
        """State (2, *value) of a filter that has rested at `value`."""
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
    """Motion as a controller sees it, from past and present samples alone.

    Velocity is frequency counting through the low-pass filter; acceleration is the difference of
    that velocity through the same filter again. The filter runs at the median step, also where the
    stamps jitter, as one in a controller does.

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
        TLRIP paper: frequency counting, then a second-order IIR filter.
    """
    time, q = _checked(time, q)
    low_pass = SecondOrderLowPass(cutoff_hz, float(np.median(np.diff(time))), damping)
    qd = low_pass(frequency_counting(time, q, counts_per_revolution, offset=offset))
    rate = np.zeros_like(qd)
    rate[1:] = np.diff(qd, axis=0) / np.diff(time)[:, None]
    measured = quantise(q, counts_per_revolution, offset=offset)
    return Motion(time, measured, qd, low_pass(rate))


def savitzky_golay(time: ArrayLike, q: ArrayLike, window_s: float = 0.06, order: int = 4) -> Motion:
    """Motion from a least-squares polynomial around every sample (non-causal).

    The window holds a fixed odd number of samples; at both ends it stays inside the record and the
    polynomial is read off its side. Irregular stamps get a polynomial of their own each.

    Args:
        time: [s], shape (time,).
        q: position [rad], shape (time, joint).
        window_s: time from the window's first sample to its last [s].
        order: of the polynomial, at least 2.
    Returns:
        Smoothed position, velocity and acceleration.
    References:
        Savitzky and Golay, Analytical Chemistry 36 (1964) 1627.
    """
    time, q = _checked(time, q)
    step = float(np.median(np.diff(time)))
    window = 2 * round(window_s / (2 * step)) + 1
    if order < 2:
        raise ValueError(f"`order` must be at least 2 to have an acceleration, got {order}.")
    if not order < window <= len(time):
        raise ValueError(
            f"`window_s` of {window_s} s is {window} samples; it must be more than order = {order} "
            f"and at most the record's {len(time)}. Change `window_s`."
        )
    if is_uniform(time):
        q, qd, qdd = (
            savgol_filter(q, window, order, deriv=k, delta=step, axis=0, mode="interp")
            for k in range(3)
        )
        return Motion(time, q, qd, qdd)
    first = np.clip(np.arange(len(time)) - window // 2, 0, len(time) - window)
    smoothed = np.empty((3, *q.shape))
    for part in np.array_split(np.arange(len(time)), math.ceil(len(time) / 4096)):
        samples = first[part, None] + np.arange(window)
        coefficients = _local_polynomial(time[samples] - time[part, None], q[samples], order)
        smoothed[:, part] = coefficients[:, :3].swapaxes(0, 1)
    return Motion(time, smoothed[0], smoothed[1], smoothed[2])


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
    time, q = _checked(time, q)
    start = float(time[0]) if start is None else start
    if not time[0] <= start <= time[-1]:
        raise ValueError(f"`start` must lie in {time[0]:g} … {time[-1]:g} s, got {start:g}.")
    slack = 1e-6 * (time[1] - time[0])
    begin = max(min(start - duration / 2, time[-1] - duration), time[0])
    first = int(np.searchsorted(time, begin - slack))
    stop = int(np.searchsorted(time, begin + duration + slack, side="right"))
    stop = min(max(stop, first + 4), len(time))
    first = max(min(first, stop - 4), 0)
    coefficients = _local_polynomial(time[None, first:stop] - start, q[None, first:stop], 3)
    return coefficients[0, 0], coefficients[0, 1]


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
    time, q = _checked(time, q)
    step = float(np.median(np.diff(time)))
    # Stamps that differ by rounding are taken as equal: steady gains are fast.
    steps = np.full(len(time) - 1, step) if is_uniform(time) else np.diff(time)
    joints = q.shape[1]
    sigma = None if noise is None else _per_joint(noise, joints, "noise")
    density = None if jerk_density is None else _per_joint(jerk_density, joints, "jerk_density")
    centred = q - q[0]
    if sigma is None or density is None:
        sigma, bandwidth = _most_likely(steps, centred, sigma, density)
    if density is not None:
        bandwidth = (density / (sigma**2 * step)) ** (1 / (2 * _ORDER))
    # In units of 1/bandwidth and sigma every joint has the same well-scaled problem.
    mean, variance = _smooth(steps[:, None] * bandwidth, bandwidth * step, centred / sigma)
    powers = bandwidth[:, None] ** np.arange(_ORDER)
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
    transition, diffusion = _constant_jerk(delta, process)
    spans = np.concatenate([np.zeros((1, delta.shape[1])), np.cumsum(delta, axis=0)])
    series = y[..., None]
    mean, covariance = _priors(spans, series)
    predicted, filtered, settled = _covariances(transition, diffusion, covariance)
    means = _filter(transition, predicted, mean, series)
    gain = np.linalg.solve(predicted[1:], transition @ filtered[:-1]).swapaxes(-1, -2)
    means[:-1] -= gain @ (transition @ means[:-1])
    for k in range(len(y) - 2, -1, -1):
        means[k] += gain[k] @ means[k + 1]
    filtered[:-1] -= gain @ predicted[1:] @ gain.swapaxes(-1, -2)
    k = len(y) - 2
    while k >= 0:
        filtered[k] += gain[k] @ filtered[k + 1] @ gain[k].swapaxes(-1, -2)
        if k > settled and _same(filtered[k], filtered[k + 1]):
            filtered[settled:k] = filtered[k]
            k = settled
        k -= 1
    return means[..., 0], np.diagonal(filtered, axis1=-2, axis2=-1)


def _constant_jerk(delta: Array, process: Array) -> tuple[Array, Array]:
    """Transition matrices and process noise of steps `delta` (any shape + (order, order))."""
    if np.all(delta == delta[:1]) and len(delta) > 1:
        one = _constant_jerk(delta[:1], process)
        shape = (*delta.shape, _ORDER, _ORDER)
        return np.broadcast_to(one[0], shape), np.broadcast_to(one[1], shape)
    order = np.arange(_ORDER)
    factorial = np.array([math.factorial(k) for k in range(_ORDER)])
    ahead = order - order[:, None]
    powers = delta[..., None, None] ** np.maximum(ahead, 0)
    transition = np.where(ahead >= 0, powers / factorial[np.maximum(ahead, 0)], 0.0)
    last = _ORDER - 1 - order
    exponent = last + last[:, None] + 1
    share = 1 / (factorial[last] * factorial[last][:, None] * exponent)
    diffusion = process[..., None, None] * share * delta[..., None, None] ** exponent
    return transition, diffusion


def _priors(spans: Array, y: Array) -> tuple[Array, Array]:
    """Mean (..., order, series) and covariance of the first state, from a cubic through the start.

    The covariance is a hundredfold of the fit's own: weak beside the record, yet well scaled.

    Args:
        spans: time from the first sample times bandwidth, (time, ...).
        y: positions over their noise, (time, ..., series).
    """
    factorial = np.array([math.factorial(k) for k in range(_ORDER)])
    mean = np.empty((*y.shape[1:-1], _ORDER, y.shape[-1]))
    covariance = np.empty((*spans.shape[1:], _ORDER, _ORDER))
    for index in np.ndindex(*spans.shape[1:]):
        span = spans[(slice(None), *index)]
        # Within three time constants the model is close to a cubic.
        near = max(int(np.searchsorted(span, 3.0, side="right")), 2 * _ORDER)
        inverse = np.linalg.pinv(span[:near, None] ** np.arange(_ORDER) / factorial)
        mean[index] = inverse @ y[(slice(near), *index)]
        covariance[index] = 100 * inverse @ inverse.T
    return mean, covariance


def _covariances(transition: Array, diffusion: Array, first: Array) -> tuple[Array, Array, int]:
    """Covariances (time, ..., order, order) for unit measurement noise.

    Returns:
        Predicted and filtered covariances, and the sample from which both stay as they are.
    """
    n = len(transition) + 1
    predicted = np.empty((n, *first.shape))
    filtered = np.empty_like(predicted)
    repeats = np.all(transition[1:] == transition[:1])
    identity = np.eye(_ORDER)
    predicted[0] = first
    for k in range(n):
        if k:
            before = transition[k - 1] @ filtered[k - 1] @ transition[k - 1].swapaxes(-1, -2)
            predicted[k] = before + diffusion[k - 1]
        gain = _gain(predicted[k])
        # Joseph's form keeps the covariance positive.
        keep = identity - gain * identity[0]
        filtered[k] = keep @ predicted[k] @ keep.swapaxes(-1, -2) + gain @ gain.swapaxes(-1, -2)
        if repeats and k and _same(filtered[k], filtered[k - 1]):
            predicted[k:], filtered[k:] = predicted[k], filtered[k]
            return predicted, filtered, k
    return predicted, filtered, n


def _same(new: Array, old: Array) -> bool:
    size = np.abs(old).max(axis=(-2, -1), keepdims=True)
    return bool((np.abs(new - old) <= 1e-9 * size).all())


def _gain(predicted: Array) -> Array:
    """Kalman gain (..., order, 1) of a position measured with unit noise."""
    return predicted[..., :1] / (predicted[..., :1, :1] + 1)


def _filter(transition: Array, predicted: Array, mean: Array, y: Array) -> Array:
    """Filtered means (time, ..., order, series) of positions `y` (time, ..., series)."""
    gain = _gain(predicted)
    keep = np.eye(_ORDER) - gain * np.eye(_ORDER)[0]
    carry = keep[1:] @ transition
    means = gain * y[..., None, :]
    means[0] += keep[0] @ mean
    for k in range(1, len(y)):
        means[k] += carry[k - 1] @ means[k - 1]
    return means


def _most_likely(
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
        variance = density * step ** (2 * _ORDER - 1) / grid[:, None] ** (2 * _ORDER)
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
    transition, diffusion = _constant_jerk(delta, np.median(delta, axis=(0, 1)))
    spans = np.concatenate([np.zeros((1, *delta.shape[1:])), np.cumsum(delta, axis=0)])
    series = np.broadcast_to(y[:, :, None], (*y.shape[:2], delta.shape[2], y.shape[2]))
    mean, covariance = _priors(spans, series)
    predicted, _, _ = _covariances(transition, diffusion, covariance)
    means = _filter(transition, predicted, mean, series)
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


def _local_polynomial(span: Array, q: Array, order: int) -> Array:
    """Value and derivatives at span 0, (batch, order + 1, joint), of least-squares polynomials.

    Args:
        span: time from the moment asked for [s], (batch, sample).
        q: (batch, sample, joint).
    """
    scale = np.abs(span).max()
    powers = np.arange(order + 1)
    basis = (span[..., None] / scale) ** powers
    transposed = basis.swapaxes(-1, -2)
    coefficients = np.linalg.solve(transposed @ basis, transposed @ q)
    factorial = np.array([math.factorial(k) for k in powers])
    return np.asarray(coefficients * (factorial / scale**powers)[:, None])


def _quantum(counts_per_revolution: float) -> float:
    if not counts_per_revolution > 0:
        raise ValueError(
            f"`counts_per_revolution` must be positive, got {counts_per_revolution}; "
            f"an encoder of 2048 lines has 8192 counts after quadrature."
        )
    return 2 * math.pi / counts_per_revolution


def _per_joint(value: ArrayLike, joints: int, name: str) -> Array:
    value = np.asarray(value, dtype=np.float64)
    if value.shape not in ((), (joints,)) or not np.all(value > 0):
        raise ValueError(f"`{name}` must be one positive number or {joints}, got {value}.")
    return np.broadcast_to(value, (joints,))


def _checked(time: ArrayLike, q: ArrayLike) -> tuple[Array, Array]:
    time, q = np.asarray(time, dtype=np.float64), np.asarray(q, dtype=np.float64)
    if q.ndim != 2 or time.shape != q.shape[:1]:
        raise ValueError(
            f"`time` must be (time,) and `q` (time, joint), got {time.shape} and {q.shape}; "
            f"a single joint is `q[:, None]`."
        )
    if len(time) < 8:
        raise ValueError(f"at least 8 samples are needed, got {len(time)}.")
    if not (np.all(np.isfinite(q)) and np.all(np.diff(time) > 0)):
        raise ValueError("`q` must be finite and `time` increasing; `Recording` tells where not.")
    return time, q
