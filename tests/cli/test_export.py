"""`export` and `verify`: a model file to every target, and the verdict as exit status."""

import argparse
import json
import re
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nfriction import LFM, NFLFM, ModelInfo, Recording, cli, rigs, save
from nfriction.cli import export
from nfriction.cli.console import Commands, Parser
from nfriction.export.c_dialect import ControllerC
from nfriction.export.c_file import find_compiler
from tests.friction.samples import randomise

RIG = rigs.tlrip()


@pytest.fixture
def model(tmp_path: Path) -> Path:
    made = LFM(RIG.joints)
    randomise(made, 0.3)
    info = ModelInfo(joint_names=tuple(RIG.joint_names), sample_time=1e-3, rig=RIG.to_dict())
    return save(made, tmp_path / "lfm.json", info)


def run_verify(*words: Any) -> int:
    parser = Parser()
    export.add_verify(Commands(parser))
    arguments = parser.parse_args(["verify", *map(str, words)], argparse.Namespace())
    return int(arguments.run(arguments))


def test_export_to_controllers_and_verification(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    limits = ",".join(["3"] * RIG.joints)
    words = ["--format", "torchscript,c", "--out", str(out), "--torque-limit", limits]
    assert cli.main(["export", str(model), *words]) == 0
    printed = capsys.readouterr().out
    assert str(out / "lfm.pt") in printed
    artefacts = [out / "lfm.pt", *([out / "lfm.c"] if find_compiler() else [])]
    for artefact in artefacts:
        assert run_verify(artefact, model, "--points", 300) == 0
        printed = capsys.readouterr().out
        assert "drawn points" in printed
        assert f"{artefact.name} is lfm.json" in printed
    # Without the TorchScript file, which runs in a separate process if there is a C compiler.
    other = save(LFM(RIG.joints, [1.0, 1.0]), tmp_path / "other.json")
    assert run_verify(artefacts[-1], other) == 1
    printed = capsys.readouterr().out
    assert "DIFFERENT" in printed
    assert f"{artefacts[-1].name} IS NOT other.json" in printed


def test_paper_network_is_also_exported_for_online_learning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = save(NFLFM(2, network="rbf"), tmp_path / "arm.json")
    words = ["export", str(path), "--out", str(tmp_path), "--online", "0.02"]
    assert cli.main([*words, "--format", "c"]) == 0
    assert "arm_online_learn(" in (tmp_path / "arm_online.h").read_text("ascii")
    capsys.readouterr()
    assert cli.main(words) == 2
    assert "--online needs c in --format" in capsys.readouterr().err
    other = save(LFM(2), tmp_path / "lfm.json")
    failed = cli.main(["export", str(other), *words[2:], "--format", "c"])
    assert failed
    assert 'network="rbf"' in capsys.readouterr().err


@pytest.mark.skipif(find_compiler() is None, reason="needs a C compiler")
def test_two_exports_link_into_one_program(tmp_path: Path) -> None:
    """Also with default names, those of the model files; one is a C keyword."""
    torques = {"upper-arm 2": "upper_arm_2", "int": "nf_int"}
    for scale, (stem, name) in enumerate(torques.items(), 1):
        path = save(LFM(1, [0.1 * scale, 0.0]), tmp_path / f"{stem}.json")
        assert cli.main(["export", str(path), "--format", "c", "--out", str(tmp_path)]) == 0
        assert (tmp_path / f"{name}.c").is_file()
    calls = "".join(
        f"{name}_step(&x, &x, &x, &tau, c, &s); sum += tau; " for name in torques.values()
    )
    includes = "".join(f'#include "{name}.h"\n' for name in torques.values())
    (tmp_path / "main.c").write_text(
        f"{includes}int main(void) {{ double x = 1, tau, sum = 0, c[2]; int s; {calls}"
        "return (int)(100 * sum + 0.5); }\n"
    )
    sources = ["main.c", *(f"{name}.c" for name in torques.values())]
    compiler = find_compiler()
    assert compiler is not None
    subprocess.run([*compiler, *sources, "-o", "both", "-lm"], cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "both"], check=False).returncode == 30


def test_exported_c_is_run_or_reported_as_not_run(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["export", str(model), "--format", "c", "--out", str(tmp_path / "out")]
    if find_compiler() is not None:
        assert cli.main(words) == 0
        assert "not run" not in capsys.readouterr().out
        before = [*(tmp_path / "out").rglob("*")]
        monkeypatch.setattr(ControllerC, "literal", lambda self, value: "0.5")
        assert cli.main(words) == 2
        assert "lfm.c differs from its model and was not written" in capsys.readouterr().err
        assert [*(tmp_path / "out").rglob("*")] == before
    monkeypatch.setenv("CC", "absent-compiler")
    assert cli.main(words) == 0
    assert "lfm.c was not run here; run its self-test" in capsys.readouterr().out


@pytest.mark.parametrize(
    "targets", ["torchscript,c", pytest.param("pt2,onnx", marks=pytest.mark.slow)]
)
def test_artefacts_in_the_folder_of_a_model_do_not_overwrite_it(model: Path, targets: str) -> None:
    before = model.read_bytes()
    assert cli.main(["export", str(model), "--format", targets, "--out", str(model.parent)]) == 0
    assert model.read_bytes() == before


def test_export_to_simulators(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    time = 1e-3 * np.arange(2000)
    phase = 5 * time[:, None] + np.arange(RIG.joints)
    recording = Recording(time, np.sin(phase), names=tuple(RIG.joint_names))
    recording.write(tmp_path / "run.csv")
    words = ["--format", "mjcf,urdf", "--recording", str(tmp_path / "run.csv")]
    assert cli.main(["export", str(model), *words, "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert printed.count("RMS") == 2 * RIG.joints
    for name in ("lfm.xml", "lfm.urdf"):
        assert RIG.joint_names[0] in (tmp_path / name).read_text()


def test_recording_in_degrees_with_own_names_gives_the_same_result(
    model: Path, tmp_path: Path
) -> None:
    time = 1e-3 * np.arange(2000)
    q = np.sin(5 * time[:, None] + np.arange(RIG.joints))
    ours = ["time", *(f"q{j + 1}" for j in range(RIG.joints))]
    theirs = ["t", *(f"enc_{j + 1}" for j in range(RIG.joints))]
    pairs = ",".join(f"{a}={b}" for a, b in zip(ours, theirs, strict=True))
    found = []
    for columns, angles, words in (
        (ours, q, []),
        (theirs, np.rad2deg(q), ["--degrees", "--columns", pairs]),
    ):
        path = tmp_path / f"{columns[0]}.csv"
        rows = np.column_stack([time, angles])
        np.savetxt(path, rows, "%.15g", ",", header=",".join(columns), comments="")
        words = ["--angles", "relative,upright", "--recording", str(path), *words]
        words = ["--format", "urdf", *words]
        assert cli.main(["export", str(model), *words, "--out", str(tmp_path / columns[0])]) == 0
        text = (tmp_path / columns[0] / "lfm.urdf").read_text()
        found.append([float(x) for x in re.findall(r'(?:damping|friction)="([^"]+)"', text)])
    assert len(found[0]) == 2 * RIG.joints
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--format", "basic"], "cannot export to 'basic'; there are torchscript, c, pt2"),
        (["--format", ","], "needs some of"),
        (["--format", "mjcf"], "--recording"),
        (["--torque-limit", "-1"], "positive numbers"),
        (["--torque-limit", "1,2"], "--torque-limit needs one number or one per joint, got 2"),
        (["--cutoff", "1,2"], "must be one number"),
        (
            ["--with-filter", "--cutoff", "900"],
            "--cutoff must be below half the sampling frequency",
        ),
        (["--with-filter", "--sample-time", "0.1"], "frequency, 5 Hz, got 20"),
        (
            ["--format", "c,torchscript,onnx", "--with-filter", "--dtype", "float32"],
            "the filter of ONNX needs float64",
        ),
        (["--name", 32 * "a", "--format", "c"], "at most 31 letters"),
        (
            ["--name", 25 * "a", "--format", "c", "--online", "0.1"],
            "up to 31 letters, got '" + 25 * "a" + "_online'",
        ),
        (["--format", "c,urdf", "--recording", "model.json"], "lfm.json"),
        (["--format", "c", "--online", "0.1"], 'network="rbf"'),
        (["--online", "0.1"], "--online needs c in"),
        (["--online", "0.1,0.2", "--format", "c"], "--online: must be one number"),
    ],
)
def test_impossible_exports_are_refused(
    model: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [word.replace("model.json", str(model)) for word in words]
    assert cli.main(["export", str(model), *words, "--out", str(model.parent / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not list((model.parent / "out").glob("*"))


@pytest.mark.parametrize("length", [25, 31])
def test_name_is_used_for_all_files(model: Path, tmp_path: Path, length: int) -> None:
    name, words = length * "a", ["--format", "c,torchscript", "--out", str(tmp_path / "out")]
    assert cli.main(["export", str(model), "--name", name, *words]) == 0
    assert {path.name.partition(".")[0] for path in (tmp_path / "out").iterdir()} == {
        name, f"{name}_selftest", f"{name}_sfun",
    }  # fmt: skip


def test_filter_is_included(model: Path, tmp_path: Path) -> None:
    words = ["--with-filter", "--cutoff", "30", "--format", "c", "--out", str(tmp_path / "out")]
    assert cli.main(["export", str(model), *words]) == 0
    contract = json.loads((tmp_path / "out" / "lfm.contract.json").read_text())
    assert contract["filter"]["cutoff_hz"] == 30.0


@pytest.mark.parametrize("suffix", [".c", ".pt"])
def test_controller_rate_may_differ_from_the_recordings(
    model: Path, tmp_path: Path, suffix: str
) -> None:
    if suffix == ".c" and not find_compiler():
        pytest.skip("no C compiler")
    words = ["--with-filter", "--sample-time", "4e-3", "--format", "c,torchscript"]
    assert cli.main(["export", str(model), *words, "--out", str(tmp_path)]) == 0
    assert "Sample time: 0.004 s" in (tmp_path / "lfm.h").read_text("ascii")
    assert run_verify(tmp_path / f"lfm{suffix}", model, "--points", 300) == 0
