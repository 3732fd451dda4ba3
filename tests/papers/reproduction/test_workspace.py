"""What counts as finished: a whole result of these very settings, and nothing else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nfriction.papers.reproduction.workspace import FULL, QUICK, Workspace


def test_a_finished_stage_is_found_again(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path, QUICK)
    assert workspace.result("NCFM") is None
    workspace.write_arrays("NCFM", {"q": np.arange(6.0).reshape(2, 3)})
    assert workspace.result("NCFM") is None  # the arrays alone finish nothing
    workspace.finish("NCFM", {"value": 0.1})
    again = Workspace(tmp_path, replace(QUICK))
    assert again.found("NCFM") == {"value": 0.1}
    assert np.array_equal(again.arrays("NCFM")["q"], np.arange(6.0).reshape(2, 3))


@pytest.mark.parametrize("change", [{"seed": 1}, {"max_steps": 9}, {"tlrip_seconds": 9.0}])
def test_other_settings_find_nothing(tmp_path: Path, change: dict) -> None:
    Workspace(tmp_path, QUICK).finish("NCFM", {})
    other = Workspace(tmp_path, replace(QUICK, **change))
    assert other.result("NCFM") is None
    with pytest.raises(ValueError, match="not finished"):
        other.found("NCFM")


def test_half_a_file_is_no_result(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path, FULL)
    workspace.finish("NCFM", {"value": list(range(100))})
    path = tmp_path / "stages" / "NCFM.json"
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"[]", b"\xff"):
        path.write_bytes(content)
        assert workspace.result("NCFM") is None


def test_a_result_that_is_not_json_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path, FULL)
    with pytest.raises(ValueError, match="JSON"):
        workspace.finish("NCFM", {"value": float("nan")})
    assert not list(tmp_path.rglob("NCFM*"))
