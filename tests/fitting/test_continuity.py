"""Windows that make one motion: which fits take it, and what a fit says where they do not join."""

import pytest

from nfriction import ALFM, LFM, NFLFM, fit
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.strategy import continuation as stages
from nfriction.fitting.strategy.constant import is_constant_fit
from nfriction.friction.coefficients import Constant
from tests.fitting.recordings import pendulum, swing

V_SMOOTH = 0.05
SOFT, HARD = DEFAULTS.penalty_sd, DEFAULTS.constraint_sd
SETTINGS = {"windows": (0.5, 1.0), "fit_plant": False, "drag": False, "max_steps": 3}


@pytest.fixture
def made(monkeypatch):
    """Every problem that a stage makes."""
    problems = []

    class Recorded(ShootingProblem):
        def __init__(self, *args, **settings):
            super().__init__(*args, **settings)
            problems.append(self)

    monkeypatch.setattr(stages, "ShootingProblem", Recorded)
    return problems


def recording():
    truth = LFM(2, [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]], v_smooth=V_SMOOTH)
    return swing(pendulum(), truth, seconds=3.0)


def test_a_search_from_far_away_is_soft_and_a_network_never_harder(made):
    model = NFLFM(2, v_smooth=V_SMOOTH, terms=(2, 2), head_units=2)
    found = fit(model, pendulum(), recording(), continuity="constraint", **SETTINGS)
    assert found.continuity == "constraint"
    assert found.to_dict()["continuity"] == "constraint"
    laws = [p for p in made if isinstance(p.friction.schedule, Constant) and p.stride == 1]
    networks = [p for p in made if not isinstance(p.friction.schedule, Constant)]
    assert [p.defect_sd for p in laws[:2]] == [SOFT, HARD]
    assert networks
    assert all(p.defect_sd == SOFT and p.extrapolation is not None for p in networks)
    assert all(p.extrapolation is None for p in laws)


def test_windows_are_apart_by_default_and_for_adaptive_models(made):
    found = fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording(), **SETTINGS)
    assert found.continuity == "none"
    assert "continuity" not in found.to_dict()
    adaptive = ALFM(2, v_smooth=V_SMOOTH)
    fit(adaptive, pendulum(), recording(), continuity="constraint", **SETTINGS)
    assert made
    assert all(p.defect_sd is None for p in made)


def test_a_constant_fit_serves_where_its_windows_join_alike():
    """Its residuals are what a network or classes are judged by."""
    found = fit(
        LFM(2, v_smooth=V_SMOOTH), pendulum(), recording(), continuity="constraint", **SETTINGS
    )
    model = NFLFM(2, v_smooth=V_SMOOTH)
    assert is_constant_fit(found, model, "constraint")
    assert not is_constant_fit(found, model)
    assert not is_constant_fit(found, model, "penalty")


def test_torques_know_no_continuity():
    with pytest.raises(ValueError, match="needs `method"):
        fit(LFM(2), pendulum(), recording(), method="equation_error", continuity="penalty")


def test_windows_that_do_not_join_are_told():
    """As where the search was stopped before they did."""
    model = LFM(2, [4e-2, 3e-2], v_smooth=V_SMOOTH)
    found = fit(model, pendulum(), recording(), callback=lambda *_: True, continuity="constraint",
                windows=(1.0,), fit_plant=False)  # fmt: skip
    assert any("Windows are not continuous" in told for told in found.warnings)
    free = fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording(), **SETTINGS)
    assert not any("Windows are not continuous" in told for told in free.warnings)
