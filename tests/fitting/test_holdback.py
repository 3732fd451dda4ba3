"""A network is kept as far as it predicts what it has not seen better than its constant law."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nfriction import LFM, NFLFM, fit
from nfriction.fitting.data.inputs import measurement_matrix
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.continuation import ShootingFitter
from nfriction.fitting.strategy.holdout import (
    Judgement,
    cut_for_folds,
    judge,
    training_blocks,
)
from nfriction.fitting.strategy.neurofuzzy import (
    correction,
    initialise_from_constant,
    revert_to_constant,
)
from nfriction.recording import Recording
from nfriction.signals import kalman_smoother
from tests.fitting.recordings import F64, pendulum, swing

V_SMOOTH = 0.05
TRUTH = [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]]
SMALL = {"terms": (2, 2), "head_units": 2}
FOLDS = DEFAULTS.folds
NONE = torch.zeros(0, dtype=F64)


@pytest.fixture(scope="module")
def constant():
    recording = swing(pendulum(), LFM(2, TRUTH, v_smooth=V_SMOOTH), seconds=3.0)
    model = LFM(2, v_smooth=V_SMOOTH)
    found = fit(model, pendulum(), recording, windows=(0.5,), fit_plant=False)
    return recording.joint_coordinates(pendulum()), found


def refinement(constant):
    joint, found = constant
    model = NFLFM(2, v_smooth=V_SMOOTH, **SMALL)
    model = initialise_from_constant(model, found, [joint], found.motions)
    model.schedule.learn_sets = False
    measurement = measurement_matrix(pendulum(), joint.resolve_convention(pendulum()))
    jacobian = StepJacobian(pendulum(), model, [])
    return ShootingFitter(jacobian, model, [joint], measurement, DEFAULTS)


def corrections(constant, vectors, reference=None):
    """Corrections by these parameters, one for each block left out."""
    search, motions = refinement(constant), constant[1].motions
    if reference is not None:
        search.friction.schedule.set_reference(reference)
    windows = cut_for_folds(search.recordings, motions, 0.5, FOLDS)
    found = []
    for seen, vector in zip(training_blocks(len(windows), FOLDS), vectors, strict=True):
        problem = search.problem(windows.subset(~seen), 1e-3, vector)
        parts = problem.variables.split(problem.variables.start(friction=vector))
        found.append(correction(problem, parts, NONE))
    return found


def vector(fitter):
    return fitter.friction.schedule.parameter_vector()


def test_every_window_is_left_out_once_with_its_neighbours():
    for count in (FOLDS, 11, 60):
        left_out = torch.stack([~seen for seen in training_blocks(count, FOLDS)])
        assert (left_out.sum(0) == 1).all()
        sizes = left_out.sum(1)
        assert sizes.max() - sizes.min() <= 1
        for row in left_out:
            # Consecutive: between two of them none belongs to another block.
            assert row.nonzero().diff(dim=0).eq(1).all()


def test_a_short_recording_with_a_gap_still_has_windows_to_leave_out(constant):
    """As cross-validation leaves it, which takes blocks out of a recording."""
    joint, _ = constant
    samples = np.r_[0:60, len(joint) - 60 : len(joint)]
    gapped = Recording(time=joint.time[samples], q=joint.q[samples])
    assert len(gapped.segments) == 2
    motion = kalman_smoother(gapped.time, gapped.q)
    assert len(cut_for_folds([gapped], [motion], 100.0, FOLDS)) >= FOLDS


def test_shares_are_those_with_which_the_errors_are_least(constant):
    """The law has 1.5 times the friction of joint 1: a correction by twice of that is half due."""
    search = refinement(constant)
    schedule = search.friction.schedule
    wrong = torch.tensor(TRUTH, dtype=F64) * torch.tensor([[1.5], [1.0]])
    schedule.set_reference(wrong)
    with torch.no_grad():
        # Of every rule the constant, in units of the coefficients.
        schedule.network.anfis.consequents[0, :, :, -1] = -2.0 / 3.0
    too_much = vector(search)
    found = judge(corrections(constant, [too_much] * FOLDS, wrong))
    assert found.kept
    assert found.windows >= FOLDS
    assert float(found.shares[0]) == pytest.approx(0.5, abs=0.05)
    assert found.ratio < -1
    statement = found.statement(["shoulder", "elbow"])
    assert "0.5 of shoulder's" in statement
    assert "% better" in statement


def test_a_correction_that_only_harms_is_rejected(constant):
    search = refinement(constant)
    with torch.no_grad():
        search.friction.schedule.network.anfis.consequents[..., -1] = 0.5
    found = judge(corrections(constant, [vector(search)] * FOLDS))
    assert float(found.shares.max()) < 0.02
    assert not found.kept
    assert "rejected" in found.rejection()


def test_a_network_that_diverges_is_rejected(constant):
    wild = torch.full_like(vector(refinement(constant)), 1e6)
    found = judge(corrections(constant, [wild] * FOLDS))
    assert not found.kept
    assert "diverges" in found.rejection()


@pytest.mark.parametrize(
    ("ratio", "spread", "kept"),
    [(-0.2, 0.05, True), (-0.2, 0.2, False), (0.1, 0.01, False), (-0.2, np.inf, False)],
)
def test_a_gain_has_to_be_more_than_chance(ratio, spread, kept):
    assert Judgement(torch.ones(2), ratio, spread, 10).kept is kept


def test_states_alone_have_the_same_quadratic_as_among_all_variables(constant):
    search, motions = refinement(constant), constant[1].motions
    torch.manual_seed(0)
    silent = vector(search)
    at = 0.1 * torch.randn(silent.shape, dtype=F64)
    problem = search.problem(search.cut(motions, 0.5), 1e-3, at)
    x = problem.variables.start()
    whole, part = problem.linearise(x), problem.linearise_states(x)
    count = problem.variables.shared_count
    torch.testing.assert_close(part.gradient, whole.gradient[count:])
    torch.testing.assert_close(part.hessian, whole.hessian[count:, count:])
    assert float(part.cost) == float(whole.cost)


def test_a_model_settles_on_a_coefficient_of_zero(constant):
    search, found = refinement(constant), constant[1]
    zero = replace(found, model=LFM(2, [[0.0, 2e-3]] * 2, v_smooth=V_SMOOTH))
    revert_to_constant(search.friction, zero)
    rest = search.friction.schedule.rest_coefficients()
    scale = search.friction.schedule.scale
    assert (rest[:, 0] < 2e-6 * scale[:, 0]).all()
    torch.testing.assert_close(rest[:, 1], torch.full((2,), 2e-3, dtype=F64), rtol=1e-6, atol=0)


def test_a_network_that_does_not_win_is_put_back(constant, monkeypatch):
    joint, found = constant
    monkeypatch.setattr("nfriction.fitting.strategy.holdout.Judgement.kept", False)
    model = NFLFM(2, v_smooth=V_SMOOTH, **SMALL)
    kept = fit(model, pendulum(), joint, start=found, windows=(0.5,), fit_plant=False, max_steps=2)
    assert kept.model is model
    assert "on blocks left out it was" in kept.status
    assert any("constant law" in w for w in kept.warnings)
    qd = torch.linspace(-3, 3, 14, dtype=F64).reshape(7, 2)
    at = qd, torch.zeros_like(qd), torch.ones_like(qd)
    torch.testing.assert_close(model(*at), found.model(*at), rtol=1e-6, atol=1e-9)


def test_a_network_takes_the_shares_that_it_is_given(constant, monkeypatch):
    joint, found = constant
    shares = torch.tensor([0.5, 0.0], dtype=F64)
    monkeypatch.setattr(
        "nfriction.fitting.strategy.neurofuzzy.judge",
        lambda left_out: Judgement(shares, -1.0, 0.01, 10),
    )
    model = NFLFM(2, v_smooth=V_SMOOTH, **SMALL)
    model.schedule.learn_sets = False
    kept = fit(model, pendulum(), joint, start=found, windows=(0.5,), fit_plant=False, max_steps=2)
    assert "0.5 of" in kept.status
    weights = model.schedule.parameter_vector()
    own = model.schedule.joint_of_weights()
    assert weights[own == 0].abs().max() > 0
    assert weights[own == 1].abs().max() == 0


def test_a_fit_stopped_before_its_network_keeps_the_constant_law(constant):
    joint, found = constant
    stages = []

    def stop(stage, step):
        stages.append(stage)
        return True

    model = NFLFM(2, v_smooth=V_SMOOTH, **SMALL)
    kept = fit(
        model, pendulum(), joint, start=found, windows=(0.5,), fit_plant=False, callback=stop
    )
    assert set(stages) == {"network"}
    assert kept.model is model
    assert not kept.converged
    assert "Stopped" in kept.status
    at = (torch.ones(1, 2, dtype=F64),) * 3
    torch.testing.assert_close(model(*at), found.model(*at), rtol=1e-6, atol=1e-9)


def test_an_interrupt_while_windows_judge_keeps_the_constant_law(constant, monkeypatch):
    joint, found = constant
    cost = ShootingProblem.cost
    judged = []

    def interrupted(problem, x):
        if len(problem.windows) == held_back:
            judged.append(x)
            raise KeyboardInterrupt
        return cost(problem, x)

    search = refinement(constant)
    windows = cut_for_folds(search.recordings, found.motions, 0.5, FOLDS)
    held_back = int((~next(training_blocks(len(windows), FOLDS))).sum())
    monkeypatch.setattr(ShootingProblem, "cost", interrupted)
    model = NFLFM(2, v_smooth=V_SMOOTH, **SMALL)
    kept = fit(model, pendulum(), joint, start=found, windows=(0.5,), fit_plant=False, max_steps=2)
    assert len(judged) == 1
    assert kept.model is model
    assert not kept.converged
    assert "Stopped" in kept.status
    at = (torch.ones(1, 2, dtype=F64),) * 3
    torch.testing.assert_close(model(*at), found.model(*at), rtol=1e-6, atol=1e-9)
