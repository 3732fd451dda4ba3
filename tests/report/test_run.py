"""Folders that are no run are refused in a line; what is missing is said."""

import copy
import json
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nfriction.report import RunError, read_run, to_html
from tests.report.runs import results, write


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("run"))


def test_a_run_is_what_its_files_say(folder):
    run = read_run(folder)
    assert run.best == "LFM"
    assert list(run.fits) == ["LFM", "NLFM", "NFLFM"]
    assert set(run.models) == {"LFM", "NFLFM"}
    assert run.comparison.table()["all"]["LFM"] == pytest.approx(0.1)
    assert run.comparison.scores()["NLFM"][0].diverged_at == 0.5
    assert {f.name for f in run.figures} == {"positions_train_calm", "rmse_test"}
    assert (run.figures[0].width, run.figures[0].height) == (800, 200)
    assert any("NLFM" in note for note in run.notes)  # its model file is not there


def test_a_damaged_model_or_figure_is_said_and_does_not_stop_the_report(tmp_path):
    folder = write(tmp_path)
    path = folder / "models" / "LFM.json"
    path.write_bytes(path.read_bytes()[:-20])
    (folder / "figures" / "rmse_test.png").write_text("<svg onload=alert(1)>")
    run = read_run(folder)
    assert "LFM" not in run.models
    said = " ".join(run.notes)
    assert "LFM" in said
    assert "rmse_test.png: not a PNG or GIF file" in said
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
    ("where", "value", "said"),
    [
        (("units",), "deg", "units"),
        (("schema",), 4, "schema is 4, not 3"),
        (("joints",), [], "no joints"),
        (("joints",), ["only one"], "each of 1 joints"),
        (("models",), [], "models"),
        (("models", "LFM", "test"), {}, "different recordings"),
        (("models", "LFM", "test"), {"x": {"free_run": {"joints": [1], "all": 1}}}, "each of 2"),
        (("models", "LFM", "fit"), "good", "fit of LFM"),
        (("models", "LFM", "fit", "warnings"), "none", "must be a list"),
        (("models", "LFM", "fit", "intervals"), {"B": [1]}, "needs 2 values"),
        (("models", "LFM", "coefficients"), {"B": [1, True]}, "number"),
        (("best",), {"model": "../../x"}, "none of its models"),
        (("command",), 3, "command"),
    ],
)  # fmt: skip
def test_entries_of_another_form_are_refused(tmp_path, where, value, said):
    content = results()
    entry = content
    for key in where[:-1]:
        entry = entry[key]
    entry[where[-1]] = value
    write(tmp_path, content)
    assert said in one_line(tmp_path)


def test_not_a_number_is_no_json(tmp_path):
    write(tmp_path)
    path = tmp_path / "results.json"
    path.write_text(path.read_text().replace("0.1", "NaN", 1))
    assert "NaN" in one_line(tmp_path)


def paths(value: object, at: tuple = ()) -> list[tuple]:
    """Every place in a JSON value."""
    children = (
        value.items() if isinstance(value, dict)
        else enumerate(value) if isinstance(value, list) else ()
    )  # fmt: skip
    return [at, *(p for key, child in children for p in paths(child, (*at, key)))]


JUNK = st.sampled_from([None, True, "x", -1, 1e400, 10**400, [], {}, [[]], {"joints": {}}])


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(place=st.sampled_from(paths(results())[1:]), junk=JUNK)
def test_junk_anywhere_is_read_or_refused_and_nothing_else(folder, tmp_path, place, junk):
    content = copy.deepcopy(results())
    entry = content
    for key in place[:-1]:
        entry = entry[key]
    entry[place[-1]] = junk
    text = json.dumps(content).replace("Infinity", "1e999")
    (tmp_path / "results.json").write_text(text)
    refused = ""
    try:
        html = to_html(read_run(tmp_path))
    except RunError as error:
        refused = str(error)
    assert "\n" not in refused
    assert refused or html.startswith("<!DOCTYPE html>")
