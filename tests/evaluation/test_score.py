"""Scores: close to the encoder's noise for the true model, infinite for a diverging one."""

import json
import re
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
import torch

from nfriction import CVFM, LFM, LinearAxis, PendulumChain, Recording, rigs, rollout, score
from nfriction.evaluation.compare import Comparison
from nfriction.evaluation.lead_in import (
    ZERO_IN,
    Simulator,
    Zero,
    estimate_starts,
    estimate_zero,
    lead_in_samples,
)
from nfriction.evaluation.score import RMSE, Errors, Score
from nfriction.friction import model_by_name
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import Coefficient, Law
from nfriction.friction.models import FrictionModel
from nfriction.recording import RecordingWarning
from nfriction.signals import quantise
from tests.fitting.recordings import pendulum, swing

MODEL = LFM(2, [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]], v_smooth=0.05)
QUANTUM = 2 * np.pi / 8192
SETTINGS = {"start": (2.8, 0.3), "seconds": 4.0}


def plant(quantum=QUANTUM) -> PendulumChain:
    return pendulum(position_quantum=quantum)


@pytest.mark.parametrize("convention", ["relative,upright", "absolute,hanging"])
def test_error_of_the_true_model_is_the_encoder_quantisation(convention):
    """From the given state, in the recording's convention, only quantisation error remains."""
    recording = swing(plant(), MODEL, convention=convention, **SETTINGS)
    q0 = recording.convention.position_from_joint(np.array(SETTINGS["start"]))
    found = score(plant(), MODEL, recording, initial_state=(q0, np.zeros(2)))
    assert found.free_run.all == pytest.approx(QUANTUM / 12**0.5, rel=0.3)
    np.testing.assert_allclose(found.simulated, recording.q, atol=2 * QUANTUM)
    wrong = score(plant(), MODEL, recording, initial_state=(q0 + 0.1, np.zeros(2)))
    assert wrong.free_run.all > 10 * found.free_run.all
    assert all(w.all < 10 * QUANTUM for w in found.windows.values())
    assert found.diverged_at == np.inf


@pytest.mark.filterwarnings("ignore:.*has gaps")
def test_score_is_printed_in_one_line():
    errors = Errors(RMSE((0.0, 0.02), 0.0141421), {"1": RMSE((0.0, 0.01), 0.0070711)})
    values = "free run: 0.0141, 1 s: 0.00707"
    assert str(errors) == values
    scored = Score(
        errors.free_run, errors.windows, errors, "run3", np.zeros(1), np.zeros(1), np.inf
    )
    assert str(scored) == f"RMSE [rad; m] of run3: {values}; limit of these data: {values}"
    assert str(replace(scored, limit=None, unit="m")) == f"RMSE [m] of run3: {values}"


def test_simulations_restart_after_a_gap():
    """The true model keeps the encoder's error, however long the recording paused."""
    whole = swing(plant(), MODEL, **SETTINGS)
    keep = (whole.time < 1.5) | (whole.time > 1.9)
    gapped = replace(whole, time=whole.time[keep], q=whole.q[keep])
    found = score(plant(), MODEL, gapped, horizons=(0.5, 1.0))
    assert found.free_run.all < 20 * QUANTUM
    assert all(w.all < 20 * QUANTUM for w in found.windows.values())
    assert len(found.simulated) == len(gapped.time)


def test_convention_of_the_recording_precedes_that_of_the_plant():
    """An encoder log without a convention, on a rig with absolute angles from hanging."""
    hanging = pendulum(convention=("absolute", "hanging"), position_quantum=QUANTUM)
    stated = swing(plant(), MODEL, convention="absolute,hanging", seconds=1.0)
    unstated = replace(stated, convention=None)
    q0 = stated.convention.position_from_joint(np.array([1.6, 0.8]))
    start = {"initial_state": (q0, np.zeros(2)), "horizons": (0.5,)}
    found = [score(hanging, MODEL, r, **start) for r in (stated, unstated)]
    assert found[0].free_run == found[1].free_run
    assert found[0].windows == found[1].windows
    assert found[1].free_run.all < QUANTUM
    # The recording's convention applies, whatever the plant's is.
    assert score(plant(), MODEL, stated, **start).free_run == found[0].free_run
    assert score(plant(), MODEL, unstated, **start).free_run.all > 0.1


def test_metres_are_not_scored_as_angles():
    recording = replace(swing(plant(), MODEL, seconds=0.5), unit="m")
    with pytest.raises(ValueError, match="swing is in m, the plant's joints are in rad"):
        score(plant(), MODEL, recording)


def test_friction_too_steep_to_simulate_diverges_with_a_message(caplog):
    recording = swing(plant(), MODEL, seconds=1.0)
    nan = LFM(2, [1e-3, 1e-3], v_smooth=0.05)
    with torch.no_grad():
        nan.schedule.raw[0, 0] = torch.nan
    for model, message in (
        (LFM(2, [1e-3, 1e3], v_smooth=1e-3), r"swing: friction needs \d+ integration steps"),
        (nan, "no finite slope"),
    ):
        caplog.clear()
        found = score(plant(), model, recording, horizons=(0.5,))
        assert found.free_run.all == found.windows["0.5"].all == np.inf
        assert found.limit.free_run.all == found.limit.windows["0.5"].all == np.inf
        assert found.diverged_at == 0.0
        assert found.simulated.shape == recording.q.shape
        assert json.dumps(found.to_dict(), allow_nan=False)
        assert re.search(message, caplog.text)


@pytest.mark.parametrize(
    ("model", "settings", "error", "message"),
    [
        (CVFM(1), {}, ValueError, "the plant has 2 joints, the friction model 1"),
        ("LFM", {}, TypeError, "a friction model is needed, got str"),
        (MODEL, {"horizons": 1.0}, ValueError, r"`horizons` must be positive lengths \[s\]"),
        (MODEL, {"horizons": (0.5, -1.0)}, ValueError, r"`horizons` must be positive lengths"),
        (MODEL, {"initial_state": (3.0, 0.0)}, ValueError, r"q0 and qd0 of shape \(2,\) each"),
    ],
)
def test_bad_input_is_refused(model, settings, error, message):
    with pytest.raises(error, match=message):
        score(plant(), model, swing(plant(), MODEL, seconds=0.5), **settings)


def test_overall_rmse_is_consistent_with_that_of_the_joints():
    error = np.random.default_rng(0).normal(size=(3, 50, 2)) * [1.0, 3.0]
    rmse = RMSE.of(error)
    assert rmse.all == pytest.approx(np.sqrt(np.mean(error**2)))
    np.testing.assert_allclose(rmse.joints, np.sqrt(np.mean(error**2, axis=(0, 1))))
    recording = swing(plant(), MODEL, seconds=1.0)
    found = score(plant(), None, recording, horizons=()).free_run
    assert found.all == pytest.approx(np.sqrt(np.mean(np.square(found.joints))))


def test_windows_are_counted_by_the_recording_length(monkeypatch):
    """9.98 s are two windows of 5 s; a shortage of 0.02 s is tolerated."""
    starts = {}

    def counted(plant, friction, q0, *rest, **settings):
        steps = settings["sample_time"]
        starts[round(float(steps.sum(-1).max()))] = len(q0)
        return original(plant, friction, q0, *rest, **settings)

    import nfriction.evaluation.lead_in as scoring

    original = scoring.rollout
    recording = swing(plant(), MODEL, seconds=9.98, sample_time=4e-3, start=(1.0, 0.0))
    monkeypatch.setattr(scoring, "rollout", counted)
    found = score(plant(), MODEL, recording, horizons=(2.0, 5.0, 20.0), limit=False)
    assert list(found.windows) == ["2", "5"]
    assert found.limit is None
    assert starts[5] == 2
    # The first window begins after its lead-in.
    assert starts[2] == 4


def test_limit_scales_with_the_encoder_resolution():
    fine = swing(plant(), MODEL, seconds=1.5, start=(2.8, 0.3))
    coarse = replace(fine, q=quantise(fine.q, 2048))
    limits = [
        score(plant(quantum), MODEL, recording, horizons=(0.5,)).limit
        for quantum, recording in ((QUANTUM, fine), (4 * QUANTUM, coarse), (None, coarse))
    ]
    for each in ([limit.free_run.all, limit.windows["0.5"].all] for limit in limits):
        assert QUANTUM / 12**0.5 < min(each) <= max(each) < 20 * QUANTUM
    ratio = limits[1].free_run.all / limits[0].free_run.all
    assert 2 < ratio < 8
    # If the resolution is unknown, it is estimated from positions.
    assert limits[2].free_run.all == pytest.approx(limits[1].free_run.all, rel=0.5)


def test_scored_samples_do_not_influence_the_initial_state():
    recording = swing(plant(), MODEL, seconds=3.0, sample_time=4e-3)
    lead, noise = lead_in_samples(recording), np.random.default_rng(0)
    assert lead == 50

    def changed(samples: np.ndarray) -> Recording:
        q = recording.q.copy()
        q[samples] += 0.1 * noise.standard_normal(q[samples].shape)
        return replace(recording, q=q)

    found, other = (
        score(plant(), MODEL, r, horizons=(), limit=False)
        for r in (recording, changed(np.arange(lead, len(recording))))
    )
    np.testing.assert_array_equal(found.simulated, other.simulated)
    assert other.free_run.all > 10 * found.free_run.all
    runs = Simulator(plant(), MODEL, recording, "rk4", 0).windows(1.0)
    assert len(runs.samples) == 2
    for window, samples in enumerate(runs.samples):
        after = changed(samples[lead:])
        again = Simulator(plant(), MODEL, after, "rk4", 0).windows(1.0)
        np.testing.assert_array_equal(again.q[window], runs.q[window])


def test_covariance_of_the_initial_state_matches_its_errors():
    """Errors of estimated initial states of a known motion have about unit normalised variance."""
    deviations = []
    for k in range(20):
        rig, recording, truth = release(k)
        runs = Simulator(rig, MODEL, recording, "rk4", 0)
        lead = np.arange(runs.lead)[None]
        starts = estimate_starts(
            lambda x, runs=runs, lead=lead: runs.simulate(x, lead)[0],
            recording.time[lead], recording.q[lead], rig.position_quantum,
        )  # fmt: skip
        deviations.append(np.linalg.solve(starts.root[0], truth - starts.state[0]))
    assert 0.5 < np.sqrt(np.mean(np.square(deviations))) < 1.3


def test_scores_of_the_true_model_are_below_the_limit():
    assert below_the_limit(range(12)) >= 11


@pytest.mark.slow
def test_true_model_is_below_the_limit_in_95_of_100_releases():
    assert below_the_limit(range(100)) >= 95


def test_limit_includes_torque_noise():
    """A fine encoder on an axis: noise in the recorded torques perturbs even the true law."""
    axis = LinearAxis(0.1, position_quantum=1e-6)
    friction = CVFM(1, [[0.3, 0.1]]).requires_grad_(False)
    time, rest = 2e-3 * np.arange(1501), torch.zeros(1, dtype=torch.float64)
    tau = np.sin(2 * np.pi * time)[:, None] + 0.5 * np.sin(7 * time)[:, None]
    run = rollout(axis, friction, rest, rest, torch.tensor(tau[:-1]), sample_time=2e-3)
    within = 0
    for seed in range(6):
        noise = 0.02 * np.random.default_rng(seed).standard_normal(tau.shape)
        found = score(axis, friction, Recording(time, run.q.numpy(), tau + noise, unit="m"))
        within += found.free_run.all <= found.limit.free_run.all
        # The limit is not just wide.
        assert found.limit.free_run.all < 10 * found.free_run.all
    assert within >= 5


def test_limit_includes_the_integration_error():
    """With a fine encoder, the integration error of steep friction in few steps is visible."""
    axis, friction = LinearAxis(0.5), CVFM(1, [0.4, 0.1], v_smooth=3e-3)
    tau = 1.5 * torch.sin(2e-2 * torch.arange(1500.0, dtype=torch.float64))[:, None]
    zero = torch.zeros(1, dtype=torch.float64)
    run = rollout(axis, friction.requires_grad_(False), zero, zero, tau, sample_time=4e-3,
                  substeps=32)  # fmt: skip
    q, held = quantise(run.q.numpy(), 2**26), np.vstack([tau.numpy(), tau[-1:].numpy()])
    found = score(axis, friction, Recording(run.time.numpy(), q, tau=held, unit="m"), horizons=())
    assert 0.2 * found.limit.free_run.all < found.free_run.all <= found.limit.free_run.all


def test_limit_includes_the_quantisation_seen_in_the_recording():
    """A joint held by friction reads a constant, with an error of up to half a count."""
    friction = CVFM(2, [[5e-2, 2e-3], [2e-2, 2e-3]], v_smooth=0.01).requires_grad_(False)
    recording = swing(plant(), friction, **SETTINGS | {"start": (2.8, 0.3)})
    stated, shown = (
        score(plant(count), friction, recording, horizons=[1.0]).limit for count in (QUANTUM, None)
    )
    assert shown.free_run.all == pytest.approx(stated.free_run.all, rel=0.001)
    assert shown.windows["1"].all == pytest.approx(stated.windows["1"].all, rel=0.001)


def below_the_limit(seeds: Iterable[int]) -> int:
    """Number of random releases in which the true model's score is within the limit."""
    scores = (score(rig, MODEL, r, horizons=()) for rig, r, _ in map(release, seeds))
    return sum(found.free_run.all <= found.limit.free_run.all for found in scores)


def release(seed: int) -> tuple[PendulumChain, Recording, np.ndarray]:
    """A random motion of 4 s, every other one driven, as sampled by an encoder, and its start."""
    random = np.random.default_rng(seed)
    time = 2e-3 * np.arange(2001)
    tau = np.zeros((2001, 2))
    if seed % 2:
        rates = random.uniform(2.0, 12.0, (3, 2))
        tau = (random.uniform(0.02, 0.1, (3, 2)) * np.sin(rates * time[:, None, None])).sum(1)
    q0, qd0 = random.uniform(-2.0, 2.0, 2) + np.array([np.pi, 0.0]), random.uniform(-3.0, 3.0, 2)
    run = rollout(
        plant(), MODEL, *map(torch.tensor, (q0, qd0)), torch.tensor(tau[:-1]), sample_time=2e-3,
        gradients=False,
    )  # fmt: skip
    q = quantise(run.q.numpy(), 8192)
    recording = Recording(time, q, tau=tau, convention="relative,upright", name=f"release {seed}")
    return plant(), recording, np.concatenate([q0, qd0])


def test_recording_too_short_for_a_lead_in_is_refused():
    short = swing(plant(), MODEL, seconds=0.15)
    with pytest.raises(ValueError, match=r"swing is too short to be scored: .* lead-in of 0.2 s"):
        score(plant(), MODEL, short)


def test_divergence_is_infinite_and_null(caplog):
    explode = Law("explode", (Coefficient("b", "N m s/rad", positive=False),),
                  lambda qd, load, c, v_smooth: c[..., 0] * qd)  # fmt: skip
    model = FrictionModel(explode, Constant(explode, 2, [-5.0]), 1.0)
    recording = swing(plant(), MODEL, seconds=1.0)
    found = score(plant(), model, recording, horizons=(0.5,))
    assert found.free_run.all == np.inf
    assert 0 < found.diverged_at < 1.0
    assert found.limit.free_run.all == found.limit.windows["0.5"].all == np.inf
    # Once for the free run and once for the windows, not for every initial state that is tried.
    assert caplog.text.count("diverged") < 10
    plain = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert plain["free_run"] == {"joints": [None, None], "all": None}
    assert plain["diverged_at"] == pytest.approx(found.diverged_at)
    good = score(plant(), MODEL, recording, horizons=(0.5,))
    table = tables({"bad": [found], "good": [good]})
    assert np.isinf(table.table().loc["bad"]).all()
    assert np.isnan(table.improvement().loc["bad"]).all()


def tables(scores: dict[str, list[Score]]) -> Comparison:
    return Comparison({}, {}, scores, unit="rad", joint_names=("joint1", "joint2"))


def test_tables_are_root_mean_squares_and_percentages():
    recording = swing(plant(), MODEL, seconds=1.0)
    scores = [score(plant(), m, recording, horizons=(0.5,)) for m in (None, MODEL)]
    both = tables({"none": [scores[0], scores[1]], "model": [scores[1], scores[1]]})
    table = both.table("0.5").to_numpy()
    a, b = (s.windows["0.5"].all for s in scores)
    assert table[0, -1] == pytest.approx(np.sqrt((a**2 + b**2) / 2))
    assert table[1, -1] == pytest.approx(b)
    saved = both.improvement("0.5").to_numpy()
    np.testing.assert_allclose(saved[0], 0.0, atol=1e-12)
    assert saved[1, -1] == pytest.approx(100 * (1 - table[1, -1] / table[0, -1]))
    assert not torch.is_grad_enabled() or MODEL.schedule.raw.grad is None


def test_path_and_rig_name_are_accepted(tmp_path):
    time = np.arange(300) * 2e-3
    recording = Recording(time, 0.01 * np.sin(time)[:, None], convention="relative,hanging")
    recording.write(tmp_path / "run.csv")
    named = score("multiarm-single", None, tmp_path / "run.csv", limit=False)
    given = score(rigs.of("multiarm-single"), None, recording, limit=False)
    assert named.free_run == given.free_run


def zeroed_in_a_pose(zero, seconds=3.0):
    """A driven double pendulum, held away from equilibrium by friction when its encoders were
    zeroed."""
    rig = pendulum(position_quantum=QUANTUM)
    law = CVFM(2, [[2e-3, 0.02], [1e-3, 0.01]], v_smooth=0.01)
    time = np.arange(0.0, seconds, 2e-3)
    hanging = np.array([np.pi, 0.0])
    turns = 0.3 * np.stack([np.sin(9.0 * time), np.cos(7.0 * time)], 1)
    tau = turns * rig.gravity_moment.numpy()
    run = rollout(
        rig, law, hanging + zero, np.zeros(2), tau[:-1],
        sample_time=2e-3, substeps=8, gradients=False,
    )  # fmt: skip
    q = quantise(run.q.numpy() - zero, 8192)
    return rig, law, Recording(time, q - hanging, tau, convention="relative,hanging")


def test_encoder_offset_is_estimated_from_samples_that_are_not_scored():
    zero = np.array([0.02, -0.03])
    rig, law, recording = zeroed_in_a_pose(zero)
    rest = (recording.q[0], np.zeros(2))
    assert estimate_zero(rig, law, recording, rest).offset == pytest.approx(zero, abs=2e-3)
    taken = score(rig, law, recording, limit=False)
    found = score(rig, law, recording, limit=False, zeroed=True)
    assert found.zero == pytest.approx(zero, abs=2e-3)
    assert found.to_dict()["zero"] == list(found.zero)
    assert taken.zero is None
    assert found.free_run.all < 0.1 * taken.free_run.all
    assert found.windows["1"].all < 0.1 * taken.windows["1"].all
    late = np.where(recording.time[:, None] > ZERO_IN, 0.1, 0.0)
    other = score(
        rig, law, recording._replace(q=recording.q + late), limit=False, horizons=(), zeroed=True
    )
    np.testing.assert_array_equal(other.simulated, found.simulated)
    assert other.free_run.all == pytest.approx(0.1, rel=0.05)


def test_recording_without_error_has_zero_encoder_offset():
    """As of a simulation that is scored by its own model and step size."""
    rig, law, recording = zeroed_in_a_pose(np.zeros(2))
    (run,) = Simulator(rig, law, recording, "rk4", 0).free_runs((recording.q[0], np.zeros(2)))
    found = score(rig, law, recording._replace(q=run.q[0]), limit=False, zeroed=True)
    assert found.zero == pytest.approx((0.0, 0.0), abs=1e-9)


def test_limit_includes_the_uncertainty_of_the_encoder_offset():
    rig, law, recording = zeroed_in_a_pose(np.zeros(2))
    limits = []
    for sd in (0.0, 0.02):
        zero = Zero(np.zeros(2), sd * np.eye(2))
        (run,) = Simulator(rig, law, recording, "rk4", 20, zero).free_runs(None)
        limits.append(np.sqrt(run.squares.mean(-1).max()))
    # Motions from different poses differ, although the encoders read the same at first.
    assert limits[1] > 3 * limits[0]
    rest = (recording.q[0], np.zeros(2))
    assert 1e-6 < np.linalg.norm(estimate_zero(rig, law, recording, rest).root, axis=1).max() < 0.02


def test_unidentifiable_encoder_offset_is_left_at_zero():
    rig, law, recording = zeroed_in_a_pose(np.array([0.02, -0.03]))
    rows = np.r_[:3, 200:1500]
    with pytest.warns(RecordingWarning, match="gap"):
        broken = Recording(
            recording.time[rows], recording.q[rows], recording.tau[rows],
            convention="relative,hanging",
        )  # fmt: skip
    for part in (recording[200:], recording[:900], broken):
        given = (rig, law, part)
        found = score(*given, limit=False, horizons=(), zeroed=True)
        assert found.free_run == score(*given, limit=False, horizons=()).free_run


def test_initial_state_with_too_few_joints_is_refused():
    rig, law, recording = zeroed_in_a_pose(np.zeros(2))
    with pytest.raises(ValueError, match=r"`initial_state` must be q0 and qd0 of shape \(2,\)"):
        score(rig, law, recording, initial_state=([0.0], [0.0, 0.0]), limit=False, zeroed=True)


def test_joint_at_rest_starts_with_deflected_bristles():
    """Undeflected bristles would let it sink by the presliding displacement."""
    count, stiffness = 2 * np.pi / 8192, 60.0
    plant = PendulumChain(mass=[1.0], length=[0.3], position_quantum=count)
    friction = model_by_name("dahl")(1, (0.6, 0.05, stiffness)).requires_grad_(False)
    time = np.arange(1000) / 500
    tau = (1.5 * np.sin(2 * np.pi * time) * (time > 0.5))[:, None]
    pose = torch.tensor([np.pi + 0.2], dtype=torch.float64)
    deflection = -plant.inverse_dynamics(pose, 0 * pose, 0 * pose) / stiffness
    run = rollout(
        plant, friction, pose, 0 * pose, torch.tensor(tau[:-1]), sample_time=2e-3,
        law_state=deflection[:, None],
    )  # fmt: skip
    held = Recording(
        time, quantise(run.q.numpy(), 8192), tau=tau, convention="relative,upright", name="held"
    )
    scored = score(plant, friction, held, horizons=(1.0,), limit=False)
    for error in (scored.free_run, scored.windows["1"]):
        assert error.all < 0.5 * count < 0.1 * abs(float(deflection))
