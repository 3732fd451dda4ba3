"""A comparison writes its folder, also where models diverge or cannot be exported."""

import dataclasses
import json
import logging
from pathlib import Path

import numpy as np
import pytest

from nfriction import NCFM, PendulumChain, Recording
from nfriction.cli.tables import error_tables
from nfriction.evaluation import results
from nfriction.evaluation.compare import Comparison
from nfriction.evaluation.cross_validation import Candidate, Selection
from nfriction.evaluation.score import RMSE, Score
from nfriction.export import ExportError
from nfriction.fitting.fit import fit

TIME = 2e-3 * np.arange(200)


@pytest.fixture(scope="module")
def recording() -> Recording:
    q = np.pi + 0.5 * np.exp(-0.3 * TIME) * np.cos(8 * TIME)
    return Recording(time=TIME, q=q[:, None], name="r")


def scored(rmse: float) -> Score:
    error = RMSE((rmse,), rmse)
    return Score("r", error, {"1": error}, None, TIME, np.zeros((len(TIME), 1)), np.inf)


@pytest.fixture(scope="module")
def comparison(recording: Recording) -> Comparison:
    """One model that predicts and one that diverges."""
    plant = PendulumChain(mass=[0.15], com=[0.15], length=[0.3], inertia=[1e-4])
    found = fit(NCFM(1), plant, recording, method="equation_error")
    scores = {"no friction": [scored(0.2)], "good": [scored(0.1)], "wild": [scored(np.inf)]}
    fits = {"good": found, "wild": found}
    return Comparison(fits, scores, {}, unit="rad", joint_names=("joint1",))


def test_divergence_is_null_and_stops_no_other_model(
    comparison: Comparison, recording: Recording, tmp_path: Path
) -> None:
    written = results.write_results(comparison, [recording], [], tmp_path, figures=False)
    assert all(path.is_file() for path in written)
    assert {p.name for p in written} >= {"table.csv", "results.json", "good.json", "wild.pt"}
    found = json.loads((tmp_path / "results.json").read_text(), parse_constant=pytest.fail)
    assert found["models"]["wild"]["train"]["r"]["free_run"] == {"joints": [None], "all": None}
    assert found["models"]["good"]["train"]["r"]["free_run"]["all"] == 0.1
    assert found["recordings"]["train"] == {"r": recording.digest()}
    rows = {line.split()[0]: line for line in error_tables(comparison).splitlines() if line.strip()}
    assert "diverged" in rows["wild"]
    assert "diverged" not in rows["good"]


def test_no_digest_is_lost_where_names_repeat_or_lack(recording: Recording) -> None:
    others = [dataclasses.replace(recording, q=recording.q + k, name=name)
              for k, name in enumerate(("r", "", "", "s"), 1)]  # fmt: skip
    told = results.digests([recording, *others])
    assert list(told) == ["r (1)", "r (2)", "recording (3)", "recording (4)", "s"]
    assert list(told.values()) == [r.digest() for r in (recording, *others)]
    assert set(results.digests([recording])) == {"r"}


def test_input_ranges_are_those_of_the_motion(comparison: Comparison, recording: Recording) -> None:
    info = results.model_info(comparison.fits["good"], [recording])
    (motion,) = comparison.fits["good"].motions
    assert info.input_ranges["qd"] == [[motion.qd.min(), motion.qd.max()]]
    assert info.sample_time == pytest.approx(2e-3)
    assert info.training_data == {"r": recording.digest()}


@pytest.mark.parametrize(("factors", "told"), [((1.0, 1.01, 0.99), 2e-3), ((1.0, 2.0), None)])
def test_one_sample_time_is_told_where_recordings_share_it(
    comparison: Comparison, recording: Recording, factors: tuple[float, ...], told: float | None
) -> None:
    several = [dataclasses.replace(recording, time=f * recording.time) for f in factors]
    assert results.model_info(comparison.fits["good"], several).sample_time == pytest.approx(told)


def test_a_failed_export_is_told_and_leaves_no_older_script(
    comparison: Comparison,
    recording: Recording,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    results.write_results(comparison, [recording], [], tmp_path, figures=False)

    def refuse(*_: object) -> Path:
        raise ExportError("it does not\nscript")

    monkeypatch.setattr(results, "torchscript", refuse)
    with caplog.at_level(logging.WARNING):
        results.write_results(comparison, [recording], [], tmp_path, figures=False)
    assert caplog.messages[0] == "good was not exported: it does not script"
    assert not list(tmp_path.rglob("*.pt"))


def test_a_later_run_leaves_its_own_files_and_the_users(
    comparison: Comparison, recording: Recording, tmp_path: Path
) -> None:
    def files() -> set[str]:
        return {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*.*")}

    first = results.write_results(comparison, [recording], [], tmp_path)
    own = {p.relative_to(tmp_path).as_posix() for p in first}
    assert files() == own
    assert {"models/wild.pt", "figures/rmse_train.png"} < own
    listed = json.loads((tmp_path / "results.json").read_text())["files"]
    assert {*listed, "results.json"} == own
    foreign = {"notes.md", "models/mine.json", "figures/rmse_mine.png"}
    for name in foreign:
        (tmp_path / name).write_text("mine")
    fewer = dataclasses.replace(
        comparison,
        fits={"good": comparison.fits["good"]},
        train={n: s for n, s in comparison.train.items() if n != "wild"},
    )
    second = results.write_results(fewer, [recording], [], tmp_path, figures=False)
    left = {"results.json", "table.csv", "models/good.json", "models/good.pt"}
    assert {p.relative_to(tmp_path).as_posix() for p in second} == left
    assert files() == left | foreign


def test_no_list_of_files_leads_out_of_the_folder(
    comparison: Comparison, recording: Recording, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    (folder / "models").mkdir(parents=True)
    victims = [tmp_path / "a.json", folder / "models" / "deep" / "a.json", folder / "notes.txt"]
    for victim in victims:
        victim.parent.mkdir(exist_ok=True)
        victim.write_text("keep")
    listed = ["../a.json", "models/../../a.json", str(tmp_path / "a.json"), "models/deep/a.json",
              "notes.txt", "models/\n.json", ".", "", None, {}, ["x"]]  # fmt: skip
    for content in ({"files": listed}, {"files": "models/a.json"}, [], "[", {"files": None}):
        text = content if isinstance(content, str) else json.dumps(content)
        (folder / "results.json").write_text(text)
        assert results.files_of(folder) == []
        results.write_results(comparison, [recording], [], folder, figures=False)
    assert all(victim.read_text() == "keep" for victim in victims)


def test_a_choice_is_kept_with_the_results(
    comparison: Comparison, recording: Recording, tmp_path: Path
) -> None:
    chosen = Selection("LFM", "so", (Candidate("LFM", (1e-3, np.inf), 2, True),), 1.0, "rad")
    for selection in (chosen, None):
        results.write_results(
            comparison, [recording], [], tmp_path, selection=selection, figures=False
        )
        found = json.loads((tmp_path / "results.json").read_text(), parse_constant=pytest.fail)
        assert found["selection"] == (None if selection is None else selection.to_dict())


def test_figures_that_fail_leave_nothing_half_drawn(
    comparison: Comparison, recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(_: object, __: object, folder: str) -> list[Path]:
        (Path(folder) / "half.png").write_bytes(b"\x89")
        raise KeyboardInterrupt

    monkeypatch.setattr("nfriction.plots.save_all", half)
    with pytest.raises(KeyboardInterrupt):
        results.write_results(comparison, [recording], [], tmp_path)
    assert not list(tmp_path.rglob("*.png"))
    assert not list(tmp_path.glob(".*"))
