"""How recordings are read as options say, and what a user is told of those that do not fit."""

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nfriction import cli, rigs
from nfriction.cli import inputs
from nfriction.fitting.options import DEFAULTS
from tests.cli.benches import compare, pendulum, results


def test_what_is_not_given_is_left_to_the_fit() -> None:
    parser = argparse.ArgumentParser()
    inputs.add_fit_options(parser)
    settings = inputs.fit_settings(parser.parse_args(["--rig", "tlrip"]))
    assert "windows" not in settings
    assert settings["drag"] is None
    assert settings["encoder_reference"] == "auto"
    assert settings["continuity"] == "none"
    assert f"(default: {','.join(f'{w:g}' for w in DEFAULTS.windows)})" in " ".join(
        parser.format_help().split()
    )
    told = parser.parse_args(
        [
            "--rig",
            "tlrip",
            "--windows",
            "1,3",
            "--no-drag",
            "--encoder-reference",
            "per_recording",
            "--continuity",
            "penalty",
        ]
    )
    settings = inputs.fit_settings(told)
    assert settings["windows"] == (1.0, 3.0)
    assert settings["drag"] is False
    assert settings["encoder_reference"] == "per_recording"
    assert settings["continuity"] == "penalty"


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("absent.csv", None, "check the path"),
        ("empty.csv", b"", "is empty"),
        ("short.csv.gz", b"\x1f\x8b\x08\x00", "truncated"),
        ("text.csv", b"time,q1\n" + b"0.1,hello\n" * 9, "must be a number"),
        ("nan.csv", b"time,q1\n" + b"".join(b"%d,nan\n" % k for k in range(9)), "finite"),
        ("two.csv", b"time,q1,q2\n" + b"".join(b"0.%d,1,2\n" % k for k in range(9)), "2 joints"),
        ("names.csv", b"time,enc_1\n" + b"".join(b"0.%d,1\n" % k for k in range(9)),
         "--columns q1=NAME"),
        ("log.xlsx", b"0", ".parquet"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("as_test", [False, True])
def test_files_that_are_no_recordings(
    bench: Path, failing, name: str, content: bytes | None, said: str, as_test: bool
) -> None:
    if content is not None:
        (bench / name).write_bytes(content)
    files = [bench / "a.csv.gz", "--test", bench / name] if as_test else [bench / name]
    line = failing("compare", *files, "--rig", bench / "bench.json", "--out", bench / "bad")
    assert said in line
    assert name in line


def test_test_recordings_are_unseen(bench: Path, failing) -> None:
    (bench / "copy.csv.gz").write_bytes((bench / "a.csv.gz").read_bytes())
    for other in ("a.csv.gz", "copy.csv.gz"):
        words = ["compare", bench / "a.csv.gz", "--test", bench / other]
        assert "not seen" in failing(*words, "--rig", bench / "bench.json", "--out", bench / "bad")


def rewritten(bench: Path, folder: Path, change, header: Sequence[str]) -> Path:
    """The bench with its recordings written in another way, their comments gone."""
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
        # A file that says nothing is written as the rig's encoders write.
        (lambda q: q, ("time", "q1"), []),
    ],
)  # fmt: skip
def test_options_tell_how_files_are_written(
    bench: Path, compared: Path, tmp_path: Path, change, header, options: list[str]
) -> None:
    folder = rewritten(bench, tmp_path, change, header)
    assert compare(folder, folder / "out", *options, "--no-figures") == 0
    # Degrees and back cost a rounding.
    assert errors(folder / "out") == pytest.approx(errors(compared), rel=1e-4)


def test_degrees_are_told_once_with_the_option_that_helps(
    bench: Path, failing, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = "".join(f"{0.1 * k},{400.0 * k}\n" for k in range(9))
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


def test_stamps_in_milliseconds_are_told(bench: Path, capsys, monkeypatch) -> None:
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
    ("header", "said"),
    [
        ("time,q1,q2,tau2", "no column tau1, so that joint is assumed to be passive; if "
         "it is driven, name it with --columns tau1=NAME."),
        ("time,q1,q2,torque1", "column torque1 looks like torque and is not read; if it is, name "
         'it with --columns "tau1=torque1".'),
    ],
)  # fmt: skip
def test_torque_that_is_not_read_is_told_once_with_the_option_that_helps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], header: str, said: str
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
    assert capsys.readouterr().err == f"nfriction: warning: a, b: {said}\n"


def test_a_robot_description_is_as_good_as_a_rig_file(bench: Path, compared: Path) -> None:
    (bench / "bench.urdf").write_text(
        '<robot name="bench"><link name="wall"/><link name="rod"><inertial>'
        '<origin xyz="0 0 -0.15"/><mass value="0.15"/><inertia ixx="1e-4" iyy="1e-4" '
        'izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="joint1" type="continuous"><parent link="wall"/><child link="rod"/>'
        '<axis xyz="0 1 0"/></joint></robot>'
    )
    rig = ["--rig", str(bench / "bench.urdf"), "--angles", "relative,hanging"]
    assert compare(bench, bench / "robot", *rig, models="NCFM,LFM") == 0
    ours, theirs = (results(out)["models"] for out in (bench / "robot", compared))
    for model in ("NCFM", "LFM"):
        for name, value in ours[model]["coefficients"].items():
            assert value == pytest.approx(theirs[model]["coefficients"][name], rel=1e-9)
        # The rig file knows the encoder's rounding besides, which weighs the samples of a lead-in.
        mine, other = (m[model]["test"]["b"]["free_run"]["all"] for m in (ours, theirs))
        assert mine == pytest.approx(other, rel=1e-4)
