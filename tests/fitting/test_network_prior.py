"""How far a network may deviate from its constant law is for windows held back to say."""

import pytest

from nfriction import LFM, NFLFM, NFStribeck, Stribeck, fit
from nfriction.fitting.network import PRIOR_SHARES
from nfriction.friction.neurofuzzy import NeuroFuzzy
from tests.fitting.recordings import pendulum, swing

V_SMOOTH = 0.05
SMALL = {"terms": (2, 2), "head_units": 2}


@pytest.fixture(scope="module")
def constant():
    truth = LFM(2, [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]], v_smooth=V_SMOOTH)
    recording = swing(pendulum(), truth, seconds=2.0)
    model = LFM(2, v_smooth=V_SMOOTH)
    return recording, fit(model, pendulum(), recording, windows=(0.5,), fit_plant=False)


@pytest.mark.parametrize("best", range(len(PRIOR_SHARES)))
def test_the_prior_is_the_one_whose_network_predicts_best(constant, monkeypatch, best):
    recording, found = constant
    seen = []

    def error(held_back, problem, vector):
        schedule = problem.friction.schedule
        if not isinstance(schedule, NeuroFuzzy):
            return 1.0
        seen.append(schedule.prior_sd)
        return 0.7 - 0.2 * (len(seen) == best + 1)

    monkeypatch.setattr("nfriction.fitting.network.error_on", error)
    model = NFLFM(2, v_smooth=V_SMOOTH, prior_sd=0.6, **SMALL)
    fit(model, pendulum(), recording, start=found, windows=(0.5,), fit_plant=False, max_steps=2)
    assert seen == pytest.approx([0.6 * share for share in PRIOR_SHARES])
    # It travels with the model as what it was fitted with.
    assert model.options()["prior_sd"] == pytest.approx(0.6 * PRIOR_SHARES[best])


def test_a_law_that_is_not_linear_has_a_network_too(constant):
    recording, _ = constant
    settings = {"windows": (0.5,), "fit_plant": False, "max_steps": 8}
    law = fit(Stribeck(2, v_smooth=V_SMOOTH), pendulum(), recording, **settings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nfriction.fitting.holdback.Judgement.score", 0.0)
        model = NFStribeck(2, v_smooth=V_SMOOTH, **SMALL)
        found = fit(model, pendulum(), recording, start=law, **settings)
    assert found.model is model
    assert found.residual <= 1.001 * law.residual
    assert float(model.schedule.parameter_vector().abs().max()) > 0
