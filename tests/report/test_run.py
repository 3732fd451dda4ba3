"""Folders without a run are refused in one line; missing parts are reported."""

import json
from pathlib import Path

import pytest

from nfriction.report import RunError, read_run, to_html
from tests.report.runs import results, write


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("run"))


def test_run_contains_what_is_in_its_files(folder):
    run = read_run(folder)
    assert run.best == "LFM"
    assert list(run.fits) == ["LFM", "NLFM", "NFLFM"]
    assert set(run.models) == {"LFM", "NFLFM"}
    assert run.comparison.table()["all"]["LFM"] == pytest.approx(0.1)
    assert run.comparison.scores()["NLFM"][0].diverged_at == 0.5
    assert {f.name for f in run.figures} == {"positions_train_calm", "rmse_test"}
    assert (run.figures[0].width, run.figures[0].height) == (800, 200)
    assert any("NLFM" in note for note in run.notes)  # its model file is missing


def test_damaged_model_or_figure_is_reported_without_stopping(tmp_path):
    folder = write(tmp_path)
    path = folder / "models" / "LFM.json"
    path.write_bytes(path.read_bytes()[:-20])
    (folder / "figures" / "rmse_test.png").write_text("<svg onload=alert(1)>")
    run = read_run(folder)
    assert "LFM" not in run.models
    notes = " ".join(run.notes)
    assert "LFM" in notes
    assert "rmse_test.png: not a PNG or GIF file" in notes
    assert "<svg" not in to_html(run)


def one_line(folder: Path) -> str:
    with pytest.raises(RunError) as caught:
        read_run(folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_folder_without_results_is_refused(tmp_path):
    assert "results.json" in one_line(tmp_path)


@pytest.mark.parametrize("keep", [0, 1, 100, -1])
def test_truncated_results_are_refused(tmp_path, keep):
    write(tmp_path)
    path = tmp_path / "results.json"
    path.write_text(path.read_text()[:keep])
    assert "cut short" in one_line(tmp_path)


@pytest.mark.parametrize(
    ("where", "value"),
    [
        (("units",), "deg"),
        (("joints",), ["only one"]),
        (("models", "LFM", "test"), {}),
        (("models", "LFM", "fit", "intervals"), {"B": [1]}),
        (("models", "LFM", "coefficients"), {"B": [1, True]}),
        (("best",), {"model": "../../x"}),
    ],
)
def test_edited_entries_are_refused(tmp_path, where, value):
    write(tmp_path)
    path = tmp_path / "results.json"
    content = entry = json.loads(path.read_text())
    for key in where[:-1]:
        entry = entry[key]
    entry[where[-1]] = value
    path.write_text(json.dumps(content))
    assert "damaged or edited" in one_line(tmp_path)


def test_results_of_another_schema_or_program_are_refused(tmp_path):
    write(tmp_path, results() | {"schema": 5})
    assert "schema 4; run the comparison again" in one_line(tmp_path)
    write(tmp_path, {"schema": 4, "joints": ["a"]})
    assert "not results of a comparison" in one_line(tmp_path)


def test_encoder_offset_that_is_no_number_is_refused(tmp_path):
    """Although the checksum matches."""
    content = results()
    for of in content["models"]["LFM"]["test"].values():
        of["zero"] = "off"
    write(tmp_path, content)
    assert "not results of a comparison" in one_line(tmp_path)


def test_nan_is_not_valid_json(tmp_path):
    write(tmp_path)
    path = tmp_path / "results.json"
    path.write_text(path.read_text().replace("0.1", "NaN", 1))
    assert "NaN" in one_line(tmp_path)
