"""Hold-out windows decide how far a network may deviate from its constant law."""

import math
from dataclasses import replace

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
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.result.identifiability import Interval
from nfriction.fitting.strategy.continuation import ShootingFitter
from nfriction.fitting.strategy.holdout import StoppedError
from nfriction.fitting.strategy.neurofuzzy import Validation, log_evidence
from nfriction.friction.neurofuzzy import NeuroFuzzy
from tests.fitting.recordings import one_link, swing

V_SMOOTH = 0.05
PRIOR_SHARES = DEFAULTS.prior_shares
SMALL = {"terms": (2, 2), "head_units": 2, "inputs": ()}
BRIEF = {"windows": (0.5,), "max_steps": 2}


@pytest.fixture(scope="module")
def constant():
    truth = LFM(1, [[1.5e-3, 2.5e-3]], v_smooth=V_SMOOTH)
    recording = swing(one_link(), truth, seconds=2.0)
    model = LFM(1, v_smooth=V_SMOOTH)
    return recording, fit(model, one_link(), recording, windows=(0.5,), fit_plant=False)


@pytest.fixture(scope="module")
def with_plant(constant):
    recording, _ = constant
    return recording, fit(LFM(1, v_smooth=V_SMOOTH), one_link(), recording, **BRIEF)


@pytest.fixture
def sets_stay(monkeypatch):
    monkeypatch.setattr(Validation, "trained_on", lambda self, trial: trial)


@pytest.mark.usefixtures("sets_stay")
@pytest.mark.parametrize("best", range(len(PRIOR_SHARES)))
def test_prior_with_the_best_predictions_is_chosen(constant, monkeypatch, best):
    recording, found = constant
    seen = []

    def squares(test, problem, *_):
        if not isinstance(problem.friction.schedule, NeuroFuzzy):
            return torch.ones(len(test))
        seen.append(float(problem.friction_prior[1][0]))
        found = seen[-1] == pytest.approx(0.6 * PRIOR_SHARES[best])
        return torch.full((len(test),), 0.5 - 0.2 * found)

    monkeypatch.setattr("nfriction.fitting.strategy.holdout.settled", squares)
    model = NFLFM(1, v_smooth=V_SMOOTH, prior_sd=0.6, **SMALL)
    # As of other windows, so that the law is scored by `squares`, too.
    law = replace(found, residuals=found.residuals[:, 1:])
    fit(model, one_link(), recording, start=law, windows=(0.5,), fit_plant=False, max_steps=2)
    tried = len(PRIOR_SHARES)
    assert seen[:tried] == pytest.approx([0.6 * share for share in PRIOR_SHARES])
    # Only the best is trained without the other windows too, and then compared with the law.
    assert seen[tried:] == [seen[best]] * DEFAULTS.folds
    # It is stored with the model as its prior.
    assert model.schedule.options()["prior_sd"] == pytest.approx(0.6 * PRIOR_SHARES[best])


@pytest.mark.usefixtures("sets_stay")
def test_a_fit_of_a_model_that_learns_its_sets_starts_from_the_same_sets(constant):
    recording, law = constant
    models = [NFLFM(1, v_smooth=V_SMOOTH, **SMALL) for _ in range(2)]
    models[1].schedule.learn_sets = True
    for model in models:
        fit(model, one_link(), recording, start=law, **BRIEF, fit_plant=False)
    one, other = (model.state_dict() for model in models)
    assert all(torch.equal(one[key], other[key]) for key in one)


@pytest.mark.usefixtures("sets_stay")
@pytest.mark.parametrize(("ratio", "kept"), [(0.75, True), (1.25, False)])
@pytest.mark.parametrize("same_windows", [True, False])
def test_network_worse_than_its_law_on_long_windows_is_rejected(
    constant, monkeypatch, ratio, kept, same_windows
):
    """Short windows hardly show a force that is slightly wrong."""
    recording, law = constant
    error = float(law.residuals.square().mean().sqrt())
    if not same_windows:
        law = replace(law, residuals=law.residuals[:, 1:])

    def rms(test, problem, *_):
        of_network = isinstance(problem.friction.schedule, NeuroFuzzy)
        if test.length > 0.4:
            return torch.full((len(test),), error * (ratio if of_network else 1.0)).square()
        return torch.full((len(test),), 0.5 if of_network else 1.0).square()

    monkeypatch.setattr("nfriction.fitting.strategy.holdout.settled", rms)
    model = NFLFM(1, v_smooth=V_SMOOTH, **SMALL)
    found = fit(model, one_link(), recording, start=law, **BRIEF, fit_plant=False)
    assert bool(model.schedule.parameter_vector().any()) is kept
    assert ("windows of 0.5 s, to which its constant law was fitted" in found.status) is not kept


@pytest.mark.usefixtures("sets_stay")
def test_network_worse_than_its_law_in_training_is_rejected(constant, monkeypatch):
    """Its last search, with all windows, may end at a worse minimum."""
    recording, found = constant
    error, parts = float(found.residuals.square().mean().sqrt()), []

    def rms(test, problem, *_):
        parts.append(len(test))
        of_network = isinstance(problem.friction.schedule, NeuroFuzzy)
        size = 1.25 * error if len(test) > max(parts[:1]) else 0.5 if of_network else 1.0
        return torch.full((len(test),), size).square()

    monkeypatch.setattr("nfriction.fitting.strategy.holdout.settled", rms)
    settings = {"windows": (0.2,), "fit_plant": False, "max_steps": 2}
    found = fit(NFLFM(1, v_smooth=V_SMOOTH, **SMALL), one_link(), recording, **settings)
    assert "over windows of 0.2 s" in found.status


@pytest.mark.slow
@pytest.mark.usefixtures("sets_stay")
def test_nonlinear_law_has_a_network_too(constant):
    recording, _ = constant
    settings = {"windows": (0.5,), "fit_plant": False, "max_steps": 4}
    law = fit(Stribeck(1, v_smooth=V_SMOOTH), one_link(), recording, **settings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nfriction.fitting.strategy.neurofuzzy.improves", lambda *_, **__: True)
        model = NFStribeck(1, v_smooth=V_SMOOTH, **SMALL)
        found = fit(model, one_link(), recording, start=law, **settings)
    assert torch.equal(*(m.schedule.parameter_vector() for m in (found.model, model)))
    assert found.residual <= 1.001 * law.residual
    assert float(model.schedule.parameter_vector().abs().max()) > 0


@pytest.mark.slow
@pytest.mark.usefixtures("sets_stay")
def test_plant_stays_within_the_uncertainty_of_the_laws_fit(constant, monkeypatch):
    recording, _ = constant
    settings = {"windows": (0.5,), "max_steps": 3}
    law = fit(NCFM(1, v_smooth=V_SMOOTH), one_link(), recording, **settings)
    open_ = {i.name: i.sd for i in law.intervals}
    # As of other windows, so that the law is scored by `squares`, too.
    law = replace(law, residuals=law.residuals[:, 1:])

    def squares(test, problem, friction, plant, *_):
        # Every network beats the law but not the others, so no gain relaxes the plant's prior.
        learns = isinstance(problem.friction.schedule, NeuroFuzzy)
        return torch.full((len(test),), 0.5 if learns else 1.0)

    monkeypatch.setattr("nfriction.fitting.strategy.holdout.settled", squares)

    def moved() -> float:
        """Largest change in standard deviations of the law's fit."""
        model = NFNCFM(1, v_smooth=V_SMOOTH, **SMALL)
        found = fit(model, one_link(), recording, start=law, **settings)
        pairs = zip(found.plant_terms, law.plant_terms, strict=True)
        return max(abs(new - old) / open_[name] for (name, new, _), (_, old, _) in pairs)

    as_left = moved()
    assert as_left < 3.0
    # Data decide how far it moves; that the law's fit bounds the change is our choice.
    monkeypatch.setattr(Interval, "sd", property(lambda interval: 1e-3 * open_[interval.name]))
    assert moved() < min(1e-3, 0.1 * as_left)


@pytest.mark.slow
@pytest.mark.usefixtures("sets_stay")
@pytest.mark.parametrize("freed", [False, True])
def test_plant_prior_is_relaxed_only_for_a_hold_out_gain(with_plant, monkeypatch, freed):
    recording, law = with_plant
    seen, trained = [], []

    def expected(problem):
        return problem.plant_prior[1].tolist()

    def network_sd(problem):
        return None if problem.friction_prior is None else float(problem.friction_prior[1][0])

    def squares(test, problem, friction, plant, *_):
        found = torch.ones(len(test))
        if not isinstance(problem.friction.schedule, NeuroFuzzy):
            return found
        seen.append((expected(problem), network_sd(problem), friction, plant))
        first = 1.0 if network_sd(problem) == seen[0][1] else 1.01
        if expected(problem) == seen[0][0]:
            return 0.5 * first * found
        # Less in total, but a gain only if it is less on nearly every window.
        return 0.4 * first * (found if freed else torch.linspace(0.6, 1.86, len(test)))

    def search(self, problem, start, *others):
        parts = problem.variables.split(start)
        trained.append((expected(problem), network_sd(problem), parts.friction, parts.plant))
        return searched(self, problem, start, *others)

    searched = ShootingFitter.search
    monkeypatch.setattr("nfriction.fitting.strategy.holdout.settled", squares)
    monkeypatch.setattr(ShootingFitter, "search", search)
    model = NFLFM(1, v_smooth=V_SMOOTH, **SMALL)
    fit(model, one_link(), recording, start=law, **BRIEF)
    seen.pop()  # over windows as long as the law's
    rounds = len(PRIOR_SHARES) + DEFAULTS.folds - 1
    near, free = seen[0][0], seen[rounds][0]
    assert [trial[0] for trial in seen] == rounds * [near] + rounds * [free]
    assert near != free
    assert all(a <= b for a, b in zip(near, free, strict=True))
    # Each search tries both priors, and the best is continued from its result.
    assert [trial[1] for trial in seen] == 2 * [trial[1] for trial in seen[:rounds]]
    best, last = seen[rounds if freed else 0], trained[-1]
    assert last[:2] == best[:2]
    assert torch.equal(last[2], best[2])
    assert torch.equal(last[3], best[3])


@pytest.mark.slow
@pytest.mark.usefixtures("sets_stay")
def test_diverging_law_does_not_relax_the_plant_prior(with_plant, monkeypatch):
    recording, law = with_plant
    trained = []

    def squares(test, problem, *_):
        by_network = isinstance(problem.friction.schedule, NeuroFuzzy)
        return torch.full((len(test),), 1.0 if by_network else math.inf)

    def search(self, problem, *others):
        trained.append(problem.plant_prior[1].tolist())
        return searched(self, problem, *others)

    searched = ShootingFitter.search
    monkeypatch.setattr("nfriction.fitting.strategy.holdout.settled", squares)
    monkeypatch.setattr(ShootingFitter, "search", search)
    fit(NFLFM(1, v_smooth=V_SMOOTH, **SMALL), one_link(), recording, start=law, **BRIEF)
    free, near = trained[0], trained[DEFAULTS.folds]
    assert near != free
    assert trained[-1] == near


PLACES = range(2 * len(PRIOR_SHARES))


@pytest.mark.parametrize(
    "place", [pytest.param(k, marks=[pytest.mark.slow] * (0 < k < PLACES[-1])) for k in PLACES]
)
def test_network_stopped_before_hold_out_is_replaced_by_its_law(with_plant, place, monkeypatch):
    recording, law = with_plant
    model, begun = NFLFM(1, v_smooth=V_SMOOTH, prior_sd=0.6, **SMALL), []

    def search(self, problem, vector, tolerance, name, *least):
        begun.append(name)
        return searched(self, problem, vector, tolerance, name, *least)

    def stop(stage, step):
        return begun.count("network, hold-out") > place

    searched = ShootingFitter.search
    monkeypatch.setattr(ShootingFitter, "search", search)
    kept = fit(model, one_link(), recording, start=law, callback=stop, **BRIEF)
    assert begun.count("network, hold-out") == place + 1
    assert begun[-1] == "network, hold-out"
    assert not kept.converged
    assert "its constant law is kept" in kept.status
    at = (torch.ones(1, 1, dtype=torch.float64),) * 3
    torch.testing.assert_close(model(*at), law.model(*at), rtol=1e-5, atol=1e-9)
    assert model.schedule.options()["prior_sd"] == 0.6


@pytest.mark.parametrize("worse", ["", "Network rejected: it is worse."])
def test_stop_during_input_selection_keeps_the_decision(constant, monkeypatch, worse):
    recording, law = constant
    judged = []

    def stop(plain):
        judged.append((plain.accepted, plain.squares))
        raise StoppedError

    monkeypatch.setattr("nfriction.fitting.strategy.neurofuzzy._with_chosen_inputs", stop)
    monkeypatch.setattr(Validation, "lost_over_long_windows", lambda self, end: worse)
    monkeypatch.setattr("nfriction.fitting.strategy.neurofuzzy.improves", lambda *_, **__: True)
    monkeypatch.setattr(Validation, "trained_on", lambda self, trial: trial)
    model = NFLFM(1, v_smooth=V_SMOOTH, terms=(2, 2), head_units=2)
    settings = {"windows": (0.5,), "fit_plant": False, "max_steps": 2}
    found = fit(model, one_link(), recording, start=law, **settings)
    assert not found.converged
    assert model.schedule.parameter_vector().any() == (not worse)
    assert worse in found.status
    # Inputs must beat the network that is kept, or its law.
    ((accepted, squares),) = judged
    assert accepted == (not worse)
    assert squares.isfinite().all()


COUNT = 1e-5
ARM = PendulumChain(mass=[0.2], length=[0.4], position_quantum=COUNT)


@pytest.fixture(scope="module")
def where_even_sets_are_wrong():
    """Viscous friction that falls and rises again within a third of the speeds."""
    truth = NFNCFM(1, [2e-3], terms=(3, 1), head_units=1)
    truth.schedule.set_range(10.0, [-80.0, 80.0])
    anfis = truth.schedule.network.anfis
    anfis.init_from_sets(
        [torch.tensor([0.1, 0.25, 0.4]), torch.tensor([0.5])],
        [torch.tensor([0.06, 0.06, 0.06]), torch.tensor([1.0])],
    )
    with torch.no_grad():
        anfis.consequents[0, 0, :, -1] = torch.tensor([1.0, -0.5, 1.0])
    q0 = torch.tensor([np.pi + 2.0], dtype=torch.float64)
    run = rollout(ARM, truth.requires_grad_(False), q0, 0 * q0, sample_time=5e-3, steps=1200)
    q = COUNT * np.round(run.q.numpy() / COUNT)
    return Recording(5e-3 * np.arange(len(q)), q, convention="relative,upright", name="step")


def test_sets_adapt_and_evidence_rises_if_even_sets_are_wrong(
    where_even_sets_are_wrong, monkeypatch
):
    recording, trials, adapted = where_even_sets_are_wrong, [], []

    def record(self, trial, noise, stride, *, learn_sets):
        adapted.append(adapt(self, trial, noise, stride, learn_sets=learn_sets))
        learning.append(learn_sets)
        return adapted[-1]

    def twice(self, trial):
        if len(trials) < 2:
            trials.append(trained_on(self, trial))
        return trials[-1]

    learning: list[bool] = []
    adapt, trained_on = Validation._adapted, Validation.trained_on
    monkeypatch.setattr(Validation, "_adapted", record)
    monkeypatch.setattr(Validation, "trained_on", twice)
    model, even = (NFNCFM(1, terms=(3, 1), head_units=1) for _ in range(2))
    found = fit(model, ARM, recording, windows=(0.5,), fit_plant=False, drag=False)
    held, moved, _ = adapted
    # Sets that have moved stay unknown.
    assert learning == [False, True, True]
    assert moved.end.problem.noise_sd == held.end.problem.noise_sd
    assert log_evidence(moved.end) > log_evidence(held.end) + 1
    assert moved.end.rms < 0.8 * held.end.rms
    pairs = zip(*(m.schedule.network.anfis.sets() for m in (model, even)), strict=True)
    assert min((new - old)[0, :3].abs().max() for new, old in pairs) > 0.05
    assert "sets moved" in found.status
    assert [residual for _, residual in found.stages] == [found.residual]
    gamma = found.to_dict()["effective_parameters"]
    assert set(gamma) >= {"set centres", "set widths", "head centres", "head widths"}
    assert all(0 <= value <= size for _, value, size in found.effective_parameters)


@pytest.mark.parametrize(("factor", "goes_on"), [(0.98, True), (1.02, False), (math.inf, False)])
def test_training_goes_on_for_gains_below_their_scatter(
    where_even_sets_are_wrong, monkeypatch, factor, goes_on
):
    rounds, judged = [], Validation.judged

    def further(self, trial, noise, stride, *, learn_sets):
        rounds.append(trial)
        return replace(trial, prior_sd=math.nan)  # another trial

    def scattered(self, trial):
        found = judged(self, trial)
        even = torch.full_like(found.squares, 1e-6)
        # Without a mean gain but for the factor of all, or of the first.
        spread = torch.where(torch.arange(len(even)) % 2 > 0, 2.0, 0.5)
        spread[0] = spread[0] if math.isfinite(factor) else math.inf
        spread *= factor if math.isfinite(factor) else 0.1
        return replace(found, squares=spread * even if rounds else even)

    monkeypatch.setattr(Validation, "_adapted", further)
    monkeypatch.setattr(Validation, "judged", scattered)
    model = NFNCFM(1, terms=(3, 1), head_units=1, inputs=())
    settings = {"windows": (0.5,), "fit_plant": False, "drag": False, "max_steps": 2}
    fit(model, ARM, where_even_sets_are_wrong, **settings)
    # A round holds the sets, then moves them; the second one gains nothing.
    assert len(rounds) == (4 if goes_on else 2)


def test_stop_during_further_training_keeps_the_accepted_network(where_even_sets_are_wrong):
    names = []

    def stop(name, step):
        names.append(name)
        return name == "network's sets, hold-out"

    model = NFNCFM(1, terms=(3, 1), head_units=1)
    found = fit(
        model, ARM, where_even_sets_are_wrong, windows=(0.5,), fit_plant=False, drag=False,
        callback=stop,
    )  # fmt: skip
    assert names.count("network's sets, hold-out") == 1
    assert not found.converged
    assert "constant law is kept" not in found.status
    assert model.schedule.parameter_vector().abs().max() > 0.01
