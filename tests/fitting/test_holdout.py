"""A network is kept only if it predicts hold-out data better than its constant law."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nfriction import LFM, NFLFM, fit
from nfriction.fitting.data.inputs import measurement_matrix
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.result.paired_test import improves
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy import neurofuzzy
from nfriction.fitting.strategy.continuation import ShootingFitter
from nfriction.fitting.strategy.holdout import (
    cut_for_folds,
    holdout_splits,
    holdout_windows,
    recording_splits,
    settled,
    verdict,
)
from nfriction.fitting.strategy.neurofuzzy import (
    Validation,
    initialise_from_constant,
    revert_to_constant,
)
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.recording import Recording
from nfriction.signals import kalman_smoother
from tests.fitting.recordings import F64, one_link, swing

V_SMOOTH = 0.05
TRUTH = [[1.5e-3, 2.5e-3]]
SMALL = {"terms": (2, 2), "head_units": 2, "inputs": ()}
FOLDS = DEFAULTS.folds
NONE = torch.zeros(0, dtype=F64)


@pytest.fixture(scope="module")
def constant():
    recording = swing(one_link(), LFM(1, TRUTH, v_smooth=V_SMOOTH), seconds=3.0)
    model = LFM(1, v_smooth=V_SMOOTH)
    found = fit(model, one_link(), recording, windows=(0.5,), fit_plant=False)
    return recording.joint_coordinates(one_link()), found


def refinement(constant):
    joint, found = constant
    model = NFLFM(1, v_smooth=V_SMOOTH, **SMALL)
    model = initialise_from_constant(model, found, [joint], found.motions)
    measurement = measurement_matrix(one_link(), joint.resolve_convention(one_link()))
    jacobian = StepJacobian(one_link(), model, [])
    return ShootingFitter(jacobian, model, [joint], measurement, DEFAULTS)


def splits(fitter, motions, length, cut=holdout_windows):
    return holdout_splits(cut(fitter.recordings, motions, length, FOLDS), FOLDS)


def rmse(*args):
    return float(settled(*args).mean().sqrt())


def vector(fitter):
    return fitter.friction.schedule.parameter_vector()


def test_every_window_is_a_hold_out_once(constant):
    search, motions = refinement(constant), constant[1].motions
    for length in (0.1, 100.0):
        hold_out = []
        for train, hold_out_windows in splits(search, motions, length):
            # Several at a time, so that each lies between training windows.
            assert len(hold_out_windows) >= FOLDS
            assert not set(train.spans) & set(hold_out_windows.spans)
            hold_out += hold_out_windows.spans
        samples = [np.arange(first, last) for _, first, last in sorted(hold_out)]
        np.testing.assert_array_equal(np.concatenate(samples), np.arange(len(constant[0]) - 1))


def test_windows_of_one_recording_count_once(constant, monkeypatch):
    """They share a search, so their scatter is not that between recordings."""
    joint, found = constant
    validation = object.__new__(Validation)
    validation.options = DEFAULTS
    validation.windows = cut_for_folds([joint] * 3 * FOLDS, found.motions * 3 * FOLDS, 0.5, FOLDS)
    monkeypatch.setattr(Validation, "_further", lambda *_: None)

    def places(_, end, test):
        return torch.tensor([place for place, *_ in test.spans], dtype=F64)

    monkeypatch.setattr(Validation, "_errors", places)
    assert validation.by_recording(None).tolist() == [*range(3 * FOLDS)]


@pytest.mark.parametrize(
    ("errors", "lost"), [([1.1, 1.1, 3.0], True), ([1.1, 3.0], False), ([0.9, 1.1, 3.0], False)]
)
def test_network_worse_on_every_recording_is_rejected(errors, lost):
    new = torch.tensor(errors, dtype=F64)
    assert neurofuzzy._worse(torch.ones_like(new), new, 0.05) == lost


@pytest.mark.parametrize("count", [2, 5])
def test_every_recording_is_a_hold_out_once(constant, count):
    joint, found = constant
    windows = holdout_windows([joint] * count, [*found.motions] * count, 0.5, FOLDS)
    held_out = []
    for train, hold_out_windows in recording_splits(windows, FOLDS):
        places = [{place for place, *_ in part.spans} for part in (train, hold_out_windows)]
        assert set.union(*places) == set(range(count))
        assert not set.intersection(*places)
        held_out += places[1]
    assert sorted(held_out) == list(range(count))


def test_short_recording_with_a_gap_still_has_hold_out_windows(constant):
    """As in cross-validation, which removes blocks from a recording."""
    joint, _ = constant
    samples = np.r_[0:60, len(joint) - 60 : len(joint)]
    gapped = Recording(time=joint.time[samples], q=joint.q[samples])
    assert len(gapped.segments) == 2
    motion = kalman_smoother(gapped.time, gapped.q)
    found = holdout_splits(holdout_windows([gapped], [motion], 100.0, FOLDS), FOLDS)
    assert all(len(train) >= 2 and len(hold_out) >= 1 for train, hold_out in found)


def test_zero_network_has_its_laws_error_and_a_bad_one_a_larger(constant):
    search, motions = refinement(constant), constant[1].motions
    train, hold_out = splits(search, motions, 0.5)[0]
    law = replace(search, friction=constant[1].model)
    of_law = rmse(hold_out, law.problem(train, 1e-3, vector(law)), vector(law), NONE)
    for value, least, most in ((0.0, 1 - 1e-9, 1 + 1e-9), (1.0, 1.5, np.inf)):
        network = torch.full_like(vector(search), value)
        by_network = search.problem(train, 1e-3, network)
        assert least <= rmse(hold_out, by_network, network, NONE) / of_law <= most
    assert not vector(search).any()


def test_window_is_scored_from_the_state_that_fits_best(constant):
    """A smoother's error at the start is no error of the law."""
    search, motions = refinement(constant), constant[1].motions
    train, hold_out = splits(search, motions, 0.5, cut_for_folds)[0]
    law = replace(search, friction=constant[1].model)
    problem = law.problem(train, 1e-4, vector(law))
    off = replace(hold_out, q0=hold_out.q0 + 5e-3, qd0=hold_out.qd0 - 0.05)
    from_off = replace(problem, windows=off)
    unsettled = from_off.errors(from_off.variables.start()).square().mean().sqrt()
    settled = rmse(off, problem, vector(law), NONE)
    assert settled < 0.1 * float(unsettled)
    assert settled == pytest.approx(rmse(hold_out, problem, vector(law), NONE), rel=0.05)


def test_diverging_network_has_infinite_error(constant):
    search, motions = refinement(constant), constant[1].motions
    train, hold_out = splits(search, motions, 0.5)[0]
    wild = torch.full_like(vector(search), 1e6)
    assert rmse(hold_out, search.problem(train, 1e-3, wild), wild, NONE) == np.inf


@pytest.mark.parametrize(
    ("ratios", "gained"),
    [
        ((0.9, 0.9, 0.9, 0.9), True),
        ((0.8, 0.9, 0.8, 0.9), True),
        ((0.2, 1.2, 1.1, 1.2), False),
        ((1.0, 1.0, 1.0, 1.0), False),
        ((0.1, 0.1, 0.1, np.inf), False),
    ],
)
def test_gain_must_exceed_its_scatter_over_windows(ratios, gained):
    law = torch.tensor([4.0, 1.0, 2.0, 3.0], dtype=F64)
    network = law * torch.tensor(ratios, dtype=F64).square()
    assert improves(network, law) is gained
    # The more candidates are compared, the larger a gain has to be.
    assert improves(network, law, 1e-6) is (gained and len(set(ratios)) == 1)
    assert improves(network, law, least=1.1) is (gained and max(ratios) < 1 / 1.1)
    # A law that diverges is worse than one that does not.
    assert improves(law, torch.where(law > 3, torch.inf, law))


def test_law_with_a_zero_coefficient_is_restored(constant):
    search, found = refinement(constant), constant[1]
    zero = replace(found, model=LFM(1, [[0.0, 2e-3]], v_smooth=V_SMOOTH))
    revert_to_constant(search.friction, zero)
    rest = search.friction.schedule.rest_coefficients()
    scale = search.friction.schedule.scale
    assert (rest[:, 0] < 2e-6 * scale[:, 0]).all()
    torch.testing.assert_close(rest[:, 1], torch.full((1,), 2e-3, dtype=F64), rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("ratio", "status"),
    [
        pytest.param(1.3, "30 % more than that of its constant law", marks=pytest.mark.slow),
        (0.95, "5 % less than that of its constant law"),
        (np.inf, "diverges"),
    ],
)
def test_rejected_network_is_reset(constant, monkeypatch, ratio, status):
    joint, found = constant

    def squares(test, problem, *_):
        law = torch.ones(len(test), dtype=F64)
        if not isinstance(problem.friction.schedule, NeuroFuzzy):
            return law
        # Better on some windows, worse on others.
        return ratio**2 * (law + torch.linspace(-0.8, 0.8, len(test), dtype=F64))

    monkeypatch.setattr("nfriction.fitting.strategy.holdout.settled", squares)
    model = NFLFM(1, v_smooth=V_SMOOTH, **SMALL)
    kept = fit(model, one_link(), joint, start=found, windows=(0.5,), fit_plant=False, max_steps=2)
    assert torch.equal(*(m.schedule.parameter_vector() for m in (kept.model, model)))
    assert status in kept.status
    assert any("constant law" in w for w in kept.warnings)
    qd = torch.linspace(-3, 3, 14, dtype=F64).reshape(14, 1)
    at = qd, torch.zeros_like(qd), torch.ones_like(qd)
    torch.testing.assert_close(model(*at), found.model(*at), rtol=1e-6, atol=1e-9)


def test_a_verdict_counts_ties():
    law = torch.ones(9, dtype=F64)
    few, most = law.clone(), law.clone()
    few[:6], few[6] = 1.1, 0.9
    most[:2] = 1.1
    assert "lower on 1 of 9 (equal on 2); the" in verdict(few, law)
    assert "lower on 0 of 9 and equal on 7, most of which the law already" in verdict(most, law)
    assert "lower on 9 of 9 (0 % and" in verdict(0.9 * law, law)


def test_law_fitted_to_other_recordings_is_refitted(constant):
    joint, found = constant
    half = joint[: len(joint) // 2]
    kept = fit(
        NFLFM(1, v_smooth=V_SMOOTH, **SMALL), one_link(), half, start=found, windows=(0.5,),
        fit_plant=False, max_steps=1,
    )  # fmt: skip
    assert len(kept.residuals) < len(found.residuals)


def test_a_fit_stopped_before_its_network_keeps_the_constant_law(constant):
    joint, found = constant
    stages = []

    def stop(stage, step):
        stages.append(stage)
        return True

    model = NFLFM(1, v_smooth=V_SMOOTH, **SMALL)
    kept = fit(
        model, one_link(), joint, start=found, windows=(0.5,), fit_plant=False, callback=stop
    )
    assert set(stages) == {"constant law, hold-out"}
    assert torch.equal(*(m.schedule.parameter_vector() for m in (kept.model, model)))
    assert not kept.converged
    assert "Stopped" in kept.status
    at = (torch.ones(1, 1, dtype=F64),) * 3
    torch.testing.assert_close(model(*at), found.model(*at), rtol=1e-6, atol=1e-9)


def test_interrupt_during_hold_out_keeps_the_constant_law(constant, monkeypatch):
    joint, found = constant
    cost = ShootingProblem.cost
    scored = []

    def interrupted(problem, x):
        if len(problem.windows) == hold_out:
            scored.append(x)
            raise KeyboardInterrupt
        return cost(problem, x)

    search = refinement(constant)
    hold_out = len(splits(search, found.motions, 0.5)[0][1])
    monkeypatch.setattr(ShootingProblem, "cost", interrupted)
    model = NFLFM(1, v_smooth=V_SMOOTH, **SMALL)
    kept = fit(model, one_link(), joint, start=found, windows=(0.5,), fit_plant=False, max_steps=2)
    assert len(scored) == 1
    assert torch.equal(*(m.schedule.parameter_vector() for m in (kept.model, model)))
    assert not kept.converged
    assert "Stopped" in kept.status
    at = (torch.ones(1, 1, dtype=F64),) * 3
    torch.testing.assert_close(model(*at), found.model(*at), rtol=1e-6, atol=1e-9)
