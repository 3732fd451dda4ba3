"""How far a network may deviate from its constant law: evidence, and windows held back."""

import re

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
from nfriction.fitting.strategy import neurofuzzy as strategy
from nfriction.fitting.strategy.continuation import ShootingFitter
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
    """A network fitted to it, the log evidence of every stage of its training, and its fit."""
    model = NFNCFM(1, terms=(3, 1), head_units=1)
    model.schedule.learn_sets = sets
    evidence, adapt = [], strategy._Training._adapt

    def record(self, *arguments, **options):
        found = adapt(self, *arguments, **options)
        evidence.append(found.log_evidence())
        return found

    monkeypatch.setattr(strategy._Training, "_adapt", record)
    # At one noise, for evidence compares priors of the same errors.
    monkeypatch.setattr(strategy._Training, "_noise_of", lambda *_: 3e-5)
    found = fit(model, ARM, recording, windows=(0.5,), fit_plant=False, drag=False)
    monkeypatch.undo()
    return model, evidence, found


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
    assert len(at_even) == 1
    assert evidence[0] == pytest.approx(at_even[0])
    assert evidence[1] > at_even[0] + 100
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
        patch.setattr("nfriction.fitting.strategy.holdout.Judgement.kept", True)
        model = NFStribeck(2, v_smooth=V_SMOOTH, **SMALL)
        found = fit(model, pendulum(), recording, start=law, **settings)
    assert found.model is model
    assert found.residual <= 1.001 * law.residual
    assert float(model.schedule.parameter_vector().abs().max()) > 0


def test_a_network_mends_the_plant_that_its_law_had_to_bend(constant, monkeypatch):
    """The truth has the plant as given, and Coulomb friction that the law cannot have."""
    recording, _ = constant
    settings = {"windows": (0.5,), "max_steps": 8}
    law = fit(NCFM(2, v_smooth=V_SMOOTH), pendulum(), recording, **settings)
    monkeypatch.setattr("nfriction.fitting.strategy.holdout.Judgement.kept", True)
    model = NFNCFM(2, v_smooth=V_SMOOTH, **SMALL)
    found = fit(model, pendulum(), recording, start=law, **settings)
    assert found.residual < law.residual

    def off(result):
        return sum((value / limit) ** 2 for _, value, limit in result.plant_terms)

    assert off(found) < off(law)
    sizes = {name: size for name, _, size in found.effective_parameters}
    assert sizes["plant"] == len(found.plant_terms)


def test_evidence_says_how_near_a_plant_stays():
    """A quadratic whose plant the errors want elsewhere, and one that they leave where it is."""
    mean, sd = torch.zeros(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    near = torch.full((2,), 0.1, dtype=torch.float64)
    prior = strategy.NetworkPrior(mean, sd, near)
    wider = prior.updated(torch.tensor([1.0, 0.01], dtype=torch.float64), torch.zeros(3).long())
    torch.testing.assert_close(wider.near, 10 * near)
    torch.testing.assert_close(wider.sd, sd)
    own = torch.full_like(near, 0.05)
    # However far evidence would let it go, it stays within what is known of the plant as given.
    assert (wider.plant_sd(own) < own).all()
    assert (prior.plant_sd(own) < wider.plant_sd(own)).all()


def test_evidence_finds_that_friction_depends_on_the_direction():
    truth = NFNCFM(1, [2e-3], terms=(2, 1), head_units=1)
    truth.schedule.set_range(SPEED, [-80.0, 80.0])
    with torch.no_grad():
        truth.schedule.lean.fill_(0.2)
    q0 = torch.tensor([np.pi + 2.0], dtype=torch.float64)
    run = rollout(ARM, truth.requires_grad_(False), q0, 0 * q0, sample_time=2e-3, steps=3000)
    q = COUNT * np.round(run.q.numpy() / COUNT)
    recording = Recording(2e-3 * np.arange(len(q)), q, convention="relative,upright")
    model = NFNCFM(1, terms=(2, 1), head_units=1)
    model.schedule.learn_sets = False
    found = fit(model, ARM, recording, windows=(0.5,), fit_plant=False, drag=False)
    assert float(model.schedule.lean) == pytest.approx(0.2, rel=0.05)
    (gamma,) = (value for name, value, _ in found.effective_parameters if name == "direction")
    assert gamma > 0.9
    (told,) = re.findall(r"and ([0-9.]+) % better than without the direction", found.status)
    assert float(told) > 50


@pytest.mark.parametrize("place", range(3))
def test_a_network_stopped_before_it_is_judged_gives_way_to_its_law(with_plant, place, monkeypatch):
    recording, law = with_plant
    model, begun = NFLFM(2, v_smooth=V_SMOOTH, prior_sd=0.6, **SMALL), []

    def search(self, problem, vector, tolerance, name):
        begun.append(name)
        return searched(self, problem, vector, tolerance, name)

    def stop(stage, step):
        return begun.count("network") > place

    searched = ShootingFitter.search
    monkeypatch.setattr(ShootingFitter, "search", search)
    kept = fit(model, pendulum(), recording, start=law, callback=stop, **BRIEF)
    # A search that takes no step calls nobody.
    assert begun[: place + 1] == ["network"] * (place + 1)
    assert not kept.converged
    assert "its constant law is kept" in kept.status
    at = (torch.ones(1, 2, dtype=torch.float64),) * 3
    torch.testing.assert_close(model(*at), law.model(*at), rtol=1e-5, atol=1e-9)
    assert model.schedule.options()["prior_sd"] == 0.6
