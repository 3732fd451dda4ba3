"""Fits of friction with memory to motions: recovery, initial states, identifiability."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from nfriction import FitResult, LinearAxis, Plant, Recording, Rotor, fit, rollout
from nfriction.evaluation.compare import Comparison, compare
from nfriction.evaluation.results import write_results
from nfriction.evaluation.score import score
from nfriction.fitting.data.windows import cut_windows
from nfriction.fitting.options import FitOptions
from nfriction.fitting.result.identifiability import CoefficientUncertainty
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.constant import _fitter
from nfriction.fitting.strategy.presliding import yielding
from nfriction.fitting.task import prepare_task, regression
from nfriction.friction import model_by_name
from nfriction.friction.memory import DAHL, Dahl, Gear, LuGre, MaxwellSlip, NFLuGre
from nfriction.friction.models import FrictionModel
from nfriction.plots.friction_torque import torque_over_velocity
from nfriction.signals import kalman_smoother, quantise
from tests.fitting.recordings import F64, pendulum

AXIS = LinearAxis(0.5)
SOFT = (1.0, 0.5, 0.05, 300.0, 5.0, 0.4)
SLIPS = (1.0, 0.5, 0.3, 0.2, 0.1, 5e-3, 0.01, 0.02, 0.05, 0.1, 3e-3, 0.3, 0.3)
# Presliding over a thousandth of an encoder count.
STIFF = (1.0, 0.5, 0.05, 3e6, 5.0, 0.4)


def pushed(model: FrictionModel, seed: int, *, seconds: float, rate: int) -> Recording:
    """An axis from rest, pushed below breakaway and beyond, with a 14-bit encoder."""
    random = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate)) / rate
    waves = [
        random.uniform(0.4, 1.0) * np.sin(2 * np.pi * f * time + random.uniform(0, 6.28))
        for f in (0.3, 0.7, 1.1, 1.9)
    ]
    force = (sum(waves) * (0.5 + 2.0 * np.sin(np.pi * time / 5) ** 2))[:, None]
    zero = torch.zeros(1, dtype=F64)
    run = rollout(AXIS, model, zero, zero, torch.as_tensor(force), sample_time=1 / rate)
    tau = np.concatenate([force, force[-1:]])
    return Recording(run.time.numpy(), quantise(run.q.numpy(), 2**14), tau=tau, unit="m")


@cache
def recorded(truth: tuple[float, ...], seed: int, seconds: float, rate: int) -> Recording:
    return pushed(LuGre(1, truth).requires_grad_(False), seed, seconds=seconds, rate=rate)


@pytest.mark.parametrize(
    ("name", "plant", "values"),
    [
        ("LuGre", LinearAxis(0.5), SOFT),
        ("NFLuGre", LinearAxis(0.5), SOFT),
        ("Gear", LinearAxis(0.5), (0.5, 0.1, 0.25, 0.4, 300.0)),
        pytest.param("MaxwellSlip", LinearAxis(0.05), SLIPS, marks=pytest.mark.slow),
        pytest.param("LuGre", pendulum(), (0.03, 0.015, 0.3, 3.0, 0.01, 0.003),
                     marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_derivatives_include_the_initial_deflections(
    name: str, plant: Plant, values: tuple[float, ...]
) -> None:
    """Gradients of the cost equal its differences, also for coefficients that scale the start."""
    joints = plant.joints
    model = model_by_name(name)(joints, values).requires_grad_(False)
    start = torch.tensor([1.6, 0.8], dtype=F64)[:joints]
    run = rollout(plant, model, start, 0.5 * start, sample_time=2e-3, steps=100)
    recording = Recording(run.time.numpy(), run.q.numpy() + 1e-3, unit=plant.unit)
    windows = cut_windows([recording], [kalman_smoother(recording.time, recording.q)], 0.1)
    problem = ShootingProblem(
        StepJacobian(plant, model, []), model, windows.with_states(plant, model), 1e-3,
        torch.eye(joints, dtype=F64),
    )  # fmt: skip
    x = problem.variables.start()
    states = problem.variables.split(x).states
    assert states.shape == (2, joints * (2 + model.law.state_size))
    own = states[:, 2 * joints :]
    own[:] = torch.linspace(-0.9, 0.8, own.numel(), dtype=F64).reshape(own.shape)
    found = problem.linearise(x).gradient
    of_states = problem.linearise(x, states=True).gradient
    torch.testing.assert_close(of_states, found[problem.variables.shared_count :])
    for k in [*range(joints * len(values)), *range(len(x) - states.numel(), len(x))]:
        # A network's parameters are zero.
        step = 1e-6 * max(abs(float(x[k])), 1e-3) if x[k] else 1e-5
        ahead, back = x.clone(), x.clone()
        ahead[k] += step
        back[k] -= step
        slope = float(problem.cost(ahead) - problem.cost(back)) / (2 * step)
        assert float(found[k]) == pytest.approx(slope, rel=1e-3, abs=1e-2)


def test_windows_begin_with_the_deflection_that_holds_the_joint() -> None:
    model = LuGre(1, SOFT).requires_grad_(False)
    # Held below breakaway, then sliding.
    force = np.repeat([[0.9], [3.0]], 400, 0)
    zero = torch.zeros(1, dtype=F64)
    run = rollout(AXIS, model, zero, zero, torch.as_tensor(force), sample_time=1e-3)
    tau = np.concatenate([force, force[-1:]])
    recording = Recording(run.time.numpy(), run.q.numpy(), tau=tau, unit="m")
    windows = cut_windows([recording], [kalman_smoother(recording.time, recording.q)], 0.2)
    share = windows.with_states(AXIS, model).law_state
    assert share is not None
    largest = sum(SOFT[:2]) / SOFT[3]
    true = run.law_state[[first for _, first, _ in windows.spans]] / largest
    # The second and fourth begin during a push; viscous friction counts as deflection, too.
    assert float(share[1]) == pytest.approx(float(true[1]), abs=0.05)
    assert float(true[3]) < float(share[3]) <= 1.0


def test_user_defined_law_may_use_other_coefficient_names() -> None:
    coefficients = torch.tensor([1.0, 0.4, 300.0], dtype=F64)
    named = [replace(c, name=f"own_{k}") for k, c in enumerate(DAHL.coefficients)]
    own = replace(DAHL, name="own", coefficients=tuple(named))
    assert torch.equal(yielding(own, coefficients, 1e-3, 1e-3), coefficients)
    assert yielding(DAHL, coefficients, 1e-3, 1e-3).tolist() == [1.0, 0.4, 1e3]


@pytest.fixture(scope="module")
def short():
    recording = recorded(SOFT, 2, 5.0, 500)
    return recording, fit("lugre", AXIS, recording, windows=(0.5,), fit_plant=False)


@pytest.mark.slow
def test_searches_start_with_the_stribeck_rise_hidden_by_sticking() -> None:
    recording = recorded((1.0, 0.33, 0.15, 1600.0, 19.4, 0.3), 0, 5.0, 500)
    begun = fit("lugre", AXIS, recording, windows=(0.5,), fit_plant=False, max_steps=0)
    _, rise, _, stiffness, *_ = begun.model.schedule.values[0].tolist()
    # By least squares of the torques the rise is zero.
    assert 0.16 < rise < 0.66
    assert 800 < stiffness < 3200


@pytest.mark.slow
def test_rows_near_reversals_do_not_bias_sliding_friction() -> None:
    """With all rows F_c is 0.42 and F_v 1.6: a contact that yields balances any torque."""
    time = 2e-3 * np.arange(2001)
    tau = ((0.7 + 2.0 * np.sin(np.pi * time / 4) ** 2) * np.sin(7 * time))[:, None]
    zero = torch.zeros(1, dtype=F64)
    model = Dahl(1, [1.0, 0.4, 310.0]).requires_grad_(False)
    run = rollout(AXIS, model, zero, zero, torch.tensor(tau[:-1]), sample_time=2e-3)
    recording = Recording(time, quantise(run.q.numpy(), 2**13), tau=tau, unit="m")
    begun = fit("dahl", AXIS, recording, windows=(0.5,), fit_plant=False, max_steps=0)
    f_c, f_v, _ = begun.model.schedule.values[0].tolist()
    assert f_c == pytest.approx(1.0, abs=0.05)
    assert f_v == pytest.approx(0.4, abs=0.1)


def test_presliding_and_sliding_determine_all_coefficients(short) -> None:
    _, found = short
    assert found.model.schedule.values[0].tolist() == pytest.approx(SOFT, rel=0.03)
    assert all(i.low < x < i.high for i, x in zip(found.intervals, SOFT, strict=True))
    assert found.converged
    assert not found.unidentifiable


def test_a_fit_with_memory_is_scored_saved_and_tabulated(short, tmp_path) -> None:
    recording, found = short
    errors = score(found.plant, found.model, recording, limit=False)
    assert errors.free_run.all < 1e-3
    # Windows continue from the deflection of the motion before.
    assert errors.windows["1"].all < 1e-3
    assert "sigma_0 of joint1" in found.summary()
    assert found.uncertainty is not None
    sd = found.uncertainty.torque_sd(found.model, torch.tensor([[-0.5], [0.5]], dtype=F64))
    assert (sd > 0).all()
    assert (sd < 0.1).all()


@pytest.fixture(scope="module")
def geared():
    truth = Gear(1, (0.4, 0.08, 0.2, 0.3, 400.0)).requires_grad_(False)
    recording = pushed(truth, 3, seconds=2.0, rate=500)
    return recording, fit("gear", AXIS, recording, method="equation_error")


def test_gear_loss_needs_the_drive_torque(geared) -> None:
    recording, found = geared
    undriven = recording._replace(tau=None, name="swing")
    message = "in swing, and gear reads the drive's torque; add tau or use dahl"
    with pytest.raises(ValueError, match=message):
        fit("gear", AXIS, undriven, method="equation_error")
    with pytest.raises(ValueError, match=message):
        score(found.plant, found.model, undriven, limit=False)
    # Before any fit, whose result would be lost.
    with pytest.raises(ValueError, match=message):
        compare(AXIS, ["viscous", "gear"], recording, undriven, callback=pytest.fail)


def test_gear_friction_curve_has_zero_drive_torque(geared) -> None:
    """Its load is a torque [N m]: 1 N m is no load at rest."""
    recording, found = geared
    constants = found.model.schedule.values
    shares = torch.tensor([0.0, 1.0, 1.0, 0.0, 0.0], dtype=F64)
    with torch.no_grad():
        other = Gear(1, constants + shares, v_smooth=found.model.v_smooth)
    name = found.model.law.name
    first, second = (
        torque_over_velocity(AXIS, {name: m}, [recording]).axes[0].lines[-1].get_ydata()
        for m in (found.model, other)
    )
    np.testing.assert_allclose(second, first)
    known = CoefficientUncertainty(found.model.schedule, torch.diag(shares))
    assert not known.torque_sd(found.model, torch.tensor([[0.5]], dtype=F64)).any()


def test_model_that_cannot_be_exported_does_not_stop_a_comparison(geared, tmp_path, caplog) -> None:
    recording, found = geared
    lugre = replace(found, model=LuGre(1, SOFT).requires_grad_(False))
    slower = recording[np.arange(len(recording.time)) % 2 == 0]
    scores = {name: [score(f.plant, f.model, recording, limit=False)] for name, f in
              (("gear", found), ("lugre", lugre))}  # fmt: skip
    for name, f, train in (("gear", found, [recording]), ("lugre", lugre, [recording, slower])):
        made = Comparison({name: f}, {name: scores[name]}, {}, unit="m", joint_names=("x",))
        write_results(made, train, [], tmp_path, figures=False)
        assert (tmp_path / "models" / f"{name}.json").is_file()
        assert [path.stem for path in tmp_path.rglob("*.pt")] == ["gear"] * (name == "gear")
    assert "lugre was not exported: the law 'lugre' has memory" in caplog.text


@pytest.mark.slow
def test_shares_of_a_small_torque_are_identifiable() -> None:
    """A share is judged by its torque, which is 0.3 mN here."""
    size = 1e-4
    large = pushed(Gear(1, (0.4, 0.08, 0.2, 0.3, 400.0)).requires_grad_(False), 3,
                   seconds=3.0, rate=200)  # fmt: skip
    small = large._replace(tau=size * large.tau)
    found = fit("gear", LinearAxis(0.5 * size), small, windows=(0.5,), fit_plant=False)
    assert not found.unidentifiable


@pytest.mark.slow
def test_gear_loss_is_recovered_in_both_directions_of_power() -> None:
    truth = (0.4, 0.08, 0.2, 0.3, 400.0)
    recording = pushed(Gear(1, truth).requires_grad_(False), 3, seconds=10.0, rate=500)
    found = fit("gear", AXIS, recording, windows=(0.5, 2.0))
    assert found.model.schedule.values[0].tolist() == pytest.approx(truth, rel=0.05)
    assert not found.unidentifiable
    dahl = fit("dahl", AXIS, recording, windows=(0.5, 2.0))
    apart = pushed(Gear(1, truth).requires_grad_(False), 4, seconds=10.0, rate=500)
    gear, other = (
        score(f.plant, f.model, apart, limit=False).windows["1"].all for f in (found, dahl)
    )
    assert gear < 0.2 * other


def test_law_with_gear_loss_removes_it_from_the_plant() -> None:
    """Only the sum of both losses is identifiable, so the law's would be drawn to zero."""
    recording = pushed(Gear(1, (0.4, 0.1, 0.1, 0.3, 400.0)).requires_grad_(False), 3,
                       seconds=2.0, rate=100)._replace(unit="rad")  # fmt: skip
    names = []
    for law in ("gear", "viscous"):
        task = prepare_task(law, Rotor(inertia=0.5), recording, FitOptions())
        fitter = _fitter(task, task.model, regression(task, task.model, task.plant), False)
        names.append([term.name for term in fitter.jacobian.terms])
    assert [any("gear loss" in name for name in of) for of in names] == [False, True]


@pytest.mark.slow
def test_unneeded_network_is_omitted(short) -> None:
    recording, law = short
    found = fit("neuro-fuzzy:lugre", AXIS, recording, windows=(0.5,), fit_plant=False, start=law)
    assert "constant law is kept" in found.status
    at = torch.linspace(-1.0, 1.0, 9, dtype=F64)[:, None]
    coefficients = found.model.coefficients(at, 10.0 * at)
    torch.testing.assert_close(coefficients, law.model.schedule.values.expand(9, 1, -1))


@pytest.mark.slow
def test_network_corrects_a_bristle_law_for_other_friction() -> None:
    truth = NFLuGre(1, SOFT)
    schedule = truth.schedule
    schedule.set_range(3.0, [-40.0, 40.0])
    # F_c and viscous friction of no law.
    rules, random = schedule.network.anfis.consequents, torch.Generator().manual_seed(3)
    with torch.no_grad():
        for k in (0, 5):
            rules[0, k] = 0.25 * torch.randn(rules[0, k].shape, generator=random, dtype=F64)
    truth.requires_grad_(False)
    first, second, apart = (pushed(truth, seed, seconds=20.0, rate=500) for seed in (0, 1, 7))
    given = {"windows": (0.5, 2.0), "fit_plant": False}
    law = fit("lugre", AXIS, [first, second], **given)
    found = fit("neuro-fuzzy:lugre", AXIS, [first, second], **given, start=law)
    better, plain = (score(f.plant, f.model, apart, limit=False).free_run.all for f in (found, law))
    assert better < 0.5 * plain
    # The contact stores energy with one stiffness.
    at = torch.linspace(-2.0, 2.0, 9, dtype=F64)[:, None]
    stiffness = found.model.coefficients(at, 10.0 * at)[..., 3]
    assert float(np.ptp(stiffness.numpy())) == 0.0


@pytest.mark.slow
def test_stiffness_below_encoder_resolution_is_unidentifiable() -> None:
    recordings = [recorded(STIFF, seed, 20.0, 1000) for seed in (0, 1)]
    found = fit("lugre", AXIS, recordings, windows=(0.5,))
    assert {"sigma_0 of joint1", "sigma_1 of joint1"} <= set(found.unidentifiable)
    interval = next(i for i in found.intervals if i.name == "sigma_0 of joint1")
    assert interval.low < STIFF[3] < interval.high
    # Sliding still determines the others.
    values = found.model.schedule.values[0]
    assert values[[0, 5]].tolist() == pytest.approx([STIFF[0], STIFF[5]], rel=0.02)


@pytest.fixture(scope="module")
def by_default() -> FitResult:
    recordings = [recorded(SOFT, seed, 20.0, 1000) for seed in (0, 1)]
    return fit("lugre", LinearAxis(0.55), recordings)


@pytest.mark.slow
def test_default_fits_recover_coefficients_and_plant(by_default: FitResult) -> None:
    assert by_default.model.schedule.values[0].tolist() == pytest.approx(SOFT, rel=0.02)
    assert float(by_default.plant.mass) == pytest.approx(0.5, rel=1e-3)


@pytest.mark.slow
def test_intervals_of_default_fits_contain_the_coefficients(by_default: FitResult) -> None:
    """With motions that repeat after 10 s, and the encoder's quantisation error with them."""
    held = [i.low <= x <= i.high for i, x in zip(by_default.intervals, SOFT, strict=False)]
    assert sum(held) >= 4


@pytest.mark.slow
def test_slip_elements_approximate_a_bristle() -> None:
    """Five widths in fixed ratios represent a contact that yields over one displacement."""
    recording = recorded(SOFT, 0, 5.0, 500)
    found = fit(MaxwellSlip(1), AXIS, recording, windows=(0.5,), fit_plant=False)
    plain = fit("stribeck", AXIS, recording, windows=(0.5,), fit_plant=False)
    assert found.residual < 0.5 * plain.residual
