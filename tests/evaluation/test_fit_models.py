"""Several fits: an order that allows most parallel work, results independent of the processes."""

import logging
from itertools import permutations
from typing import Any

import pytest
import torch

from nfriction import Recording, fit
from nfriction.evaluation import parallel
from nfriction.evaluation.parallel import Data, dependency_levels, fit_models, warm_starts
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction import model_by_name, model_names
from nfriction.signals import kalman_smoother
from tests.cli.benches import pendulum, swing

QUICK: dict[str, Any] = {"windows": (0.5,), "max_steps": 1, "drag": False}


@pytest.fixture(scope="module")
def data() -> Data:
    recording = swing("a", 1.5)
    joint = recording.joint_coordinates(pendulum())
    return Data([recording], [kalman_smoother(joint.time, joint.q)])


@pytest.mark.parametrize(
    "names", [list(model_names()), list(model_names())[::-1], ["NFLFM", "ALFM"], ["LFM"]]
)
def test_every_start_is_fitted_before_it_is_needed(names: list[str]) -> None:
    origin = warm_starts(names)
    fitted: set[str | None] = {None}
    for group in dependency_levels(origin):
        assert {origin[name] for name in group} <= fitted
        fitted |= set(group)
    assert fitted == {None, *names}


def test_networks_and_classes_start_from_the_constant_fit_of_their_law() -> None:
    for names in permutations(("NCFM", "LFM", "NFLFM", "ALFM")):
        origin = warm_starts(names)
        assert origin["NFLFM"] == origin["ALFM"] == "LFM"
        first, second = sorted(("NCFM", "LFM"), key=names.index)
        assert origin[first] is None
        assert origin[second] == first
    assert warm_starts(["NFLFM", "NCFM"]) == {"NFLFM": "NCFM", "NCFM": None}
    # All models together take three rounds, not one each.
    assert len(list(dependency_levels(warm_starts(list(model_names()))))) == 3


def same(one: FitResult, other: FitResult) -> bool:
    """True if two fits are equal bit for bit."""
    pairs = zip(one.model.state_dict().values(), other.model.state_dict().values(), strict=True)
    return one.to_dict() == other.to_dict() and all(torch.equal(a, b) for a, b in pairs)


# A network's law must be recognised in another process: laws are compared by identity.
CASES = [
    pytest.param(["NCFM", "LFM"], {"method": "equation_error"}, marks=pytest.mark.slow),
    pytest.param(["LFM", "NFLFM"], QUICK, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("names", "settings"), CASES)
def test_results_do_not_depend_on_the_number_of_processes(
    data: Data, names: list[str], settings: dict[str, Any]
) -> None:
    pytest.importorskip("joblib")
    for jobs in (1, 2):
        found = fit_models(pendulum(), names, {"x": data, "y": data}, jobs=jobs, **settings)
        fits = {part: of.found for part, of in found.items()}
        assert list(fits) == ["x", "y"]
        assert all(list(of) == names for of in fits.values())
        for name in names:
            assert same(fits["x"][name], fits["y"][name])
            assert type(fits["x"][name].model) is model_by_name(name)
            assert fits["x"][name].motions == tuple(data.motions)
        if jobs == 1:
            alone = fits["x"]
    assert all(same(alone[name], fits["x"][name]) for name in names)


def test_failed_model_does_not_lose_the_others(
    data: Data, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    started: dict[str, FitResult | None] = {}

    def fragile(model: Any, plant: Any, recordings: list[Recording], **settings: Any) -> FitResult:
        name = type(model).__name__
        started[name] = settings["start"]
        if name == "LFM":
            raise ValueError("the data say nothing")
        return fit(model, plant, recordings, method="equation_error")

    monkeypatch.setattr(parallel, "fit", fragile)
    with caplog.at_level(logging.INFO, "nfriction"):
        found, failed = fit_models(pendulum(), ["NCFM", "LFM", "NLFM"], {"fit": data})["fit"]
    assert list(found) == ["NCFM", "NLFM"]
    assert failed == {"LFM": "the data say nothing"}
    assert "fit LFM failed: the data say nothing" in caplog.messages
    assert sum("Converged: linear" in message for message in caplog.messages) == 2
    assert started["NCFM"] is None
    assert started["NLFM"] is not None
    with pytest.raises(ValueError, match="the data say nothing"):
        fit_models(pendulum(), ["LFM"], {"fit": data})


def test_objects_that_cannot_be_sent_to_processes_are_refused(data: Data) -> None:
    pytest.importorskip("joblib")
    with pytest.raises(ValueError, match="progress"):
        fit_models(pendulum(), ["LFM"], {"fit": data}, jobs=2, callback=lambda *_: None)
    with pytest.raises(ValueError, match="there are viscous"):
        fit_models(pendulum(), ["XFM"], {"fit": data})
