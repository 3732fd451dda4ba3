"""The uncertainty of coefficients follows from that of their parameters."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nfriction import CVFM, LFM, NFLFM, LinearAxis, Recording, Rotor, fit, rigs, rollout
from nfriction.fitting.data.windows import cut_windows
from nfriction.fitting.result.identifiability import (
    PIECE,
    CoefficientUncertainty,
    standard_deviations,
)
from nfriction.fitting.shooting import uncertainty
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.shooting.uncertainty import torque_noise, torque_response
from nfriction.fitting.strategy.neurofuzzy import Validation
from nfriction.signals import kalman_smoother, quantise
from tests.fitting.recordings import flywheel

F64 = torch.float64


@pytest.fixture(scope="module")
def swings():
    """Two swings of a pendulum with known friction, sampled by an encoder."""
    plant, made = rigs.multiarm_single(), []
    truth = LFM(1, [4e-4, 2e-3]).requires_grad_(False)
    for k, start in enumerate((2.0, 1.2)):
        q0, qd0 = torch.tensor([np.pi + start]), torch.zeros(1)
        run = rollout(plant, truth, q0.double(), qd0.double(), sample_time=4e-3, steps=500)
        counts = np.round(run.q.numpy() / plant.position_quantum) * plant.position_quantum
        time = 4e-3 * np.arange(len(counts))
        made.append(Recording(time, counts, convention="relative,upright", name=f"swing{k}"))
    return plant, made


@pytest.fixture(scope="module")
def fits(swings):
    options = {"windows": (1.0,), "fit_plant": False, "drag": False}
    law = fit(LFM(1), *swings, **options)
    with pytest.MonkeyPatch.context() as patch:
        # The network has nothing to correct here, but it must be kept.
        patch.setattr("nfriction.fitting.strategy.neurofuzzy.improves", lambda *_, **__: True)
        patch.setattr(Validation, "trained_on", lambda self, trial: trial)
        patch.setattr(Validation, "lost_over_long_windows", lambda *_: "")
        patch.setattr(Validation, "lost_by_recording", lambda *_: "")
        network = NFLFM(1, terms=(3, 2), head_units=2)
        return law, fit(network, *swings, start=law, **options)


@pytest.mark.slow
def test_intervals_include_torque_noise():
    """It affects all later samples in windows whose initial state absorbs most of it."""
    off = []
    for seed in range(4):
        recording = flywheel(seed, CVFM(1, [0.35, 0.12]))
        found = fit(CVFM(1), LinearAxis(0.13), recording, windows=(2.0,))
        off += [
            (i.value - truth) / i.sd
            for i, truth in zip(found.intervals, (0.35, 0.12), strict=False)
        ]
    # By residuals alone 3 standard deviations.
    assert 0.3 < np.sqrt(np.mean(np.square(off))) < 1.5


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_intervals_include_the_error_of_the_smoothed_sign(seed):
    """Without torque noise, the smoothed sign of the fit is the largest error."""
    truth = (0.35, 0.12)
    sharp = CVFM(1, truth, v_smooth=1e-5)
    recording = flywheel(seed, sharp, noise=0.0, scheme="time_stepping")
    found = fit(CVFM(1), LinearAxis(0.13), recording, windows=(2.0,), fit_plant=False)
    for i, true in zip(found.intervals, truth, strict=True):
        # By quantisation and steps alone up to 4.6 standard deviations.
        assert abs(i.value - true) < 1.5 * i.sd < 5e-3 * true


def stuck_half_the_time(seed: int, friction: dict[str, float]) -> Recording:
    """A driven wheel of 0.02 kg m^2 that friction holds exactly, in steps of 0.2 ms."""
    time, rng, h = np.arange(2001) / 250, np.random.default_rng(seed), 1 / 5000
    waves = zip((0.7, 0.5, 0.3), (0.2, 0.5, 1.1), rng.uniform(0, 6.28, 3), strict=True)
    torque = sum(a * np.sin(2 * np.pi * f * time + phase) for a, f, phase in waves)
    q, v, angle = 0.0, 0.0, []
    for given in torque:
        angle.append(q)
        for _ in range(20):
            dry = friction["F_c"] + friction["F_d"] * np.exp(-((v / friction["v_s"]) ** 2))
            free = v + h / 0.02 * given
            slid = max(0.0, abs(free) - h / 0.02 * dry) / (1 + h / 0.02 * friction["F_v"])
            q, v = q + h * (v + np.copysign(slid, free)) / 2, float(np.copysign(slid, free))
    return Recording(time, quantise(np.array(angle)[:, None], 16384), tau=torque[:, None])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3])
def test_intervals_include_the_step_size_limit_of_the_sign(seed):
    true = {"F_c": 0.35, "F_d": 0.2, "F_v": 0.12, "v_s": 0.2}
    settings = {"windows": (0.5,), "fit_plant": False, "encoder_reference": "shared"}
    found = fit("stribeck", Rotor(0.02), stuck_half_the_time(seed, true), **settings)
    assert found.usability == ("good", "")
    for i in found.intervals:
        assert i.low < true[i.name.split(" of ")[0]] < i.high
        assert i.high - i.low < 0.5 * i.value


def test_torque_noise_counts_once(monkeypatch):
    """A fine encoder shows nothing else, so residuals add nothing to the samples."""
    tasks, drawn = [], uncertainty.gathered_information
    monkeypatch.setattr(
        "nfriction.fitting.shooting.uncertainty.gathered_information",
        lambda *task: tasks.append(task) or drawn(*task),
    )
    recording = flywheel(0, CVFM(1, [0.35, 0.12]), counts=2**18)
    fit(CVFM(1), LinearAxis(0.13), recording, windows=(0.5,), fit_plant=False)
    ((problem, x, sd, *_),) = tasks
    whole, alone = (standard_deviations(drawn(problem, x, by * sd)) for by in (1.0, 0.0))
    torch.testing.assert_close(whole, alone, rtol=0.03, atol=0)


def test_diverging_noise_samples_are_excluded(monkeypatch):
    axis, model = LinearAxis(0.13), CVFM(1, [0.35, 0.12])
    recording = flywheel(0, model)[:400]
    motion = kalman_smoother(recording.time, recording.q)
    windows = cut_windows([recording], [motion], 0.4)
    problem = ShootingProblem(
        StepJacobian(axis, model, []), model, windows, 1e-3, torch.eye(1, dtype=F64)
    )
    x = problem.variables.start()
    whole = torque_response(problem, x, 3)
    simulate, calls = uncertainty._positions, iter(range(9))

    def second_diverges(*task):
        return simulate(*task) * (torch.inf if next(calls) == 2 else 1.0)

    monkeypatch.setattr(uncertainty, "_positions", second_diverges)
    torch.testing.assert_close(torque_response(problem, x, 3), whole[..., [0, 2]])
    monkeypatch.setattr(uncertainty, "_positions", lambda *task: simulate(*task) * torch.inf)
    assert torque_response(problem, x, 3) is None


def test_predicted_sd_matches_the_change_by_perturbed_parameters():
    torch.manual_seed(0)
    schedule = NFLFM(2, [2e-3, 1e-2]).schedule
    vector = schedule.parameter_vector()
    root = 1e-3 * torch.randn(len(vector), 5, dtype=F64)
    qd, qdd = 5 * torch.randn(2, 3, 2, dtype=F64), 50 * torch.randn(2, 3, 2, dtype=F64)
    predicted = CoefficientUncertainty(schedule, root).sd(qd, qdd)

    def at(moved):
        schedule.set_parameter_vector(vector + moved)
        return schedule(qd, qdd).detach()

    # Central differences, accurate to second order in the step.
    slopes = torch.stack([(at(0.01 * r) - at(-0.01 * r)) / 0.02 for r in root.T])
    torch.testing.assert_close(slopes.norm(dim=0), predicted, rtol=1e-6, atol=0)


def test_chunks_give_equal_results_and_open_parameters_infinite_sd():
    torch.manual_seed(1)
    schedule = NFLFM(1).schedule
    root = torch.randn(len(schedule.parameter_vector()), 3, dtype=F64)
    qd = torch.linspace(-9, 9, PIECE + 7, dtype=F64)[:, None]
    whole = CoefficientUncertainty(schedule, root).sd(qd, 3 * qd)
    one_by_one = [CoefficientUncertainty(schedule, root).sd(v, 3 * v) for v in qd[-3:]]
    torch.testing.assert_close(whole[-3:], torch.stack(one_by_one))
    constant = LFM(2).schedule
    root = torch.eye(4, dtype=F64)
    root[3] = torch.inf
    sd = CoefficientUncertainty(constant, root).sd(qd.expand(-1, 2), qd.expand(-1, 2))
    assert sd[0].tolist() == [[1.0, 1.0], [1.0, torch.inf]]


def test_intervals_do_not_depend_on_the_unit_of_length():
    """The first noise is a guess in metres, too; if too large, priors outweigh the data."""
    time = 2e-3 * np.arange(751)
    tau = 0.3 * np.sin(5 * time) + 0.15 * np.sin(14 * time)
    true, widths = CVFM(1, [0.05, 0.02], v_smooth=0.05).requires_grad_(False), []
    run = rollout(LinearAxis(0.02), true, [0.3], [0.0], tau[:-1, None], sample_time=2e-3)
    for unit in (1.0, 1e-3):
        q, force = unit * quantise(run.q.numpy(), 8192), unit * tau[:, None]
        recording = Recording(time, q, tau=force, unit="m")
        model = CVFM(1, v_smooth=0.05 * unit)
        found = fit(model, LinearAxis(0.02), recording, windows=(0.5,), drag=False)
        (dry, viscous), scale = found.intervals[:2], (unit, 1.0)
        widths.append([(i.high - i.low) / k for i, k in zip((dry, viscous), scale, strict=True)])
    np.testing.assert_allclose(*widths, rtol=0.2)


def test_uncertainty_of_constants_equals_the_intervals(fits):
    law, _ = fits
    rest = torch.zeros(1, dtype=F64)
    sd = law.uncertainty.sd(rest, rest)[0]
    for interval, value in zip(law.intervals, sd.tolist(), strict=False):
        assert interval.high - interval.value == pytest.approx(1.959964 * value)


def test_true_friction_is_covered_and_sd_grows_outside_the_data(fits):
    _, found = fits
    (motion, _) = found.motions
    there = [torch.tensor(x[30::30]) for x in (motion.qd, motion.qdd)]
    sd = found.uncertainty.sd(*there)
    error = found.model.schedule(*there).detach() - torch.tensor([4e-4, 2e-3], dtype=F64)
    assert (error.abs() <= 4 * sd).all()
    never = torch.full((1, 1), 1e3, dtype=F64)  # as at the corner of the range
    assert (found.uncertainty.sd(never, never)[0, 0] > 1.5 * sd.median(0).values).all()


def test_rejected_network_has_the_uncertainty_of_its_law(fits):
    law, found = fits
    kept = replace(law, model=found.model)  # as in a fit whose network predicts worse
    rest = torch.zeros(3, 1, dtype=F64)
    torch.testing.assert_close(kept.uncertainty.sd(rest, rest), law.uncertainty.sd(rest, rest))


def test_torque_noise_does_not_depend_on_other_recordings():
    """Windows of a low sample rate, or of a recording without torque, are padded or zero."""
    random, made = np.random.default_rng(0), []
    for step, noise in ((1e-3, 0.02), (4e-3, 0.05), (1e-3, None)):
        time = step * np.arange(round(4.0 / step))
        q = np.sin(3.0 * time)[:, None]
        tau = None if noise is None else 0.5 * q + noise * random.normal(size=q.shape)
        made.append(Recording(time, q, tau, convention="relative,upright"))
    motions = [kalman_smoother(r.time, r.q) for r in made]
    found = torque_noise(cut_windows(made, motions, 0.5))
    assert np.concatenate(found) == pytest.approx([0.02, 0.05, 0.0], rel=0.1)
