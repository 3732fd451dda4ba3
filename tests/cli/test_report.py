"""`nfriction report` as a user runs it."""

import shutil
from pathlib import Path

from nfriction import cli
from nfriction.evaluation.results import COMPLETE
from nfriction.friction import both_names
from tests.cli.benches import compare, results


def test_a_comparison_becomes_a_page(compared: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "pages" / "mine.html"
    assert cli.main(["report", str(compared), "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"wrote {out}\n"
    html = out.read_text(encoding="utf-8")
    figures = list((compared / "figures").glob("*.png"))
    assert html.count("data:image/png;base64,") == len(figures) > 0
    best = results(compared)["best"]["model"]
    assert f"<strong>{both_names(best)}</strong> predicts" in html
    assert "nfriction compare" in html


def test_page_is_written_to_the_folder_by_default(compared: Path) -> None:
    assert cli.main(["report", str(compared)]) == 0
    first = (compared / "report.html").read_bytes()
    assert cli.main(["report", str(compared)]) == 0
    assert (compared / "report.html").read_bytes() == first


def test_folder_without_a_run_is_refused_in_one_line(
    bench: Path, compared: Path, tmp_path, failing
) -> None:
    assert "no folder" in failing("report", tmp_path / "absent")
    assert "results.json" in failing("report", bench)
    assert "is a folder" in failing("report", compared, "--out", tmp_path)
    (tmp_path / "results.json").write_text('{"models": {')
    assert "cut short" in failing("report", tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_missing_model_raises_a_warning(tmp_path: Path, compared: Path, capsys) -> None:
    (tmp_path / "results.json").write_bytes((compared / "results.json").read_bytes())
    assert cli.main(["report", str(tmp_path)]) == 0
    assert "warning: NCFM: its model file could not be read" in capsys.readouterr().err


def test_a_rerun_refreshes_the_page_in_its_folder(bench: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for models in ("NCFM", "LFM"):
        assert compare(bench, out, "--no-figures", models=models) == 0
        if models == "NCFM":
            assert cli.main(["report", str(out)]) == 0
    html = (out / "report.html").read_text(encoding="utf-8")
    assert f'content="{results(out)["run"]}"' in html
    assert "<h3>load-coulomb (LFM)</h3>" in html
    assert "NCFM" not in html


def test_files_of_two_runs_are_refused(
    bench: Path, compared: Path, tmp_path: Path, failing
) -> None:
    assert compare(bench, tmp_path, "--no-figures", "--max-steps", "1") == 0
    (tmp_path / "models" / "NCFM.json").write_bytes((compared / "models/NCFM.json").read_bytes())
    assert "files of two runs: models/NCFM.json" in failing("report", tmp_path)


def test_run_killed_at_its_end_is_completed(compared: Path, tmp_path: Path, capsys) -> None:
    whole = tmp_path / "whole"
    shutil.copytree(compared, whole / COMPLETE)
    assert cli.main(["report", str(whole)]) == 0
    assert "warning" not in capsys.readouterr().err
    assert results(whole) == results(compared)
    assert not list(whole.glob(".*"))
