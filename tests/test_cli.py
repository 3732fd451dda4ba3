"""The command line as a user meets it: what it writes, how it fails, how it stops."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from nfriction import LFM, PendulumChain, Recording, cli, load, rigs, rollout
from nfriction.angles import AngleConvention
from nfriction.fitting.estimate import Fit
from nfriction.version import __version__

QUICK = ["--windows", "0.5", "--max-steps", "3"]
HANGING = AngleConvention("absolute", "hanging")


def pendulum(**changes: object) -> PendulumChain:
    """A bench whose files count from hanging."""
    return PendulumChain(
        mass=[0.15], com=[0.15], length=[0.3], inertia=[1e-4], name="bench",
        convention=("absolute", "hanging"), position_quantum=1e-4, **changes,
    )  # fmt: skip


def swing(name: str, start: float) -> Recording:
    """A second of a released pendulum with known friction, seen by an encoder."""
    q0 = torch.tensor([start + np.pi], dtype=torch.float64)
    friction = LFM(1, [[2e-4, 1e-3]])
    with torch.no_grad():
        run = rollout(
            pendulum(), friction, q0, torch.zeros_like(q0), sample_time=2e-3, steps=500
        )  # fmt: skip
    q = np.round((run.q.numpy() - np.pi) / 1e-4) * 1e-4
    return Recording(time=2e-3 * np.arange(len(q)), q=q, convention=HANGING, name=name)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a user has it: a rig, a recording to train on and one held out."""
    folder = tmp_path_factory.mktemp("bench")
    rigs.write(pendulum(), folder / "bench.json")
    swing("a", 1.5).write(folder / "a.csv.gz")
    swing("b", 2.0).write(folder / "b.csv")
    return folder


def compare(bench: Path, out: Path, *more: str, models: str = "NCFM") -> int:
    files = [str(bench / "a.csv.gz"), "--held-out", str(bench / "b.csv")]
    rig = ["--rig", str(bench / "bench.json"), "--models", models, "--out", str(out)]
    return cli.main(["compare", *files, *rig, *QUICK, *more])


@pytest.fixture(scope="module")
def compared(bench: Path) -> Path:
    out = bench / "out"
    assert compare(bench, out, models="NCFM,LFM") == 0
    return out


@pytest.fixture
def failing(capsys: pytest.CaptureFixture[str]):
    """Run a command that must fail: status 2 and one line, which is returned."""

    def run(*words: object) -> str:
        assert cli.main([str(w) for w in words]) == 2
        printed = capsys.readouterr()
        assert printed.err.startswith("nfriction: error: ")
        assert printed.err.count("\n") == 1
        return printed.err

    return run


def results(out: Path) -> dict:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    return json.loads((out / "results.json").read_text(), parse_constant=refuse)


def test_compare_writes_the_promised_schema(compared: Path) -> None:
    found = results(compared)
    assert found["units"] == "rad"
    assert list(found["models"]) == ["no friction", "NCFM", "LFM"]
    for name, model in found["models"].items():
        assert ("coefficients" in model) == (name != "no friction")
        for kind, recording in (("train", "a"), ("held_out", "b")):
            score = model[kind][recording]
            assert list(score["windows"]) == ["1"]  # 2 and 5 s do not fit into a second
            for rmse in (score["free_run"], *score["windows"].values()):
                assert rmse["all"] == pytest.approx(np.sqrt(np.mean(np.square(rmse["joints"]))))
    assert "compare" in found["command"]


def test_friction_predicts_better_than_none(compared: Path) -> None:
    error = {
        n: m["held_out"]["b"]["free_run"]["all"] for n, m in results(compared)["models"].items()
    }
    assert error["LFM"] < error["NCFM"] < error["no friction"]


def test_table_holds_the_errors_of_the_results(compared: Path) -> None:
    table = pd.read_csv(compared / "table.csv")
    models = results(compared)["models"]
    of = table[(table.horizon == "free run") & (table.joint == "all") & (table.recording == "b")]
    for row in of.itertuples():
        assert row[-1] == models[row.model]["held_out"]["b"]["free_run"]["all"]
    assert set(of.model) == set(models)


def test_models_load_and_scripts_need_torch_alone(compared: Path) -> None:
    qd = torch.linspace(-3, 3, 7, dtype=torch.float64)[:, None]
    inputs = (qd, torch.zeros_like(qd), torch.ones_like(qd))
    for name in ("NCFM", "LFM"):
        script = torch.jit.load(compared / "models" / f"{name}.pt")
        model = load(compared / "models" / f"{name}.json")
        torch.testing.assert_close(script(*inputs), model(*inputs), rtol=0, atol=1e-12)
    code = (
        "import sys, torch; torch.jit.load(sys.argv[1]);"
        "assert not any(m.startswith('nfriction') for m in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, compared / "models" / "LFM.pt"], check=True)


def test_figures_are_drawn_and_nothing_unfinished_stays(compared: Path) -> None:
    drawn = {path.stem for path in (compared / "figures").glob("*.png")}
    assert {"rmse_held_out", "positions_held_out_b", "torque_over_velocity"} <= drawn
    assert not list(compared.rglob(".*"))


def test_equal_input_gives_equal_bytes(bench: Path, compared: Path) -> None:
    assert compare(bench, bench / "again", "--no-figures", models="NCFM,LFM") == 0
    assert not (bench / "again" / "figures").exists()
    assert (bench / "again/table.csv").read_bytes() == (compared / "table.csv").read_bytes()
    assert results(bench / "again") | {"command": ""} == results(compared) | {"command": ""}


def test_initial_states_are_used_and_missing_ones_named(
    bench: Path, compared: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    states = bench / "recordings.csv"
    states.write_text("id,q0_1,qd0_1\nb,2.1,0\n")
    assert compare(bench, bench / "s", "--initial-states", str(states), "--no-figures") == 0
    assert f"warning: {states} has no state of a;" in capsys.readouterr().err
    plain, off = (results(out)["models"]["NCFM"] for out in (compared, bench / "s"))
    assert off["train"] == plain["train"]
    # The run starts 0.1 rad off and so ends about as far off.
    assert off["held_out"]["b"]["free_run"]["all"] > 0.03


def test_angles_and_degrees_say_how_files_are_written(bench: Path, compared: Path) -> None:
    folder = bench / "degrees"
    folder.mkdir()
    for name in ("a.csv.gz", "b.csv"):
        table = pd.read_csv(bench / name, comment="#")
        table["q1"] = np.rad2deg(table["q1"] + np.pi)
        table.to_csv(folder / name, index=False)
    rigs.write(pendulum(), folder / "bench.json")
    given = ["--degrees", "--angles", "relative,upright", "--no-figures"]
    assert compare(folder, folder / "out", *given) == 0
    # Degrees and back cost a rounding.
    for kind, name in (("held_out", "b"), ("train", "a")):
        plain, turned = (
            results(out)["models"]["NCFM"][kind][name]["free_run"]["all"]
            for out in (compared, folder / "out")
        )
        assert turned == pytest.approx(plain, rel=1e-4)


def test_plant_given_adjusts_nothing_and_drag_adds_terms(bench: Path) -> None:
    terms = []
    for k, option in enumerate((["--plant", "given"], [], ["--drag"])):
        out = bench / f"plant{k}"
        assert compare(bench, out, *option, "--max-steps", "1", "--no-figures") == 0
        terms.append(set(results(out)["models"]["NCFM"]["fit"]["plant"]))
    given, fitted, drag = terms
    assert not given
    assert given < fitted < drag


def test_fit_and_export(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = bench / "fit" / "m.json"
    rig = ["--rig", str(bench / "bench.json"), "--model", "LFM", "--out", str(model)]
    assert cli.main(["fit", str(bench / "a.csv.gz"), *rig, *QUICK]) == 0
    assert isinstance(load(model), LFM)
    assert cli.main(["export", str(model), "--out", str(bench / "x")]) == 0
    assert str(bench / "x" / "m.pt") in capsys.readouterr().out
    torch.jit.load(bench / "x" / "m.pt")


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--windows", "0"], "--windows takes positive"),
        (["--windows=-1"], "--windows takes positive"),
        (["--windows", "1,nan"], "--windows takes positive"),
        (["--max-steps", "-1"], "whole number"),
        (["--models", ","], "NCFM, LFM"),
        (["--models", "NCFM,FOO"], "NCFM, LFM"),
        (["--rig", "nowhere"], "multiarm-triple"),
        (["--rig", "absent.json"], "absent.json: No such file"),
        (["--angles", "sideways"], "absolute,hanging"),
        (["--plant", "guess"], "--help"),
        (["--initial-states", "absent.csv"], "absent.csv"),
    ],
)
def test_options_that_make_no_sense(bench: Path, failing, more: list[str], said: str) -> None:
    words = ["compare", bench / "a.csv.gz", "--rig", bench / "bench.json", "--out", bench / "bad"]
    assert said in failing(*words, *more)
    assert not (bench / "bad").exists()


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("absent.csv", None, "check the path"),
        ("empty.csv", b"", "is empty"),
        ("short.csv.gz", b"\x1f\x8b\x08\x00", "truncated"),
        ("text.csv", b"time,q1\n" + b"0.1,hello\n" * 9, "must be a number"),
        ("nan.csv", b"time,q1\n" + b"".join(b"%d,nan\n" % k for k in range(9)), "finite"),
        ("two.csv", b"time,q1,q2\n" + b"".join(b"0.%d,1,2\n" % k for k in range(9)), "2 joints"),
        ("log.txt", b"0", ".parquet"),
    ],
)
@pytest.mark.parametrize("held_out", [False, True])
def test_files_that_are_no_recordings(
    bench: Path, failing, name: str, content: bytes | None, said: str, held_out: bool
) -> None:
    if content is not None:
        (bench / name).write_bytes(content)
    files = [bench / "a.csv.gz", "--held-out", bench / name] if held_out else [bench / name]
    line = failing("compare", *files, "--rig", bench / "bench.json", "--out", bench / "bad")
    assert said in line
    assert name in line


def test_held_out_means_unseen(bench: Path, failing) -> None:
    (bench / "copy.csv.gz").write_bytes((bench / "a.csv.gz").read_bytes())
    for other in ("a.csv.gz", "copy.csv.gz"):
        words = ["compare", bench / "a.csv.gz", "--held-out", bench / other]
        assert "not seen" in failing(*words, "--rig", bench / "bench.json", "--out", bench / "bad")


def test_folders_and_files_in_the_way(bench: Path, failing) -> None:
    words = [bench / "a.csv.gz", "--rig", bench / "bench.json", "--out"]
    for out in (bench / "b.csv", bench / "b.csv" / "under"):
        assert "in its way" in failing("compare", *words, out)
    assert "is a folder" in failing("fit", *words, bench)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root writes anywhere")
def test_folder_that_must_not_be_written(bench: Path, failing) -> None:
    locked = bench / "locked"
    locked.mkdir(mode=0o500)
    words = ["compare", bench / "a.csv.gz", "--rig", bench / "bench.json", "--out", locked]
    assert "ermission denied" in failing(*words)


def test_export_and_demo_say_what_they_cannot(bench: Path, compared: Path, failing) -> None:
    assert "no such file" in failing("export", bench / "absent.json")
    assert "model file" in failing("export", bench / "bench.json")
    assert "torchscript" in failing("export", compared / "models" / "NCFM.json", "--to", "basic")
    assert "positive seconds" in failing("demo", "--seconds", "nan")
    assert "whole number" in failing("demo", "--seed", "-1")
    assert "NCFM, LFM" in failing("demo", "--models", "FOO")


def test_debug_shows_the_error_itself(bench: Path) -> None:
    with pytest.raises(FileNotFoundError):
        cli.main(["compare", "absent.csv", "--rig", str(bench / "bench.json"), "--debug"])


def test_version_and_bare_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out == f"nfriction {__version__}\n"
    assert cli.main([]) == 2
    assert "usage: nfriction" in capsys.readouterr().err


def test_unit_warnings_reach_the_user_in_one_line(
    bench: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    turning = 400.0 * np.arange(9.0)
    rows = "".join(f"{0.1 * k},{q}\n" for k, q in enumerate(turning))
    (bench / "wheel.csv").write_text("time,q1\n" + rows)

    def ends(*_: object, **__: object) -> Fit:
        raise ValueError("enough")

    monkeypatch.setattr(cli, "compare", ends)
    words = [
        str(bench / "wheel.csv"),
        "--rig",
        str(bench / "bench.json"),
        "--out",
        str(bench / "w"),
    ]
    assert cli.main(["compare", *words]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("nfriction: warning: recording 'wheel': `q` looks like degrees")
    assert second == "nfriction: error: enough"


def test_ctrl_c_ends_the_run_though_the_solver_survives_it(
    bench: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told = []
    step = cli._Progress.step

    def interrupted_step(self: cli._Progress, stage: str) -> None:
        told.append(stage)
        signal.raise_signal(signal.SIGINT)
        step(self, stage)

    monkeypatch.setattr(cli._Progress, "step", interrupted_step)
    out = bench / "interrupted"
    before = signal.getsignal(signal.SIGINT)
    assert compare(bench, out, models="NCFM,LFM") == 130
    assert len(told) == 1  # the second model was never begun
    assert "interrupted (fit NCFM)" in capsys.readouterr().err
    assert not list(out.iterdir())
    assert signal.getsignal(signal.SIGINT) is before


def test_interrupt_outside_a_solver(
    bench: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object, **__: object) -> Fit:
        raise KeyboardInterrupt

    monkeypatch.setattr("nfriction.comparison.fit", stop)
    assert compare(bench, bench / "stopped") == 130
    assert capsys.readouterr().err.count("\n") == 1
    assert not list((bench / "stopped").iterdir())


def test_installed_command_fails_in_one_line() -> None:
    words = [sys.executable, "-m", "nfriction.cli", "fit", "absent.csv", "--rig", "tlrip"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["demo", "--seconds", "1", "--models", "NCFM", "--out", str(tmp_path), "--no-figures"]
    assert cli.main(words) == 0
    assert "2 held out" in capsys.readouterr().out
    assert list(results(tmp_path)["models"]) == ["no friction", "NCFM"]


@pytest.mark.slow
def test_triple_pendulum_held_out(data_dir: Path, tmp_path: Path) -> None:
    """Half of the card's experiment: viscous friction leaves 11.6 mrad in 10 s, 6.1 mrad in 5 s."""
    data = data_dir / "multiarm_pendulum"
    words = [str(data / "triple_b0.csv.gz"), "--held-out", str(data / "triple_b2.csv.gz")]
    words += ["--rig", "multiarm-triple", "--initial-states", str(data / "recordings.csv")]
    words += ["--models", "NCFM,LFM", "--no-figures", "--out", str(tmp_path)]
    assert cli.main(["compare", *words]) == 0
    found = {n: m["held_out"]["triple_b2"] for n, m in results(tmp_path)["models"].items()}
    for name in ("NCFM", "LFM"):
        pairs = zip(found[name]["free_run"]["joints"], found["no friction"]["free_run"]["joints"],
                    strict=True)  # fmt: skip
        assert all(own < none for own, none in pairs)
    assert found["NCFM"]["free_run"]["all"] == pytest.approx(11.6e-3, rel=0.15)
    assert found["NCFM"]["windows"]["5"]["all"] == pytest.approx(6.1e-3, rel=0.15)
