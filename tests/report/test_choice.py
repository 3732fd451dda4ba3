"""The choice on training data alone, and failed models, on the page."""

import json
import math
from pathlib import Path

from nfriction.evaluation.cross_validation import Candidate, Selection
from nfriction.io.files import checked_json
from nfriction.report.page import to_html
from nfriction.report.run import read_run
from tests.report.runs import EVIL, results

CHOICE = Selection(
    "LFM", f"because {EVIL}",
    (Candidate("LFM", (1e-3, 2e-3), 4, True), Candidate(EVIL, (1e-3, math.inf), 90, False)),
    2.0, "rad",
)  # fmt: skip


def folder(path: Path, **changes: object) -> Path:
    (path / "results.json").write_text(json.dumps(checked_json(results() | changes)))
    return path


def test_the_choice_is_read_back_and_shown(tmp_path: Path) -> None:
    run = read_run(folder(tmp_path, selection=CHOICE.to_dict()))
    assert run.selection == CHOICE
    page = to_html(run)
    assert "Model selection (training data only)" in page
    assert "2 s simulations" in page
    assert EVIL not in page


def test_without_a_choice_there_is_no_section(tmp_path: Path) -> None:
    for k, none in enumerate(({}, {"selection": None})):
        (tmp_path / str(k)).mkdir()
        run = read_run(folder(tmp_path / str(k), **none))
        assert run.selection is None
        assert "Model selection (training data only)" not in to_html(run)


def test_failed_models_and_warnings_of_test_recordings_are_shown(tmp_path: Path) -> None:
    found = {"failed": {"ALFM": f"no classes {EVIL}"}, "test_warnings": [f"b: a mistake {EVIL}"]}
    page = to_html(read_run(folder(tmp_path, **found)))
    for expected in ("Not fitted. ", "no classes", "<li>b: a mistake "):
        assert expected in page
    assert EVIL not in page
