"""Comparisons: every model fitted and scored, tables with names, results as plain JSON."""

import json

import pytest

from nfriction import LFM, compare
from tests.fitting.recordings import pendulum, swing

MODEL = LFM(2, [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]], v_smooth=0.05)
A, B = (swing(pendulum(), MODEL, seconds=1.5, start=s, name=n)
        for s, n in (((1.6, 0.8), "a"), ((2.0, 0.2), "b")))  # fmt: skip


@pytest.fixture(scope="module")
def comparison():
    stages = []
    found = compare(pendulum(), ["NCFM", "LFM", "NCFM"], [A], [B], horizons=(0.5, 1.0),
                    on_stage=stages.append, windows=(0.5,), max_steps=3)  # fmt: skip
    return found, stages


def test_tables_have_a_row_a_model_and_a_column_a_joint(comparison):
    found, stages = comparison
    for horizon in (None, "0.5", "1"):
        for held_out in (True, False):
            table = found.table(horizon, held_out=held_out)
            assert list(table.index) == ["no friction", "NCFM", "LFM"]
            assert list(table.columns) == [*found.joint_names, "all"]
            assert (table > 0).all().all()
    assert found.horizons() == ["0.5", "1"]
    saved = found.improvement()
    assert (saved.loc["no friction"] == 0).all()
    assert (saved.loc["LFM"] > 0).all()
    assert stages[:2] == ["fit NCFM", "fit LFM"]


def test_results_are_plain_json_with_the_names_others_rely_on(comparison):
    found, _ = comparison
    data = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert data["units"] == "rad"
    lfm = data["models"]["LFM"]
    assert set(lfm["coefficients"]) == {"B", "C"}
    for kind, name in (("held_out", "b"), ("train", "a")):
        scores = lfm[kind][name]
        assert set(scores["windows"]) == {"0.5", "1"}
        for rmse in (scores["free_run"], *scores["windows"].values()):
            assert len(rmse["joints"]) == 2
            mean = sum(x * x for x in rmse["joints"]) / 2
            assert rmse["all"] == pytest.approx(mean**0.5)
    assert "coefficients" not in data["models"]["no friction"]


def test_names_must_tell_recordings_apart():
    with pytest.raises(ValueError, match="a repeats"):
        compare(pendulum(), ["NCFM"], [A], [A])
    with pytest.raises(ValueError, match="at least one"):
        compare(pendulum(), [], [A])
    with pytest.raises(ValueError, match="there are"):
        compare(pendulum(), ["NOPE"], [A])


def test_without_held_out_recordings_there_is_no_such_table(comparison):
    found = compare(pendulum(), ["NCFM"], [A], horizons=(0.5,), windows=(0.5,), max_steps=1)
    assert found.table(held_out=False).shape == (2, 3)
    with pytest.raises(ValueError, match="held_out"):
        found.table()
    assert set(found.to_dict()["models"]) == {"no friction", "NCFM"}
