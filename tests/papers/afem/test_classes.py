"""Acceleration classes are recovered, and missing data are named."""

import numpy as np
import pytest
import torch

from nfriction import Recording
from nfriction.papers.afem.adaptive import ALFM
from nfriction.papers.afem.classes import ClassOptions, class_intervals, find_classes, otsu
from nfriction.signals import Motion

STEP = 2e-3
JOINTS = ("a", "b")


def swinging(*sections, seed=0, name="swing"):
    """Motion of two joints whose accelerations have given amplitudes for given times [s]."""
    sizes = np.concatenate([np.full(round(t / STEP), size) for t, size in sections])
    time = STEP * np.arange(len(sizes))
    qdd = np.stack([sizes * np.sin(7.0 * time + seed), 0.5 * sizes * np.cos(9.0 * time)], -1)
    qd, q = qdd / 8.0, qdd / 64.0
    return Recording(time, q, name=name), Motion(time, q, qd, qdd)


def found_in(*pieces, **settings):
    schedule = ALFM(2, time_constant=0.5).schedule
    recordings, motions = zip(*pieces, strict=True)
    return schedule, find_classes(schedule, recordings, motions, JOINTS, ClassOptions(**settings))


DYING = ((6.0, 200.0), (8.0, 30.0), (16.0, 3.0))


def test_decaying_motion_passes_all_classes_in_time():
    recording, motion = swinging(*DYING)
    schedule, classes = found_in((recording, motion))
    assert classes.notes == ()
    assert (classes.stands_for == torch.arange(3)).all()
    for j, scale in enumerate((1.0, 0.5)):
        low, high = schedule.thresholds[j].tolist()
        assert 3.0 * scale < low < 30.0 * scale < high < 200.0 * scale
        # An acceleration that starts at zero is not known to be high before its first peak.
        intervals = [
            (known, start, end)
            for known, start, end in class_intervals(
                recording.time, classes.labels[0][:, j].numpy()
            )
            if end > 0.3
        ]
        assert [known for known, _, _ in intervals] == ["high", "medium", "low"]
        # The memory decays within a few of its time constants, and never looks ahead.
        ends = [end for _, _, end in intervals]
        assert 6.0 <= ends[0] < 8.0
        assert 14.0 <= ends[1] < 16.0
    assert schedule.sample_time == pytest.approx(STEP)


def test_given_intervals_are_used_and_separated_by_their_thresholds():
    given = {"swing": {"a": [("high", 0, 7), ("medium", 7, 14), ("low", 14, 25)],
                       "b": [("low", 0, 1.3), ("high", 1.3, 6), ("low", 14, 30)]}}  # fmt: skip
    recording, motion = swinging(*DYING)
    schedule, classes = found_in((recording, motion), intervals=given)
    labels = classes.labels[0]
    at = {t: labels[round(t / STEP)].tolist() for t in (0.5, 5.0, 13.0, 29.0)}
    # Outside every interval the nearest one applies.
    assert at == {0.5: [2, 0], 5.0: [2, 2], 13.0: [1, 0], 29.0: [0, 0]}
    known = schedule.classes(torch.as_tensor(motion.qd), torch.as_tensor(motion.qdd))
    assert float((known[:, 0] == labels[:, 0]).double().mean()) > 0.9
    for wrong in (
        {"other": given["swing"]},
        {"swing": {"a": given["swing"]["a"]}},
        {"swing": {**given["swing"], "b": [("tall", 0, 1)]}},
        {"swing": {**given["swing"], "b": [("low", 2, 1)]}},
    ):
        with pytest.raises(ValueError, match="interval"):
            found_in((recording, motion), intervals=wrong)


def test_given_thresholds_are_kept():
    schedule, _ = found_in(swinging(*DYING), thresholds=[[10.0, 100.0], [5.0, 50.0]])
    assert schedule.thresholds.tolist() == [[10.0, 100.0], [5.0, 50.0]]


def test_class_with_little_data_uses_its_neighbours_coefficients():
    _, classes = found_in(swinging((0.2, 200.0), (10.0, 30.0), (10.0, 3.0)),
                          thresholds=[10.0, 60.0])  # fmt: skip
    assert classes.stands_for[0].tolist() == [0, 1, 2]
    _, strict = found_in(swinging((0.2, 200.0), (10.0, 30.0), (10.0, 3.0)),
                         thresholds=[10.0, 60.0], least=3.0)  # fmt: skip
    assert strict.stands_for[0].tolist() == [0, 1, 1]
    assert any("high class of a" in note and "of medium" in note for note in strict.notes)


def test_motion_without_variation_is_refused():
    with pytest.raises(ValueError, match="hardly varies"):
        found_in(swinging((10.0, 50.0)))


def test_sample_times_must_agree():
    other = Recording(1e-3 * np.arange(100), np.zeros((100, 2)), name="fine")
    still = Motion(other.time, other.q, other.q, other.q)
    with pytest.raises(ValueError, match="sample time"):
        found_in(swinging(*DYING), (other, still))


def test_otsu_separates_three_clusters():
    random = np.random.default_rng(0)
    heaps = [random.normal(centre, 0.1, 500) for centre in (0.0, 1.0, 4.0)]
    low, high = otsu(np.concatenate(heaps))
    assert 0.3 < low < 0.7
    assert 1.3 < high < 3.7
