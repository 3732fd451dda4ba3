"""Tables from results: their arithmetic, and the order that the papers report."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from nfriction.papers.reproduction import page, tables
from nfriction.papers.reproduction.stages import LAWS, SECOND_PAPER, stages
from nfriction.papers.reproduction.workspace import QUICK, Workspace

CONTROL = ("still", "follow", "swing-up", "three links")
EVERY = [name for name in stages() if name != "control" and not name.startswith("twin")]


def entry(error: float | None, split: str) -> dict[str, Any]:
    scales = (1.0, 2.0, 3.0)
    joints = [None if error is None else error * k for k in scales]
    of = {"joints": joints, "all": error}
    driven = {"joints": [None if e is None else 0.5 * e for e in joints], "all": error}
    return {"split": split, "free_run": of, "measured_drive": driven, "windows": {"1": of}}


def workspace(folder: Path, errors: Mapping[str, float | None]) -> Workspace:
    """All stages complete, with errors by model (1 by default) on one of two test runs."""
    made = Workspace(folder, QUICK)
    for name in stages():
        names = tables.SECOND_COEFFICIENTS.get(name.removeprefix("rtip-"), {})
        made.finish(
            name,
            {
                "scores": {
                    "a": entry(9.0, "train"),
                    "b": entry(errors.get(name, 1.0), "test"),
                    "c": entry(0.0, "test"),
                },
                "fresh": [entry(errors.get(name, 1.0), "test")["free_run"]["joints"]] * 3,
                "coefficients": {k: [1.0, 2.0, 3.0] for k in names},
                "classes": {"low": {"B": [1.0, 2.0, 3.0]}, "high": {"B": [4.0, 5.0, 6.0]}},
                "intervals": [[["high", 0.0, 7.5], ["low", 7.5, 40.0]]] * 3,
                "tables": {task: {"none": {"power [W]": None}} for task in CONTROL},
                "fit": {"status": "ended", "converged": name != "ALFM"},
                "missed_torque": {"speed": 0.25, "speed and acceleration": 0.125},
            },
        )
    return made


def test_an_error_over_recordings_is_their_root_mean_square(tmp_path: Path) -> None:
    found = tables.rmse(workspace(tmp_path, {"NCFM": 2.0}), ["NCFM"])
    np.testing.assert_allclose(found.loc["NCFM"], np.array([2.0, 4.0, 6.0]) / np.sqrt(2))
    train = tables.rmse(workspace(tmp_path, {}), ["NCFM"], split="train")
    np.testing.assert_allclose(train.loc["NCFM"], [9.0, 18.0, 27.0])


def test_diverged_runs_have_infinite_error(tmp_path: Path) -> None:
    made = workspace(tmp_path, {"NFLFM": None})
    assert np.isinf(tables.rmse(made, ["NFLFM"]).to_numpy()).all()
    assert not tables.order(made).holds


def test_table_10_is_compared_with_the_printed_one(tmp_path: Path) -> None:
    made = workspace(tmp_path, {})
    table, measured = tables.table_10(made), tables.table_10(made, "measured_drive")
    assert len(table) == 16
    for name, row in tables.TABLE_10.items():
        assert list(table["printed"].loc[name]) == row
    assert table["printed"].loc["LFM"].isna().all()
    pd.testing.assert_frame_equal(2 * measured["ours"], table["ours"])


def test_table_11_compares_the_best_model_with_every_other(tmp_path: Path) -> None:
    table = tables.table_11(workspace(tmp_path, {"NFNLFM": 0.25}))
    np.testing.assert_allclose(table["ours"], 75.0)
    printed = table["printed"].dropna()
    # 11.56 to 94.55 % in the paper's text.
    assert printed.to_numpy().min() == pytest.approx(11.57, abs=0.01)
    assert printed.to_numpy().max() == pytest.approx(94.55, abs=0.005)
    assert list(printed.index) == ["ANCFM", "ALFM", "ANLFM", "NFNCFM", "NFLFM"]


def test_tables_6_to_9_contain_the_classes(tmp_path: Path) -> None:
    made = workspace(tmp_path, {})
    table = tables.table_6(made)
    assert list(table["ours"].loc["joint 3, 1"]) == ["high", 0.0, 7.5]
    assert list(table["printed"].loc["joint 4, 4"]) == ["low", 13.0, 30.0]
    assert table["ours"].loc["joint 4, 4"].isna().all()
    assert list(table.index) == sorted(table.index)
    by_class = tables.adaptive_coefficients(made, "LFM")
    for method in ("pattern search", "Gauss-Newton"):
        assert tuple(by_class[method].loc["B, high"]) == (4.0, 5.0, 6.0)


def test_fits_that_did_not_converge_are_named_at_the_end(tmp_path: Path) -> None:
    lines = page.text(workspace(tmp_path, {})).splitlines()
    assert "1 of 19 fits did not converge (ALFM)" in lines[-1]
    assert any(line.split() == ["NFLFM-papers", "ended"] for line in lines)


def test_improvement_by_each_step_within_a_law(tmp_path: Path) -> None:
    table = tables.steps_saved(workspace(tmp_path, {"NFLFM": 0.25}))
    np.testing.assert_allclose(table["ours"].loc["NFLFM against ALFM"], 75.0)
    np.testing.assert_allclose(table["ours"].loc["ANCFM against NCFM"], 0.0, atol=1e-12)
    theirs = tables.TABLE_10
    expected = 100 * (1 - np.array(theirs["NFLFM"]) / np.array(theirs["ALFM"]))
    np.testing.assert_allclose(table["printed"].loc["NFLFM against ALFM"], expected)


def test_tables_of_the_second_paper(tmp_path: Path) -> None:
    made = workspace(tmp_path, dict.fromkeys(SECOND_PAPER, 3.0))
    for law in LAWS:
        table = tables.second_coefficients(made, law)
        assert list(table.index) == list(tables.SECOND_COEFFICIENTS[law])
        assert tuple(table["ours"].iloc[0]) == (1.0, 2.0, 3.0)
    assert tuple(tables.second_table_4(made)["printed"].loc["LFM"]) == (0.0049, 0.0065, 0.0079)


@pytest.mark.parametrize("law", LAWS)
def test_order_accepts_ties_and_reports_violations(tmp_path: Path, law: str) -> None:
    errors = {law: 3.0, f"A{law}": 2.0, f"NF{law}": 1.0}
    nine = {name: errors.get(name, 2.5) for name in tables.NINE}
    found = tables.order(workspace(tmp_path, nine))
    assert found.holds
    assert set(found.best.values()) == {f"NF{law}"}
    tied = tables.order(workspace(tmp_path, nine | {f"A{law}": 1.0}))
    assert tied.holds
    assert set(tied.best.values()) == {f"A{law} = NF{law}"}
    rounded = tables.order(workspace(tmp_path, nine | {f"A{law}": 1.0 - 1e-12}))
    assert rounded.holds
    assert rounded.best == tied.best
    worse = tables.order(workspace(tmp_path, nine | {f"A{law}": 4.0}))
    assert len(worse.broken) == 3  # on every joint
    assert all(f"A{law}" in text for text in worse.broken)


def test_everything_is_written_and_printed(tmp_path: Path) -> None:
    made = workspace(tmp_path, {"NFNLFM": 0.5, "LFM": None})
    written = page.write_tables(made, command="a command")
    assert all(path.stat().st_size for path in written)
    results = json.loads((tmp_path / "results.json").read_text())
    assert set(results["stages"]) == set(stages())
    long = pd.read_csv(tmp_path / "rmse.csv")
    # Models, recordings, kinds of error (two drives and one window), joints and all of them.
    assert len(long) == len(EVERY) * 3 * 3 * 4
    text = page.text(made)
    for name in (*tables.NINE, "Table 11", "Table IV", "how the fits ended"):
        assert name in text
