"""Windows cover recordings, restart at their own samples, and are padded with zero weight."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nfriction import (
    CVFM,
    FrictionEstimator,
    PendulumChain,
    Recording,
    compare,
    fit,
    plots,
    rollout,
    score,
)
from nfriction.fitting.data.inputs import released
from nfriction.fitting.data.windows import cut_windows
from nfriction.signals import Motion, quantise
from tests.fitting.recordings import one_link, swing


def made(samples, seed=0, tau=False):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(5e-3, 15e-3, samples))
    q = rng.normal(size=(samples, 2))
    recording = Recording(time, q, tau=rng.normal(size=(samples, 2)) if tau else None)
    return recording, Motion(time, q + 0.1, q + 0.2, q + 0.3)


@pytest.mark.parametrize("length", [0.1, 0.5, 0.77, 100.0])
def test_windows_cover_the_recording_without_gaps(length):
    recording, motion = made(301, tau=True)
    w = cut_windows([recording], [motion], length)
    steps = w.weight.sum(1).to(torch.int64) - 1
    assert int(steps.sum()) == 300
    assert int(steps.max() - steps.min()) <= 1
    first = 0
    for i, n in enumerate(steps.tolist()):
        part = slice(first, first + n + 1)
        np.testing.assert_array_equal(w.q[i, : n + 1], recording.q[part])
        np.testing.assert_array_equal(w.tau[i, :n], recording.tau[part][:-1])
        np.testing.assert_allclose(w.step[i, :n], np.diff(recording.time[part]))
        np.testing.assert_array_equal(w.q0[i], motion.q[first])
        np.testing.assert_array_equal(w.qd0[i], motion.qd[first])
        assert not w.step[i, n:].any()
        assert not w.weight[i, n + 1 :].any()
        assert torch.isfinite(w.q).all()
        first += n
    span = float(w.step.sum())
    assert span == pytest.approx(recording.duration)
    if length < span:
        assert span / len(w) == pytest.approx(length, rel=0.35)


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_final_rest_of_a_recording_is_in_no_window(noise):
    time = np.arange(500) * 0.01
    away = np.where(time < 3.0, np.cos(7 * time), np.cos(21.0))
    smooth = np.stack([away, 0.3 + 0 * time], 1)
    read = smooth + noise * np.random.default_rng(0).normal(size=smooth.shape)
    rest = np.arange(500) >= 300
    for moving, last in ((smooth, 300), (smooth[rest], 199)):
        at = slice(500 - len(moving), None)
        recording, motion = Recording(time[at], read[at]), Motion(time[at], moving, moving, moving)
        w = cut_windows([recording], [motion], 0.5)
        # This includes recordings without any motion, whose joints are named elsewhere.
        assert w.spans[-1][2] == pytest.approx(last, abs=2)


def test_rest_away_from_the_equilibrium_does_not_bias_the_friction():
    """It creeps under a smoothed sign, which more friction would reduce."""
    plant = PendulumChain([0.5], [0.4], com=[0.2], inertia=[0.004])
    truth = CVFM(1, [[0.04, 0.0008]]).requires_grad_(False)
    recordings = []
    for angle in (2.3, -2.05):
        q0 = torch.tensor([np.pi + angle], dtype=torch.float64)
        run = rollout(plant, truth, q0, 0 * q0, sample_time=5e-3, steps=2200, substeps=4,
                      scheme="time_stepping")  # fmt: skip
        recordings.append(Recording(run.time.numpy(), quantise(run.q.numpy(), 4096)))
    found = fit("CVFM", plant, recordings, windows=(0.3,), drag=False, fit_plant=False)
    for interval, true in zip(found.intervals, (0.04, 0.0008), strict=True):
        assert interval.low < true < interval.high


def test_subset_keeps_the_data_of_its_windows():
    recording, motion = made(301, tau=True)
    w = cut_windows([recording], [motion], 0.5)
    chosen = torch.arange(len(w)) % 2 == 0
    some = w.subset(chosen)
    assert len(some) == int(chosen.sum())
    assert some.spans == w.spans[::2]
    for name in ("q", "tau", "step", "weight", "q0", "qd0"):
        assert torch.equal(getattr(some, name), getattr(w, name)[::2])


def still(samples=301, slope=0.0):
    """Two recordings; the first moves at once by `slope` [rad/s], and both do later on."""
    time = np.linspace(0.0, 3.0, samples)
    parts = []
    for rate in (slope, 0.0):
        q = 0.2 + np.stack([rate * time + 0.3 * time**3, -0.1 * time**2], 1)
        motion = Motion(time, q + 0.1, np.gradient(q, time, axis=0) + 0.2, np.zeros_like(q))
        parts.append((Recording(time, q), motion))
    return zip(*parts, strict=True)


def test_recordings_that_begin_at_rest_start_at_the_encoder_reading():
    recordings, motions = still()
    smoothed = cut_windows(recordings, motions, 1.0)
    w = cut_windows(recordings, motions, 1.0, rest_speed=0.3)
    assert smoothed.at_rest == ()
    # The first window of each.
    assert w.at_rest == (0, 3)
    for i in range(len(w)):
        if i in w.at_rest:
            assert torch.equal(w.q0[i], w.q[i, 0])
            assert not w.qd0[i].any()
        else:
            assert torch.equal(w.q0[i], smoothed.q0[i])
            assert torch.equal(w.qd0[i], smoothed.qd0[i])
    assert w.subset(torch.arange(len(w)) > 1).at_rest == (1,)


def test_motion_from_the_first_sample_is_not_rest():
    recordings, motions = still(slope=1.0)
    w = cut_windows(recordings, motions, 1.0, rest_speed=0.3)
    assert w.at_rest == (3,)
    np.testing.assert_array_equal(w.qd0[0], motions[0].qd[0])


def test_several_recordings_share_one_stack():
    parts = [made(100, 1), made(30, 2, tau=True)]
    w = cut_windows([r for r, _ in parts], [m for _, m in parts], 0.3)
    places = [place for place, *_ in w.spans]
    assert places == sorted(places)
    first_short = places.index(1)
    assert not w.tau[:first_short].any()
    assert w.tau[first_short:].any()


def test_windows_too_short_for_a_step_are_refused():
    recording, motion = made(8)
    with pytest.raises(ValueError, match="too few"):
        cut_windows([recording], [motion], 1e-3)
    with pytest.raises(ValueError, match="positive"):
        cut_windows([recording], [motion], 0.0)


@pytest.mark.filterwarnings("ignore:.*has gaps")
@pytest.mark.parametrize("length", [0.3, 1.0, 100.0])
def test_windows_do_not_span_gaps(length):
    recording, motion = made(301)
    time = recording.time + 2.0 * (np.arange(301) > 120)
    w = cut_windows([Recording(time, recording.q)], [motion], length)
    assert float(w.step.max()) < 0.1
    assert int((w.weight.sum(1) - 1).sum()) == 299
    assert [span for span in w.spans if span[1] <= 120 < span[2]] == []


@pytest.mark.parametrize("held", [0.1, 1.0])
def test_a_free_motion_is_used_from_its_release(held):
    """Before it, a hand holds the link: friction cannot hold a link that moves later."""
    plant = one_link()
    whole = swing(plant, CVFM(1, [5e-3, 1e-3]), seconds=2.0)
    rows = np.r_[np.zeros(round(held / 2e-3), int), 0 : len(whole)]
    late = Recording(2e-3 * np.arange(len(rows)), whole.q[rows], convention=whole.convention)
    with pytest.warns(UserWarning, match="has no torque, and rests for .* held or pushed"):
        (found,) = released([late])
    assert found.time[0] == pytest.approx(held, abs=0.02)
    assert released([found])[0] is found
    assert released([whole])[0] is whole
    # A drive may start later than the log.
    driven = replace(late, tau=np.ones_like(late.q))
    assert released([driven])[0] is driven


def test_hold_before_the_release_does_not_affect_fit_and_score():
    plant, truth = one_link(), CVFM(1, [5e-3, 1e-3])
    whole = swing(plant, truth, seconds=3.0)
    rows = np.r_[np.zeros(250, int), 0 : len(whole)]
    late = Recording(2e-3 * np.arange(len(rows)), whole.q[rows], convention=whole.convention)
    with pytest.warns(UserWarning, match="held or pushed"):
        found = fit("CVFM", plant, late, windows=(0.5,))
    expected = fit("CVFM", plant, whole, windows=(0.5,))
    torch.testing.assert_close(
        found.model.schedule.values, expected.model.schedule.values, rtol=0.02, atol=1e-5
    )
    scored = score(plant, truth, late, limit=False)
    assert scored.free_run.all < 2e-3
    # Aligned with the recording, for figures.
    assert scored.simulated.shape == late.q.shape
    assert np.isnan(scored.simulated[:240]).all()


@pytest.mark.filterwarnings("ignore:.*held or pushed")
def test_figures_and_estimators_accept_a_hold_before_the_release(tmp_path):
    plant = one_link()
    whole = swing(plant, CVFM(1, [5e-3, 1e-3]), seconds=2.0)
    rows = np.r_[np.zeros(500, int), 0 : len(whole)]
    time = 2e-3 * np.arange(len(rows))
    held = Recording(time, whole.q[rows], convention=whole.convention, name="held")
    settings = {"windows": (0.5,), "max_steps": 5}
    found = compare(plant, "CVFM", held, horizons=(0.5,), **settings)
    drawn = {path.stem for path in plots.save_all(found, [held], tmp_path)}
    assert {"positions_train_held", "torque_over_velocity"} <= drawn
    estimator = FrictionEstimator(plant, "CVFM", **settings).fit([held])
    assert len(estimator.simulate(held)) == len(held)
    assert -0.02 < estimator.score([held]) < 0.0


@pytest.mark.parametrize("start", [1e-3, 1e-2])
def test_a_slow_start_near_upright_is_no_hold(start):
    slow = swing(one_link(), CVFM(1, [1e-6, 1e-4]), seconds=4.0, start=(start,))
    assert released([slow])[0] is slow


def test_release_in_the_last_samples_is_ignored():
    time = 2e-3 * np.arange(500)
    late = Recording(time, np.maximum(0.0, time - time[-4])[:, None])
    assert released([late])[0] is late
