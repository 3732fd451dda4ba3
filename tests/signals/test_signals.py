"""Signals of known motions: error of every method, causality, frequency response, limits."""

import math
import time as clock
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import savgol_filter

from nfriction.recording import Recording
from nfriction.signals import (
    Motion,
    SecondOrderLowPass,
    causal_motion,
    count_seen,
    frequency_counting,
    kalman_smoother,
    period_counting,
    quantise,
)

COUNTS = 8192
QUANTUM = 2 * math.pi / COUNTS


def sines(time: np.ndarray) -> Motion:
    """Three joints, each a sum of three sines of 0.5 to 6 Hz."""
    amplitude = np.array([[0.6, 0.3, 0.1], [0.4, 0.5, 0.05], [0.9, 0.2, 0.03]])
    rate = 2 * np.pi * np.array([[0.7, 1.9, 4.3], [1.1, 2.3, 6.1], [0.5, 1.3, 3.7]])
    z = amplitude * np.exp(1j * (time[:, None, None] * rate + np.array([0.3, 1.0, 2.0])))
    q, qd, qdd = (((1j * rate) ** k * z).sum(axis=-1).imag for k in range(3))
    return Motion(time, q, qd, qdd)


def decay(time: np.ndarray) -> Motion:
    """Three damped oscillations, as of a pendulum that comes to rest."""
    pole = np.array([-0.25 + 8.2j, -0.3 + 5.7j, -0.4 + 12.6j])
    z = np.array([0.8, 1.0, 0.5]) * np.exp(time[:, None] * pole)
    return Motion(time, *((pole**k * z).real for k in range(3)))  # type: ignore[misc]


def savitzky_golay(time: np.ndarray, q: np.ndarray, window_s: float = 0.06) -> Motion:
    """Local polynomials of order 4 on uniform samples, for comparison."""
    step = float(np.median(np.diff(time)))
    window = 2 * round(window_s / (2 * step)) + 1
    return Motion(
        time, *(savgol_filter(q, window, 4, deriv=k, delta=step, axis=0) for k in range(3))
    )


MOTIONS = {"sines": sines, "decay": decay}
METHODS = {
    "causal": lambda t, q: causal_motion(t, q, COUNTS),
    "kalman": kalman_smoother,
}
UNIFORM = np.arange(5000) * 1e-3
IRREGULAR = UNIFORM + np.random.default_rng(5).uniform(-2e-4, 2e-4, UNIFORM.shape)


def rmse(found: np.ndarray, truth: np.ndarray) -> float:
    """RMSE over all joints without the ends of 0.2 s."""
    return float(np.sqrt(np.mean((found - truth)[200:-200] ** 2)))


def errors(method: str, truth: Motion) -> tuple[float, float]:
    found = METHODS[method](truth.time, quantise(truth.q, COUNTS))
    return rmse(found.qd, truth.qd), rmse(found.qdd, truth.qdd)


# --- every method on a known motion ----------------------------------------------------------


@pytest.mark.parametrize("motion", MOTIONS)
def test_smoother_is_far_better_than_the_causal_filter(motion: str) -> None:
    truth = MOTIONS[motion](UNIFORM)
    causal, smooth = errors("causal", truth), errors("kalman", truth)
    # The causal filter is late by about 20 ms; the smoother is not.
    assert smooth[0] < causal[0] / 20
    assert smooth[1] < causal[1] / 5


@pytest.mark.parametrize("motion", MOTIONS)
def test_causal_error_is_the_delay_of_the_filter(motion: str) -> None:
    truth = MOTIONS[motion](UNIFORM)
    delay = math.sqrt(2) / (2 * math.pi * 20.0)  # of a Butterworth filter of 20 Hz at low frequency
    jerk = np.gradient(truth.qdd, 1e-3, axis=0)
    qd, qdd = errors("causal", truth)
    # To first order in frequency over cut-off (up to 6/20); acceleration passes two filters.
    assert qd == pytest.approx(delay * rmse(truth.qdd, 0 * jerk), rel=0.2)
    assert qdd == pytest.approx(2 * delay * rmse(jerk, 0 * jerk), rel=0.2)


@pytest.mark.parametrize("motion", MOTIONS)
def test_kalman_smoother_finds_a_good_bandwidth(motion: str) -> None:
    """Without knowledge of the motion it rivals the best of many Savitzky-Golay windows."""
    truth = MOTIONS[motion](UNIFORM)
    q = quantise(truth.q, COUNTS)
    tried = [savitzky_golay(truth.time, q, window) for window in np.arange(0.02, 0.2, 0.01)]
    qd, qdd = errors("kalman", truth)
    assert qd < 1.6 * min(rmse(one.qd, truth.qd) for one in tried)
    assert qdd < 2.5 * min(rmse(one.qdd, truth.qdd) for one in tried)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("method", METHODS)
def test_irregular_time_stamps_hardly_increase_the_error(motion: str, method: str) -> None:
    even = errors(method, MOTIONS[motion](UNIFORM))
    jittered = errors(method, MOTIONS[motion](IRREGULAR))
    # Quantisation differs, so the two errors are similar, not equal. The causal filter runs at the
    # nominal step, and the difference of velocities over a short step is noisier.
    limit = 1.6 if method == "causal" else 1.25
    assert jittered[0] < limit * even[0]
    assert jittered[1] < limit * even[1]


def test_irregular_path_equals_the_uniform_one() -> None:
    """A jitter just above the tolerance switches the code path and hardly moves a sample."""
    truth = sines(UNIFORM[:2000])
    nudged = truth.time.copy()
    nudged[1000] += 5e-6
    q = quantise(truth.q, COUNTS)
    fast, exact = (
        kalman_smoother(time, q, noise=2e-4, jerk_density=1e8) for time in (truth.time, nudged)
    )
    # 5 µs at up to 10 rad/s are 5e-5 rad, a fraction of the noise, in one sample of thousands.
    assert np.abs(fast.qd - exact.qd).max() < 2e-3
    assert np.abs(fast.qdd - exact.qdd).max() < 0.5
    # Far from that sample the effect has vanished.
    assert np.abs(fast.qdd - exact.qdd)[:500].max() < 1e-6


@pytest.mark.parametrize("time", [UNIFORM[:400], IRREGULAR[:400]], ids=["uniform", "irregular"])
def test_smoother_reproduces_cubics_exactly(time: np.ndarray) -> None:
    """The constant-jerk model contains every cubic, including the ends."""
    s = time[:, None]
    q = 0.3 - 2 * s + 5 * s**2 - 4 * s**3
    found = kalman_smoother(time, q, noise=1e-4, jerk_density=1e2)
    np.testing.assert_allclose(found.q, q, atol=1e-9)
    np.testing.assert_allclose(found.qd, -2 + 10 * s - 12 * s**2, atol=1e-7)
    np.testing.assert_allclose(found.qdd, 10 - 24 * s, atol=1e-5)


# --- encoder ---------------------------------------------------------------------------------


@given(q=st.floats(-1e3, 1e3), counts=st.integers(4, 10**6))
def test_quantise_is_nearest_and_idempotent(q: float, counts: int) -> None:
    once = quantise(q, counts)
    # Half a count, and the rounding of 1e3.
    assert abs(once - q) <= math.pi / counts + 1e-12
    assert abs(quantise(once, counts) - once) < 1e-12


@pytest.mark.parametrize("speed", [-3.1, -0.2, 0.05, 0.9, 40.0])
def test_period_counting_of_a_constant_rotation(speed: float) -> None:
    time = np.arange(4000) * 1e-3
    q = quantise(speed * time[:, None] + 0.01, COUNTS)
    found = period_counting(time, q, COUNTS)[1000:, 0]
    # An edge is known to one sample: between edges that are a time T apart the speed error is at
    # most a share 1 ms / T; faster than a count per sample, it is a count in 1 ms.
    share = 1e-3 * abs(speed) / QUANTUM
    assert np.abs(found - speed).max() <= abs(speed) * share / max(1 - share, 0.5) + (
        QUANTUM / 1e-3 if share > 0.5 else 1e-12
    )
    assert abs(found.mean() - speed) < 0.02 * abs(speed)


def test_period_counting_falls_to_zero_at_rest_and_ignores_dither() -> None:
    time = np.arange(3000) * 1e-3
    moving = np.minimum(time, 1.0)[:, None]
    found = period_counting(time, quantise(moving, COUNTS), COUNTS)[:, 0]
    rest = time > 1.1
    assert np.all(np.diff(found[rest]) < 0)
    # No edge for t seconds: at most one count in that time; the last edge is at most at 1 s.
    assert np.all(found[rest] <= QUANTUM / (time[rest] - 1.0) * (1 + 1e-12))
    dither = QUANTUM * (np.arange(3000) % 2)[:, None]
    assert np.all(period_counting(time, dither, COUNTS)[2:] == 0)


# --- the causal way --------------------------------------------------------------------------


def test_causal_motion_does_not_depend_on_future_samples() -> None:
    truth = sines(UNIFORM[:3000])
    q = quantise(truth.q, COUNTS)
    other = q.copy()
    other[2000:] = 7.0 - 3 * other[2000:]
    first, second = causal_motion(truth.time, q, COUNTS), causal_motion(truth.time, other, COUNTS)
    for key in ("q", "qd", "qdd"):
        assert np.array_equal(getattr(first, key)[:2000], getattr(second, key)[:2000])
        assert not np.array_equal(getattr(first, key)[2000:], getattr(second, key)[2000:])


def response(low_pass: SecondOrderLowPass, frequency_hz: float) -> float:
    """Gain measured on a long sine."""
    time = np.arange(int(20 / low_pass.sample_time)) * low_pass.sample_time
    late = time > 10
    carrier = np.exp(-2j * np.pi * frequency_hz * time)
    output = low_pass(np.sin(2 * np.pi * frequency_hz * time))
    return 2 * abs(np.mean((output * carrier)[late]))


@pytest.mark.parametrize("sample_time", [1e-3, 4e-3])
@pytest.mark.parametrize("cutoff", [2.0, 20.0, 100.0])
def test_cut_off_is_at_minus_three_decibels(cutoff: float, sample_time: float) -> None:
    # Ten seconds contain whole periods: the transient has decayed and there is no leakage.
    gain = response(SecondOrderLowPass(cutoff, sample_time), cutoff)
    assert gain == pytest.approx(math.sqrt(0.5), rel=1e-3)
    damped = response(SecondOrderLowPass(cutoff, sample_time, damping=1.0), cutoff)
    assert damped == pytest.approx(0.5, rel=1e-3)


def test_low_pass_is_of_second_order() -> None:
    low_pass = SecondOrderLowPass(1.0, 1e-3)
    assert response(low_pass, 20.0) / response(low_pass, 40.0) == pytest.approx(4, rel=0.03)
    assert response(low_pass, 0.05) == pytest.approx(1, rel=1e-4)


def test_low_pass_at_rest_stays_at_rest() -> None:
    low_pass = SecondOrderLowPass(15.0, 1e-3)
    # Rounding, preserved by poles close to 1.
    np.testing.assert_allclose(low_pass(np.full((1000, 2), 3.7)), 3.7, rtol=1e-11)
    with pytest.raises(ValueError, match=r"half the sampling frequency \(500 Hz\), got 600"):
        SecondOrderLowPass(600.0, 1e-3)
    with pytest.raises(ValueError, match="must be positive"):
        SecondOrderLowPass(10.0, 1e-3, damping=0.0)


# --- Kalman smoother -------------------------------------------------------------------------


def test_standard_deviations_are_correct_for_the_true_model() -> None:
    """For motion sampled from the model itself, with its parameters given."""
    rng = np.random.default_rng(11)
    step, n, joints, noise, density = 1e-3, 4000, 12, 3e-4, 1e8
    power = np.arange(4)
    fine = np.linalg.cholesky(
        density
        * np.array(
            [
                [step ** (7 - i - j) / math.factorial(3 - i) / math.factorial(3 - j) / (7 - i - j)
                 for j in power]
                for i in power
            ]
        )
    )  # fmt: skip
    carry = np.array(
        [[step ** (j - i) / math.factorial(j - i) if j >= i else 0.0 for j in power] for i in power]
    )
    state = np.zeros((n, 4, joints))
    for k in range(1, n):
        state[k] = carry @ state[k - 1] + fine @ rng.normal(size=(4, joints))
    measured = state[:, 0] + noise * rng.normal(size=(n, joints))
    found = kalman_smoother(np.arange(n) * step, measured, noise, density)
    assert found.std is not None
    for k, key in enumerate(("q", "qd", "qdd")):
        score = (getattr(found, key) - state[:, k]) / getattr(found.std, key)
        # Errors are correlated over about 20 samples: about 2,400 independent ones, 1.5 % of
        # spread.
        assert np.sqrt(np.mean(score**2)) == pytest.approx(1.0, abs=0.06)
    # The same parameters are estimated if they are not given.
    searched = kalman_smoother(np.arange(n) * step, measured)
    assert searched.std is not None
    ratio = searched.std.qdd[n // 2] / found.std.qdd[n // 2]
    assert np.all((ratio > 0.7) & (ratio < 1.4))


@pytest.mark.parametrize("motion", MOTIONS)
def test_standard_deviations_cover_the_error_of_quantised_motion(motion: str) -> None:
    truth = MOTIONS[motion](UNIFORM)
    found = kalman_smoother(truth.time, quantise(truth.q, COUNTS))
    assert found.std is not None
    for key in ("q", "qd", "qdd"):
        score = np.abs(getattr(found, key) - getattr(truth, key)) / getattr(found.std, key)
        # Real motion is smoother than the model: conservative by less than a factor of 2.5.
        assert 0.4 < np.sqrt(np.mean(score**2)) < 1.1
        assert 0.93 < np.mean(score < 2) <= 1.0


def test_noise_is_estimated_or_given() -> None:
    rng = np.random.default_rng(0)
    truth = sines(UNIFORM[:3000])
    sigma = np.array([1e-4, 1e-3, 5e-3])
    measured = truth.q + sigma * rng.normal(size=truth.q.shape)
    found = kalman_smoother(truth.time, measured)
    residual = found.q - truth.q
    assert np.all(np.sqrt(np.mean(residual**2, axis=0)) < 0.5 * sigma)
    assert found.std is not None
    mean_std = found.std.qd.mean(axis=0)
    assert mean_std[0] < mean_std[1] < mean_std[2]
    # More noise or jerk gives a larger uncertainty.
    pairs = [(1e-3, 1e6), (2e-3, 1e6), (1e-3, 1e7)]
    stds = [kalman_smoother(truth.time, truth.q, *pair).std.qd.mean() for pair in pairs]  # type: ignore[union-attr]
    assert stds[0] < min(stds[1:])
    # Either of the two may be given alone; the other is then estimated.
    for option in ({"noise": sigma}, {"jerk_density": 1e7}):
        alone = kalman_smoother(truth.time, measured, **option)  # type: ignore[arg-type]
        assert np.all(np.sqrt(np.mean((alone.q - truth.q) ** 2, axis=0)) < 0.5 * sigma)
    with pytest.raises(ValueError, match="`noise` must be one positive number or 3"):
        kalman_smoother(truth.time, truth.q, noise=[1.0, 2.0])


@pytest.mark.parametrize("gap", [0.3, 10.0, 1e5])
@pytest.mark.parametrize("cut", [3, 1500, 2990])
def test_gap_separates_a_recording_without_edge_errors(gap: float, cut: int) -> None:
    time = UNIFORM[:3000].copy()
    time[cut:] += gap
    truth = sines(time)
    measured = truth.q + 1e-4 * np.random.default_rng(2).normal(size=truth.q.shape)
    found = kalman_smoother(time, measured)
    assert found.std is not None
    for key in ("q", "qd", "qdd"):
        score = np.abs(getattr(found, key) - getattr(truth, key)) / getattr(found.std, key)
        # The largest of 9000 normal deviations is about 4; three samples alone are very uncertain.
        assert score.max() < 6
    if cut == 1500:
        halves = [kalman_smoother(time[k : k + 1500], measured[k : k + 1500]) for k in (0, 1500)]
        apart = np.concatenate([half.qdd for half in halves])
        # Only the noise ratio, estimated from all of it, differs, and the information across the
        # gap.
        assert rmse(found.qdd, truth.qdd) < 1.2 * rmse(apart, truth.qdd)


@pytest.mark.parametrize("counter", [1e-6, 1e-7])
@pytest.mark.filterwarnings("error")
def test_time_stamps_of_a_coarse_clock_keep_results_finite(counter: float) -> None:
    """Ten stamps of a 10 ms clock, separated by a counter: tiny steps, then a huge one."""
    group, place = np.divmod(np.arange(500), 10)
    time = group / 100 + counter * place
    for q in (1e-3 * np.random.default_rng(0).normal(size=500), np.sin(group / 20)):
        found = kalman_smoother(time, q[:, None])
        assert found.std is not None
        for values in (found.q, found.qd, found.qdd, found.std.q, found.std.qd, found.std.qdd):
            assert np.isfinite(values).all()


def test_joint_at_rest_has_no_motion() -> None:
    q = np.full((300, 2), 0.7)
    q[:, 1] = quantise(np.sin(np.arange(300) / 50), COUNTS)
    found = kalman_smoother(np.arange(300) * 1e-3, q)
    np.testing.assert_allclose(found.q[:, 0], 0.7, atol=1e-12)
    np.testing.assert_allclose(found.qdd[:, 0], 0.0, atol=1e-6)
    assert np.all(np.isfinite(found.qdd))


@pytest.mark.slow
def test_smoother_is_fast() -> None:
    time = np.arange(40_000) * 1e-3
    q = quantise(sines(time).q, COUNTS)
    begin = clock.perf_counter()
    kalman_smoother(time, q)
    # 1.1 s on one core of a busy machine.
    assert clock.perf_counter() - begin < 5


def test_smoothers_agree_on_a_real_triple_pendulum(data_dir: Path) -> None:
    recording = Recording.read(data_dir / "multiarm_pendulum" / "triple_b0.csv.gz")
    smooth = kalman_smoother(recording.time, recording.q)
    local = savitzky_golay(recording.time, recording.q)
    # Both are close to the residual noise of 2-5e-5 rad of the data card.
    assert 1e-5 < rmse(smooth.q, recording.q) < 6e-5
    assert rmse(smooth.qd, local.qd) < 0.01
    assert smooth.std is not None
    assert rmse(smooth.qdd, local.qdd) < 0.5


# --- the border ------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_bad_arrays_are_refused(method: str) -> None:
    time = np.arange(100) * 1e-3
    with pytest.raises(ValueError, match=r"`q` \(time, joint\).*q\[:, None\]"):
        METHODS[method](time, np.zeros(100))
    with pytest.raises(ValueError, match="at least 8 samples"):
        METHODS[method](time[:7], np.zeros((7, 1)))
    with pytest.raises(ValueError, match="`time` increasing"):
        METHODS[method](time[::-1], np.zeros((100, 1)))


def test_bad_settings_are_refused() -> None:
    q = np.zeros((100, 1))
    with pytest.raises(ValueError, match="8192 counts after quadrature"):
        quantise(q, 0)
    with pytest.raises(ValueError, match="positive and finite, got inf"):
        quantise(q, math.inf)


def test_encoder_resolution_is_estimated_from_repeated_steps():
    time = np.arange(0.0, 4.0, 1e-3)
    smooth = np.stack([np.sin(time), np.exp(-time) * np.cos(9 * time)], -1)
    assert np.isnan(count_seen(smooth)).all()
    assert np.isnan(count_seen(smooth.round(9))).all()
    assert np.isnan(count_seen(np.zeros((9, 2)))).all()
    assert np.isnan(count_seen((60 * time - 2.5 * time**2)[:, None])).all()
    read = quantise(smooth, 8192)
    quantum = 2 * np.pi / 8192
    # Converted to other coordinates and back, or written with few digits.
    for q in (read, np.pi + (read - np.pi), read.round(5)):
        np.testing.assert_allclose(count_seen(q), quantum, rtol=0.02)
    # A joint that never stops changes by dozens of counts at once.
    running = quantise(30 * time[:, None] + smooth, 8192)
    np.testing.assert_allclose(count_seen(running), quantum, rtol=1e-6)
    # Windows have no change from one to the next.
    np.testing.assert_allclose(count_seen(read[:3600].reshape(9, 400, 2)), quantum)


@pytest.mark.parametrize("interval", [0.005, 0.02])
def test_frequency_counting_resolves_a_count_over_its_interval(interval: float) -> None:
    time = np.arange(4000) / 1000
    resolution = 2 * np.pi / COUNTS / interval
    for speed in (50.0, -3.0, 0.4 * resolution):
        found = frequency_counting(time, speed * time[:, None], COUNTS, interval=interval)[100:, 0]
        assert np.abs(found - speed).max() <= resolution * (1 + 1e-6)
        np.testing.assert_allclose(found / resolution, np.rint(found / resolution), atol=1e-6)
        assert found.mean() == pytest.approx(speed, rel=0.02)
    # Slower than that it jumps between zero and one count; period counting does not.
    assert set(np.rint(found / resolution)) == {0.0, 1.0}
    timed = period_counting(time, speed * time[:, None], COUNTS)[1000:, 0]
    assert np.abs(timed - speed).max() < 0.1 * np.abs(found - speed).max()


@pytest.mark.parametrize("times", [0.2, 0.7, 1.4, 10.0])
def test_period_counting_is_better_below_the_crossover_speed(times: float) -> None:
    """Their resolutions, counts per interval and v² sample / count, are equal at one speed."""
    time, sample, interval = np.arange(8000) / 1000, 1e-3, 0.01
    # A single speed may fit a whole number of counts into the interval.
    speeds = times * QUANTUM / math.sqrt(sample * interval) * np.linspace(0.8, 1.2, 81)
    q = time[:, None] * speeds
    by_edges = period_counting(time, q, COUNTS)
    by_counts = frequency_counting(time, q, COUNTS, interval=interval)
    edges, counts = (np.std((v - speeds)[1000:]) for v in (by_edges, by_counts))
    # A resolution r, rounded up or down in a random share of samples: r / sqrt(6).
    assert counts == pytest.approx(QUANTUM / interval / math.sqrt(6), rel=0.2)
    timed = min(times**2 * QUANTUM / interval, QUANTUM / sample) / math.sqrt(6)
    assert edges == pytest.approx(timed, rel=0.1)
    assert (edges < counts) == (times < 1)


def test_frequency_counting_starts_at_zero_and_needs_an_interval() -> None:
    time = np.arange(100) / 1000
    found = frequency_counting(time, 10.0 * time[:, None], COUNTS)
    assert found[0] == 0.0
    assert np.abs(found[1:, 0] - 10.0).max() < 2 * np.pi / COUNTS / 1e-3
    with pytest.raises(ValueError, match="interval"):
        frequency_counting(time, time[:, None], COUNTS, interval=0.0)
