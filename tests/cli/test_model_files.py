"""`fit`, `info` and `export`: from a recording to a model file, its description and artefact."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nfriction import (
    LFM,
    NFLFM,
    FitResult,
    LinearAxis,
    ModelInfo,
    Recording,
    cli,
    load,
    rigs,
    rollout,
    save,
)  # fmt: skip
from nfriction.fitting.fit import fit
from nfriction.friction import model_by_name
from nfriction.friction.memory import Gear
from nfriction.io.model_file import load_plant
from tests.cli.benches import QUICK


@pytest.fixture(scope="module")
def fitted(bench: Path) -> Path:
    model = bench / "fit" / "m.json"
    rig = ["--rig", str(bench / "bench.json"), "--model", "LFM", "--out", str(model)]
    assert cli.main(["fit", str(bench / "a.csv.gz"), *rig, *QUICK]) == 0
    return model


def values(text: str, row: str) -> list[float]:
    """Coefficients that a command printed in a row of its table."""
    (found,) = (line for line in text.splitlines() if line.startswith(f"{row} "))
    return [float(word) for word in found.removeprefix(row).split()]


def test_next_command_printed_by_fit_works(
    bench: Path, fitted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = ["--rig", str(bench / "bench.json"), "--model", "LFM", "--out", str(fitted)]
    assert cli.main(["fit", str(bench / "a.csv.gz"), *rig, *QUICK]) == 0
    output = capsys.readouterr().out
    model = load(fitted)
    assert isinstance(model, LFM)
    # As a rig, a model file is that of the fit.
    read, given = rigs.read(fitted), rigs.read(bench / "bench.json")
    assert not torch.equal(read.inertia_coupling, given.inertia_coupling)
    assert read.to_dict() == load_plant(fitted).to_dict()
    edited = fitted.with_name("edited.json")
    edited.write_text(fitted.read_text().replace('"kind": "chain"', '"kind": "axis"'))
    with pytest.raises(ValueError, match=r"edited.json: the checksum does not match"):
        rigs.read(edited)
    # Four digits are printed.
    assert values(output, "joint1") == pytest.approx(model.schedule.values[0].tolist(), rel=1e-3)
    (command,) = (line for line in output.splitlines() if line.startswith("next: "))
    words = command.split()[2:]
    assert cli.main([*words, "--out", str(bench / "x")]) == 0
    assert str(bench / "x" / "m.pt") in capsys.readouterr().out
    torch.jit.load(bench / "x" / "m.pt")


def test_unconverged_fit_is_not_recommended_for_export(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = ["--rig", str(bench / "bench.json"), "--model", "LFM", "--out", str(tmp_path / "m.json")]
    words = ["fit", str(bench / "a.csv.gz"), *rig, *QUICK, "--max-steps", "0"]
    assert cli.main(words) == 0
    output = capsys.readouterr().out
    assert "LFM: doubtful (the search did not converge). Not converged" in output
    assert f"wrote {tmp_path / 'm.json'}" in output
    assert "next:" not in output


def test_unusable_fit_is_exported_with_its_rating(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    time = 0.01 * np.arange(200)
    driven = Recording(time, 0.5 * time[:, None] ** 2, convention="absolute,hanging")
    driven.write(tmp_path / "driven.csv")
    words = ["--rig", str(bench / "bench.json"), "--model", "LFM", *QUICK]
    out = ["--out", str(tmp_path / "m.json")]
    assert cli.main(["fit", str(tmp_path / "driven.csv"), *words, *out]) == 0
    output = capsys.readouterr().out
    assert "do not use (a mistake in data or rig is likely" in output
    assert "gains energy" in output
    assert "next:" not in output
    model, rating = str(tmp_path / "m.json"), "do not use: a mistake in data or rig is likely"
    assert cli.main(["info", model]) == 0
    assert f"rating:        {rating}" in capsys.readouterr().out
    assert cli.main(["export", model, "--format", "c", "--out", str(tmp_path)]) == 0
    assert f"m.json has the rating '{rating}" in capsys.readouterr().err
    assert f"Rating of the fit: {rating}" in (tmp_path / "m.h").read_text()


def test_model_unsuitable_for_controllers_is_not_recommended_for_export(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def quick(*task: Any, **_: object) -> FitResult:
        return fit(*task, method="equation_error")

    monkeypatch.setattr("nfriction.fitting.fit.fit", quick)
    axis, time = LinearAxis(0.5, name="axis"), 4e-3 * np.arange(500)
    rigs.write(axis, tmp_path / "axis.json")
    truth = Gear(1, [0.4, 0.08, 0.2, 0.3, 400.0]).requires_grad_(False)
    force = (3.0 * np.sin(5 * time) + np.sin(13 * time))[:, None]
    zero = torch.zeros(1, dtype=torch.float64)
    run = rollout(axis, truth, zero, zero, torch.tensor(force[:-1]), sample_time=4e-3)
    for name, each in (("a", 1), ("b", 2)):
        q, tau = run.q.numpy()[::each], force[::each]
        Recording(time[::each], q, tau=tau, unit="m").write(tmp_path / f"{name}.csv")
    out = ["--rig", str(tmp_path / "axis.json"), "--out", str(tmp_path / "m.json")]
    # A law with memory is advanced by one sample time; recordings with different ones define none.
    for model, names, exportable in (("gear", "a", True), ("dahl", "ab", False)):
        logs = [str(tmp_path / f"{name}.csv") for name in names]
        assert cli.main(["fit", *logs, "--model", model, *out]) == 0
        output = capsys.readouterr().out
        assert ("next:" in output) is exportable, output


def test_info_prints_the_contents_of_the_file(
    fitted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["info", str(fitted)]) == 0
    output = capsys.readouterr().out
    model = load(fitted)
    assert values(output, "joint1") == pytest.approx(model.schedule.values[0].tolist(), rel=1e-3)
    for word in ("LFM", "bench", "0.002 s", "rad/s^2", "B [N m s/rad]", "C [N m]", "trained on:"):
        assert word in output


def test_info_of_a_minimal_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = NFLFM(2, [3.0, 4.0])
    save(model, tmp_path / "m.json", ModelInfo(unit="m"))
    assert cli.main(["info", str(tmp_path / "m.json")]) == 0
    output = capsys.readouterr().out
    assert "B [N s/m]" in output
    # An untrained network equals its reference everywhere.
    assert "at rest" not in output
    assert values(output, "joint2") == pytest.approx([3.0, 4.0])


def test_info_of_many_coefficients_fits_a_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = model_by_name("slip")(2)
    file = save(model, tmp_path / "slip.json", ModelInfo(sample_time=1e-3))
    assert cli.main(["info", str(file)]) == 0
    output = capsys.readouterr().out
    for k, coefficient in enumerate(model.law.coefficients):
        (row,) = (line for line in output.splitlines() if line.startswith(f"{coefficient.name} "))
        shown = [float(word) for word in row.split()[-2:]]
        assert shown == pytest.approx(model.schedule.values[:, k].tolist(), rel=1e-3)
    assert max(map(len, output.splitlines())) <= 100
