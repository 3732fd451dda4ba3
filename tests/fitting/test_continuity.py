"""Windows that make one motion: which fits take it, and what a fit says where they do not join."""

import pytest

from nfriction import ALFM, LFM, NFLFM, fit
from nfriction.fitting.shooting.problem import TrajectoryProblem
from nfriction.fitting.strategy import continuation as stages
from nfriction.fitting.strategy.constant_start import is_constant_fit
from nfriction.friction.coefficients import Constant
from tests.fitting.recordings import pendulum, swing

V_SMOOTH = 0.05
SOFT, HARD = stages.JUMP_SD["soft"], stages.JUMP_SD["hard"]
SETTINGS = {"windows": (0.5, 1.0), "fit_plant": False, "drag": False, "max_steps": 3}


@pytest.fixture
def made(monkeypatch):
    """Every problem that a stage makes."""
    problems = []

    class Recorded(TrajectoryProblem):
        def __post_init__(self):
            super().__post_init__()
            problems.append(self)

    monkeypatch.setattr(stages, "TrajectoryProblem", Recorded)
    return problems


def recording():
    truth = LFM(2, [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]], v_smooth=V_SMOOTH)
    return swing(pendulum(), truth, seconds=3.0)


def test_a_search_from_far_away_is_soft_and_a_network_never_harder(made):
    model = NFLFM(2, v_smooth=V_SMOOTH, terms=(2, 2), head_units=2)
    found = fit(model, pendulum(), recording(), continuity="hard", **SETTINGS)
    assert found.continuity == "hard"
    assert found.to_dict()["continuity"] == "hard"
    laws = [p for p in made if isinstance(p.friction.schedule, Constant) and p.stride == 1]
    networks = [p for p in made if not isinstance(p.friction.schedule, Constant)]
    assert [p.jump_sd for p in laws[:2]] == [SOFT, HARD]
    assert networks
    assert all(p.jump_sd == SOFT and p.anchors is not None for p in networks)
    assert all(p.anchors is None for p in laws)


def test_windows_are_apart_by_default_and_for_adaptive_models(made):
    found = fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording(), **SETTINGS)
    assert found.continuity == "free"
    assert "continuity" not in found.to_dict()
    adaptive = ALFM(2, v_smooth=V_SMOOTH)
    fit(adaptive, pendulum(), recording(), continuity="hard", **SETTINGS)
    assert made
    assert all(p.jump_sd is None for p in made)


def test_a_constant_fit_serves_where_its_windows_join_alike():
    """Its residuals are what a network or classes are judged by."""
    found = fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording(), continuity="hard", **SETTINGS)
    model = NFLFM(2, v_smooth=V_SMOOTH)
    assert is_constant_fit(found, model, "hard")
    assert not is_constant_fit(found, model)
    assert not is_constant_fit(found, model, "soft")


def test_torques_know_no_continuity():
    with pytest.raises(ValueError, match="of trajectories, not of torques"):
        fit(LFM(2), pendulum(), recording(), method="torque", continuity="soft")


def test_windows_that_do_not_join_are_told():
    """As where the search was stopped before they did."""
    model = LFM(2, [4e-2, 3e-2], v_smooth=V_SMOOTH)
    found = fit(model, pendulum(), recording(), callback=lambda *_: True, continuity="hard",
                windows=(1.0,), fit_plant=False)  # fmt: skip
    assert any("Windows do not join" in told for told in found.warnings)
    free = fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording(), **SETTINGS)
    assert not any("Windows do not join" in told for told in free.warnings)
