"""A comparison writes its folder, even if models diverge or cannot be exported."""

import dataclasses
import json
import logging
import os
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nfriction import NCFM, ModelInfo, PendulumChain, Recording
from nfriction.cli.tables import error_tables
from nfriction.evaluation import results
from nfriction.evaluation.compare import Comparison
from nfriction.evaluation.cross_validation import Candidate, Selection
from nfriction.evaluation.score import RMSE, Score
from nfriction.export import ExportError
from nfriction.fitting.fit import fit
from nfriction.report import RunError, read_run, write_report

TIME = 2e-3 * np.arange(200)


@pytest.fixture(scope="module")
def recording() -> Recording:
    q = np.pi + 0.5 * np.exp(-0.3 * TIME) * np.cos(8 * TIME)
    return Recording(time=TIME, q=q[:, None], name="r")


def scored(rmse: float) -> Score:
    error = RMSE((rmse,), rmse)
    return Score(error, {"1": error}, None, "r", TIME, np.zeros((len(TIME), 1)), np.inf)


@pytest.fixture(scope="module")
def comparison(recording: Recording) -> Comparison:
    """One model that predicts and one that diverges."""
    plant = PendulumChain(mass=[0.15], com=[0.15], length=[0.3], inertia=[1e-4])
    found = fit(NCFM(1), plant, recording, method="equation_error")
    scores = {"no friction": [scored(0.2)], "good": [scored(0.1)], "wild": [scored(np.inf)]}
    fits = {"good": found, "wild": found}
    return Comparison(fits, scores, {}, unit="rad", joint_names=("joint1",))


def test_divergence_is_null_and_does_not_stop_other_models(
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


def test_digests_are_kept_if_names_are_repeated_or_missing(recording: Recording) -> None:
    others = [dataclasses.replace(recording, q=recording.q + k, name=name)
              for k, name in enumerate(("r", "", "", "s"), 1)]  # fmt: skip
    digests = results.digests([recording, *others])
    assert list(digests) == ["r (1)", "r (2)", "recording (3)", "recording (4)", "s"]
    assert list(digests.values()) == [r.digest() for r in (recording, *others)]
    assert set(results.digests([recording])) == {"r"}


def test_input_ranges_are_those_of_the_motion(comparison: Comparison, recording: Recording) -> None:
    info = results.model_info(comparison.fits["good"], [recording])
    (motion,) = comparison.fits["good"].motions
    assert info.input_ranges["qd"] == [[motion.qd.min(), motion.qd.max()]]
    assert info.sample_time == pytest.approx(2e-3)
    assert info.training_data == {"r": recording.digest()}


@pytest.mark.parametrize(("factors", "expected"), [((1.0, 1.01, 0.99), 2e-3), ((1.0, 2.0), None)])
def test_sample_time_is_stored_only_if_recordings_share_it(
    comparison: Comparison, recording: Recording, factors: tuple[float, ...], expected: float | None
) -> None:
    several = [dataclasses.replace(recording, time=f * recording.time) for f in factors]
    assert results.model_info(comparison.fits["good"], several).sample_time == pytest.approx(
        expected
    )


def test_failed_export_is_logged_and_removes_the_older_script(
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


def test_later_run_keeps_only_its_own_and_the_users_files(
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


def test_listed_files_outside_the_folder_are_not_deleted(
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
        assert results.files_of(folder / "results.json") == []
        results.write_results(comparison, [recording], [], folder, figures=False)
    assert all(victim.read_text() == "keep" for victim in victims)


def test_choice_is_stored_with_the_results(
    comparison: Comparison, recording: Recording, tmp_path: Path
) -> None:
    chosen = Selection("LFM", "so", (Candidate("LFM", (1e-3, np.inf), 2, True),), 1.0, "rad")
    for selection in (chosen, None):
        results.write_results(
            comparison, [recording], [], tmp_path, selection=selection, figures=False
        )
        found = json.loads((tmp_path / "results.json").read_text(), parse_constant=pytest.fail)
        assert found["selection"] == (None if selection is None else selection.to_dict())


def run_ids(folder: Path) -> dict[str, str]:
    """Run id in each of our files; TorchScript is replaced by a stub."""
    ids = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".json":
            content = json.loads(path.read_text())
            ids[name] = content.get("run") or content["fit"]["run"]
        elif path.suffix == ".csv":
            ids[name] = path.read_text().splitlines()[1].split(",")[0]
        elif path.suffix in (".pt", ".html"):
            ids[name] = path.read_text().partition("run:")[2][:16]
    return {name: run for name, run in ids.items() if not name.startswith(".")}


@pytest.fixture
def quick_scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    def script(_: object, path: Path, info: ModelInfo) -> Path:
        path.write_text(f"run:{info.fit['run']}")
        return path

    monkeypatch.setattr(results, "torchscript", script)


@pytest.fixture
def other(comparison: Comparison) -> Comparison:
    """A later run with another score and one model fewer."""
    train = {"no friction": [scored(0.3)], "good": [scored(0.2)]}
    return dataclasses.replace(comparison, fits={"good": comparison.fits["good"]}, train=train)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that share what was fitted")
@pytest.mark.usefixtures("quick_scripts")
def test_a_kill_at_any_moment_never_mixes_two_runs(
    comparison: Comparison, other: Comparison, recording: Recording, tmp_path: Path
) -> None:
    def write(made: Comparison, folder: Path) -> str:
        results.write_results(made, [recording], [], folder, figures=False)
        return str(json.loads((folder / "results.json").read_text())["run"])

    def write_and_die(folder: Path, moment: int) -> int:
        """Exit status of a child that writes and is killed at its file operation of this number."""
        child = os.fork()
        if child:
            return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        left = moment

        def count(event: str, _: object) -> None:
            nonlocal left
            left -= event in ("os.rename", "os.remove", "os.mkdir", "os.rmdir")
            if left < 0 and event != "os.kill":
                os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(count)
        status = 1
        try:
            write(other, folder)
            status = 0
        finally:
            os._exit(status)

    second = write(other, tmp_path / "second")
    assert write(other, tmp_path / "again") == second  # equal results have equal ids
    ended = set()
    for moment in range(200):
        folder = tmp_path / str(moment)
        first = write(comparison, folder)
        assert first != second
        (folder / "notes.md").write_text("mine")
        (folder / "report.html").write_text(f'{results.REPORT_MARK.decode()}" run:{first}>')
        status = write_and_die(folder, moment)
        assert status in (-signal.SIGKILL, 0)
        found = run_ids(folder)
        assert len(set(found.values())) <= 1
        if "results.json" in found:
            listed = json.loads((folder / "results.json").read_text())["files"]
            assert {*listed} <= {*found}
        with results.exclusive(folder):
            pass
        found = run_ids(folder)
        assert set(found.values()) in ({first}, {second})
        assert ("models/wild.json" in found) == (first in found.values())
        assert ("report.html" in found) == (first in found.values())
        assert (folder / "notes.md").read_text() == "mine"
        assert not list(folder.glob(".*"))
        ended |= set(found.values())
        if status == 0:
            break
    else:
        pytest.fail("never came to the end")
    assert ended == {first, second}
    assert set(found.values()) == {second}


@pytest.mark.usefixtures("quick_scripts")
def test_ctrl_c_between_two_files_leaves_a_complete_run(
    comparison: Comparison, other: Comparison, recording: Recording, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    results.write_results(comparison, [recording], [], tmp_path, figures=False)
    replace = Path.replace

    def interrupt(path: Path, to: Path) -> Path:
        if path.suffix == ".pt" and path.parent.parent.name == results.COMPLETE:
            monkeypatch.undo()
            raise KeyboardInterrupt
        return replace(path, to)

    monkeypatch.setattr(Path, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        results.write_results(other, [recording], [], tmp_path, figures=False)
    found = run_ids(tmp_path)
    assert len(set(found.values())) == 1
    assert set(found) >= {"results.json", "table.csv", "models/good.json"}
    assert "models/wild.json" not in found
    assert not list(tmp_path.glob(".*"))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a second process")
@pytest.mark.usefixtures("quick_scripts")
def test_concurrent_writes_to_one_folder_are_refused(
    comparison: Comparison, recording: Recording, tmp_path: Path
) -> None:
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        with results.exclusive(tmp_path):
            os.write(writer, b"x")
            signal.pause()
    os.read(reader, 1)
    try:
        with pytest.raises(OSError, match="another process is writing"):
            results.write_results(comparison, [recording], [], tmp_path, figures=False)
        assert not list(tmp_path.glob("[!.]*"))
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    # The lock of a killed process is void.
    with results.exclusive(tmp_path):
        results.write_results(comparison, [recording], [], tmp_path, figures=False)
    assert not list(tmp_path.glob(".*"))


@pytest.mark.usefixtures("quick_scripts")
def test_a_report_of_two_runs_is_refused(
    comparison: Comparison, other: Comparison, recording: Recording, tmp_path: Path
) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    renamed = {"NCFM": comparison.fits["good"]}
    for made, folder in ((comparison, one), (other, two)):
        train = {"no friction": made.train["no friction"], "NCFM": made.train["good"]}
        made = dataclasses.replace(made, fits=renamed, train=train)
        results.write_results(made, [recording], [], folder)
        assert read_run(folder).id in (folder / "models/NCFM.pt").read_text()
    for name in ("models/NCFM.json", "figures/rmse_train.png"):
        mixed = tmp_path / "mixed" / name.replace("/", "-")
        shutil.copytree(two, mixed)
        read_run(mixed)
        shutil.copy(one / name, mixed / name)
        with pytest.raises(RunError, match=f"files of two runs: {name} .*run the comparison again"):
            read_run(mixed)


@pytest.mark.usefixtures("quick_scripts")
def test_names_are_not_spreadsheet_formulas_and_may_be_any_bytes(
    comparison: Comparison, recording: Recording, tmp_path: Path
) -> None:
    names = ["=cmd|' /C calc'!A0", "+1", "-1", "@SUM(1)", "\t=1", "＝1", "surr\udcff", "a=b"]
    recordings = [dataclasses.replace(recording, name=name) for name in names]
    train = {"no friction": [dataclasses.replace(scored(0.1), recording=n) for n in names]}
    fits = {"good": comparison.fits["good"]}
    made = dataclasses.replace(comparison, fits=fits, train=train | {"good": train["no friction"]})
    made = dataclasses.replace(made, joint_names=("=joint()",))
    results.write_results(made, recordings, [], tmp_path, figures=False)
    table = pd.read_csv(tmp_path / "table.csv")
    assert set(table.joint) == {"'=joint()", "all"}
    safe = [f"'{name}" for name in names[:6]]
    assert list(dict.fromkeys(table.recording)) == [*safe, "surr\\udcff", "a=b"]
    page = tmp_path / "report.html"
    write_report(tmp_path, page)
    assert "surr\\udcff" in page.read_text(encoding="utf-8")


def test_failed_figures_leave_no_partial_files(
    comparison: Comparison, recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(_: object, __: object, folder: Path, **___: object) -> list[Path]:
        folder.mkdir()
        (folder / "half.png").write_bytes(b"\x89")
        raise KeyboardInterrupt

    monkeypatch.setattr("nfriction.plots.save_all", half)
    with pytest.raises(KeyboardInterrupt):
        results.write_results(comparison, [recording], [], tmp_path)
    assert not list(tmp_path.rglob("*.png"))
    assert not list(tmp_path.glob(".*"))


def test_model_info_accepts_recordings_by_path(tmp_path) -> None:
    time = 2e-3 * np.arange(500)
    recording = Recording(time, 0.3 * np.cos(4.0 * time)[:, None], convention="relative,hanging")
    recording.write(tmp_path / "run.csv")
    plant = PendulumChain([0.2], [0.4])
    settings = {"windows": (0.2,), "fit_plant": False, "max_steps": 1}
    found = fit("viscous", plant, recording, **settings)
    expected = results.model_info(found, Recording.read(tmp_path / "run.csv"))
    assert results.model_info(found, tmp_path / "run.csv") == expected
