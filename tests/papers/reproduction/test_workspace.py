"""Only a complete result with the same settings counts as finished."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nfriction import LFM, fit
from nfriction.fitting.result.fit_result import InputGain
from nfriction.fitting.robust_loss import Outliers
from nfriction.papers.reproduction.workspace import FULL, QUICK, Bench, Workspace, smoothed
from tests.fitting.recordings import pendulum, swing


def test_a_finished_stage_is_found_again(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path, QUICK)
    assert workspace.result("NCFM") is None
    workspace.write_arrays("NCFM", {"q": np.arange(6.0).reshape(2, 3)})
    assert workspace.result("NCFM") is None  # the arrays alone are not a finished stage
    workspace.finish("NCFM", {"value": 0.1})
    again = Workspace(tmp_path, replace(QUICK))
    assert again.found("NCFM") == {"value": 0.1}
    assert np.array_equal(again.arrays("NCFM")["q"], np.arange(6.0).reshape(2, 3))


@pytest.mark.parametrize("change", [{"seed": 1}, {"max_steps": 9}, {"tlrip_seconds": 9.0}])
def test_other_settings_have_no_result(tmp_path: Path, change: dict) -> None:
    Workspace(tmp_path, QUICK).finish("NCFM", {})
    other = Workspace(tmp_path, replace(QUICK, **change))
    assert other.result("NCFM") is None
    with pytest.raises(ValueError, match="not finished"):
        other.found("NCFM")


def test_partial_file_is_no_result(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path, FULL)
    workspace.finish("NCFM", {"value": list(range(100))})
    path = tmp_path / "stages" / "NCFM.json"
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"[]", b"\xff"):
        path.write_bytes(content)
        assert workspace.result("NCFM") is None


def test_result_that_is_not_json_is_refused_without_leftovers(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path, FULL)
    with pytest.raises(ValueError, match="JSON"):
        workspace.finish("NCFM", {"value": float("nan")})
    assert not list(tmp_path.rglob("NCFM*"))


def test_fit_round_trip_is_exact(tmp_path: Path) -> None:
    """Its parts keep their types, whose names the summary needs."""
    recording = swing(pendulum(), LFM(2), seconds=1.0)
    bench = Bench(pendulum(), [recording], [], smoothed(pendulum(), [recording]), {})
    found = replace(
        fit(LFM(2), bench.plant, bench.train, method="equation_error", fit_plant=False),
        outliers=(Outliers("run", "joint1", 0.1, 0.2, 0.3),),
        inputs=(InputGain("direction", -0.1, (0.1, 0.2)),),
    )
    workspace = Workspace(tmp_path, QUICK)
    workspace.fit("LFM", bench, lambda step: found)
    kept = workspace.fit("LFM", bench, lambda step: pytest.fail("fitted again"))
    assert kept.to_dict() == found.to_dict()
