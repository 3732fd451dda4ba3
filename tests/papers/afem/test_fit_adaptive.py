"""Adaptive fits recover coefficients by class and are never worse than the constant law."""

import math
from dataclasses import replace
from itertools import cycle

import pytest
import torch

from nfriction import LFM, NFLFM, fit
from nfriction.evaluation.score import score
from nfriction.fitting.options import FitOptions
from nfriction.fitting.plant_parameters import plant_parameters
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.friction.models import FrictionModel
from nfriction.papers.afem.adaptive import ALFM
from nfriction.papers.afem.classes import ClassOptions
from nfriction.papers.afem.fit_adaptive import (
    ClassFitter,
    GivenClasses,
    GivenClassesProblem,
    fit_adaptive,
)
from nfriction.papers.afem.fit_by_search import SearchOptions, fit_by_search
from nfriction.signals import kalman_smoother
from tests.fitting.recordings import F64, pendulum, swing
from tests.fitting.test_shooting_problem import ABSOLUTE, point, windows

V_SMOOTH = 0.05
THRESHOLDS = [[30.0, 90.0], [60.0, 200.0]]
# Joint, class, coefficient: viscous friction grows with the class, dry friction falls.
TRUTH = [
    [[1e-3, 4.5e-3], [2e-3, 3.5e-3], [4e-3, 2e-3]],
    [[8e-4, 2.2e-3], [1.5e-3, 1.5e-3], [2.5e-3, 1e-3]],
]


def true_model():
    model = ALFM(2, TRUTH, v_smooth=V_SMOOTH, sample_time=2e-3)
    model.schedule.set_classes(THRESHOLDS)
    return model.requires_grad_(False)


@pytest.fixture(scope="module")
def case():
    """Training and test swings, their motions and the constant fit."""
    plant = pendulum()
    train = [swing(plant, true_model(), seconds=6.0, start=start, name=name)
             for name, start in (("a", (2.6, 0.2)), ("b", (0.9, -0.5)))]  # fmt: skip
    held = swing(plant, true_model(), seconds=6.0, start=(1.2, 0.6), name="c")
    motions = [kalman_smoother(r.time, r.q) for r in train]
    constant = fit(LFM(2, v_smooth=V_SMOOTH), plant, train, fit_plant=False, windows=(1.0,),
                   motions=motions)  # fmt: skip
    return plant, train, held, motions, constant


@pytest.mark.slow
def test_terms_are_relative_to_the_rig_as_given_though_it_is_corrected():
    recording = swing(pendulum(), true_model(), seconds=4.0, start=(2.6, 0.2))
    guessed = pendulum().replace(
        gravity_moment=torch.tensor([1.0, 2.0]) * pendulum().gravity_moment
    )
    constant = fit("load-coulomb", guessed, recording, windows=(0.5,))
    assert any("fit starts from the corrected rig" in text for text in constant.warnings)
    options, few = FitOptions(windows=(0.5,), max_steps=2), SearchOptions(max_evaluations=50)
    for found in (
        constant,
        fit_adaptive(ALFM(2), guessed, recording, options=options, start=constant),
        fit_by_search(LFM(2), guessed, recording, options=few, start=constant),
    ):
        (change,) = (x for name, x, _ in found.plant_terms if name == "gravity 2")
        true = found.plant.gravity_moment[1] / guessed.gravity_moment[1] - 1.0
        assert change == pytest.approx(float(true), rel=1e-6)
        assert change < -0.3


def fitted(case, model=None, **settings):
    plant, train, _, motions, constant = case
    options = FitOptions(fit_plant=False, windows=(1.0,), max_steps=settings.pop("max_steps", 30))
    return fit_adaptive(
        model or ALFM(2, v_smooth=V_SMOOTH), plant, train, options=options, start=constant,
        motions=motions, **settings,
    )  # fmt: skip


def test_coefficients_by_class_are_recovered(case):
    plant, _, held, _, constant = case
    model = ALFM(2, v_smooth=V_SMOOTH)
    found = fitted(case, model, classes=ClassOptions(THRESHOLDS, prior_sd=3.0))
    # A class is characterised by its friction at the speeds that it contains.
    true, speeds = torch.tensor(TRUTH, dtype=F64), torch.tensor([[2.0, 4.0, 8.0]] * 2, dtype=F64)
    for factor in (0.7, 1.4):
        ours, exact = (
            v[..., 0] * factor * speeds + v[..., 1] for v in (model.schedule.values, true)
        )
        torch.testing.assert_close(ours, exact, rtol=0.05, atol=0)
    assert torch.equal(*(m.schedule.parameter_vector() for m in (found.model, model)))
    assert found.converged
    assert found.residual < 0.3 * constant.residual
    ours, flat = (score(plant, m, held) for m in (model, constant.model))
    assert max(ours.free_run.joints) < 0.5 * max(flat.free_run.joints)
    for mine, other in zip(ours.windows["2"].joints, flat.windows["2"].joints, strict=True):
        assert mine < other


@pytest.mark.slow
def test_default_fit_finds_the_classes(case):
    plant, train, _, motions, constant = case
    model = ALFM(2, v_smooth=V_SMOOTH)
    found = fit(model, plant, train, fit_plant=False, windows=(1.0,), start=constant,
                motions=motions)  # fmt: skip
    assert found.residual < 0.8 * constant.residual
    assert not any(p.requires_grad for p in model.parameters())
    assert model.schedule.sample_time == pytest.approx(2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["pattern", "sqp"])
def test_searches_improve_on_the_constant_law_too(case, method):
    plant, train, held, motions, constant = case
    model = ALFM(2, v_smooth=V_SMOOTH)
    options = SearchOptions(method, horizon=1.0, max_evaluations=600, threads=1, seed=1)
    found = fit_by_search(model, plant, train, options=options, classes=ClassOptions(THRESHOLDS),
                          start=constant, motions=motions)  # fmt: skip
    assert "constant law is kept" not in found.status
    assert score(plant, model, held).free_run.all < score(plant, constant.model, held).free_run.all


def test_without_class_differences_the_constant_law_is_kept(case):
    """A tight prior keeps every class at the constant law; nothing may get worse."""
    constant = case[-1]
    model = ALFM(2, v_smooth=V_SMOOTH)
    found = fitted(case, model, classes=ClassOptions(prior_sd=1e-6), max_steps=3)
    flat = constant.model.schedule.values[:, None].expand(2, 3, 2)
    torch.testing.assert_close(model.schedule.values, flat, rtol=1e-3, atol=1e-8)
    assert found.residual <= constant.residual * (1 + 1e-9)


def test_classes_that_only_fit_noise_are_rejected():
    plant, truth = pendulum(), LFM(2, [3e-3, 4e-3], v_smooth=V_SMOOTH)
    train = [swing(plant, truth, start=start) for start in ((2.6, 0.2), (0.9, -0.5))]
    model = ALFM(2, v_smooth=V_SMOOTH)
    found = fit(model, plant, train, fit_plant=False, windows=(1.0,))
    assert "By evidence classes gain too little" in found.status
    assert list(model.schedule.coefficient_sets()) == ["always"]


def test_stopped_fit_keeps_the_constant_law(case):
    plant, train, _, motions, constant = case
    found = fit_adaptive(ALFM(2), plant, train, start=constant, motions=motions,
                         callback=lambda name, step: True)  # fmt: skip
    assert not found.converged
    assert "Stopped before the classes were found" in found.status


@pytest.mark.slow
def test_a_stop_after_evidence_accepted_the_classes_keeps_them(case, monkeypatch):
    searches, original = [], ClassFitter.likeliest

    def likeliest(self, *about):
        searches.append(about)
        return original(self, *about) if len(searches) == 1 else (None, 0.0)

    monkeypatch.setattr(ClassFitter, "likeliest", likeliest)
    found = fitted(case, classes=ClassOptions(THRESHOLDS, prior_sd=3.0))
    assert len(searches) == 2
    assert "constant law is kept" not in found.status
    assert not found.converged
    assert "stop" in found.status.lower()
    assert found.residual < 0.5 * case[-1].residual


@pytest.mark.parametrize(("of_class", "kept"), [(3.0, False), (-math.inf, True)])
def test_prior_with_diverging_motion_is_not_chosen(case, monkeypatch, of_class, kept):
    """The evidence of the constant law diverges too: differences would not be numbers."""
    evidence = cycle([-math.inf, -math.inf, of_class, -math.inf, -math.inf, -math.inf])
    monkeypatch.setattr("nfriction.papers.afem.fit_adaptive.log_evidence", lambda _: next(evidence))
    assert ("gain too little" in fitted(case, max_steps=2).status) == kept


def test_kept_constant_law_is_reported_once_with_its_warnings(case):
    constant = replace(case[-1], unidentifiable=("B of joint1",))
    found = fit_adaptive(ALFM(2), *case[:2], start=constant, motions=case[3],
                         callback=lambda name, step: True)  # fmt: skip
    table = found.to_pandas()
    assert list(table.index[:4]) == [f"{c} of joint{j}" for j in (1, 2) for c in "BC"]
    assert not any(", high" in name for name in table.index)
    assert table["low"].notna().all()
    settled = replace(found, mistakes=(), converged=True)
    assert "the data do not determine 1 parameter" in settled.usability[1]
    assert any("the constant law is kept" in warning for warning in found.warnings)


def test_worse_coefficients_are_rejected(case, monkeypatch):
    constant = case[-1]
    monkeypatch.setattr("nfriction.papers.afem.fit_adaptive.PositionError.residuals",
                        lambda self, vector: torch.full((1, 1, 2), 1e9, dtype=F64))  # fmt: skip
    model = ALFM(2, v_smooth=V_SMOOTH)
    found = fitted(case, model, max_steps=1)
    flat = constant.model.schedule.values[:, None].expand(2, 3, 2)
    torch.testing.assert_close(model.schedule.values, flat, rtol=1e-12, atol=0)
    assert "constant law is kept" in found.status
    assert found.residual == constant.residual


@pytest.mark.parametrize("substeps", [1, 2])
def test_gradient_by_class_equals_finite_differences(substeps):
    plant, model = pendulum(), ALFM(2, v_smooth=0.1)
    one = torch.ones(2, 2, dtype=F64)
    given = FrictionModel(model.law, GivenClasses(model, 4e-3 * one, 1e-3 * one), 0.1)
    terms = plant_parameters(plant, driven=(0, 1), largest_torque=0.1)
    of = windows()
    samples = 1 + max(last for _, _, last in of.spans)
    classes = (torch.arange(2 * samples).reshape(samples, 2) // 7 % 3).to(F64)
    jacobian = StepJacobian(plant, given, terms)
    p = GivenClassesProblem(
        jacobian, given, of, 1e-3, ABSOLUTE, substeps=substeps,
        classes=(classes,) * (1 + max(place for place, _, _ in of.spans)),
    )  # fmt: skip
    x = point(p)
    gradient = p.linearise(x).gradient
    for i in range(p.variables.shared_count):
        step = torch.zeros_like(x)
        step[i] = 1e-6
        slope = (p.cost(x + step) - p.cost(x - step)) / 2e-6
        assert float(gradient[i]) == pytest.approx(float(slope), rel=2e-4, abs=1e-2)
    # Every class of both joints contributed.
    assert (gradient[: p.variables.friction_count].abs() > 1e-6).all()


def test_inconsistent_input_is_refused(case):
    plant, train, _, _, _ = case
    with pytest.raises(ValueError, match="no adaptive model"):
        fit_adaptive(NFLFM(2), plant, train)
    with pytest.raises(ValueError, match="output_error"):
        fit(ALFM(2), plant, train, method="equation_error")
    with pytest.raises(ValueError, match="prior_sd"):
        ClassOptions(prior_sd=0.0)
    with pytest.raises(ValueError, match="method"):
        SearchOptions("simplex")
