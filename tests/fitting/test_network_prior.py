"""How far a network may deviate from its constant law is for windows held back to say."""

import math

import pytest
import torch

from nfriction import LFM, NCFM, NFLFM, NFNCFM, NFStribeck, Stribeck, fit
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.result.identifiability import Interval
from nfriction.fitting.strategy.continuation import ShootingFitter
from nfriction.friction.neurofuzzy import NeuroFuzzy
from tests.fitting.recordings import pendulum, swing

V_SMOOTH = 0.05
PRIOR_SHARES = DEFAULTS.prior_shares
SMALL = {"terms": (2, 2), "head_units": 2}
BRIEF = {"windows": (0.5,), "max_steps": 2}


@pytest.fixture(scope="module")
def constant():
    truth = LFM(2, [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]], v_smooth=V_SMOOTH)
    recording = swing(pendulum(), truth, seconds=2.0)
    model = LFM(2, v_smooth=V_SMOOTH)
    return recording, fit(model, pendulum(), recording, windows=(0.5,), fit_plant=False)


@pytest.fixture(scope="module")
def with_plant(constant):
    recording, _ = constant
    return recording, fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, **BRIEF)


@pytest.mark.parametrize("best", range(len(PRIOR_SHARES)))
def test_the_prior_is_the_one_whose_network_predicts_best(constant, monkeypatch, best):
    recording, found = constant
    seen = []

    def error(test, problem, *_):
        if not isinstance(problem.friction.schedule, NeuroFuzzy):
            return 1.0
        seen.append(float(problem.friction_prior[1][0]))
        return 0.7 - 0.2 * (len(seen) == best + 1)

    monkeypatch.setattr("nfriction.fitting.strategy.neurofuzzy.holdout_rmse", error)
    model = NFLFM(2, v_smooth=V_SMOOTH, prior_sd=0.6, **SMALL)
    fit(model, pendulum(), recording, start=found, windows=(0.5,), fit_plant=False, max_steps=2)
    assert seen == pytest.approx([0.6 * share for share in PRIOR_SHARES])
    # It travels with the model as what it was fitted with.
    assert model.schedule.options()["prior_sd"] == pytest.approx(0.6 * PRIOR_SHARES[best])


def test_a_law_that_is_not_linear_has_a_network_too(constant):
    recording, _ = constant
    settings = {"windows": (0.5,), "fit_plant": False, "max_steps": 4}
    law = fit(Stribeck(2, v_smooth=V_SMOOTH), pendulum(), recording, **settings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nfriction.fitting.strategy.holdout.HoldoutScore.score", 0.0)
        model = NFStribeck(2, v_smooth=V_SMOOTH, **SMALL)
        found = fit(model, pendulum(), recording, start=law, **settings)
    assert found.model is model
    assert found.residual <= 1.001 * law.residual
    assert float(model.schedule.parameter_vector().abs().max()) > 0


def test_the_plant_stays_about_as_near_to_the_laws_as_that_left_it_open(constant, monkeypatch):
    recording, _ = constant
    settings = {"windows": (0.5,), "max_steps": 3}
    law = fit(NCFM(2, v_smooth=V_SMOOTH), pendulum(), recording, **settings)
    open_ = {i.name: i.sd for i in law.intervals}
    monkeypatch.setattr("nfriction.fitting.strategy.holdout.HoldoutScore.score", 0.5)

    def moved() -> float:
        """By how many standard deviations that the law's fit left open, at most."""
        model = NFNCFM(2, v_smooth=V_SMOOTH, **SMALL)
        found = fit(model, pendulum(), recording, start=law, **settings)
        pairs = zip(found.plant_terms, law.plant_terms, strict=True)
        return max(abs(new - old) / open_[name] for (name, new, _), (_, old, _) in pairs)

    assert 0.1 < moved() < 3.0
    monkeypatch.setattr(Interval, "sd", property(lambda told: 1e-3 * open_[told.name]))
    assert moved() < 1e-3


@pytest.mark.parametrize(("of_near", "freed"), [(0.9, False), (0.7, True)])
def test_a_plant_is_let_go_only_for_what_windows_held_back_gain(
    with_plant, monkeypatch, of_near, freed
):
    recording, law = with_plant
    seen, trained = [], []

    def expected(problem):
        return problem.plant_prior[1].tolist()

    def network_sd(problem):
        return None if problem.friction_prior is None else float(problem.friction_prior[1][0])

    def error(test, problem, friction, plant):
        if not isinstance(problem.friction.schedule, NeuroFuzzy):
            return 1.0
        seen.append((expected(problem), network_sd(problem), friction, plant))
        near = expected(problem) == seen[0][0]
        return 0.7 * (1.0 if near else of_near) * (1.0 if len(seen) % 2 else 1.01)

    def search(self, problem, start, *others):
        parts = problem.variables.split(start)
        trained.append((expected(problem), network_sd(problem), parts.friction, parts.plant))
        return searched(self, problem, start, *others)

    searched = ShootingFitter.search
    monkeypatch.setattr("nfriction.fitting.strategy.neurofuzzy.holdout_rmse", error)
    monkeypatch.setattr(ShootingFitter, "search", search)
    model = NFLFM(2, v_smooth=V_SMOOTH, **SMALL)
    fit(model, pendulum(), recording, start=law, **BRIEF)
    near, _, free, _ = (trial[0] for trial in seen)
    assert near != free
    assert all(a <= b for a, b in zip(near, free, strict=True))
    # Each search tries both priors, and the best is gone on with from where it stood.
    assert [trial[1] for trial in seen] == 2 * [trial[1] for trial in seen[:2]]
    best, last = seen[2 if freed else 0], trained[-1]
    assert last[:2] == best[:2]
    assert torch.equal(last[2], best[2])
    assert torch.equal(last[3], best[3])


def test_a_law_that_diverges_lets_go_of_no_plant(with_plant, monkeypatch):
    recording, law = with_plant
    trained = []

    def error(test, problem, *_):
        return 1.0 if isinstance(problem.friction.schedule, NeuroFuzzy) else math.inf

    def search(self, problem, *others):
        trained.append(problem.plant_prior[1].tolist())
        return searched(self, problem, *others)

    searched = ShootingFitter.search
    monkeypatch.setattr("nfriction.fitting.strategy.neurofuzzy.holdout_rmse", error)
    monkeypatch.setattr(ShootingFitter, "search", search)
    fit(NFLFM(2, v_smooth=V_SMOOTH, **SMALL), pendulum(), recording, start=law, **BRIEF)
    free, near, *_ = trained
    assert near != free
    assert trained[-1] == near


@pytest.mark.parametrize("place", range(2 * len(PRIOR_SHARES)))
def test_a_network_stopped_before_it_is_judged_gives_way_to_its_law(with_plant, place, monkeypatch):
    recording, law = with_plant
    model, begun = NFLFM(2, v_smooth=V_SMOOTH, prior_sd=0.6, **SMALL), []

    def search(self, problem, vector, tolerance, name):
        begun.append(name)
        return searched(self, problem, vector, tolerance, name)

    def stop(stage, step):
        return begun.count("network, hold-out") > place

    searched = ShootingFitter.search
    monkeypatch.setattr(ShootingFitter, "search", search)
    kept = fit(model, pendulum(), recording, start=law, callback=stop, **BRIEF)
    assert begun[1:] == ["network, hold-out"] * (place + 1)
    assert not kept.converged
    assert "its constant law is kept" in kept.status
    at = (torch.ones(1, 2, dtype=torch.float64),) * 3
    torch.testing.assert_close(model(*at), law.model(*at), rtol=1e-5, atol=1e-9)
    assert model.schedule.options()["prior_sd"] == 0.6
