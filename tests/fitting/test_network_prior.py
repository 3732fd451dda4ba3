"""How far a network may deviate from its constant law: evidence, and windows held back."""

import math

import numpy as np
import pytest
import torch

from nfriction import (
    LFM,
    NCFM,
    NFLFM,
    NFNCFM,
    NFStribeck,
    PendulumChain,
    Recording,
    Stribeck,
    fit,
    rollout,
)
from nfriction.fitting.result.identifiability import Interval
from nfriction.fitting.strategy import neurofuzzy as strategy
from nfriction.fitting.strategy.continuation import ShootingFitter
from nfriction.friction.neurofuzzy import NeuroFuzzy
from tests.fitting.recordings import pendulum, swing

V_SMOOTH = 0.05
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


COUNT = 1e-5
ARM = PendulumChain(mass=[0.2], length=[0.4], position_quantum=COUNT)
SPEED = 10.0


def crowded_at_rest(model: NFNCFM) -> None:
    """Viscous friction that falls and rises again within a third of the speeds."""
    model.schedule.set_range(SPEED, [-80.0, 80.0])
    anfis = model.schedule.network.anfis
    anfis.init_from_sets(
        [torch.tensor([0.1, 0.25, 0.4]), torch.tensor([0.5])],
        [torch.tensor([0.06, 0.06, 0.06]), torch.tensor([1.0])],
    )
    with torch.no_grad():
        anfis.consequents[0, 0, :, -1] = torch.tensor([1.0, -0.5, 1.0])


@pytest.fixture(scope="module")
def where_even_sets_are_wrong():
    truth = NFNCFM(1, [2e-3], terms=(3, 1), head_units=1, interpretable=False)
    crowded_at_rest(truth)
    q0 = torch.tensor([np.pi + 2.0], dtype=torch.float64)
    run = rollout(ARM, truth.requires_grad_(False), q0, 0 * q0, sample_time=2e-3, steps=3000)
    q = COUNT * np.round(run.q.numpy() / COUNT)
    return Recording(2e-3 * np.arange(len(q)), q, convention="relative,upright", name="step")


def learnt(recording, monkeypatch, *, sets: bool):
    """A network fitted to it, its log evidence after every search, and its fit."""
    model = NFNCFM(1, terms=(3, 1), head_units=1)
    model.schedule.learn_sets = sets
    evidence = []

    def record(end):
        found = network_evidence(end)
        evidence.append(found.occam - float(end.result.cost))
        return found

    network_evidence = strategy.network_evidence
    monkeypatch.setattr(strategy, "network_evidence", record)
    # At one noise, for evidence compares priors of the same errors.
    monkeypatch.setattr(strategy._Validation, "_noise_of", lambda *_: 3e-5)
    found = fit(model, ARM, recording, windows=(0.5,), fit_plant=False, drag=False)
    monkeypatch.undo()
    # The first search has the noise of the law, the last one all windows.
    return model, evidence[1:-1], found


def test_sets_move_and_the_evidence_rises_where_even_sets_are_wrong(
    where_even_sets_are_wrong, monkeypatch
):
    recording = where_even_sets_are_wrong
    even = NFNCFM(1, terms=(3, 1), head_units=1).schedule.network
    model, evidence, found = learnt(recording, monkeypatch, sets=True)
    network = model.schedule.network
    pairs = zip(network.anfis.sets(), even.anfis.sets(), strict=True)
    centres, widths = ((new - old)[0, :3].abs().max() for new, old in pairs)
    assert min(centres, widths) > 0.05
    ordered = network.anfis.sets()[0][0, :3].detach()
    assert (ordered.diff() > 0).all()
    held, at_even, with_even = learnt(recording, monkeypatch, sets=False)
    # Of its prior first, and then by far more of the sets.
    assert at_even[-1] > at_even[0] + 1
    assert evidence[-1] > at_even[-1] + 100
    for ours, given in zip(held.schedule.network.anfis.sets(), even.anfis.sets(), strict=True):
        assert torch.equal(ours, given)
    assert found.residual < 0.5 * with_even.residual
    gamma = found.to_dict()["effective_parameters"]
    assert set(gamma) == set(model.schedule.group_names())
    assert all(0 <= value <= size for _, value, size in found.effective_parameters)


def test_a_law_that_is_not_linear_has_a_network_too(constant):
    recording, _ = constant
    settings = {"windows": (0.5,), "fit_plant": False, "max_steps": 8}
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
    settings = {"windows": (0.5,), "max_steps": 4}
    law = fit(NCFM(2, v_smooth=V_SMOOTH), pendulum(), recording, **settings)
    open_ = {i.name: i.sd for i in law.intervals}
    monkeypatch.setattr("nfriction.fitting.strategy.holdout.HoldoutScore.score", 0.5)
    # The intervals belong to the noise of the law's residuals.
    monkeypatch.setattr(strategy._Validation, "_noise_of", lambda self, *_: self.noise)

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

    def error(test, problem, friction, plant):
        if not isinstance(problem.friction.schedule, NeuroFuzzy):
            return 1.0
        seen.append((expected(problem), friction, plant))
        return 0.7 * (1.0 if len(seen) == 1 else of_near)

    def search(self, problem, start, *others):
        parts = problem.variables.split(start)
        trained.append((expected(problem), parts.friction, parts.plant))
        return searched(self, problem, start, *others)

    searched = ShootingFitter.search
    monkeypatch.setattr("nfriction.fitting.strategy.neurofuzzy.holdout_rmse", error)
    monkeypatch.setattr(ShootingFitter, "search", search)
    model = NFLFM(2, v_smooth=V_SMOOTH, **SMALL)
    fit(model, pendulum(), recording, start=law, **BRIEF)
    near, free = (trial[0] for trial in seen)
    assert near != free
    assert all(a <= b for a, b in zip(near, free, strict=True))
    # The better one is searched on from its end.
    best, last = seen[1 if freed else 0], trained[-1]
    assert last[0] == best[0]
    assert torch.equal(last[1], best[1])
    assert torch.equal(last[2], best[2])


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


@pytest.mark.parametrize("place", range(3))
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
