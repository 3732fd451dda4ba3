"""Networks that correct adaptive models: better where they can, left where they cannot."""

from types import SimpleNamespace

import pytest
import torch

from nfriction import ALFM, LFM, NFLFM, fit
from nfriction.evaluation.score import score
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.shooting.uncertainty import integration_error
from nfriction.friction.laws import LINEAR
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.signals import kalman_smoother
from tests.fitting.recordings import F64, pendulum, swing
from tests.fitting.test_trajectory import ABSOLUTE, windows
from tests.papers.nffem.test_adaptive_neurofuzzy import adaptive

V_SMOOTH = 0.05


def network() -> NFLFM:
    return NFLFM(2, v_smooth=V_SMOOTH, network="by_class", terms=(3, 3), head_units=3)


def truth() -> FrictionModel:
    """Viscous friction that falls by half over the speeds of the motion."""
    made = NeuroFuzzy(LINEAR, 2, [[4e-3, 3e-3], [2e-3, 1.5e-3]], terms=(2, 2), head_units=2)
    made.set_range(12.0, [-300.0, 300.0])
    # The faster motions of these swings go beyond, and find it still low there.
    made.reach = 100.0
    vector = made.parameter_vector().reshape(-1)
    consequents = made.network.anfis.consequents
    with torch.no_grad():
        consequents[:, 0, :, 0] = -0.5
    assert not vector.any()
    return FrictionModel(LINEAR, made, V_SMOOTH).requires_grad_(False)


@pytest.fixture(scope="module")
def case():
    plant = pendulum()
    train = [swing(plant, truth(), seconds=6.0, start=start, name=name)
             for name, start in (("a", (2.6, 0.2)), ("b", (0.9, -0.5)))]  # fmt: skip
    held = swing(plant, truth(), seconds=6.0, start=(1.2, 0.6), name="c")
    motions = [kalman_smoother(r.time, r.q) for r in train]
    settings = {"fit_plant": False, "windows": (1.0,), "motions": motions}
    constant = fit(LFM(2, v_smooth=V_SMOOTH), plant, train, **settings)
    by_class = fit(ALFM(2, v_smooth=V_SMOOTH), plant, train, start=constant, **settings)
    return plant, train, held, by_class


def refined(model, case, max_steps):
    plant, train, _, by_class = case
    return fit(model, plant, train, start=by_class, windows=(1.0,), fit_plant=False,
               motions=by_class.motions, max_steps=max_steps)  # fmt: skip


@pytest.mark.slow
def test_what_classes_cannot_say_is_learned(case):
    plant, _, held, by_class = case
    found = refined(network(), case, max_steps=8)
    assert "kept" not in found.status
    assert found.residual < 0.7 * by_class.residual
    ours, before = (score(plant, m, held) for m in (found.model, by_class.model))
    assert ours.free_run.all < 0.7 * before.free_run.all


def test_a_correction_that_does_not_help_is_left(case, monkeypatch):
    plant, _, held, by_class = case
    # However little is taken, the hold-out windows come out worse.
    monkeypatch.setattr(
        "nfriction.papers.nffem.correction._errors",
        lambda p, vector: (1.0 + vector.any()) * torch.ones(len(p.windows), 2, dtype=F64),
    )
    found = refined(network(), case, max_steps=1)
    assert "kept" in found.status
    ours, before = (score(plant, m, held) for m in (found.model, by_class.model))
    assert ours.free_run.joints == pytest.approx(before.free_run.joints, rel=1e-6)


def test_a_correction_worse_where_it_was_learned_is_left(case, monkeypatch):
    """Though its parts did well on hold-out windows."""
    monkeypatch.setattr(
        "nfriction.papers.nffem.correction._cross_fitted",
        lambda schedule, *_: (schedule.parameter_vector(), torch.ones(2, dtype=F64)),
    )
    monkeypatch.setattr(
        "nfriction.papers.nffem.correction._errors",
        lambda p, vector: (1.0 + vector.any()) * torch.ones(len(p.windows), 2, dtype=F64),
    )
    found = refined(network(), case, max_steps=1)
    assert "kept" in found.status
    assert not found.model.schedule.parameter_vector().any()


def test_an_interrupt_while_it_is_judged_keeps_the_adaptive_model(case):
    plant, train, _, by_class = case
    heard = []

    def interrupt(stage, step):
        heard.append(stage)
        raise KeyboardInterrupt

    found = fit(network(), plant, train, start=by_class, windows=(1.0,), fit_plant=False,
                motions=by_class.motions, callback=interrupt)  # fmt: skip
    assert len(heard) == 1
    assert not found.converged
    assert "Stopped" in found.status
    assert not found.model.schedule.parameter_vector().any()


def test_a_joint_s_part_that_does_not_help_is_left(case, monkeypatch):
    plant = case[0]
    model = network()
    of_joint = model.schedule.joint_of_parameters()

    def errors(problem, vector):
        # The first joint's part halves its error, the second's doubles it.
        moved = torch.stack([vector[of_joint == j].any() for j in range(2)])
        factor = torch.where(moved, torch.tensor([0.5, 2.0]), torch.ones(2))
        return factor.to(F64).expand(len(problem.windows), 2)

    monkeypatch.setattr("nfriction.papers.nffem.correction._errors", errors)
    found = refined(model, case, max_steps=1)
    taken = found.model.schedule.parameter_vector()
    assert taken[of_joint == 0].any()
    assert not taken[of_joint == 1].any()
    assert f"0 of {plant.joint_names[1]}'s" in found.status


@pytest.mark.slow
def test_without_an_adaptive_fit_to_start_from_there_is_one_first(case):
    plant, train, _, by_class = case
    found = fit(network(), plant, train, windows=(1.0,), fit_plant=False, max_steps=1,
                motions=by_class.motions)  # fmt: skip
    assert found.model.schedule.adaptive.thresholds.equal(by_class.model.schedule.thresholds)


def remembering(**options) -> ShootingProblem:
    """Windows of a network by class, whose classes remember."""
    model = NFLFM(2, v_smooth=0.1, network="by_class", terms=(2, 2), head_units=2)
    model.schedule.set_adaptive(adaptive(sample_time=2e-3, **options))
    model.schedule.adaptive.set_coefficients(1e-2 * model.schedule.adaptive.values)
    model.schedule.deviation.scale.mul_(1e-2)
    model.schedule.deviation.set_range(8.0, [-300.0, 300.0])
    model.requires_grad_(False)
    w = windows()
    memory = model.schedule.initial_state(w.qd0, torch.full_like(w.qd0, 20.0))
    return ShootingProblem(
        StepJacobian(pendulum(), model, []), model, w, 1e-3, ABSOLUTE, stride=4, memory=memory
    )


def test_finer_steps_that_would_advance_a_memory_sooner_are_no_error_of_the_integration():
    p = remembering(time_constant=0.02)
    x = p.variables.start()
    found = SimpleNamespace(x=x, hessian=p.linearise(x).hessian)
    assert not integration_error(p, found).any()


def test_gradient_with_a_memory_is_the_cost_s_derivative():
    p = remembering()
    g = torch.Generator().manual_seed(1)
    x = p.variables.start()
    x[: p.variables.friction_count] = 0.1 * torch.randn(
        p.variables.friction_count, generator=g, dtype=F64
    )
    found = p.linearise(x)
    assert float(found.cost) == pytest.approx(float(p.cost(x)))
    for _ in range(4):
        along = torch.randn(x.shape, generator=g, dtype=F64)
        step = 1e-6
        slope = float(p.cost(x + step * along) - p.cost(x - step * along)) / (2 * step)
        # The classes do not change within so small a step.
        assert slope == pytest.approx(float(found.gradient @ along), rel=1e-5)
