"""Robust losses equal SciPy's, and outliers of a sensor hardly change a fit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.optimize import least_squares

from nfriction import CVFM, LinearAxis, Recording, fit
from nfriction.fitting.data.windows import cut_windows
from nfriction.fitting.options import FitOptions
from nfriction.fitting.robust_loss import EFFICIENT, SQUARES, RobustLoss
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.signals import kalman_smoother
from tests.fitting.recordings import F64, driven_axis

LOSSES = ("soft_l1", "huber", "cauchy")
TRUTH = [0.8, 2.0]
SPIKES = [300, 301, 650, 1111]


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_equal_those_of_scipy(loss):
    errors = torch.tensor([-40.0, -2.0, -0.3, 0.0, 0.7, 1.5, 1e4], dtype=F64)
    ours = RobustLoss(loss, torch.tensor(1.3, dtype=F64))
    theirs = [
        least_squares(lambda x, e=e: e + x, [0.0], loss=loss, f_scale=1.3, max_nfev=1)
        for e in errors.tolist()
    ]
    counted = ours.counted(errors)
    costs = torch.tensor([found.cost for found in theirs], dtype=F64)
    torch.testing.assert_close(0.5 * counted.square(), costs, rtol=1e-9, atol=1e-30)
    slopes = torch.tensor([found.grad[0] for found in theirs], dtype=F64)
    torch.testing.assert_close(ours.weight(errors) * errors, slopes)
    assert torch.equal(counted.sign(), errors.sign())


@pytest.mark.parametrize("loss", LOSSES)
def test_robust_losses_are_95_percent_efficient(loss):
    """Asymptotic efficiency of an M-estimate: E[psi']^2 / E[psi^2]."""
    ours = RobustLoss(loss, torch.tensor(EFFICIENT[loss], dtype=F64))

    def influence(x):
        return float(ours.weight(torch.tensor(x, dtype=F64)) * x)

    def density(x):
        return np.exp(-0.5 * x * x) / np.sqrt(2 * np.pi)

    kinks = {"points": [-EFFICIENT[loss], EFFICIENT[loss]], "limit": 200}
    # E[psi'] = E[x psi] for a normal x.
    slope = quad(lambda x: x * influence(x) * density(x), -9, 9, **kinks)[0]
    power = quad(lambda x: influence(x) ** 2 * density(x), -9, 9, **kinks)[0]
    assert slope**2 / power == pytest.approx(0.95, abs=1e-3)


def test_scale_is_that_of_normal_noise_despite_outliers():
    noise = torch.randn(20_000, 2, generator=torch.Generator().manual_seed(0), dtype=F64)
    noise[:, 1] *= 3
    noise[:100] = 1e3
    scale = RobustLoss.of_errors("huber", noise, 0.0).scale / EFFICIENT["huber"]
    torch.testing.assert_close(scale, torch.tensor([1.0, 3.0], dtype=F64), rtol=0.03, atol=0)
    # Errors of a joint at rest are zero; its scale is the encoder resolution.
    still = RobustLoss.of_errors("huber", torch.zeros(9, 1, dtype=F64), 0.5)
    assert still.scale.tolist() == [0.5 * EFFICIENT["huber"]]


@pytest.mark.parametrize("loss", LOSSES)
def test_gradient_is_that_of_the_cost(loss):
    axis, recording = LinearAxis(2.0), spiked()
    motion = kalman_smoother(recording.time, recording.q)
    windows = cut_windows([recording], [motion], 0.5)
    problem = ShootingProblem(
        StepJacobian(axis, CVFM(1), []), CVFM(1, [[1.0, 1.5]]), windows, 1e-3,
        torch.eye(1, dtype=F64), options=FitOptions(loss=loss), stride=2,
    )  # fmt: skip
    x = problem.variables.start()
    problem = problem.rescaled(x)
    local = problem.linearise(x)
    for k in range(problem.variables.shared_count + 2):
        step = torch.zeros_like(x)
        step[k] = 1e-6
        slope = (problem.cost(x + step) - problem.cost(x - step)) / 2e-6
        assert float(local.gradient[k]) == pytest.approx(float(slope), rel=1e-4, abs=1e-3)
    # Every sum of squares of these errors is a sum of the loss.
    squares = replace(problem, loss=SQUARES)
    assert problem.counted_errors(x).square().sum() < squares.counted_errors(x).square().sum()


def spiked() -> Recording:
    """A driven axis whose sensor reads 3 cm wrong in four samples."""
    clean = driven_axis(LinearAxis(2.0), CVFM(1, [TRUTH], v_smooth=0.05))
    q = clean.q.copy()
    q[SPIKES] += 0.03
    return clean._replace(q=q)


def deviation(found) -> float:
    values = found.model.schedule.coefficient_sets()["always"][0]
    return float((values / torch.tensor(TRUTH, dtype=F64) - 1).abs().max())


SETTINGS = {"windows": (0.5, 1.5), "fit_plant": False}


@pytest.mark.parametrize(
    "loss", [pytest.param(loss, marks=[pytest.mark.slow] * (loss != "soft_l1")) for loss in LOSSES]
)
def test_spikes_hardly_change_a_robust_fit_and_are_named(loss):
    recording, axis = spiked(), LinearAxis(2.0)
    found = fit(CVFM(1, v_smooth=0.05), axis, recording, loss=loss, **SETTINGS)
    squares = fit(CVFM(1, v_smooth=0.05), axis, recording, **SETTINGS)
    assert squares.outliers == ()
    assert deviation(found) < min(0.02, 0.2 * deviation(squares))
    spikes = [o for o in found.outliers if o.weight < 0.1]
    assert {(o.recording, o.joint) for o in spikes} == {("axis", "joint1")}
    at = recording.time[SPIKES].tolist()
    assert {(o.first, o.last) for o in spikes} == {(at[0], at[1]), (at[2], at[2]), (at[3], at[3])}
    assert any("gives less than half weight" in w for w in found.warnings)
    assert found.to_dict()["outliers"][0]["recording"] == "axis"
    # Residuals are as measured; their root mean square uses the loss.
    assert float(found.residuals.abs().max()) > 0.02
    assert found.residual < 0.2 * squares.residual


@pytest.mark.parametrize("loss", LOSSES)
def test_spikes_of_the_torque_hardly_change_a_robust_regression(loss):
    clean, axis = driven_axis(LinearAxis(2.0), CVFM(1, [TRUTH], v_smooth=0.05)), LinearAxis(2.0)
    tau = clean.tau.copy()
    tau[SPIKES] += 300.0
    recording = clean._replace(tau=tau)
    settings = {"method": "equation_error", **SETTINGS}
    best, found, squares = (
        fit(CVFM(1, v_smooth=0.05), axis, given, loss=of, **settings)
        for given, of in ((clean, "linear"), (recording, loss), (recording, "linear"))
    )
    assert abs(deviation(found) - deviation(best)) < 0.2 * abs(deviation(squares) - deviation(best))
    for time in recording.time[SPIKES]:
        assert any(o.first <= time <= o.last and o.weight < 0.1 for o in found.outliers)
    assert any("gives less than half weight" in w for w in found.warnings)
