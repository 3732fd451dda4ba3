"""Training scripts: their output, and that an interruption changes no result."""

import importlib
import json
import os
import re
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from nfriction import ANCFM, CVFM, load, rollout, save
from nfriction.cli.console import UsageError
from nfriction.friction import model_names
from nfriction.io.model_file import load_info
from nfriction.papers.controller import load_rules, paper_controller, save_rules
from nfriction.papers.nffem import train_network
from nfriction.papers.nffem.evidence import EvidenceState
from nfriction.plant import PendulumChain, rigs

TRAINERS = Path(__file__).resolve().parents[2] / "trainers"
sys.path.insert(0, str(TRAINERS))  # as when a script of that folder runs
SCRIPTS = sorted(path.name for path in TRAINERS.glob("train_*.py"))
common = importlib.import_module("common")
QUICK = ["--seconds", "1", "--windows", "0.5", "--max-steps", "2"]
SEARCH = ["train_constant.py", "--twin", "rtip", "--seconds", "2", "--model", "LFM",
          "--method", "pattern", "--horizon", "1", "--max-evaluations", "400"]  # fmt: skip


@pytest.fixture(autouse=True)
def same_interrupt() -> Iterator[None]:
    """Restore the interrupt handler, which a trainer replaces, for the other tests."""
    before = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, before)


def train(*words: object) -> None:
    """Run a trainer within this process, in which torch is already loaded."""
    script, *others = map(str, words)
    sys.argv, before = [script], sys.argv
    try:
        common.run(runpy.run_path(str(TRAINERS / script))["train"], others)
    finally:
        sys.argv = before


def test_there_is_a_script_for_each_kind_of_model() -> None:
    assert [
        f"train_{kind}.py" for kind in ("adaptive", "constant", "neurofuzzy", "supervised")
    ] == SCRIPTS


@pytest.mark.slow
def test_a_model_is_trained_written_and_read_by_resume(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train_constant.py", *QUICK, "--model", "NCFM", "--out", tmp_path]
    train(*words)
    first = capsys.readouterr().out
    assert ", test: " in first
    model = (tmp_path / "NCFM.json").read_bytes()
    assert load(tmp_path / "NCFM.json").joints == 3
    assert (tmp_path / "NCFM.pt").exists()
    train(*words, "--resume")
    assert capsys.readouterr().out == first
    assert (tmp_path / "NCFM.json").read_bytes() == model


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_offered_model_exists(script: str) -> None:
    offered = runpy.run_path(str(TRAINERS / script))["MODELS"]
    assert set(offered) <= set(model_names())


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A recording, in the folder of its rig file."""
    rigs.write(PendulumChain([0.5], [0.4], [0.2], [0.01]), tmp_path / "rig.json")
    time = np.arange(400) / 200
    table = pd.DataFrame({"time": time, "q1": 3 + np.exp(-time) * np.cos(6 * time)})
    table.to_csv(tmp_path / "run.csv", index=False)
    return tmp_path / "run.csv"


def begin(log: Path, *words: object) -> None:
    """Read the data and begin checkpoints, as a trainer does before its fits."""
    words = (log, "--rig", log.with_name("rig.json"), "--out", log.parent, *words)
    given = common.parser("").parse_args([*map(str, words)])
    common.start(given, common.read(given))


def test_checkpoints_of_other_options_are_refused(log: Path) -> None:
    begin(log, "--seed", "3")
    begin(log, "--seed", "3", "--resume")
    with pytest.raises(ValueError, match="other options"):
        begin(log, "--seed", "4", "--resume")


@pytest.mark.parametrize(("name", "old", "new"), [("run.csv", ",4.0", ",4.001"),
                                                  ("rig.json", "0.4", "0.5")])  # fmt: skip
def test_checkpoints_of_a_changed_file_are_refused(
    log: Path, name: str, old: str, new: str
) -> None:
    begin(log)
    path = log.with_name(name)
    before = path.read_text()
    path.write_text(before.replace(old, new))
    with pytest.raises(ValueError, match=rf"other contents of \S*{name}; restore"):
        begin(log, "--resume")
    path.write_text(before)
    begin(log, "--resume")


def test_checkpoints_are_deleted_only_after_a_finished_run(log: Path) -> None:
    begin(log)
    begin(log)  # no result is lost yet
    kept = log.with_name("checkpoints") / "stages" / "NLFM.json"
    kept.write_text("a result")
    with pytest.raises(ValueError, match=r"did not finish.*--resume, or delete"):
        begin(log)
    common.finished(common.parser("").parse_args(["--out", str(log.parent)]))
    for wrong in (["--rig", "no.json"], ["--angles", "x"], ["--rig", "tlrip"]):
        with pytest.raises((ValueError, OSError, UsageError)):
            begin(log, *wrong)
    with pytest.raises(SystemExit, match="--joint must be 1 to 1, got 2"):
        train("evolve_rules.py", log, "--rig", log.with_name("rig.json"), "--joint", "2",
              "--out", log.parent)  # fmt: skip
    assert kept.exists()
    begin(log)
    assert not kept.exists()


def test_recordings_need_a_rig(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="--rig"):
        train("train_adaptive.py", "run.csv", "--out", tmp_path)


def test_columns_of_a_recording_are_named_as_in_fits(tmp_path: Path) -> None:
    time = np.arange(0.0, 1.0, 2e-3)
    positions = np.degrees(np.pi + 0.5 * np.cos(8.0 * time))
    table, rig = tmp_path / "run.csv", tmp_path / "rig.json"
    np.savetxt(table, np.c_[1e3 * time, positions], delimiter=",", header="t,enc", comments="")
    rig.write_text('{"mass": [0.2], "length": [0.2]}')
    options = ["--rig", rig, "--columns", "time=t:ms,q1=enc:deg"]
    made = common.parser("").parse_args([str(word) for word in (table, *options)])
    (recording,) = common.read(made).train
    assert recording.q[:, 0] == pytest.approx(np.radians(positions))
    assert recording.time[-1] == pytest.approx(time[-1])
    other = common.parser("").parse_args(
        [str(word) for word in (table, *options, "--rig", "tlrip")]
    )
    with pytest.raises(UsageError, match="has 1 joints, the rig has 3"):
        common.read(other)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data sets of these tests, built once; compiled models stay in the common cache."""
    return tmp_path_factory.mktemp("cache")


@pytest.mark.parametrize(
    ("adaptive", "made"),
    [(None, "NFLFM"), pytest.param(ANCFM(3, [0.02]), "NFNCFM", marks=pytest.mark.slow)],
)
def test_networks_are_trained_on_the_supervised_set(
    tmp_path: Path,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    adaptive: ANCFM | None,
    made: str,
) -> None:
    monkeypatch.setattr("nfriction.datasets.cache_folder", lambda: cache)
    words = ["--seconds", "3", "--units", "3", "--max-steps", "2", "--out", str(tmp_path)]
    if adaptive is not None:
        words += ["--adaptive", str(save(adaptive, tmp_path / "adaptive.json"))]
    train("train_supervised.py", *words)
    assert "3000 samples per joint, 3 units" in capsys.readouterr().out
    model = load(tmp_path / f"{made}.json")
    # The network follows the controllers: it differs from its initial constant.
    speeds = torch.tensor([[0.1] * 3, [3.0] * 3], dtype=torch.float64)
    spread = model.schedule(speeds, torch.zeros_like(speeds)).diff(dim=0).abs()
    assert adaptive is not None or (spread > 0).all()
    for name in (f"{made}.pt", f"{made}-loss.png", f"{made}-outputs.png"):
        assert (tmp_path / name).stat().st_size > 0


@pytest.mark.parametrize("joint", [1, 3])
def test_an_interrupted_training_of_networks_writes_no_model(
    tmp_path: Path,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    joint: int,
) -> None:
    monkeypatch.setattr("nfriction.datasets.cache_folder", lambda: cache)
    begun = []

    def interrupt(state: EvidenceState) -> None:
        begun.extend([state] if state.step == 1 else [])
        if len(begun) == joint:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(train_network, "recorded_losses", lambda names: ({}, interrupt))
    with pytest.raises(SystemExit) as ended:
        train("train_supervised.py", "--seconds", "3", "--units", "3", "--max-steps", "2",
              "--out", tmp_path)  # fmt: skip
    assert ended.value.code == 130
    assert capsys.readouterr().err == "\ninterrupted\n"
    assert not [*tmp_path.iterdir()]


def test_a_closed_output_is_no_error() -> None:
    script = f"import sys; sys.path.insert(0, {str(TRAINERS)!r}); import common; common.run(str)"
    process = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.communicate()[1] == b""
    assert process.returncode == 141


@pytest.mark.parametrize("script", [*SCRIPTS, "evolve_rules.py", "learn_online.py"])
def test_a_negative_seed_is_refused_by_name(
    script: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        train(script, "--seed", "-1")
    assert "argument --seed: must be a whole number from 0, got '-1'" in capsys.readouterr().err


@pytest.mark.slow
def test_networks_tolerate_noise_on_their_targets(
    tmp_path: Path,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("nfriction.datasets.cache_folder", lambda: cache)
    words = ["--seconds", "3", "--every", "2", "--units", "6", "--max-steps", "10"]
    worst = {}
    for noise in ("0.001", "0.5"):
        train("train_supervised.py", *words, "--noise", noise, "--out", str(tmp_path))
        printed = capsys.readouterr().out
        assert "1500 samples per joint" in printed
        worst[noise] = max(map(float, re.findall(r"\b[BC] ([\d.]+)", printed)))
    # In % of the outputs' range: noise has an effect, but most of its 50 % is averaged out.
    assert worst["0.001"] < 1.0 < worst["0.5"] < 10.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "model", "options"),
    [
        ("train_adaptive.py", "ANCFM", []),
        ("train_neurofuzzy.py", "NFNCFM", ["--terms", "3", "2", "--units", "4"]),
        ("train_neurofuzzy.py", "NFNCFM", ["--procedure", "papers", "--samples", "200"]),
        ("train_neurofuzzy.py", "NFNCFM", ["--terms", "3", "2"]),
    ],
)
def test_every_kind_of_model_is_trained(
    tmp_path: Path, script: str, model: str, options: list[str]
) -> None:
    train(script, *QUICK, "--model", model, "--out", tmp_path, *options)
    assert type(load(tmp_path / f"{model}.json")).__name__ == model
    assert (tmp_path / "checkpoints" / "stages" / "NCFM-fit.json").exists()
    assert (tmp_path / f"{model}-loss.png").stat().st_size > 0


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_interrupted_search_resumes_to_the_same_result(tmp_path: Path, how: int) -> None:
    train(*SEARCH, "--out", tmp_path / "whole")
    folder = tmp_path / "ended"
    words = [sys.executable, str(TRAINERS / SEARCH[0]), *SEARCH[1:], "--out", str(folder)]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    state = folder / "checkpoints" / "stages" / "LFM-search.json"
    deadline = time.monotonic() + 120
    while not state.exists() and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.005)
    process.send_signal(how)
    assert process.wait(60) != 0
    assert 0 < json.loads(state.read_text())["result"]["evaluations"] < 400
    assert not (folder / "LFM.json").exists()
    train(*SEARCH, "--out", folder, "--resume")
    ours, theirs = (load(f / "LFM.json").state_dict() for f in (folder, tmp_path / "whole"))
    assert all((ours[name] == theirs[name]).all() for name in theirs)
    assert load_info(folder / "LFM.json").fit == load_info(tmp_path / "whole" / "LFM.json").fit


def test_law_without_an_adaptive_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="--procedure ours"):
        train("train_neurofuzzy.py", *QUICK, "--model", "NFStribeck", "--procedure", "papers",
              "--out", tmp_path)  # fmt: skip


def test_a_motion_too_short_for_the_table_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        train("learn_online.py", "--seconds", "5", "--out", tmp_path / "out")
    assert "--seconds must be at least 10" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_network_adapts_online_to_falling_friction(tmp_path: Path) -> None:
    train("learn_online.py", "--seconds", "40", "--warming", "5", "--out", tmp_path)
    table = pd.read_csv(tmp_path / "drift.csv", index_col=0)
    assert (table["learning"].iloc[1:] < 0.8 * table["frozen"].iloc[1:]).all()
    assert (tmp_path / "arm.c").exists()


def test_written_rules_are_read_back(tmp_path: Path) -> None:
    rules, path = paper_controller(3).rule_base, tmp_path / "rules.json"
    save_rules(rules, path)
    assert load_rules(path) == rules


@pytest.mark.slow
def test_rules_evolve_to_a_front_and_resume(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["evolve_rules.py", *QUICK, "--model", "ANCFM", "--population", "5",
             "--prices", "0", "0.5", "--generations", "2", "--out", tmp_path]  # fmt: skip
    train(*words)
    first = capsys.readouterr().out
    table = pd.read_csv(tmp_path / "pareto.csv", index_col=0)
    assert table["rules"].iloc[0] == 25  # as given
    assert table["rules"].iloc[1:].is_monotonic_increasing
    assert table["training error [mN m]"].iloc[1:].is_monotonic_decreasing
    assert (tmp_path / "pareto.png").stat().st_size > 0
    files = [tmp_path / f"candidate-{number}.json" for number in range(1, len(table))]
    assert [len(load_rules(file).rules) for file in files] == table["rules"].iloc[1:].to_list()
    train(*words, "--resume")
    assert capsys.readouterr().out == first


@pytest.mark.slow
def test_rules_evolve_on_a_user_defined_driven_rig(tmp_path: Path) -> None:
    """The drive's torque is not friction, and there are no test recordings."""
    plant = PendulumChain([0.5], [0.4], [0.2], [0.01])
    law = CVFM(1, [[0.05, 0.02]]).requires_grad_(False)
    time = np.arange(8000) / 1000
    # With growing amplitude, so that the acceleration has classes.
    tau = (0.1 + 0.08 * time) * np.sin(5 * time + np.sin(3 * time))
    tau = tau[:, None]
    zero = torch.zeros(1, dtype=torch.float64)
    moved = rollout(plant, law, zero + 3, zero, tau=tau, sample_time=1e-3)
    table = pd.DataFrame(
        {"time": time, "q1": moved.q[:, 0].numpy()[: len(time)], "tau1": tau[:, 0]}
    )
    table.to_csv(tmp_path / "run.csv", index=False)
    rigs.write(plant, tmp_path / "rig.json")
    train("evolve_rules.py", tmp_path / "run.csv", "--rig",
          tmp_path / "rig.json", "--model", "ACVFM", "--population", "5", "--prices", "0",
          "--generations", "1", "--max-steps", "5", "--out", tmp_path / "out")  # fmt: skip
    found = pd.read_csv(tmp_path / "out" / "pareto.csv", index_col=0)
    assert [*found.columns] == ["rules", "training error [mN m]"]
    # The drive's torque is about 300 mN m.
    assert found["training error [mN m]"].iloc[0] < 5
