"""`compare` and `demo` as a user runs them: files, output, interruption."""

import logging
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from nfriction import Recording, cli, load
from nfriction.cli.console import Progress
from nfriction.evaluation.compare import LIMIT
from nfriction.io.model_file import load_info
from tests.cli.benches import QUICK, compare, results


def test_compare_writes_the_promised_schema(compared: Path) -> None:
    found = results(compared)
    assert found["units"] == "rad"
    assert list(found["models"]) == ["no friction", "NCFM", "LFM"]
    for name, model in found["models"].items():
        assert ("coefficients" in model) == (name != "no friction")
        for kind, recording in (("train", "a"), ("test", "b")):
            score = model[kind][recording]
            assert list(score["windows"]) == ["1"]  # 2 and 5 s do not fit into 1.2 s
            for rmse in (score["free_run"], *score["windows"].values()):
                assert rmse["all"] == pytest.approx(np.sqrt(np.mean(np.square(rmse["joints"]))))
    assert "compare" in found["command"]
    assert found["best"]["model"] == "LFM"
    assert "test" in found["best"]["by"]


def test_friction_predicts_better_than_none(compared: Path) -> None:
    error = {n: m["test"]["b"]["free_run"]["all"] for n, m in results(compared)["models"].items()}
    assert error["LFM"] < error["NCFM"] < error["no friction"]


def test_table_contains_the_errors_of_the_results(compared: Path) -> None:
    table = pd.read_csv(compared / "table.csv", float_precision="round_trip")
    models = results(compared)["models"]
    of = table[(table.horizon == "free run") & (table.joint == "all") & (table.recording == "b")]
    assert of.model.tolist() == ["no friction", "NCFM", "LFM", LIMIT]
    of = of[of.model != LIMIT]
    for row in of.itertuples():
        assert row[-1] == models[row.model]["test"]["b"]["free_run"]["all"]
    assert set(of.model) == set(models)


def test_model_files_load_and_scripts_agree_with_them(compared: Path) -> None:
    qd = torch.linspace(-3, 3, 7, dtype=torch.float64)[:, None]
    inputs = (qd, torch.zeros_like(qd), torch.ones_like(qd))
    for name in ("NCFM", "LFM"):
        script = torch.jit.load(compared / "models" / f"{name}.pt")
        model = load(compared / "models" / f"{name}.json")
        torch.testing.assert_close(script(*inputs), model(*inputs), rtol=0, atol=1e-12)


def test_figures_are_drawn_and_no_temporary_files_remain(compared: Path) -> None:
    drawn = {path.stem for path in (compared / "figures").glob("*.png")}
    assert {"rmse_test", "positions_test_b", "torque_over_velocity"} <= drawn
    assert not list(compared.rglob(".*"))


def test_equal_input_gives_equal_bytes(compared: Path, again: tuple[Path, str]) -> None:
    out, _ = again
    assert not (out / "figures").exists()
    assert (out / "table.csv").read_bytes() == (compared / "table.csv").read_bytes()
    own = {"command": "", "files": [], "checksum": ""}
    assert results(out) | own == results(compared) | own


def test_output_names_the_best_model_and_its_file(again: tuple[Path, str]) -> None:
    out, printed = again
    assert "models: NCFM: viscous, LFM: load-coulomb\n" in printed
    assert "best on test recordings: LFM" in printed
    (file,) = re.findall(r"its model file: (.*)", printed)
    assert Path(file).is_file()
    coefficients = results(out)["models"]["LFM"]["coefficients"]
    printed_table = printed.partition("Coefficients of LFM\n")[2]
    header, row, *_ = printed_table.splitlines()
    assert re.split(r"\s{2,}", header.strip()) == ["B [N m s/rad]", "C [N m]"]
    values = [float(word) for word in row.split()[1:]]
    # Four digits are printed.
    assert values == pytest.approx([coefficients["B"][0], coefficients["C"][0]], rel=1e-3)
    assert "windows of 5 s: none, b lasts 1.2 s" in printed
    assert f"\nresults and models are in {out}\n" in printed


def test_output_ends_with_the_improvement_and_next_commands(
    again: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, printed = again
    *_, without, learnt, report, export = printed.splitlines()
    free = {n: m["test"]["b"]["free_run"]["all"] for n, m in results(out)["models"].items()}
    none, best = free["no friction"], free["LFM"]
    assert without.endswith(f" miss the measured motion by {1e3 * none:.3g} mrad;")
    assert "(load-coulomb)" in learnt
    less = float(learnt.split()[-3])
    assert learnt.endswith(f" by {1e3 * best:.3g} mrad, {less:g} % less.")
    assert less < 100 * (1 - best / none) < less + 0.01
    assert 100 * (1 - best / none) > 99.95  # "100 % less" would be wrong
    monkeypatch.chdir(tmp_path)
    for line in (report, export):
        assert cli.main(line.partition("nfriction ")[2].split()) == 0
    assert (out / "report.html").is_file()
    assert list((tmp_path / "controller").glob("*.c"))


def test_without_test_recordings_no_model_is_named_best(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(bench / "a.csv.gz"), "--rig", str(bench / "bench.json"), "--models", "NCFM"]
    quick = ["--max-steps", "1", "--windows", "0.5", "--no-figures", "--out", str(bench / "alone")]
    assert cli.main(["compare", *words, *quick]) == 0
    assert "no verdict: there was no test recording" in capsys.readouterr().out
    assert results(bench / "alone")["best"] is None


def test_initial_states_are_used_and_missing_ones_named(
    bench: Path, compared: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    states = bench / "recordings.csv"
    states.write_text("id,q0_1,qd0_1\nb,2.1,0\n")
    assert compare(bench, bench / "s", "--initial-states", str(states), "--no-figures") == 0
    assert f"warning: {states} has no state of a;" in capsys.readouterr().err
    plain, off = (results(out)["models"]["NCFM"] for out in (compared, bench / "s"))
    assert off["train"] == plain["train"]
    # The run starts with an error of 0.1 rad and keeps about that error.
    assert off["test"]["b"]["free_run"]["all"] > 0.03


@pytest.mark.slow
def test_no_fit_plant_keeps_the_plant_and_drag_adds_terms(bench: Path) -> None:
    terms = []
    for k, option in enumerate((["--no-fit-plant"], [], ["--drag"])):
        out = bench / f"plant{k}"
        assert compare(bench, out, *option, "--max-steps", "1", "--no-figures") == 0
        terms.append(set(results(out)["models"]["NCFM"]["fit"]["plant"]))
    given, fitted, drag = terms
    assert not given
    assert given < fitted < drag


def test_choice_on_training_data_is_printed_with_its_reason(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare(bench, bench / "chosen", "--select", "--no-figures", models="NCFM,LFM") == 0
    choice = capsys.readouterr().out.partition("training data alone would choose ")[2]
    chosen, reason = choice.split("\n")[0].split(": ")
    assert chosen in ("NCFM", "LFM")
    assert results(bench / "chosen")["selection"]["chosen"] == chosen
    assert "error on hold-out blocks" in reason
    # Each hold-out block has 0.4 s, half of which is the lead-in.
    assert re.search(r"0\.2\d* s simulations", choice)
    for name in ("NCFM", "LFM"):
        assert re.search(rf"^{name} +[\d.]+ +\d +(yes|no)$", choice, re.MULTILINE)


def test_warnings_and_intervals_of_fits_are_printed(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare(bench, bench / "wary", "--no-figures", models="NCFM,LFM") == 0
    printed = capsys.readouterr().out
    found = results(bench / "wary")
    fits, best = found["models"], found["best"]["model"]
    for name in ("NCFM", "LFM"):
        for warning in fits[name]["fit"]["warnings"]:
            assert f"\n  - {warning}" in printed
    table = printed.partition("95 % confidence intervals")[2]
    for name, (low, high) in fits[best]["fit"]["intervals"].items():
        (row,) = (line for line in table.splitlines() if line.startswith(f"{name} "))
        interval = [None if word == "unknown" else float(word) for word in row.split()[-2:]]
        assert interval == [pytest.approx(x, rel=1e-3) for x in (low, high)]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such a file name")
@pytest.mark.slow
def test_file_name_that_is_not_unicode_loses_no_fits(bench: Path, tmp_path: Path) -> None:
    odd, out = tmp_path / os.fsdecode(b"surr\xff.csv"), tmp_path / "out"
    shutil.copy(bench / "b.csv", odd)
    words = [bench / "a.csv.gz", "--test", odd, "--rig", bench / "bench.json", "--models", "NCFM"]
    words += [*QUICK, "--out", out, "--log-file", tmp_path / "log"]
    # In a separate process, whose streams have a terminal's encoding.
    command = [sys.executable, "-m", "nfriction", "compare"]
    subprocess.run([*command, *words], check=True, capture_output=True)
    assert (out / "models" / "NCFM.pt").is_file()
    assert cli.main(["report", str(out)]) == 0
    for file in (tmp_path / "log", out / "table.csv", out / "report.html"):
        assert "surr" in file.read_text(encoding="utf-8")


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_the_run_although_the_solver_catches_it(
    bench: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    kind: signal.Signals,
) -> None:
    stages = []
    step = Progress.step

    def interrupted_step(self: Progress, stage: str) -> None:
        stages.append(stage)
        signal.raise_signal(kind)
        step(self, stage)

    monkeypatch.setattr(Progress, "step", interrupted_step)
    out = bench / "interrupted"
    before = signal.getsignal(kind)
    assert compare(bench, out, models="NCFM,LFM") == 130
    assert len(stages) == 1  # the second model was never started
    assert "interrupted (fit NCFM)" in capsys.readouterr().err
    assert not list(out.iterdir())
    assert signal.getsignal(kind) is before


def test_linear_algebra_failure_is_a_one_line_error(
    bench: Path, monkeypatch: pytest.MonkeyPatch, failing: Callable[..., str]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise torch.linalg.LinAlgError("linalg.cholesky:\nnot positive definite")

    monkeypatch.setattr("nfriction.evaluation.parallel.fit", fail)
    words = [bench / "a.csv.gz", "--rig", bench / "bench.json", "--models", "NCFM"]
    assert "not positive definite" in failing("compare", *words, "--out", bench / "hopeless")


def test_interrupt_outside_a_solver(
    bench: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("nfriction.evaluation.parallel.fit", stop)
    assert compare(bench, bench / "stopped") == 130
    assert capsys.readouterr().err.count("\n") == 1
    assert not list((bench / "stopped").iterdir())


def test_process_count_is_checked_and_does_not_change_results(
    bench: Path, compared: Path, failing: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["compare", bench / "a.csv.gz", "--rig", bench / "bench.json", "--jobs"]
    for wrong in ("0", "-2", "two"):
        assert "from 1, or -1" in failing(*words, wrong)
    with monkeypatch.context() as absent:
        absent.setitem(sys.modules, "joblib", None)
        assert "pip install nfriction[parallel]" in failing(*words, "2", "--out", bench / "none")
    pytest.importorskip("joblib")
    out = bench / "jobs"
    assert compare(bench, out, "--no-figures", "--jobs", "2", models="NCFM,LFM") == 0
    assert (out / "table.csv").read_bytes() == (compared / "table.csv").read_bytes()


def test_log_file_records_progress_that_the_console_omits(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "night.log"
    for _ in range(2):
        assert compare(bench, tmp_path / "out", "--no-figures", "--log-file", str(log)) == 0
    lines = log.read_text().splitlines()
    # The second run is appended below the first.
    assert sum("nfriction compare" in line for line in lines) == 2
    for entry in ("fit NCFM", "fit NCFM: ", "score NCFM", "best on test recordings: NCFM"):
        assert sum(line.split("INFO ")[1].startswith(entry) for line in lines) >= 2
    assert all(re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} (INFO|WARNING) ", x) for x in lines)
    assert "INFO" not in capsys.readouterr().err
    assert not logging.getLogger("nfriction").handlers


def test_failed_model_is_reported_with_the_others(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One second of swinging has one class of acceleration, too few for an adaptive model."""
    out = bench / "partly"
    assert compare(bench, out, "--no-figures", models="NCFM,ANCFM") == 1
    assert "ANCFM: not fitted: the acceleration hardly varies" in capsys.readouterr().out
    found = results(out)
    assert "hardly varies" in found["failed"]["ANCFM"]
    assert list(found["models"]) == ["no friction", "NCFM"]


@pytest.mark.slow
def test_demo_writes_results_and_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["demo", "--seconds", "1", "--models", "NCFM", "--out", str(tmp_path), "--no-figures"]
    assert cli.main(words) == 0
    assert "2 for testing" in capsys.readouterr().out
    assert list(results(tmp_path)["models"]) == ["no friction", "NCFM"]


@pytest.mark.slow
def test_triple_pendulum_errors_match_the_data_card(data_dir: Path, tmp_path: Path) -> None:
    """Half of the data card's experiment: viscous friction has 11.6 mrad in 10 s, 6.1 in 5 s."""
    data = data_dir / "multiarm_pendulum"
    words = [str(data / "triple_b0.csv.gz"), "--test", str(data / "triple_b2.csv.gz")]
    words += ["--rig", "multiarm-triple", "--initial-states", str(data / "recordings.csv")]
    # As on the data card: no air drag.
    words += ["--models", "NCFM,LFM", "--no-drag", "--no-figures", "--out", str(tmp_path)]
    assert cli.main(["compare", *words]) == 0
    found = {n: m["test"]["triple_b2"] for n, m in results(tmp_path)["models"].items()}
    for name in ("NCFM", "LFM"):
        pairs = zip(found[name]["free_run"]["joints"], found["no friction"]["free_run"]["joints"],
                    strict=True)  # fmt: skip
        assert all(own < none for own, none in pairs)
    # The card's ratios are independent, ours are constrained by the chain's geometry.
    assert 0.8 < found["NCFM"]["free_run"]["all"] / 11.6e-3 < 1.15
    assert 0.8 < found["NCFM"]["windows"]["5"]["all"] / 6.1e-3 < 1.15


def test_file_names_in_legacy_encodings_lose_nothing(bench: Path, tmp_path: Path) -> None:
    files = [tmp_path / os.fsdecode(f"Gelenk_{x}_ä.csv".encode("latin-1")) for x in "ab"]
    for path, name in zip(files, ("a.csv.gz", "b.csv"), strict=True):
        Recording.read(bench / name).write(path)
    rig = ["--rig", str(bench / "bench.json")]
    train, test, out = str(files[0]), str(files[1]), tmp_path / "out"
    words = ["compare", train, "--test", test, *rig, "--models", "NCFM", *QUICK, "--no-figures"]
    assert cli.main([*words, "--out", str(out)]) == 0
    found = results(out)
    assert list(found["models"]["NCFM"]["test"]) == ["Gelenk_b_ä"]
    assert "Gelenk_b_ä" in set(pd.read_csv(out / "table.csv").recording)
    assert cli.main(["report", str(out)]) == 0
    assert "Gelenk_b_ä" in (out / "report.html").read_text(encoding="utf-8")
    model = tmp_path / "model.json"
    assert cli.main(["fit", train, *rig, "--model", "NCFM", *QUICK, "--out", str(model)]) == 0
    assert "Gelenk_a_ä" in str(load_info(model))
