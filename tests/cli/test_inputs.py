"""Options that define how recordings are read, and messages about recordings that do not fit."""

import argparse
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from nfriction import CVFM, PendulumChain, cli, friction, rigs
from nfriction.cli import inputs
from nfriction.cli.console import Progress
from nfriction.cli.tables import interval_table
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.identifiability import Interval
from nfriction.io.model_file import save
from tests.cli.benches import compare, pendulum, results


def test_omitted_options_keep_the_defaults_of_fit() -> None:
    parser = argparse.ArgumentParser()
    inputs.add_fit_options(parser)
    settings = inputs.fit_settings(parser.parse_args(["--rig", "tlrip"]))
    assert "windows" not in settings
    assert settings["drag"] is None
    assert settings["encoder_reference"] == "auto"
    assert f"(default: {','.join(f'{w:g}' for w in DEFAULTS.windows)})" in " ".join(
        parser.format_help().split()
    )
    given = parser.parse_args(
        [
            "--rig",
            "tlrip",
            "--windows",
            "1,3",
            "--no-drag",
            "--encoder-reference",
            "per_recording",
        ]
    )
    settings = inputs.fit_settings(given)
    assert settings["windows"] == (1.0, 3.0)
    assert settings["drag"] is False
    assert settings["encoder_reference"] == "per_recording"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.csv", None, "check the path"),
        ("empty.csv", b"", "is empty"),
        ("short.csv.gz", b"\x1f\x8b\x08\x00", "truncated"),
        ("text.csv", b"time,q1\n" + b"0.1,hello\n" * 9, "must be a number"),
        ("nan.csv", b"time,q1\n" + b"".join(b"%d,nan\n" % k for k in range(9)), "9 of 9 rows"),
        ("two.csv", b"time,q1,q2\n" + b"".join(b"0.%d,1,2\n" % k for k in range(9)), "2 joints"),
        ("names.csv", b"time,enc_1\n" + b"".join(b"0.%d,1\n" % k for k in range(9)),
         '--columns "q1=enc_1"'),
        ("log.xlsx", b"0", ".parquet"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("as_test", [False, True])
def test_files_that_are_not_recordings_are_refused(
    bench: Path, failing, name: str, content: bytes | None, message: str, as_test: bool
) -> None:
    if content is not None:
        (bench / name).write_bytes(content)
    files = [bench / "a.csv.gz", "--test", bench / name] if as_test else [bench / name]
    line = failing("compare", *files, "--rig", bench / "bench.json", "--out", bench / "bad")
    assert message in line
    assert name in line


def test_test_recordings_are_not_used_in_the_fit(bench: Path, failing) -> None:
    (bench / "copy.csv.gz").write_bytes((bench / "a.csv.gz").read_bytes())
    for other in ("a.csv.gz", "copy.csv.gz"):
        words = ["compare", bench / "a.csv.gz", "--test", bench / other]
        assert "not seen" in failing(*words, "--rig", bench / "bench.json", "--out", bench / "bad")


def rewritten(bench: Path, folder: Path, change, header: Sequence[str]) -> Path:
    """The bench with its recordings in another format and without their comments."""
    for name in ("a.csv.gz", "b.csv"):
        table = pd.read_csv(bench / name, comment="#")
        table["q1"] = change(table["q1"])
        table.to_csv(folder / name, index=False, header=list(header))
    rigs.write(pendulum(), folder / "bench.json")
    return folder


def errors(out: Path) -> list[float]:
    model = results(out)["models"]["NCFM"]
    return [model[kind][name]["free_run"]["all"] for kind, name in (("test", "b"), ("train", "a"))]


@pytest.mark.parametrize(
    ("change", "header", "options"),
    [
        (lambda q: np.rad2deg(q + np.pi), ("time", "q1"),
         ["--degrees", "--angles", "relative,upright"]),
        (lambda q: q, ("t", "enc_1"), ["--columns", "time=t, q1=enc_1"]),
        # A file without a convention has that of the rig's encoders.
        (lambda q: q, ("time", "q1"), []),
    ],
)  # fmt: skip
def test_options_define_the_file_format(
    bench: Path, compared: Path, tmp_path: Path, change, header, options: list[str]
) -> None:
    folder = rewritten(bench, tmp_path, change, header)
    assert compare(folder, folder / "out", *options, "--no-figures") == 0
    # The conversion to degrees and back costs round-off.
    assert errors(folder / "out") == pytest.approx(errors(compared), rel=1e-4)


def test_degrees_are_reported_once_with_the_option_to_use(
    bench: Path, failing, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = "".join(f"{0.1 * k},{400.5 * k}\n" for k in range(9))
    wheels = [bench / "wheel.csv", bench / "cart.csv"]
    for k, path in enumerate(wheels):
        path.write_text("time,q1\n" + rows + f"0.9,{3600 + k}\n")

    def ends(*_: object, **__: object) -> None:
        raise ValueError("enough")

    monkeypatch.setattr("nfriction.evaluation.compare.compare", ends)
    words = [str(wheels[0]), "--test", str(wheels[1]), "--rig", str(bench / "bench.json")]
    assert cli.main(["compare", *words, "--out", str(bench / "w")]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("nfriction: warning: wheel, cart: positions look like degrees")
    assert "--degrees" in first
    assert "--columns q1=q1:counts/8192" in first
    assert second == "nfriction: error: enough"


def test_time_stamps_in_milliseconds_are_reported(bench: Path, capsys, monkeypatch) -> None:
    path = bench / "slow.csv"
    path.write_text("time,q1\n" + "".join(f"{k},{0.1 * k}\n" for k in range(9)))

    def ends(*_: object, **__: object) -> None:
        raise ValueError("enough")

    monkeypatch.setattr("nfriction.fitting.fit.fit", ends)
    out = str(bench / "w" / "m.json")
    assert cli.main(["fit", str(path), "--rig", str(bench / "bench.json"), "--out", out]) == 2
    first, _ = capsys.readouterr().err.splitlines()
    assert "slow" in first
    assert "milliseconds" in first


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("time,q1,q2,tau2", "no column tau1, so that joint is assumed to be passive; if "
         "it is driven, name it with --columns tau1=NAME."),
        ("time,q1,q2,torque1", "column torque1 looks like torque and is not read; if it is, name "
         'it with --columns "tau1=torque1".'),
    ],
)  # fmt: skip
def test_unread_torque_is_reported_once_with_the_option_to_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], header: str, message: str
) -> None:
    rows = "".join(f"{0.01 * k},0.1,0.2,0.3\n" for k in range(9))
    paths = [tmp_path / "a.csv", tmp_path / "b.csv"]
    for path in paths:
        path.write_text(f"{header}\n{rows}")
    parser = argparse.ArgumentParser()
    inputs.add_fit_options(parser)
    arguments = parser.parse_args(["--rig", "multiarm-double"])
    with warnings.catch_warnings():
        inputs.read_recordings(paths, inputs.read_rig("multiarm-double"), arguments)
    assert capsys.readouterr().err == f"nfriction: warning: a, b: {message}\n"


def test_robot_description_gives_the_same_result_as_a_rig_file(bench: Path, compared: Path) -> None:
    (bench / "bench.urdf").write_text(
        '<robot name="bench"><link name="wall"/><link name="rod"><inertial>'
        '<origin xyz="0 0 -0.15"/><mass value="0.15"/><inertia ixx="1e-4" iyy="1e-4" '
        'izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="joint1" type="continuous"><parent link="wall"/><child link="rod"/>'
        '<axis xyz="0 1 0"/></joint></robot>'
    )
    rig = ["--rig", str(bench / "bench.urdf"), "--angles", "relative,hanging"]
    assert compare(bench, bench / "robot", *rig, "--no-figures", models="NCFM,LFM") == 0
    ours, theirs = (results(out)["models"] for out in (bench / "robot", compared))
    for model in ("NCFM", "LFM"):
        for name, value in ours[model]["coefficients"].items():
            assert value == pytest.approx(theirs[model]["coefficients"][name], rel=1e-9)
        # The rig file also has the encoder resolution, which weights the samples of a lead-in.
        mine, other = (m[model]["test"]["b"]["free_run"]["all"] for m in (ours, theirs))
        assert mine == pytest.approx(other, rel=1e-4)


OWN = """
import torch
from nfriction.friction.laws import Coefficient, Law

def torque(qd, load, coefficients, v_smooth):
    return coefficients[..., 0] * torch.tanh(qd / v_smooth) + coefficients[..., 1] * qd * qd.abs()

STICKY = Law("sticky_joint", (Coefficient("K", "N m"), Coefficient("D", "N m s^2/rad^2")), torque)
OTHER = 5
TAKEN = Law("CVFM", (Coefficient("K", "N m"),), torque)
"""


@pytest.fixture
def own_law(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file with a user-defined law that no other test uses."""
    for name in ("_LAWS", "_MODELS", "_ALL", "_BY_TEXT", "_OWN"):
        monkeypatch.setattr(friction, name, dict(getattr(friction, name)))
    path = tmp_path / "my.py"
    path.write_text(OWN)
    return path


def test_user_defined_law_works_from_fit_to_export(
    bench: Path, own_law: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models = f"viscous,{own_law}:STICKY"
    assert compare(bench, tmp_path / "out", "--no-figures", models=models) == 0
    assert set(results(tmp_path / "out")["models"]) == {"no friction", "NCFM", "sticky_joint"}
    model = tmp_path / "out" / "models" / "sticky_joint.json"
    words = ["--law", f"{own_law}:STICKY"]
    assert cli.main(["info", str(model), *words]) == 0
    out = ["--format", "c", "--out", str(tmp_path / "c")]
    assert cli.main(["export", str(model), *out, *words]) == 0
    assert (tmp_path / "c" / "sticky_joint.c").is_file()
    assert "sticky_joint, sticky-joint" in capsys.readouterr().out
    assert inputs.models(f"neuro-fuzzy:{own_law}:STICKY,sticky-joint") == [
        "NFsticky_joint",
        "sticky_joint",
    ]


def test_file_of_a_law_is_part_of_printed_commands(own_law: Path) -> None:
    for name in inputs.models(f"{own_law}:STICKY,neuro-fuzzy:{own_law}:STICKY"):
        words = inputs.law_words(friction.model_by_name(name)(1).law.name)
        assert words == ["--law", f"{own_law}:STICKY"]
    assert inputs.law_words("CVFM") == []


@pytest.mark.parametrize(
    ("law", "message"),
    [
        ("my.py:STICKI", "has no law STICKI; its laws: STICKY"),
        ("my.py:OTHER", "has no law OTHER"),
        ("my.py:TAKEN", "CVFM is one of the library"),
        ("absent.py:STICKY", "absent.py does not exist"),
        ("broken.py:STICKY", "broken.py cannot be run: NameError"),
    ],
)
def test_unusable_law_is_named(
    law: str, message: str, own_law: Path, failing: Callable[..., str]
) -> None:
    (own_law.parent / "broken.py").write_text("STICKY = lw\n")
    words = ("a.csv", "--rig", "tlrip", "--model", own_law.parent / law)
    (own_law.parent / "a.csv").touch()
    assert message in failing("fit", own_law.parent / "a.csv", *words[1:])


def test_model_file_of_an_unknown_law_raises_error_with_remedy(
    own_law: Path, tmp_path: Path, failing: Callable[..., str]
) -> None:
    (name,) = inputs.models(f"{own_law}:STICKY")
    model = save(friction.model_by_name(name)(1), tmp_path / "sticky_joint.json")
    for known in (friction._LAWS, friction._MODELS, friction._ALL, friction._OWN):
        for name in [n for n in known if "sticky" in n]:
            del known[name]
    assert "name its law, --law my.py:LAW" in failing("export", model, "--format", "c")


def test_progress_counts_stages_and_states_the_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = [0.0]
    monkeypatch.setattr("nfriction.cli.console.time.monotonic", lambda: clock[0])
    with Progress() as progress:
        progress.expect(3)
        progress.expect(1)
        progress.stage("fit CVFM")
        assert capsys.readouterr().err == ""  # no progress lines in a run of a few seconds
        clock[0] = 12.0
        progress.step("2 s windows")
        clock[0] = 15.0
        progress.step("2 s windows")
        progress.done()
        progress.stage("fit NFCVFM")
        clock[0] = 30.0
        progress.step("0.5 s windows")
        clock[0] = 50.0
        progress.step("2 s windows")
    assert capsys.readouterr().err.splitlines() == [
        "nfriction: 1 of 4: fit CVFM, 2 s windows, step 1 (12 s)",
        "nfriction: 2 of 4: fit NFCVFM, 0.5 s windows, step 1 (30 s)",
        "nfriction: 2 of 4: fit NFCVFM, 2 s windows, step 2 (50 s)",
    ]


def test_fitted_plant_terms_are_printed_in_si() -> None:
    plant = PendulumChain([0.3, 0.2], [0.2, 0.15], inertia=[1e-3, 4e-4], armature=[0.01, 0.02])
    plant = plant.replace(armature=torch.tensor([0.01, 0.025]))
    changes = {"inertia 22": 0.0, "gravity 2": 0.0, "armature 2": 0.25, "length 1": 0.1}
    fit = FitResult(
        CVFM(2), plant, tuple((name, x, 0.3) for name, x in changes.items()), "", True, 0.0, (), 0,
        (), torch.zeros(0),
        intervals=tuple(Interval(n, 0.0, -0.1, 0.1) for n in ("F_c of joint1", *changes)),
    )  # fmt: skip
    terms = [line.partition("  ")[0] for line in interval_table(fit).splitlines()[2:]]
    assert "complete" not in interval_table(fit)
    doubted = replace(fit, warnings=("The intervals do not cover this.",))
    assert "of CVFM, assuming a complete model (plant" in interval_table(doubted)
    inertia, moment = float(plant.inertia_coupling[1, 1]), float(plant.gravity_moment[1])
    assert terms == [
        "F_c of joint1",
        f"inertia 22 ({inertia:.4g} -> {inertia:.4g} kg m^2)",
        f"gravity 2 ({moment:.4g} -> {moment:.4g} N m)",
        "armature 2 (0.02 -> 0.025 kg m^2)",
        "length 1",
    ]
    assert fit.to_dict()["names_with_si"]["armature 2"] == terms[3]
