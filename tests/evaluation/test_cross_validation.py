"""Choice of a law by error on hold-out blocks; the simpler law if there is no clear difference."""

import math
import warnings
from itertools import pairwise

import numpy as np
import pytest

from nfriction import LFM, NCFM, fit
from nfriction.evaluation.cross_validation import (
    Candidate,
    Selection,
    blocked_k_fold,
    choose,
    select,
)
from nfriction.recording import RecordingWarning
from tests.fitting.recordings import pendulum, swing


def candidate(name, errors, parameters):
    return Candidate(name, tuple(errors), parameters, True)


def test_the_least_error_is_chosen():
    name, reason = choose([candidate("A", (3, 3, 3), 1), candidate("B", (1, 1, 1), 9)])
    assert name == "B"
    assert "A follows" in reason


def test_tie_is_decided_for_the_simpler_model():
    simple, rich = candidate("A", (1.01, 1.0, 1.0), 1), candidate("B", (1, 1, 1), 9)
    name, reason = choose([rich, simple])
    assert name == "A"
    assert "fewer parameters" in reason


def test_difference_in_a_single_block_is_a_tie():
    """The mean differs by at most its standard error over blocks."""
    simple, rich = candidate("A", (1.0, 1.0, 3.0), 1), candidate("B", (1.0, 1.0, 1.0), 9)
    assert choose([simple, rich])[0] == "A"
    steady = candidate("A", (1.4, 1.5, 1.6), 1)
    assert choose([steady, rich])[0] == "B"


def test_one_outlying_block_does_not_hide_a_consistently_worse_model():
    """The single pendulum's nine blocks: two have far larger swings than the training data."""
    simple = candidate("A", (2.24, 2.98, 6.36, 5.02, 2.33, 1.87, 4.16, 4.63, 3.34), 1)
    rich = candidate("B", (7.25, 1.77, 2.85, 6.35, 1.3, 1.22, 0.91, 2.04, 1.29), 5)
    name, reason = choose([simple, rich])
    assert name == "B"
    assert "A follows" in reason
    # As many blocks are better as worse, which proves nothing.
    mixed = candidate("A", (7.9, 1.9, 2.6, 6.3, 1.2, 1.3, 1.0, 1.9, 1.4), 1)
    assert choose([mixed, rich])[0] == "A"


def test_diverging_model_is_not_chosen():
    lost, fine = candidate("A", (math.inf, 1.0), 1), candidate("B", (5.0, 5.0), 9)
    assert choose([lost, fine])[0] == "B"
    assert choose([lost])[0] == "A"


def test_repr_shows_the_choice_and_every_candidate():
    candidates = (candidate("A", (3e-3, 4e-3), 1), candidate("B", (math.inf,), 9))
    found = Selection("A", "so it is.", candidates, 2.0, "rad")
    head, _, *rows = repr(found).splitlines()
    assert head == "Selection of A: so it is."
    assert [row.split()[0] for row in rows] == ["A", "B"]
    table = found.to_frame()
    assert table.loc["A", "error [rad]"] == pytest.approx(math.sqrt(12.5) * 1e-3)
    assert list(table.loc["B"]) == [math.inf, 9, True]


def by_torque(model, plant, recordings, *, motions, start, **_):
    return fit(model, plant, recordings, motions=motions, method="equation_error")


def test_a_model_that_fails_in_a_fold_counts_as_diverged(monkeypatch):
    def fragile(model, *args, motions, **settings):
        if isinstance(model, LFM) and motions[0].time[0] > 0:
            raise ValueError("nothing to be learnt")
        return by_torque(model, *args, motions=motions, **settings)

    monkeypatch.setattr("nfriction.evaluation.parallel.fit", fragile)
    recording = swing(pendulum(), NCFM(2, [[2e-3], [1e-3]]), seconds=1.0)
    found = select(pendulum(), ["NCFM", "LFM"], [recording], folds=2)
    assert found.chosen == "NCFM"
    failed = found.candidates[1]
    assert sum(map(math.isinf, failed.errors)) == 1
    assert not failed.converged


def test_blocks_cover_a_recording_and_share_their_end_samples():
    recording = swing(pendulum(), LFM(2, [1e-3, 1e-3], v_smooth=0.05), seconds=1.0)
    folds = blocked_k_fold(pendulum(), recording, 3)
    blocks = [fold.test for fold in folds]
    assert blocks[0].recording.time[0] == recording.time[0]
    assert blocks[-1].recording.time[-1] == recording.time[-1]
    for before, after in pairwise(blocks):
        assert before.recording.time[-1] == after.recording.time[0]
    for k, (block, rest) in enumerate(folds):
        shared = np.intersect1d(block.recording.time, rest.recording.time)
        assert len(shared) == (2 if k == 1 else 1)
        assert len(rest.recording) + len(block.recording) == len(recording) + len(shared)
        assert len(rest.recording.segments) == (2 if k == 1 else 1)
        for part in (block, rest):
            np.testing.assert_array_equal(part.motion.time, part.recording.time)


def test_fold_does_not_use_its_hold_out_data(monkeypatch):
    """With two recordings, each fold misses a different segment of each."""
    folds = []

    def watched(plant, names, parts, **_):
        folds.extend(parts.values())
        raise InterruptedError

    monkeypatch.setattr("nfriction.evaluation.cross_validation.fit_models", watched)
    recordings = [
        swing(pendulum(), NCFM(2, [[1e-3]] * 2), seconds=1.0),
        swing(pendulum(), NCFM(2, [[2e-3]] * 2), seconds=1.0),
    ]
    with pytest.raises(InterruptedError):
        select(pendulum(), ["NCFM"], recordings, folds=3)
    assert len(folds) == 3
    missing = []
    for seen in folds:
        for whole, part in zip(recordings, seen.recordings, strict=True):
            out = np.setdiff1d(whole.time, part.time)
            assert 0.3 < np.ptp(out) < 0.35
            missing.append(out[0])
    assert len(set(missing)) == 3
    assert all(a != b for a, b in zip(missing[::2], missing[1::2], strict=True))


def test_recordings_with_gaps_are_scored_between_the_gaps(monkeypatch):
    whole = swing(pendulum(), NCFM(2, [[2e-3], [1e-3]]), seconds=2.0)
    recording = whole[(whole.time < 0.4) | (whole.time > 0.8)]
    monkeypatch.setattr("nfriction.evaluation.parallel.fit", by_torque)
    found = select(pendulum(), ["NCFM"], [recording], folds=2)
    assert found.horizon < 0.8
    assert all(map(math.isfinite, found.candidates[0].errors))


def test_remaining_parts_of_a_recording_cause_no_warnings():
    recording = swing(pendulum(), NCFM(2, [[1e-3]] * 2), seconds=1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RecordingWarning)
        middle = blocked_k_fold(pendulum(), recording, 3)[1].train
        assert len(middle.recording.joint_coordinates(pendulum()).segments) == 2


def test_bad_input_is_refused():
    recording = swing(pendulum(), NCFM(2, [[1e-3]] * 2), seconds=0.4)
    for arguments, message in (
        ((["NCFM"], [recording], 1), "2 folds"),
        (("NCFM", recording, 2.5), "1 models, 1 recordings and 2.5 folds"),
        (([], [recording], 2), "0 models"),
        ((["NCFM"], [recording], 3), "too few"),
    ):
        models, recordings, folds = arguments
        with pytest.raises(ValueError, match=message):
            select(pendulum(), models, recordings, folds=folds)
    with pytest.raises(ValueError, match=r"`horizon` must be a positive length .* got -1\.0"):
        select(pendulum(), "NCFM", recording, folds=2, horizon=-1.0)


@pytest.mark.slow
def test_true_law_is_chosen():
    """Dry friction is not viscous, and for viscous friction a Coulomb coefficient does not pay."""
    settings = {"folds": 2, "fit_plant": False, "windows": (0.5,)}
    dry = swing(pendulum(), LFM(2, [[1e-5, 3e-3], [1e-5, 2e-3]], v_smooth=0.05), seconds=4.0)
    found = select(pendulum(), ["NCFM", "LFM"], [dry], **settings)
    assert found.chosen == "LFM"
    assert found.to_dict()["candidates"]["LFM"]["error"] > 0
    wet = swing(pendulum(), NCFM(2, [[2e-3], [1e-3]]), seconds=4.0)
    assert select(pendulum(), ["NCFM", "LFM"], [wet], **settings).chosen == "NCFM"
