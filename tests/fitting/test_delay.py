"""The delay of the torque is estimated together with the friction, with its interval."""

import math
import re

import numpy as np
import pytest
import torch

from nfriction import CVFM, NCFM, LinearAxis, Recording, Stribeck, compare, fit, rollout, score_fit
from nfriction.fitting.data.inputs import adjustable_terms
from nfriction.fitting.data.windows import cut_windows
from nfriction.fitting.options import FitOptions
from nfriction.fitting.plant_parameters import TORQUE_DELAY
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.task import prepare_task
from nfriction.papers.afem.adaptive import ACVFM
from nfriction.signals import kalman_smoother, quantise
from tests.fitting.recordings import COUNTS, F64, driven_axis, pendulum, swing

LATE = 0.0137
TRUTH = [0.8, 2.0]


DRY = [[2e-3, 1e-3], [2e-3, 1e-3]]


def driven_pendulum(seed: int, size: float, v_smooth: float) -> Recording:
    """A double pendulum whose torques change within samples and are logged at each."""
    random, plant = np.random.default_rng(seed), pendulum()
    time = 1e-4 * np.arange(40_001)
    rate, phase = random.uniform(3.0, 12.0, (3, 2)), random.uniform(0.0, 6.0, (3, 2))
    tau = size * np.sin(rate * time[:, None, None] + phase).sum(1)
    rest = torch.tensor([np.pi, 0.0], dtype=F64)
    out = rollout(
        plant, CVFM(2, DRY, v_smooth=v_smooth), rest, 0 * rest, torch.as_tensor(tau[:-1]),
        sample_time=1e-4, gradients=False,
    )  # fmt: skip
    q = quantise(out.q.numpy(), COUNTS)
    return Recording(time, q, tau=tau, convention="relative,upright")[::10]


def delayed(name: str = "axis", seconds: float = 3.0) -> Recording:
    """A driven axis whose torque is logged late by a non-integer number of samples."""
    clean = driven_axis(LinearAxis(2.0), CVFM(1, [TRUTH], v_smooth=0.05), seconds=seconds)
    return clean._replace(tau=clean.torque_at(clean.time - LATE), name=name)


def test_fitted_delay_is_recovered_within_its_interval():
    recording, axis = delayed(), LinearAxis(2.0)
    settings = {"windows": (0.5, 1.5), "fit_plant": False}
    late = fit(CVFM(1, v_smooth=0.05), axis, recording, **settings)
    found = fit(CVFM(1, v_smooth=0.05), axis, recording, fit_delay=True, **settings)
    assert found.converged
    # Half a sample: the torque is held over a sample, and the log is interpolated linearly.
    assert found.torque_delay == pytest.approx(LATE, abs=1e-3)
    assert score_fit(found, recording, limit=False).free_run.all < 0.1 * late.residual
    (interval,) = (i for i in found.intervals if i.name == TORQUE_DELAY)
    assert 0 < interval.sd < 1e-3
    truth = torch.tensor(TRUTH, dtype=F64)
    errors = [
        float((f.model.schedule.coefficient_sets()["always"][0] / truth - 1).abs().max())
        for f in (late, found)
    ]
    assert errors[1] < min(0.02, 0.1 * errors[0])
    # A fitted delay raises no warning; otherwise it is named with its remedy.
    assert found.mistakes == ()
    assert "`fit_delay=True`" in late.warnings[0]
    assert late.torque_delay == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("late", [0.0, 0.004, 0.0125])
def test_vibrations_do_not_shift_the_delay_by_their_period(late):
    """A controlled joint vibrates, so that the torques fit nearly as well a period later."""
    time = 1e-4 * np.arange(40_001)
    slow = 8.0 * np.sin([[2.0], [3.1], [4.7]] * time + [[0.3], [2.0], [4.0]]).sum(0)
    tau = (slow + 40.0 * np.sin(math.tau * 60.0 * time))[:, None]
    axis, dip = LinearAxis(2.0), Stribeck(1, [3.0, 3.0, 3.0, 0.15, 2.0], v_smooth=5e-3)
    rest = torch.zeros(1, dtype=F64)
    out = rollout(
        axis, dip, rest, rest, torch.as_tensor(tau[:-1]), sample_time=1e-4, gradients=False
    )
    recording = Recording(time, quantise(out.q.numpy(), math.tau / 1e-6), tau=tau, unit="m")[::10]
    recording = recording._replace(tau=recording.torque_at(recording.time - late))
    task = prepare_task("coulomb-viscous", axis, recording, FitOptions(fit_delay=True))
    assert task.delay == pytest.approx(late, abs=5e-4)


def test_delay_of_a_joint_at_rest_starts_from_zero():
    recording = delayed()
    still = recording._replace(q=np.zeros_like(recording.q))
    axis, options = LinearAxis(2.0), FitOptions(fit_delay=True)
    assert prepare_task("coulomb-viscous", axis, still, options).delay == 0


def test_early_torques_are_doubtful_beside_a_residual():
    """A wrong law may cause them, while filtered positions leave only noise."""
    recording, settings = delayed(), {"windows": (0.5,), "fit_plant": False, "fit_delay": True}
    early = recording._replace(tau=recording.torque_at(recording.time + 2 * LATE))
    sound = fit(CVFM(1, v_smooth=0.05), LinearAxis(2.0), early, **settings)
    assert sound.torque_delay == pytest.approx(-LATE, abs=1e-3)
    assert not any("later than torques" in text for text in sound.warnings)
    wrong = fit(NCFM(1), LinearAxis(2.0), early, **settings)
    assert any("Positions seem to be recorded" in text for text in wrong.unmodelled)
    assert wrong.usability[0] != "good"


@pytest.mark.slow
def test_scores_use_the_fitted_delay():
    train, test = delayed("one"), delayed("two", 2.0)
    test = test._replace(q=-test.q, tau=-test.tau)  # the other way, or a fit would have seen it
    settings = {"windows": (0.5, 1.5), "fit_plant": False}
    late = compare(LinearAxis(2.0), "CVFM", train, test, **settings)
    found = compare(LinearAxis(2.0), "CVFM", train, test, fit_delay=True, **settings)
    assert found.table().loc["CVFM", "all"] < 0.1 * late.table().loc["CVFM", "all"]
    # A figure shows the recording; every sample of it is simulated.
    assert found.scores()["CVFM"][0].simulated.shape == test.q.shape


def test_gradient_with_respect_to_the_delay_is_that_of_the_cost():
    recording, axis = delayed(), LinearAxis(2.0)
    options = FitOptions(fit_delay=True)
    terms = adjustable_terms(axis, CVFM(1).law, [recording], options)
    motion = kalman_smoother(recording.time, recording.q)
    windows = cut_windows([recording], [motion], 0.5)
    problem = ShootingProblem(
        StepJacobian(axis, CVFM(1), terms), CVFM(1, [[1.0, 1.5]]), windows, 1e-3,
        torch.eye(1, dtype=F64), substeps=2,
    )  # fmt: skip
    x = problem.variables.start()
    k = problem.variables.shared_count - 1
    assert terms[-1].name == TORQUE_DELAY
    x[k] = 0.0051
    # The slope is taken over a sample, hence the difference too.
    step = torch.zeros_like(x)
    step[k] = 1e-3
    slope = (problem.cost(x + step) - problem.cost(x - step)) / 2e-3
    assert float(problem.linearise(x).gradient[k]) == pytest.approx(float(slope), rel=1e-3)


def test_torques_between_samples_are_interpolated_and_held_at_the_ends():
    time = 0.25 * np.arange(8)
    recording = Recording(time, np.zeros((8, 1)), 4 * time[:, None], unit="m")
    at = recording.torque_at(np.array([-1.0, 0.125, 1.5625, 9.0]))
    assert at[:, 0].tolist() == [0.0, 0.5, 6.25, 7.0]
    assert not Recording(time, np.zeros((8, 2)), unit="m").torque_at(time[:3]).any()


def test_a_delay_needs_torques_and_simulated_windows():
    plant = pendulum()
    with pytest.raises(ValueError, match="needs recordings with torques"):
        fit(CVFM(2), plant, swing(plant, CVFM(2)), fit_delay=True)
    with pytest.raises(ValueError, match='fit_delay=True` needs `method="output_error"`'):
        FitOptions(method="equation_error", fit_delay=True)


@pytest.mark.slow
def test_half_a_sample_of_delay_is_reported():
    """A torque that changes within samples; the log contains the value measured at each."""
    fine = driven_axis(LinearAxis(2.0), CVFM(1, [TRUTH], v_smooth=0.05), seconds=3.0)
    measured, settings = fine[::10], {"windows": (0.5, 1.5)}
    found = fit(CVFM(1, v_smooth=0.05), LinearAxis(2.0), measured, **settings)
    (warning,) = (text for text in found.warnings if "`fit_delay=True`" in text)
    # Held over a sample of the simulation, it is half a sample early.
    late = 0.5 * (measured.sample_time - fine.sample_time)
    (milliseconds,) = re.findall(r"Perhaps torques are recorded ([\d.]+) ms later", warning)
    assert float(milliseconds) == pytest.approx(1e3 * late, rel=0.05)
    # Friction depends on the delay, also in a model that starts from such a fit.
    assert "F_c of joint1 0.8" in warning
    start = {"start": found, "windows": (0.5,), "max_steps": 9}
    by_class = fit(ACVFM(1, v_smooth=0.05), LinearAxis(2.0), measured, **start)
    for result in (found, by_class):
        assert result.usability[0] == "doubtful"
        assert "later than" in result.usability[1]
    held = fit(CVFM(1, v_smooth=0.05), LinearAxis(2.0), fine, **settings)
    assert not any("delay" in text for text in held.warnings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "verdict"),
    # The last case needs more integration steps at the start of the search than at its end.
    [((3, 0.1, 0.003), "doubtful"), ((1, 0.1, 0.003), "good"), ((0, 0.45, 0.05), "doubtful")],
)
def test_fit_is_doubtful_if_the_delay_moves_coefficients_significantly(motion, verdict):
    recording, truth = driven_pendulum(*motion), np.ravel(DRY)
    found, right = (
        fit(CVFM(2), pendulum(), recording, windows=(0.5,), fit_delay=fitted)
        for fitted in (False, True)
    )
    warning = "".join(text for text in found.warnings if "Perhaps torques" in text)
    own = {i.name: (i, x) for i, x in zip(found.intervals[:4], truth, strict=True)}
    assert found.usability[0] == verdict
    assert all(i.low <= x <= i.high for i, x in own.values()) == (verdict == "good")
    # A delay below one sample on which no coefficient depends is not reported.
    assert bool(warning) == (verdict == "doubtful")
    named = re.findall(r"(\w+ of joint\d) ([\d.]+)", warning)
    assert bool(named) == bool(warning)
    for name, value in named:
        assert float(value.rstrip(".")) == pytest.approx(own[name][1], rel=0.03)
    np.testing.assert_allclose(np.ravel(right.model.schedule.values), truth, rtol=0.03)
