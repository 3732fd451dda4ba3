"""`nfriction fit-torque` and `nfriction score-torque`."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nfriction.cli import main
from nfriction.evaluation.torque_tables import fit_torque
from nfriction.report.torque import write_torque_fits


@pytest.fixture
def csv(tmp_path: Path) -> Path:
    """Constant-velocity tests of a joint with Coulomb and viscous friction."""
    rng = np.random.default_rng(0)
    qd = np.repeat(np.concatenate([np.linspace(-2, -0.1, 15), np.linspace(0.1, 2, 15)]), 4)
    tau = 1.5 * np.sign(qd) + 0.4 * qd + rng.normal(0, 0.05, len(qd))
    path = tmp_path / "table.csv"
    rows = "".join(f"{v:.6f},{t:.6f}\n" for v, t in zip(qd, tau, strict=True))
    path.write_text("speed,tau\n" + rows)
    return path


def test_a_table_is_fitted_scored_and_exported(
    csv: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    out = tmp_path / "run"
    words = ["--columns", "qd=speed", "--models", "viscous,coulomb-viscous"]
    assert main(["fit-torque", str(csv), *words, "--out", str(out), "--no-figures"]) == 0
    printed = capsys.readouterr().out
    assert "NRMSE on hold-out blocks" in printed
    assert f"wrote {out / 'report.html'}" in printed
    results = json.loads((out / "results.json").read_text())
    assert results["chosen"]["joint1"]["model"] == "CVFM"
    assert results["command"].startswith("nfriction fit-torque")
    for model in (out, out / "models" / "CVFM.json"):
        assert main(["score-torque", str(model), str(csv), "--columns", "qd=speed"]) == 0
        row = capsys.readouterr().out.splitlines()[-1].split()
        assert row[:2] == ["joint1", "coulomb-viscous"]
        assert float(row[3]) < 0.05
        assert float(row[2]) < 2 * float(row[4])
    warm = tmp_path / "warm.csv"
    rows = [line.split(",") for line in csv.read_text().splitlines()]
    warm.write_text("\n".join([",".join(rows[0]), *(f"{a},{0.7 * float(b)}" for a, b in rows[1:])]))
    assert main(["score-torque", str(out), str(warm), "--columns", "qd=speed"]) == 0
    assert "twice those on blocks left out of the training table (times, at joint1: " in caplog.text
    file = str(out / "models" / "CVFM.json")
    assert main(["info", file]) == 0
    assert "coulomb-viscous" in capsys.readouterr().out
    assert main(["export", file, "--format", "torchscript", "--out", str(tmp_path)]) == 0


def test_second_run_removes_files_of_the_first_in_its_folder(tmp_path: Path) -> None:
    qd = np.linspace(-1, 1, 40)
    table = pd.DataFrame({"qd": qd, "tau": 0.3 * np.sign(qd) + 0.2 * qd})
    write_torque_fits(fit_torque(table, "viscous,coulomb", folds=2), tmp_path, figures=False)
    # Of the user, and as `compare` writes beside each model.
    index = json.loads((tmp_path / "results.json").read_text())
    for name in ("notes.txt", "models/CFM.pt"):
        (tmp_path / name).touch()
        index["files"].append(name)
    (tmp_path / "results.json").write_text(json.dumps(index))
    write_torque_fits(fit_torque(table, "viscous", folds=2), tmp_path, figures=False)
    found = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*.*")}
    assert found == {"models/NCFM.json", "notes.txt", "report.html", "results.json", "table.csv"}


def test_errors_are_one_line_with_the_remedy(
    csv: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fit-torque", str(csv), "--out", str(tmp_path / "run")]) == 2
    line = capsys.readouterr().err
    assert "column qd is missing; found speed, tau" in line
    assert '--columns "qd=speed"' in line
    assert main(["score-torque", str(tmp_path), str(csv)]) == 2
    assert "no folder written by fit-torque" in capsys.readouterr().err
    assert main(["score-torque", str(tmp_path / "none"), str(csv)]) == 2
    assert "does not exist" in capsys.readouterr().err
    words = ["--columns", "qd=speed", "--folds", "1"]
    assert main(["fit-torque", str(csv), *words]) == 2
    assert "--folds must be at least 2" in capsys.readouterr().err
