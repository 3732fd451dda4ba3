"""Typical mistakes in recordings and rigs are named; valid data raise no warning."""

import functools
import math
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from nfriction import (
    CVFM,
    LFM,
    NCFM,
    LinearAxis,
    Motor,
    PendulumChain,
    Plant,
    Recording,
    Rotor,
    Stribeck,
    fit,
    rollout,
)
from nfriction.fitting.adjusted_plant import adjusted_plant
from nfriction.fitting.data import inputs
from nfriction.fitting.diagnosis import changes
from nfriction.fitting.diagnosis.changes import changing_friction, loose_loads
from nfriction.fitting.diagnosis.corrections import corrected_rigs
from nfriction.fitting.options import FitOptions
from nfriction.fitting.plant_parameters import plant_parameters
from nfriction.fitting.result.fit_result import DOUBTFUL_ERROR
from nfriction.fitting.strategy import constant, continuation
from nfriction.fitting.task import prepare_task
from nfriction.recording.validation import time_unit
from nfriction.signals import kalman_smoother, quantise
from tests.evaluation.test_score import zeroed_in_a_pose
from tests.fitting.recordings import one_link, pendulum, swing

COUNT = 2 * math.pi / 4096
WHEEL = {"inertia": 0.02, "motor": Motor(50, rotor_inertia=1.2e-5)}
STEP, SAMPLES = 2e-3, 3001
LATER = (np.arange(SAMPLES) >= 1000)[:, None]
DOUBLE = {"mass": [0.5, 0.3], "length": [0.3, 0.25], "com": [0.15, 0.12],
          "inertia": [3.75e-3, 1.56e-3]}  # fmt: skip
MOTOR = {"mass": [1.0], "length": [0.3], "com": [0.15], "inertia": [0.0075], "armature": [0.05]}


slow = functools.partial(pytest.param, marks=pytest.mark.slow)


def torque(peaks: list[float], seed: int) -> np.ndarray:
    """Sums of sines with these peaks, (sample, joint)."""
    rng = np.random.default_rng(seed)
    time = STEP * np.arange(SAMPLES)
    columns = []
    for peak in peaks:
        waves = [rng.normal() * np.sin(2 * np.pi * f * time) for f in rng.uniform(0.3, 2.5, 6)]
        columns.append(peak * sum(waves) / np.abs(sum(waves)).max())
    return np.stack(columns, 1)


@functools.cache
def measured(name: str, count: float | None = COUNT) -> tuple[Plant, np.ndarray, np.ndarray | None]:
    """Rig, positions in joint coordinates as quantised by encoders, and torques."""
    plants = {"free": PendulumChain(**DOUBLE), "driven": PendulumChain(**DOUBLE),
              "motor": PendulumChain(**MOTOR), "axis": LinearAxis(0.13),
              "direct": PendulumChain(**MOTOR | {"armature": [0.0], "inertia": [0.0575]}),
              "wheel": Rotor(**WHEEL)}  # fmt: skip
    plant, joints = plants[name], 2 if name in ("free", "driven") else 1
    friction = {"free": [[0.02, 0.004], [0.008, 0.003]], "driven": [[0.1, 0.05], [0.02, 0.01]]}
    model = CVFM(joints, friction.get(name, [[0.3, 0.12]])).requires_grad_(False)
    tau = {"free": None, "driven": torque([1.5, 0.3], 1)}.get(name, torque([3.0], 2))
    start = {
        "free": [math.pi + 1.2, -0.5],
        "driven": [math.pi, 0.0],
        "motor": [math.pi],
        "direct": [math.pi],
    }
    q0 = torch.tensor(start.get(name, [0.0]), dtype=torch.float64)
    found = rollout(
        plant, model, q0, torch.zeros_like(q0), sample_time=STEP, steps=SAMPLES - 1, substeps=8,
        tau=None if tau is None else torch.as_tensor(tau[:-1]),
    )  # fmt: skip
    q = found.q.numpy()
    return plant, count * np.round(q / count) if count else q, tau


def warnings_of(plant: Plant, q: np.ndarray, tau: np.ndarray | None, **given) -> tuple[str, ...]:
    convention = None if plant.unit == "m" else given.get("convention", "relative,upright")
    time = given.get("time", STEP * np.arange(len(q)))
    recording = Recording(time, q, tau, convention=convention, unit=plant.unit)
    return prepare_task(CVFM(plant.joints), plant, recording, FitOptions()).data_warnings


def later(values: np.ndarray, samples: int) -> np.ndarray:
    return np.concatenate([np.repeat(values[:1], samples, 0), values[:-samples]])


def test_reversed_motor_is_named():
    plant, q, tau = measured("driven")
    # From hanging, so that reversed signs are another motion.
    hanging = (q - [math.pi, 0.0]) * [1, -1]
    (found, *_) = warnings_of(plant, hanging, tau * [1, -1], convention="relative,hanging")
    assert "the signs of joint2's position and torque are reversed" in found


def test_a_wrong_gear_ratio_of_a_motor_is_named():
    """In angle and torque at once, which no other cause scales in this way."""
    _, q, tau = measured("driven")
    geared = PendulumChain(**DOUBLE, motor=Motor([50.0, 40.0], torque_constant=0.1))
    (found, *_) = warnings_of(geared, q * [1, 1 / 1.5], tau * [1, 1.5])
    assert re.search(r"the gear ratio of joint2 is (0\.66|0\.67)\d* times that of the rig", found)


@pytest.mark.slow
def test_exchanged_columns_of_motors_with_different_gears_are_named():
    _, q, tau = measured("driven")
    geared = PendulumChain(**DOUBLE, motor=Motor([50.0, 30.0], torque_constant=[0.1, 0.2]))
    factors = geared.motor_factors
    motors, currents = q / factors["motor"], tau / factors["current"]
    exchanged = motors[:, ::-1] * factors["motor"], currents[:, ::-1] * factors["current"]
    (found, *_) = warnings_of(geared, *exchanged)
    assert "the columns of joint1 and joint2 are exchanged" in found


@pytest.mark.slow
def test_motors_in_the_base_are_named_with_a_remedy_for_motors():
    _, q, tau = measured("driven")
    absolute = np.cumsum(q, axis=1)
    geared = PendulumChain(**DOUBLE, motor=Motor([50.0, 40.0], torque_constant=0.1))
    (found, *_) = warnings_of(geared, absolute, tau)
    assert "angles are absolute, not relative (a belt drive? convert its columns)" in found


def test_coarsely_quantised_torque_is_neither_clipped_nor_stuck():
    plant, q, tau = measured("motor")
    noisy = tau + 0.05 * np.random.default_rng(0).normal(size=tau.shape)
    found = warnings_of(plant, q, 0.1 * np.round(noisy / 0.1))
    assert any("the torque of joint1 has steps of 0.1, larger than its noise" in w for w in found)
    assert not any("clipped" in w for w in found)


def test_sharp_torque_reversal_is_no_spike():
    """As when friction replaces a drive at rest."""
    time = STEP * np.arange(SAMPLES)
    tau = np.sin(2 * math.pi * 0.3 * time)
    tau += 0.8 * np.abs(np.mod(time, 2.0) - 1.0)
    recording = Recording(time, np.sin(time)[:, None], tau[:, None])
    assert not any(inputs._spikes([recording], FitOptions()))
    spiked = replace(recording, tau=tau[:, None] + 0.5 * (np.arange(SAMPLES) == 700)[:, None])
    assert len([*inputs._spikes([spiked], FitOptions())]) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gain", "said", "verdict"),
    [(1.25, r"1\.2[45]\d*", "doubtful"), (1.05, r"1\.0[45]\d*", "good"), (1.0, None, "good")],
)
def test_gain_of_one_drive_is_named_if_friction_leaves_its_interval(gain, said, verdict):
    plant, q, tau = measured("driven")
    time, convention = STEP * np.arange(len(q)), "relative,upright"
    recording = Recording(time, q, tau * [1.0, gain], convention=convention)
    found = fit(CVFM(2), plant, recording, windows=(0.5,))
    texts = [w for w in found.warnings if "Torques of joint2" in w]
    assert len(texts) == (said is not None)
    for text in texts:
        assert re.search(rf"recorded {said} times as large as those of the other joints", text)
    assert found.usability[0] == verdict


def test_a_torque_constant_that_the_fit_corrects_is_no_wrong_rig():
    plant, time = PendulumChain(**DOUBLE | {"armature": [0.02, 0.01]}), STEP * np.arange(SAMPLES)
    rate = np.array([[1.1, 2.3], [2.9, 1.7], [4.3, 5.1]])
    waves = [rate**n * np.sin(rate * time[:, None, None] + n * math.pi / 2) for n in range(3)]
    q, qd, qdd = (0.3 * torch.as_tensor(wave.sum(1)) for wave in waves)
    dry, viscous = torch.tensor([[0.2, 0.1], [0.1, 0.05]])
    tau = (plant.inverse_dynamics(q, qd, qdd) + dry * torch.sign(qd) + viscous * qd).numpy()
    tau += 0.01 * np.random.default_rng(0).normal(size=tau.shape)
    assert warnings_of(plant, q.numpy(), tau * [1, 1.18]) == ()


@pytest.mark.parametrize(("grown", "named"), [(0.2, True), (1.0, False)])
def test_torque_scale_that_changes_is_no_change_of_friction(grown, named):
    """It differs by no more than the torque constants of two drives may."""
    rig, recordings, rng = LinearAxis(3.5), [], np.random.default_rng(0)
    time = 0.004 * np.arange(2001)[:, None]
    for number, fastest in enumerate((1.3, 1.7)):
        wave = np.array([fastest, 2.3 * fastest])
        q, qd, qdd = (
            0.1 * (wave**k * np.sin(wave * time + 0.5 * k * math.pi)).sum(1, keepdims=True)
            for k in range(3)
        )
        tau = (1 + grown * number) * (3.5 * qdd + 2 * np.sign(qd) + 1 * qd)
        tau += 0.02 * rng.normal(size=q.shape)
        q = q + 1e-5 * rng.normal(size=q.shape)
        recordings.append(Recording(time[:, 0], q, tau, unit="m", name=f"run{number}"))
    motions = [kalman_smoother(r.time, r.q) for r in recordings]
    warned = dict(changing_friction(rig, recordings, motions, FitOptions()))
    assert ("scale" in warned) == named
    if named:
        grows = r"scale of the force of joint1 grows by (19|2[01])\.?\d* ± "
        assert re.search(grows, warned.pop("scale"))
        assert not warned


@pytest.mark.parametrize("reason", ["too long", "lossy"])
def test_skipped_windows_of_a_single_free_link_indicate_a_wrong_law(reason, monkeypatch):
    """Its motion is not chaotic, and there are no torque errors that could accumulate."""

    def skipping(*given):
        return replace(searched(*given), skipped=(2.0,), reason=reason)

    searched = constant.horizon_continuation
    monkeypatch.setattr(constant, "horizon_continuation", skipping)
    rig = PendulumChain([0.5], [0.4], inertia=[0.0])
    truth = CVFM(1, [[8e-3, 2e-3]], v_smooth=0.01).requires_grad_(False)
    found = fit("CVFM", rig, swing(rig, truth, start=(1.5,)), windows=(0.5,))
    assert "Windows of 2 s were skipped: law or plant are wrong." in found.warnings
    assert found.usability == ("doubtful", "windows of 2 s were skipped, see warnings")


def test_errors_below_the_noise_indicate_no_wrong_law(monkeypatch):
    """Longer windows may show such errors, as those of the integration."""
    monkeypatch.setattr(continuation, "loses", lambda *_: True)
    rig, truth = one_link(), CVFM(1, [[8e-3, 2e-3]]).requires_grad_(False)
    found = fit("CVFM", rig, swing(rig, truth), windows=(0.5, 2.0))
    assert "Windows of 2 s were not needed: over them errors below the encoder's" in found.status
    assert found.usability == ("good", "")


@pytest.mark.parametrize("name", ["free", "driven", "motor", "axis"])
def test_valid_data_raise_no_warning(name):
    assert warnings_of(*measured(name)) == ()


def test_small_motion_near_the_vertical_is_not_at_the_horizontal():
    """An offset of the drive would explain the constant gravity there."""
    plant = PendulumChain(**MOTOR)
    time = STEP * np.arange(SAMPLES)[:, None]
    q = math.pi + 0.05 * np.sin(2 * math.pi * time)
    assert warnings_of(plant, q, torque([1.0], 4)) == ()


def test_a_joint_at_rest_names_no_mistake():
    """Friction holds it, whatever its rig; an encoder that flickers shows no motion."""
    plant, count = PendulumChain(**MOTOR, position_quantum=COUNT), np.arange(SAMPLES) // 700 % 3
    assert COUNT is not None
    said = warnings_of(plant, math.pi + COUNT * count[:, None], None)
    assert any("2 of its encoder's counts" in text for text in said)
    assert not any("mistake" in text for text in said)


def test_viscous_friction_has_no_sign_to_smooth(monkeypatch):
    monkeypatch.setattr(inputs, "turning_velocity", lambda *_: (1e-2, 1e-3))
    recording = swing(pendulum(), NCFM(2, [2e-3]), seconds=0.5)
    tasks = [prepare_task(x, pendulum(), [recording], FitOptions()) for x in ("NCFM", "CFM")]
    assert [len(task.smoothed) for task in tasks] == [0, 1]


def test_very_short_recording_names_no_mistake():
    """Corrections explain the few torques of a short recording by chance."""
    plant, model = pendulum(), LFM(2, [[2e-3, 3e-3]] * 2)
    recording = swing(plant, model, seconds=0.3)
    assert not any("mistake" in w for w in warnings_of(plant, recording.q, None))


@functools.cache
def warming(change: float, chirp: bool) -> tuple[np.ndarray, np.ndarray]:
    """Positions and torques of the motor with Stribeck friction that changes linearly by this
    factor."""
    time = STEP * np.arange(SAMPLES)
    swept = (0.5 + 0.3 * time) * np.sin(2 * math.pi * (0.2 + 0.12 * time) * time)
    tau = swept[:, None] if chirp else torque([3.0], 3)
    state, parts = torch.zeros(2, 1, dtype=torch.float64), []
    state[0] = math.pi
    # Ten segments of the recording, each with its own friction.
    for k, part in enumerate(np.array_split(tau[:-1], 10)):
        level = 1 + change * (k - 4.5) / 9
        model = Stribeck(1, [[0.3 * level, 0.1 * level, 0.12 * level, 0.3, 2.0]])
        found = rollout(
            PendulumChain(**MOTOR), model.requires_grad_(False), *state, torch.as_tensor(part),
            sample_time=STEP, substeps=8,
        )  # fmt: skip
        state = torch.stack([found.q[-1], found.qd[-1]])
        parts.append(found.q.numpy() if k == 0 else found.q.numpy()[1:])
    q, noise = np.concatenate(parts), np.random.default_rng(0).normal(size=tau.shape)
    return COUNT * np.round(q / COUNT), tau + 0.01 * noise


@functools.cache
def geared(play: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and torques of the motor with this play between its rotor and the link."""
    given, tau, steps = PendulumChain(**MOTOR), torque([3.0], 5), 20
    link, weight = float(given.inertia_coupling[0, 0]), float(given.gravity_moment.sum())
    h, (q, qd, link_q, link_qd), seen = STEP / steps, np.zeros(4), []
    for u in tau[:, 0].tolist():
        seen.append(q)
        for _ in range(steps):
            pressed = max(abs(q - link_q) - play / 2, 0.0)
            tooth = math.copysign(2000 * pressed, q - link_q) + (pressed > 0) * 0.4 * (qd - link_qd)
            rub = 0.25 * math.tanh(qd / 3e-3) + 0.08 * qd
            qd += h * (u - tooth - rub) / 0.05
            link_qd += h * (tooth - weight * math.sin(link_q)) / link
            q, link_q = q + h * qd, link_q + h * link_qd
    noise = np.random.default_rng(0).normal(size=tau.shape)
    return COUNT * np.round(np.array(seen)[:, None] / COUNT) + math.pi, tau + 0.01 * noise


@pytest.mark.parametrize(("play", "named"), [(1.0, True), (0.0, False)])
def test_play_in_a_gear_is_named(play, named):
    warned = warnings_of(PendulumChain(**MOTOR), *geared(math.radians(play)))
    shares = [re.search(r"gear of joint1 has play: .* (\d+) ± ", w) for w in warned]
    assert [80 < int(found[1]) < 130 for found in shares if found] == [True] * named


@pytest.mark.slow
def test_fit_with_play_in_the_gear_is_doubtful():
    q, tau = geared(math.radians(1.0))
    recording = Recording(STEP * np.arange(len(q)), q, tau, convention="relative,upright")
    given = {"windows": (0.1,), "max_steps": 5}
    found = fit(CVFM(1), PendulumChain(**MOTOR), recording, **given)
    assert found.usability[0] == "doubtful"
    assert "joint1 has play" in found.usability[1]
    again = fit(CVFM(1), PendulumChain(**MOTOR), recording, start=found, **given)
    assert again.unmodelled == found.unmodelled


@pytest.mark.parametrize("samples", [50, 130, 200])
def test_short_recording_is_not_tested_for_play(samples):
    q, tau = geared(math.radians(1.0))
    short = Recording(
        STEP * np.arange(samples), q[:samples], tau[:samples], convention="relative,upright"
    )
    plant, motions = PendulumChain(**MOTOR), [kalman_smoother(short.time, short.q)]
    assert list(loose_loads(plant, [short], motions, FitOptions())) == []


@pytest.mark.parametrize("change", [0.3, -0.3])
def test_a_friction_that_changes_within_a_recording_is_named(change):
    warned = warnings_of(PendulumChain(**MOTOR), *warming(change, chirp=False))
    named = [re.search(r"friction of joint1 (\w+) by (\S+) ± (\S+) %", w) for w in warned]
    ((way, found, within),) = (match.groups() for match in named if match)
    assert way == ("grows" if change > 0 else "falls")
    start, end = 1 - change / 2, 1 + change / 2
    assert abs(float(found) - 100 * abs(end / start - 1)) < float(within) + 1 < 20


@pytest.mark.parametrize(("fall", "constants"), [(0.0, 1), (0.2, 0.01), (0.2, 4)])
def test_change_is_detected_if_friction_dominates_the_torque(fall, constants):
    """As in a warm-up over several of its time constants."""
    rate, time = np.array([0.9, 1.7, 3.1]), 0.004 * np.arange(5001)[:, None]
    phase, rng = rate * time, np.random.default_rng(0)
    q, qd, qdd = 0.1 * np.sin(phase), 0.1 * rate * np.cos(phase), -0.1 * rate**2 * np.sin(phase)
    q, qd, qdd = (x.sum(1, keepdims=True) for x in (q, qd, qdd))
    warm = np.expm1(-constants * time / time[-1]) / np.expm1(-constants)
    tau = 3.5 * qdd + (1 - fall * warm) * (12 * np.sign(qd) + 15 * qd)
    q += 1e-5 * rng.normal(size=q.shape)
    tau += 0.1 * rng.normal(size=q.shape)
    recording = Recording(time[:, 0], q, tau, unit="m")
    motions = [kalman_smoother(recording.time, recording.q)]
    warned = list(changing_friction(LinearAxis(3.5), [recording], motions, FitOptions()))
    assert len(warned) == (fall > 0)
    for changed, sentence in warned:
        assert changed == "friction"
        found, within = re.search(r"falls by (\S+) ± (\S+) %", sentence).groups()
        assert abs(float(found) - 100 * fall) < float(within) + 1 < 6


@pytest.mark.parametrize("falls", [(0.0, 0.0), (0.3, 0.15)])
def test_unequal_falls_in_two_recordings_are_no_less_evident(falls):
    """In the middle of each, the usual friction fits better than the usual fall."""
    recordings, rng = [], np.random.default_rng(0)
    time = 0.004 * np.arange(5001)[:, None]
    for k, fall in enumerate(falls):
        rate = np.array([0.9, 1.7, 3.1]) + 0.2 * k
        q, qd, qdd = (
            0.1 * (rate**n * np.sin(rate * time + 0.5 * n * math.pi)).sum(1, keepdims=True)
            for n in range(3)
        )
        tau = 3.5 * qdd + (1 - fall * time / time[-1]) * (12 * np.sign(qd) + 15 * qd)
        tau += 0.1 * rng.normal(size=q.shape)
        recordings.append(Recording(time[:, 0], q + 1e-5 * rng.normal(size=q.shape), tau, unit="m"))
    motions = [kalman_smoother(r.time, r.q) for r in recordings]
    warned = list(changing_friction(LinearAxis(3.5), recordings, motions, FitOptions()))
    during = [text for kind, text in warned if kind == "friction" and "during a record" in text]
    assert [float(re.search(r"falls by (\S+) ±", text)[1]) for text in during] == pytest.approx(
        [23] * (falls[0] > 0), abs=3
    )


@pytest.mark.parametrize("drift", [0.0, 1.0, -1.0])
def test_drifting_offset_of_a_force_sensor_is_named(drift):
    """The drift is at most a twelfth of the friction."""
    rate, time = np.array([0.9, 1.7, 3.1]), 0.004 * np.arange(5001)[:, None]
    phase, rng = rate * time, np.random.default_rng(0)
    q, qd, qdd = 0.1 * np.sin(phase), 0.1 * rate * np.cos(phase), -0.1 * rate**2 * np.sin(phase)
    q, qd, qdd = (x.sum(1, keepdims=True) for x in (q, qd, qdd))
    tau = 3.5 * qdd + 12 * np.sign(qd) + 15 * qd + drift * time / time[-1]
    q += 1e-5 * rng.normal(size=q.shape)
    tau += 0.1 * rng.normal(size=q.shape)
    recording = Recording(time[:, 0], q, tau, unit="m")
    motions = [kalman_smoother(recording.time, recording.q)]
    warned = list(changing_friction(LinearAxis(3.5), [recording], motions, FitOptions()))
    assert [changed for changed, _ in warned] == ["offset"] * (drift != 0)
    for _, sentence in warned:
        way, found, within = re.search(
            r"The offset of the force of joint1 (\w+) by (\S+) ± (\S+) N during", sentence
        ).groups()
        assert way == ("grows" if drift > 0 else "falls")
        assert abs(float(found) - abs(drift)) < float(within) + 0.05 < 0.2


# If friction changes its sign, something else has changed.
@pytest.mark.parametrize(
    ("change", "rate", "named"), [(0.0, None, False), (0.3, None, True), (0.3, -3.0, False)]
)
def test_recording_with_different_friction_is_named(change, rate, named, monkeypatch):
    """Each with another motion."""

    def growth(*given):
        found, *others = estimated(*given)
        return rate or found, *others

    estimated = changes._growth
    monkeypatch.setattr(changes, "_growth", growth)
    recordings, rng = [], np.random.default_rng(0)
    time = 0.004 * np.arange(2001)[:, None]
    for number, fastest in enumerate((1.3, 1.7, 2.3, 1.9)):
        wave = np.array([fastest, 0.53 * fastest])
        q, qd, qdd = (
            0.1 * (wave**k * np.sin(wave * time + 0.5 * k * math.pi)).sum(1, keepdims=True)
            for k in range(3)
        )
        factor = 1 + change * (number == 2)
        tau = 3.5 * qdd + factor * (12 * np.sign(qd) + 15 * qd) + 0.1 * rng.normal(size=q.shape)
        q = q + 1e-5 * rng.normal(size=q.shape)
        recordings.append(Recording(time[:, 0], q, tau, unit="m", name=f"run{number}"))
    motions = [kalman_smoother(r.time, r.q) for r in recordings]
    warned = list(changing_friction(LinearAxis(3.5), recordings, motions, FitOptions()))
    assert len(warned) == named
    for _, sentence in warned:
        numbers = re.search(r"grows by (\S+) ± (\S+) % in run2 relative to", sentence)
        found, within = map(float, numbers.groups())
        assert abs(found - 30) < within < 5


@pytest.mark.parametrize("chirp", [True, False])
@pytest.mark.parametrize("mass", [1.0, 1.1])
def test_wrong_law_or_mass_or_growth_is_no_change_of_friction(chirp, mass):
    plant = PendulumChain(**MOTOR | {"mass": [mass]})
    warned = warnings_of(plant, *warming(0.0, chirp))
    assert not any("friction of" in w or "loose" in w for w in warned)


@pytest.mark.parametrize(
    ("pushed", "coefficients", "mass", "seed"),
    [
        (
            lambda t: np.where(t < 0.7, 2.5 * np.sin(2 * math.pi * t), 0.0),
            [0.3, 0.3, 0.12, 0.5],
            1.0,
            216,
        ),
        (
            lambda t: 3 * np.exp(-3 * t / t[-1]) * np.sin(2 * np.pi * 1.1 * t),
            [0.35, 0.0, 0.12, 1.0],
            1.15,
            18,
        ),
    ],
    ids=["rest after a push", "a motion that decays, with a wrong mass"],
)
def test_one_short_motion_is_no_evidence_of_a_change_of_friction(pushed, coefficients, mass, seed):
    time = STEP * np.arange(2500)
    tau, law = pushed(time)[:, None], Stribeck(1, [[*coefficients, 2.0]])
    rest = torch.zeros(1, dtype=torch.float64)
    found = rollout(
        PendulumChain(**MOTOR), law.requires_grad_(False), rest + math.pi, rest,
        torch.as_tensor(tau[:-1]), sample_time=STEP, substeps=4,
    )  # fmt: skip
    tau = tau + 0.01 * np.random.default_rng(seed).normal(size=tau.shape)
    given = PendulumChain(**MOTOR | {"mass": [mass]})
    warned = warnings_of(given, COUNT * np.round(found.q.numpy() / COUNT), tau)
    assert not any("friction of" in w for w in warned)


@pytest.mark.slow
def test_mistake_is_named_at_a_high_sample_rate_too():
    """There were few blocks with many samples each."""
    plant, q, tau = measured("motor", None)
    slow, time = STEP * np.arange(SAMPLES), 5e-5 * np.arange(120_000)
    q, tau = (np.interp(time, slow, x[:, 0])[:, None] for x in (q, tau))
    assert any("sign" in w for w in warnings_of(plant, q, -tau, time=time))


def test_a_torque_held_for_long_steps_is_no_delay():
    plant, step = PendulumChain(**DOUBLE | {"inertia": [0.005, 0.002]}), 4e-3
    rng = np.random.default_rng(0)
    time, joints = step * np.arange(501), 2
    rate, phase = rng.uniform(0.3, 2.5, (4, joints)), rng.uniform(0, 6.28, (4, joints))
    tau = 0.5 * np.sin(2 * np.pi * rate * time[:, None, None] + phase).sum(1)
    tau *= np.minimum(time, 1)[:, None]
    model = CVFM(joints, [[0.1, 0.02], [0.05, 0.01]]).requires_grad_(False)
    q0 = torch.tensor([math.pi, 0.0], dtype=torch.float64)
    found = rollout(
        plant, model, q0, 0 * q0, torch.as_tensor(tau[:-1]), sample_time=step, substeps=16
    )
    q = 1e-4 * np.round(found.q.numpy() / 1e-4)
    assert warnings_of(plant, q, tau, time=time) == ()


@pytest.mark.parametrize(
    ("name", "change", "finding"),
    [
        ("free", lambda q: q * [1, -1], "the sign of joint2's position is reversed"),
        ("free", lambda q: q[:, ::-1], "the positions of joint1 and joint2 are exchanged"),
        ("free", lambda q: q + np.array([math.pi / 2, 0]), "joint1's position is 90 degrees off"),
        ("free", np.degrees, "positions are in degrees"),
        slow("free", lambda q: q * [4, 1], "4 times too large"),
        ("driven", lambda q: q * [1, math.pi / 180], "57.3 times too small (radians read as deg"),
        ("motor", np.radians, "positions are in radians, but were read as degrees"),
        slow("driven", lambda q: q * [1, 180 / math.pi], "57.3 times too large (degrees read as"),
        ("free", lambda q: q[::-1], "time runs backwards"),
        slow("driven", lambda q: q * [-1, 1], "the sign of joint1's position is reversed"),
        ("driven", lambda q: q + np.array([0, math.pi]), "joint2's position is 180 degrees off"),
        slow("driven", lambda q: later(q, 10), "positions are recorded 2"),
        slow("motor", np.degrees, "positions are in degrees"),
        ("motor", lambda q: 5 * q, "too large (of the motor, before its gear)"),
        slow("driven", lambda q: 50 * q, "all positions are 50 times"),
        ("axis", lambda q: 1e3 * q, "positions are in mm"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_mistakes_in_positions_are_named(name, change, finding):
    plant, q, tau = measured(name)
    assert finding in warnings_of(plant, np.ascontiguousarray(change(q)), tau)[0]


@pytest.mark.parametrize(
    ("name", "change", "finding"),
    [
        ("driven", lambda tau: -tau, "every torque has the wrong sign"),
        slow("driven", lambda tau: 1e3 * tau, "every torque is 1000 times too large"),
        slow("driven", lambda tau: tau * [3.0, 0.4], "different factors: that of joint1 is 3"),
        slow(
            "driven", lambda tau: tau * [0.3, -1.0], "and that of joint2 has the wrong sign (torque"
        ),
        slow("driven", lambda tau: tau[:, ::-1], "the torques of joint1 and joint2 are exchanged"),
        ("driven", lambda tau: later(tau, 10), "torques are recorded 18"),
        ("motor", lambda tau: tau / 0.12, "the torque of joint1 is 8.3"),
        slow("axis", lambda tau: -tau, "the force of joint1 has the wrong sign"),
        ("motor", np.abs, "the torque of joint1 is recorded without its sign"),
        slow(
            "driven", lambda tau: np.abs(tau) * [1, 0] + tau * [0, 1], "joint1 is recorded without"
        ),
    ],
)
def test_mistakes_in_torques_are_named(name, change, finding):
    plant, q, tau = measured(name)
    assert finding in warnings_of(plant, q, np.ascontiguousarray(change(tau)))[0]


@pytest.mark.parametrize(
    ("name", "rig", "finding"),
    [
        ("wheel", {"motor": Motor(50)}, "rotor inertia of 0.03"),
        ("motor", {"armature": None}, "rotor inertia of 0.05"),
        ("motor", {"inertia": [0.0075 + 0.15**2]}, "inertias are about the joints"),
        ("motor", {"mass": [1e3], "inertia": [7.5]}, "masses are in g"),
        ("free", {"inertia": [37.5, 15.6]}, "inertias are in kg cm^2"),
        slow("motor", {"length": [300.0], "com": [150.0], "inertia": [7.5e3]}, "in kg mm^2"),
        slow("driven", {"length": [300, 250], "com": [150, 120]}, "lengths are in mm"),
        ("free", {"length": [300, 250], "com": [150, 120]}, "lengths are in mm"),
        slow("free", {"mass": [500, 300], "inertia": [3.75, 1.56]}, "heavier than a cube of steel"),
        slow("driven", {"inertia": [37.5, 15.6]}, "inertias are in kg cm^2"),
        # The same link without 0.05 kg at its end.
        (
            "driven",
            {"mass": [0.5, 0.25], "com": [0.15, 0.094], "inertia": [3.75e-3, 5.46e-4]},
            "the link of joint2 carries 0.0491 kg at its end",
        ),
        ("wheel", {"motor": Motor(50, rotor_inertia=120)}, "each `rotor_inertia` is in g cm^2"),
        slow(
            "driven",
            {
                "mass": [500, 300],
                "length": [300, 250],
                "com": [150, 120],
                "inertia": [3.75e6, 1.56e6],
            },
            "the rig is in g, mm and g mm^2",
        ),
    ],
)
def test_mistakes_in_rigs_are_named(name, rig, finding):
    _, q, tau = measured(name)
    kind = Rotor if name == "wheel" else PendulumChain
    plant = kind(**{**{"motor": MOTOR, "wheel": WHEEL}.get(name, DOUBLE), **rig})
    assert finding in warnings_of(plant, q, tau)[0]


GUESSED = {"mass": [0.2, 0.2], "length": [0.2, 0.25]}


@pytest.mark.parametrize(("mass", "length"), [slow([0.2, 0.2], 0.2), ([0.5, 0.1], 0.3)])
def test_free_rig_with_guessed_masses_and_lengths_is_corrected(mass, length):
    true, q, _ = measured("free")
    guessed = PendulumChain(mass=mass, length=[length, 0.25])
    recording = Recording(STEP * np.arange(SAMPLES), q, convention="relative,upright")
    found = fit("coulomb-viscous", guessed, recording, windows=(0.5,))
    rating, reason = found.usability
    assert rating == "doubtful"
    (note,) = (text for text in found.warnings if text.startswith("Several terms of the rig are"))
    assert note.endswith("from the corrected rig; terms are relative to the rig as given.")
    if length == 0.3:
        assert reason.startswith("several terms of the rig are wrong, see warnings")
        assert not found.mistakes
    else:  # a length that is wrong by a half is no likelier than a wrong clock
        assert "length 1 1.5), or the true sample rate is 1.23 times that in `time`. " in note
        assert reason.startswith("a mistake in data or rig is likely: several terms of the rig")
    # A free swing determines ratios to the first gravity term.
    scale = guessed.gravity_moment[0] / true.gravity_moment[0]
    for name in ("gravity_moment", "inertia_coupling"):
        values, expected = getattr(found.plant, name), scale * getattr(true, name)
        torch.testing.assert_close(values, expected, rtol=0.03, atol=0.0)
    # Terms and intervals are relative to the rig as given, also of a fit that starts from another.
    moment = found.plant.gravity_moment[1] / guessed.gravity_moment[1]
    again = fit("coulomb-viscous", guessed, recording, windows=(0.5,), start=found)
    for result in (found, again):
        (term,) = (x for name, x, _ in result.plant_terms if name == "gravity 2")
        assert 1 + term == pytest.approx(float(moment), rel=1e-4)
        (interval,) = (i for i in result.intervals if i.name == "gravity 2")
        assert interval.low < interval.value == term < interval.high
    values = found.model.schedule.values / scale
    expected = torch.tensor([[0.02, 0.004], [0.008, 0.003]], dtype=torch.float64)
    torch.testing.assert_close(values, expected, rtol=0.1, atol=0.0)


def test_guessed_free_rig_does_not_hide_a_wrong_convention():
    _, q, _ = measured("free")
    (warned, *_) = warnings_of(PendulumChain(**GUESSED), np.cumsum(q, axis=1), None)
    assert "likely: angles are absolute, not relative (`convention`)" in warned


def test_driven_rig_with_several_wrong_terms_is_named():
    _, q, tau = measured("driven")
    (warned, *_) = warnings_of(PendulumChain(**GUESSED), q, tau)
    assert "several terms of the rig are wrong (times the given ones: inertia 11 " in warned


@pytest.mark.parametrize(("name", "remedy"), [("driven", "`gravity`: 1e-6"), ("arm", "no `mass`")])
def test_torques_without_gravity_are_named(name, remedy):
    """The rig lies flat, or its controller adds gravity after the torque is recorded."""
    plant, q, tau = measured("motor" if name == "arm" else name)
    if name == "arm":
        plant = Rotor(0.08, mass=1.0, com=0.15, convention=["relative", "upright"])
    held = plant.gravity(torch.as_tensor(q)).numpy()
    first = warnings_of(plant, q, tau - held)[0]
    assert f"torques show no gravity: joints turn in a horizontal plane ({remedy})" in first


@pytest.mark.parametrize("bob", [0.05, 1.0])
def test_weight_at_the_end_of_a_light_rod_is_named(bob):
    rod = {"mass": [0.1], "length": [0.4], "com": [0.2], "inertia": [0.1 * 0.4**2 / 12]}
    mass = 0.1 + bob
    com = (0.1 * 0.2 + bob * 0.4) / mass
    inertia = rod["inertia"][0] + 0.1 * (com - 0.2) ** 2 + bob * (0.4 - com) ** 2
    whole = PendulumChain([mass], [0.4], com=[com], inertia=[inertia])
    tau = torque([0.3 * 9.81 * mass * com], 3)
    rest = torch.tensor([math.pi], dtype=torch.float64)
    model = CVFM(1, [[0.02, 0.005]]).requires_grad_(False)
    found = rollout(
        whole, model, rest, 0 * rest, torch.as_tensor(tau[:-1]), sample_time=STEP,
        steps=SAMPLES - 1, substeps=8,
    )  # fmt: skip
    (first, *_) = warnings_of(PendulumChain(**rod), quantise(found.q.numpy(), 4096), tau)
    (named,) = re.findall(r"likely: the link of joint1 carries (\S+) kg at its end", first)
    assert float(named) == pytest.approx(bob, rel=0.02)


@pytest.mark.parametrize("name", ["free", "driven"])
def test_vertical_rig_given_as_horizontal_is_named(name):
    _, q, tau = measured(name)
    (first, *_) = warnings_of(PendulumChain(**DOUBLE, gravity=1e-6), q, tau)
    assert "the motion shows gravity: joints turn in a vertical plane" in first
    assert "gains energy" not in first


@pytest.mark.parametrize(("name", "stiffness"), [("axis", 40.0), ("wheel", 1.5)])
def test_spring_missing_in_the_rig_is_named(name, stiffness):
    plant, q, tau = measured(name)
    named = warnings_of(plant, q, tau + stiffness * (q - 0.1))[0]
    found = float(re.search(r"joint1 has a spring of (\S+) N", named)[1])
    assert found == pytest.approx(stiffness, rel=0.02)
    assert warnings_of(plant, q, tau) == ()


@pytest.mark.parametrize(
    ("name", "rate", "share"), [("wheel", 7, 0.2), ("wheel", 84, 0.2), ("driven", 7, 1.0)]
)
def test_cogging_is_named(name, rate, share):
    """The drive has to balance it, in addition to the torque of the same motion without it."""
    plant, q, tau = measured(name)
    assert tau is not None
    size = share * np.sqrt(np.mean(tau[:, -1] ** 2))
    q = q[:, -1:]
    wave = np.pad(size * np.sin(rate * q + 1.0), ((0, 0), (tau.shape[1] - 1, 0)))
    (found,) = warnings_of(plant, measured(name)[1], tau + wave)
    named = f"joint{plant.joints} has a torque of (\\S+) N m that repeats {rate} times per turn"
    (seen,) = re.findall(named, found)
    assert float(seen) == pytest.approx(size, rel=0.2)


@pytest.mark.parametrize("inertia", [0.002, 0.02, 2.0])
def test_quantisation_at_a_steady_speed_is_no_mistake(inertia):
    """Dry friction and an offset explain a constant torque, so that only noise remains."""
    time, torque = STEP * np.arange(SAMPLES), 0.3
    settling = inertia / 0.02  # From rest, with dry friction of 0.1 and viscous friction of 0.02.
    q = 10 * (time + settling * np.expm1(-time / settling))[:, None]
    q = COUNT * np.round(q / COUNT)
    assert warnings_of(Rotor(inertia), q, np.full_like(q, torque)) == ()


def test_torque_jumps_do_not_hide_a_mistake():
    """At 50 Hz a block has few samples, and a torque that switches differs between them."""
    time, switched = 0.02 * np.arange(1501), np.random.default_rng(0).choice([-3.0, 3.0], 751)
    tau, plant = np.repeat(switched, 2)[:1501, None], Rotor(0.02)
    model = CVFM(1, [[0.3, 0.12]]).requires_grad_(False)
    rest = torch.zeros(1, dtype=torch.float64)
    given = {"sample_time": 0.02, "substeps": 80, "gradients": False}
    q = rollout(plant, model, rest, rest, torch.as_tensor(tau[:-1]), **given).q.numpy()
    q = COUNT * np.round(q / COUNT)
    assert re.search(r"10[0-9]{2} times too large", warnings_of(plant, q, 1e3 * tau, time=time)[0])
    assert "reversed" in warnings_of(plant, -q, tau, time=time)[0]


@pytest.mark.parametrize(("times", "named"), [(2, "repeated"), (0, "missing")])
def test_rows_lost_or_repeated_with_even_time_stamps_are_named(times, named):
    """A fit absorbs most of a wrong clock in the inertia, and looks good."""
    plant, q, tau = measured("wheel", 1e-4)
    rows = np.ones(len(q), dtype=int)
    rows[np.random.default_rng(0).choice(len(q), len(q) // 30, replace=False)] = times
    rows = np.repeat(np.arange(len(q)), rows)
    found = warnings_of(plant, q[rows], tau[rows], time=STEP * np.arange(len(rows)))
    assert f"% of the rows of a recording are {named}, although" in found[0]


def test_stale_positions_are_named():
    """A sensor slower than the log repeats its last position while the torque continues."""
    plant, q, tau = measured("wheel", 1e-4)
    rows = np.arange(len(q))
    late = np.random.default_rng(0).choice(len(q) - 1, len(q) // 20, replace=False) + 1
    rows[late] -= 1
    first = warnings_of(plant, q[rows], tau)[0]
    assert "% of the rows of a recording repeat the position before, although" in first


@pytest.mark.parametrize("period", [1.0, 10.0])
def test_recurring_or_rare_overflow_is_named_first(period):
    """Many jumps look like a lively motion, and after filtering like an elastic joint."""
    plant, q, tau = measured("wheel")
    first = warnings_of(plant, 5 * q % period, tau)[0]
    assert "likely: a counter overflows: joint1 of a recording jumps by" in first


def test_noise_of_a_resting_joint_is_no_overflow():
    plant, q, tau = measured("driven")
    noise = 1e-3 * np.random.default_rng(0).normal(size=len(q))
    still = np.stack([q[:, 0], noise], 1)
    assert not any("overflows" in warning for warning in warnings_of(plant, still, tau))


def test_wrapped_angles_are_not_taken_for_an_elastic_joint():
    plant, q, tau = measured("wheel")
    with pytest.warns(UserWarning, match="looks wrapped"):
        first = warnings_of(plant, 20 * q % (2 * math.pi), tau)[0]
    assert "likely: positions of a recording are wrapped (unwrap them" in first


def test_an_inertia_that_the_fit_corrects_is_no_mistake():
    plant, q, tau = measured("wheel")
    less = 0.93 * plant.inertia_coupling
    assert warnings_of(plant.replace(inertia_coupling=less), q, tau) == ()


@pytest.mark.parametrize("name", ["free", pytest.param("driven", marks=pytest.mark.slow)])
def test_mistakes_in_conventions_and_time_are_named(name):
    plant, q, tau = measured(name)
    assert (
        "angles are relative, not absolute"
        in warnings_of(plant, q, tau, convention="absolute,upright")[0]
    )
    assert (
        "angles are measured from upright, not from hanging"
        in warnings_of(plant, q, tau, convention="relative,hanging")[0]
    )
    misread = np.cumsum(q - [math.pi, 0], axis=1)
    first = warnings_of(plant, misread, tau, convention="relative,hanging")[0]
    assert "angles are absolute, not relative" in first
    with pytest.warns(UserWarning, match="milliseconds"):
        assert "time is in ms" in warnings_of(plant, q, tau, time=2.0 * np.arange(len(q)))[0]


@pytest.mark.parametrize("name", ["free", pytest.param("driven", marks=pytest.mark.slow)])
def test_a_wrong_sample_rate_is_named(name):
    plant, q, tau = measured(name)
    (text,) = warnings_of(plant, q, tau, time=2.5 * STEP * np.arange(len(q)))
    assert "likely: the true sample rate is 2.5 times that in `time`" in text


@pytest.mark.parametrize("rate", [20.0, 500.0, 4000.0, 10000.0])
@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_time_unit_is_chosen_by_usual_sample_rates(rate, unit, factor):
    time = np.arange(100) / rate
    assert time_unit(time) is None
    found = time_unit(factor * time)
    # Above 2 kHz, milliseconds cannot be distinguished from seconds.
    assert found is None if factor / rate < 0.5 else found[0] == unit


@pytest.mark.parametrize("name", ["free", "motor", "axis"])
@pytest.mark.parametrize(("unit", "rate"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_wrong_time_unit_is_named_alone(name, unit, rate):
    """An inertia or torque that is wrong by the square of the factor would explain as much."""
    plant, q, tau = measured(name)
    with pytest.warns(UserWarning, match="`time` looks like"):
        first = warnings_of(plant, q, tau, time=rate * STEP * np.arange(len(q)))[0]
    assert first.startswith(f"A mistake in data or rig is likely: time is in {unit}. ")


def test_exchanged_columns_are_named():
    plant, q, tau = measured("driven")
    swapped = (np.ascontiguousarray(x[:, ::-1]) for x in (q, tau))
    assert "the columns of joint1 and joint2 are exchanged" in warnings_of(plant, *swapped)[0]


def test_advanced_torque_is_aligned_again():
    plant, q, tau = measured("motor")
    late = Recording(STEP * np.arange(len(q)), q, later(tau, 10), convention="relative,upright")
    aligned = late.advance_torque(10 * STEP)
    np.testing.assert_allclose(aligned.tau, tau[: len(aligned)], atol=1e-12)
    np.testing.assert_array_equal(aligned.q, q[: len(aligned)])
    assert warnings_of(plant, aligned.q, aligned.tau) == ()
    with pytest.raises(ValueError, match="no torque to advance"):
        Recording(late.time, q).advance_torque(0.01)


def off_as_drawings_are(plant: Plant, seed: int, driven: Sequence[int] = ()) -> Plant:
    """The plant with an error of a drawing in every term."""
    terms = plant_parameters(plant, driven=[*driven])
    terms = [term for term in terms if term.ratio or term.name.startswith("angle offset")]
    draw = torch.Generator().manual_seed(seed)
    sizes = torch.randn(len(terms), generator=draw, dtype=torch.float64).clamp(-1.9, 1.9)
    usual = torch.tensor([term.prior_sd for term in terms], dtype=torch.float64)
    return adjusted_plant(plant, terms, sizes * usual)


@pytest.mark.parametrize("seed", [0, slow(2), slow(5)])
def test_delay_is_named_beside_errors_of_a_drawing(seed):
    plant, q, tau = measured("driven")
    drawn = off_as_drawings_are(plant, seed, driven=(0, 1))
    assert not any("later than" in w for w in warnings_of(drawn, q, tau))
    (text,) = (w for w in warnings_of(drawn, q, later(tau, 15)) if "later than positions" in w)
    assert 0.025 < float(text.split(" ms later")[0].split()[-1]) / 1e3 < 0.032


@pytest.mark.parametrize("seed", [4, slow(13)])
def test_errors_of_a_drawing_are_no_gain_of_energy(seed):
    """The energy of a free swing rises if it is computed with slightly wrong terms."""
    links = {"mass": [0.2, 0.27, 0.34], "length": [0.3, 0.3, 0.23], "com": [0.12, 0.18, 0.08]}
    plant = PendulumChain(**links, inertia=[2e-3, 3e-3, 2e-3])
    truth = CVFM(3, [[0.02, 1e-3], [0.012, 1e-3], [0.006, 1e-3]])
    recording = swing(plant, truth, seconds=6.0, start=(2.2, 1.0, 0.8))
    wrong = off_as_drawings_are(plant, seed)
    assert not any("gains energy" in w for w in warnings_of(wrong, recording.q, None))
    reverse = np.ascontiguousarray(recording.q[::-1])
    assert any("gains energy" in w for w in warnings_of(wrong, reverse, None))


def test_wrong_sample_rate_of_a_single_link_is_named_beside_its_inertia():
    """The balance determines only the inertia times the square of the rate."""
    plant = one_link()
    recording = swing(plant, CVFM(1, [[0.006, 1e-3]]), seconds=6.0)
    (text, *_) = warnings_of(plant, recording.q, None, time=2 * recording.time)
    assert "or the true sample rate is 2" in text


@pytest.mark.parametrize("seed", [0, slow(1), slow(2)])
def test_mistakes_are_named_beside_errors_of_a_drawing(seed):
    """Wrong terms of the rig would absorb both the mistake and these errors."""
    plant, q, tau = measured("motor")
    drawn = off_as_drawings_are(plant, seed, driven=(0,))
    assert not any("likely" in w for w in warnings_of(drawn, q, tau))
    (unit, *_) = warnings_of(drawn, q, 1e3 * tau)
    assert 850 < float(re.findall(r"torque of joint1 is (\S+) times too large", unit)[0]) < 1150
    (rate, *_) = warnings_of(drawn, q, tau, time=2 * STEP * np.arange(SAMPLES))
    assert 1.8 < float(re.findall(r"true sample rate is (\S+) times", rate)[0]) < 2.2


@pytest.mark.parametrize("name", ["driven", "motor", "axis", "wheel"])
def test_a_driven_motion_without_torque_is_named(name):
    plant, q, _ = measured(name)
    (found, *_) = warnings_of(plant, q, None)
    assert "has no torque, but its motion gains energy up to" in found


@pytest.mark.parametrize("backwards", [slow(False), True])
def test_a_swing_that_gains_little_energy_is_named(backwards):
    """The torque balance is too coarse for weak friction; a fit is not."""
    swung = swing(pendulum(), CVFM(2, [[1e-3, 2e-4], [4e-4, 1e-4]]).requires_grad_(False))
    q = np.pi / 1024 * np.round(swung.q * 1024 / np.pi)
    recording = Recording(swung.time, q[::-1] if backwards else q, convention=swung.convention)
    found = fit(CVFM(2), pendulum(), recording, windows=(0.5, 2.0), max_steps=20)
    named = [text for text in found.mistakes if "time runs backwards" in text]
    assert bool(named) == backwards
    assert (found.usability[0] == "do not use") == backwards


def of_motor(plant: Plant, tau: np.ndarray) -> np.ndarray:
    """Positions of a motor with these torques, as given by its encoder."""
    start = torch.tensor([math.pi], dtype=torch.float64)
    model = CVFM(1, [[0.3, 0.12]]).requires_grad_(False)
    found = rollout(plant, model, start, 0 * start, sample_time=STEP, steps=SAMPLES - 1,
                    substeps=8, tau=torch.as_tensor(tau[:-1]))  # fmt: skip
    return COUNT * np.round(found.q.numpy() / COUNT)


@pytest.mark.parametrize(
    "off", [slice(SAMPLES // 2, None), slow(slice(SAMPLES // 3, 2 * SAMPLES // 3))]
)
def test_a_drive_that_is_off_for_a_while_is_named(off):
    """An emergency stop, for example, after which the log contains the command."""
    plant, _, commanded = measured("motor")
    driven = commanded.copy()
    driven[off] = 0.0
    q = of_motor(plant, driven)
    assert warnings_of(plant, q, driven) == ()
    (warning,) = warnings_of(plant, q, commanded)
    first = STEP * off.start
    lower = float(re.search(r"the drive of joint1 is off from ([\d.]+) to ", warning)[1])
    assert lower == pytest.approx(first, abs=0.2)
    assert "although a torque is recorded (set it to 0)" in warning


@pytest.mark.parametrize(("sine", "named"), [(1.0, True), (0.15, False)])
def test_a_joint_held_by_a_brake_is_named(sine, named):
    """Without a torque, friction of 0.3 N m holds a little of the weight of 1.5 N m."""
    plant, q, tau = measured("motor")
    stop = 1000 + int(np.abs(np.abs(np.sin(q[1000:2000, 0])) - sine).argmin())
    held, driven = q.copy(), tau.copy()
    held[stop:], driven[stop:] = q[stop], 0.0
    (warning,) = warnings_of(plant, held, driven)
    found = re.search(r"joint1 of recording 1 rests from (\S+) to \S+ s against 1.5 N m", warning)
    assert (found is not None) == named
    assert not named or float(found[1]) == pytest.approx(STEP * stop, abs=0.1)


def test_steady_creeping_against_static_friction_is_no_brake():
    """Friction at 0.01 rad/s is 2.5 times the friction at higher speeds."""
    ramp, speeds = np.linspace(0.0, 1.0, 100), (0.01, -0.01, 0.1, -0.1, 1.0, -1.0, 4.0, -4.0)
    v = np.concatenate([[*v * ramp, *np.full(900, v), *v * ramp[::-1]] for v in speeds])
    friction = (0.3 + 0.45 * np.exp(-((v / 0.05) ** 2))) * np.sign(v) + 0.01 * v
    count, plant = 2 * math.pi / 65536, Rotor(**WHEEL)
    tau = (0.02 + 50**2 * 1.2e-5) * np.gradient(v, STEP) + friction
    q = count * np.round(np.cumsum(v) * STEP / count)
    assert not any("brake" in w for w in warnings_of(plant, q[:, None], tau[:, None]))


def turned(stop: float, effort: float, seed: int) -> Recording:
    """A driven wheel of 0.02 kg m^2 between two stops [rad], from which it bounces a little."""
    time, random, h = np.arange(5001) / 500, np.random.default_rng(seed), 1 / 5000
    waves = zip((0.6, 0.4, 0.3), (0.3, 0.7, 1.3), random.uniform(0, 6.28, 3), strict=True)
    torque = effort * sum(a * np.sin(2 * np.pi * f * time + phase) for a, f, phase in waves)
    q, v, angle = 0.0, 0.0, []
    for given in torque:
        angle.append(q)
        for _ in range(10):
            free = v + h / 0.02 * given
            v = float(np.copysign(max(0.0, abs(free) - h / 0.02 * 0.1) / (1 + h), free))
            q += h * v
            if abs(q) > stop and q * v > 0:
                q, v = float(np.copysign(stop, q)), -0.2 * v
    return Recording(time, quantise(np.array(angle)[:, None], 4096), tau=torque[:, None])


@pytest.mark.parametrize(
    ("stop", "effort", "ends"),
    [(0.5, 0.3, ["-0.5", "0.5"]), (3.0, 1.0, ["-3", "3"]), (9.0, 0.3, [])],
)
def test_end_stops_are_named(stop, effort, ends):
    recordings = [turned(stop, effort, seed) for seed in (1, 2)]
    found = prepare_task("CVFM", Rotor(0.02), recordings, FitOptions()).mistakes
    assert [re.findall(r"(\S+) rad \(at", text) for text in found] == ([ends] if ends else [])


def test_saturating_drive_is_named():
    plant, q, tau = measured("motor")
    most = np.abs(tau).max()
    # The log contains the command, which does not show the limit.
    commanded = np.sign(tau) * np.where(np.abs(tau) > 0.6 * most, 2 * np.abs(tau) - 0.6 * most,
                                        np.abs(tau))  # fmt: skip
    driven = np.clip(commanded, -0.6 * most, 0.6 * most)
    q = of_motor(plant, driven)
    assert warnings_of(plant, q, driven) == ()
    (warning,) = warnings_of(plant, q, commanded)
    assert f"the drive of joint1 saturates at {0.6 * most:.2g}"[:-1] in warning


@pytest.mark.parametrize("drift", [0.01, -0.01])
def test_drifting_clock_is_named(drift):
    plant, q, tau = measured("motor")
    time = STEP * np.arange(len(q))
    late = np.interp(time * (1 - drift), time, tau[:, 0])[:, None]
    (warning,) = warnings_of(plant, q, late)
    way = "fast" if drift > 0 else "slow"
    (named,) = re.findall(rf"the clock of the torques is ([\d.]+) % {way}", warning)
    assert float(named) == pytest.approx(1, rel=0.05)


@pytest.mark.parametrize("name", ["wheel", pytest.param("driven", marks=pytest.mark.slow)])
def test_zero_order_hold_of_torques_is_no_mistake(name):
    """Half a sample late throughout, which resembles a small drift or inertia error."""
    plant, _, tau = measured(name)
    joints, step, samples = plant.joints, 1e-2, 2000
    time = step * np.arange(samples)
    waves = 0.5 * np.abs(tau).max(0) * (np.sin(1.6 * time) + 0.5 * np.sin(2.8 * time))[:, None]
    start = torch.zeros(joints).double()
    start[0] = 0.0 if name == "wheel" else math.pi
    model = NCFM(joints, [0.05]).requires_grad_(False)
    found = rollout(plant, model, start, 0 * start, sample_time=step, substeps=8,
                    tau=torch.as_tensor(waves[:-1]))  # fmt: skip
    assert warnings_of(plant, found.q.numpy(), waves, time=time) == ()


def test_fit_with_an_elastic_joint_is_doubtful_and_names_it():
    """A drive with half the inertia, a spring, and a link whose encoder is read."""
    plant, _, tau = measured("direct")
    drive, link, stiffness = 0.04, 0.04, 80.0
    weight = float(plant.gravity_moment.sum())
    steps = 10
    h, state, seen = STEP / steps, np.zeros(4), []
    for u in tau[:, 0]:
        seen.append(state[1])
        for _ in range(steps):
            # Semi-implicit Euler: an undamped spring neither gains nor loses energy.
            spring = stiffness * (state[0] - state[1]) + 0.05 * (state[2] - state[3])
            rub = 0.3 * np.tanh(state[2] / 3e-3) + 0.12 * state[2]
            state[2] += h * (u - rub - spring) / drive
            state[3] += h * (spring - weight * np.sin(state[1])) / link
            state[:2] += h * state[2:]
    q = COUNT * np.round(np.array(seen)[:, None] / COUNT) + math.pi
    recording = Recording(STEP * np.arange(SAMPLES), q, tau, convention="relative,upright")
    found = fit(CVFM(1), plant, recording, windows=(0.5,))
    assert "joint1 is elastic or has play between drive and encoder" in found.mistakes[0]
    resonance = math.sqrt(stiffness * (1 / drive + 1 / link)) / math.tau
    (named,) = re.findall(r"resonance near ([\d.]+) Hz", found.mistakes[0])
    assert float(named) == pytest.approx(resonance, rel=0.15)
    # Simulations still follow the motion.
    assert found.usability[0] == "doubtful"
    assert replace(found, converged=False).usability[0] == "do not use"


def of_several_days(rig: Plant, friction: list[float]) -> list[Recording]:
    """Two recordings of the motor, and one of this rig with this friction."""
    _, q, tau = measured("motor")
    start = torch.tensor([math.pi], dtype=torch.float64)
    other = rollout(
        rig, CVFM(1, [friction]).requires_grad_(False), start, 0 * start, sample_time=STEP,
        steps=SAMPLES - 1, substeps=8, tau=torch.as_tensor(tau[:-1]),
    )  # fmt: skip
    files = {"monday": q, "tuesday": q + 2e-3 * np.sin(q), "other": other.q.numpy()}
    return [
        Recording(STEP * np.arange(SAMPLES), x, tau, convention="relative,upright", name=name)
        for name, x in files.items()
    ]


@pytest.mark.parametrize("zero", ["upright", pytest.param("hanging", marks=pytest.mark.slow)])
def test_a_recording_of_another_rig_is_named(zero):
    """Also if all encoders read zero at first, and may have been zeroed in any pose."""
    plant = measured("motor")[0]
    recordings = of_several_days(plant.replace(gravity_moment=2 * plant.gravity_moment), [0.8, 0.3])
    if zero == "hanging":
        recordings = [
            replace(r, q=r.q - math.pi, convention="relative,hanging") for r in recordings
        ]
    task = prepare_task(CVFM(1), plant, recordings, FitOptions())
    assert task.per_recording == (zero == "hanging")
    (found,) = task.mistakes
    of = "other is from another rig than the others, or was recorded differently"
    assert re.fullmatch(rf"{of} \(gravity 1 is 2\.0\d times that of the rig\)", found)
    assert not prepare_task(CVFM(1), plant, recordings[:2], FitOptions()).mistakes


@pytest.mark.slow
@pytest.mark.parametrize("factor", [3.0, 0.3])
def test_friction_change_between_recordings_is_not_another_rig(factor):
    plant = measured("motor")[0]
    recordings = of_several_days(plant, [0.3 * factor, 0.12 * factor])
    for given in (recordings, recordings[1:]):
        task = prepare_task(CVFM(1), plant, given, FitOptions())
        assert not task.mistakes
        assert_drift(task.drift, {"joint1": factor})


@pytest.mark.parametrize("factor", [3.0, 1.0, 0.25])
def test_friction_change_between_swings_is_named_not_another_rig(factor):
    plant, friction = pendulum(), np.array([[0.01, 4e-3], [4e-3, 2e-3]])
    models = [CVFM(2, f * friction, v_smooth=0.01) for f in (1.0, factor)]
    starts = (1.6, 0.8), (1.2, 1.0)
    made = [
        swing(plant, model.requires_grad_(False), start=start, seconds=6.0)
        for model, start in zip(models, starts, strict=True)
    ]
    task = prepare_task(CVFM(2), plant, made, FitOptions())
    assert not task.mistakes
    assert_drift(task.drift, dict.fromkeys(plant.joint_names if factor != 1 else (), factor))


def assert_drift(warned: tuple[str, ...], factors: dict[str, float]) -> None:
    """Assert that the friction of only these joints changes, by these factors."""
    assert len(warned) == len(factors)
    for sentence, (joint, factor) in zip(warned, factors.items(), strict=True):
        way, found, within = re.match(
            rf"The friction of {joint} (grows|falls) by (\S+) ± (\S+) % "
            "(?:.* to the last|in other)",
            sentence,
        ).groups()
        assert way == ("grows" if factor > 1 else "falls")
        assert float(found) <= 100 or factor > 1
        assert abs(float(found) - 100 * abs(factor - 1)) < float(within) + 20


@pytest.mark.slow
def test_recordings_zeroed_in_different_poses_are_of_one_rig():
    made = [zeroed_in_a_pose(np.array(zero)) for zero in ((0.02, -0.03), (-0.01, 0.02))]
    plant, recordings = made[0][0], [recording for *_, recording in made]
    task = prepare_task(CVFM(2), plant, recordings, FitOptions())
    assert task.per_recording
    assert not task.mistakes
    shared = prepare_task(CVFM(2), plant, recordings, FitOptions(encoder_reference="shared"))
    assert re.search("zeros differ: .* 1.7 degrees .* 2.9 degrees .*per_rec", shared.mistakes[0])


@pytest.mark.parametrize(
    "degrees", [pytest.param((3.0, 0.0), marks=pytest.mark.slow), (0.0, 3.0), (0.0, 0.0)]
)
def test_encoder_homed_again_is_named(degrees):
    """Also if friction dominates the torque, so that the correction explains less than half."""
    plant = PendulumChain(**DOUBLE)
    model = CVFM(2, [[0.02, 0.004], [0.008, 0.003]], v_smooth=0.01).requires_grad_(False)
    starts = (1.2, -0.5), (0.9, 0.7)
    recordings = [swing(plant, model, start=start, seconds=6.0) for start in starts]
    q = recordings[1].q + np.radians(degrees)
    recordings[1] = recordings[1]._replace(q=q, name="after")
    task = prepare_task(CVFM(2), plant, recordings, FitOptions())
    joints = [x for x, off in zip(plant.joint_names, degrees, strict=True) if off]
    assert len(task.mistakes) == len(joints)
    for found, joint in zip(task.mistakes, joints, strict=True):
        assert re.match(rf"encoder zeros differ: {joint} by (2\.9|3|3\.1) degrees", found)
        assert "and after (`encoder_reference" in found
    # A recording too short for the test does not shift the names; the option needs this method.
    short = recordings[0][: round(0.1 / recordings[0].sample_time)]._replace(name="short")
    for given in ([recordings[0], short, recordings[1]], [short, *recordings]):
        options = FitOptions(method="equation_error")
        for found in prepare_task(CVFM(2), plant, given, options).mistakes:
            assert "short" not in found
            assert found.endswith('(`method="output_error"`, `encoder_reference="per_recording"`)')


def test_drive_offset_may_look_like_an_encoder_offset():
    plant, q, tau = measured("motor")
    halves = []
    for part, offset in ((slice(SAMPLES // 2), 0.0), (slice(SAMPLES // 2, None), 0.3)):
        time = STEP * np.arange(len(q[part]))
        halves.append(
            Recording(time, q[part], tau=tau[part] + offset, convention="relative,upright")
        )
    (found,) = prepare_task(CVFM(1), plant, halves, FitOptions()).mistakes
    assert found.startswith("encoder zeros differ: joint1 by ")
    assert found.endswith("or the offset of a drive or torque sensor changed between recordings")


@pytest.mark.parametrize("rounded", [True, False])
def test_a_spike_is_named_with_its_time(rounded):
    plant, q, tau = measured("driven")
    # Also without visible counts.
    q = q.copy() if rounded else kalman_smoother(STEP * np.arange(len(q)), q).q.copy()
    q[1000, 1] += 0.5
    (found,) = (w for w in warnings_of(plant, q, tau) if "one sample" in w)
    assert "joint2 jumps for one sample at 2 s;" in found


@pytest.mark.slow
def test_lost_counts_and_missing_samples_are_named_with_their_time():
    plant, q, tau = measured("driven")
    (found,) = (w for w in warnings_of(plant, q + (q * 0 + [0, 0.3]) * LATER, tau) if "good" in w)
    assert "joint2 of a recording jumps for good at 2 s:" in found
    # A logger writes the nominal time.
    kept = np.r_[0:1000, 1030 : len(q)]
    found = warnings_of(plant, q[kept], tau[kept], time=STEP * np.arange(len(kept)))
    assert any("jumps for good at 2 s:" in warning for warning in found)
    # Jumps in position look like friction that changes.
    assert not any("friction of" in warning for warning in found)
    assert not any("jumps" in warning for warning in warnings_of(plant, q, tau))


@pytest.mark.parametrize("jitter", [0.0, 5e-5, 1e-4])
def test_rows_left_out_with_their_times_are_no_jumps(jitter):
    random, time = np.random.default_rng(0), 1e-3 * np.arange(15_000)
    kept = random.random(len(time)) > 3e-3
    q = quantise(np.sin(time)[:, None] + 0.3 * np.sin(7 * time)[:, None], 1e5)[kept]
    stamps = time[kept] + jitter * random.normal(size=kept.sum())
    assert not [*inputs.lasting_jumps([Recording(stamps, q)], FitOptions())]
    lost = q + 0.02 * (np.arange(len(q)) > 7000)[:, None]
    assert len([*inputs.lasting_jumps([Recording(stamps, lost)], FitOptions())]) == 1


@pytest.mark.parametrize("wrong", ["q1", "motor1"])
def test_positions_of_joints_read_as_of_motors_are_named(wrong):
    _, q, tau = measured("direct")
    # Of a motor without inertia.
    plant = PendulumChain(**MOTOR | {"armature": None, "inertia": [0.0575]}, motor=Motor(20.0))
    first = warnings_of(plant, q * 20.0 if wrong == "q1" else q / 20.0, tau)[0]
    other = "joints, but were read as those of their motors (`q1`, ...)"
    if wrong == "q1":
        other = "motors, but were read as those of the joints (`motor1`, ...)"
    assert f"positions are of the {other}" in first


def test_counter_overflow_is_named():
    plant, q, tau = measured("driven")
    wrapped = (q + 0.1) % 0.7
    (found, *_) = (w for w in warnings_of(plant, wrapped, tau) if "good" in w)
    assert "a counter overflows, after 0.7 rad each; unwrap its column" in found


@pytest.mark.parametrize("name", ["direct", pytest.param("motor", marks=pytest.mark.slow)])
def test_wrongly_scaled_torques_are_named(name):
    """They fit a rig that is heavier throughout, within the allowed range; also with a gear."""
    plant, q, tau = measured(name)
    recording = Recording(STEP * np.arange(len(q)), q, 1.2 * tau, convention="relative,upright")
    found = fit(CVFM(1), plant, recording, windows=(0.5,))
    assert any("torques are recorded 1.2 times as large as they are" in w for w in found.warnings)


@pytest.mark.parametrize(
    ("scale", "inertia", "named"),
    [(1.15, 1.06, True), slow(1.0, 1.08, False), slow(1.0, 1.25, False)],
)
def test_torque_scale_is_named_despite_errors_of_the_rig(scale, inertia, named):
    """Only a common change of inertia and gravity beyond that of usual rig errors."""
    plant, q, tau = measured("direct")
    recording = Recording(STEP * np.arange(len(q)), q, scale * tau, convention="relative,upright")
    wrong = plant.replace(inertia_coupling=plant.inertia_coupling / inertia)
    found = fit(CVFM(1), wrong, recording, windows=(0.5,))
    warned = [w for w in found.warnings if "torques are recorded" in w]
    assert len(warned) == named
    for text in warned:
        assert re.search(r"are on average 1\.1[78]\d* times those of the rig", text)
        assert found.usability[0] == "doubtful"


def test_a_step_at_a_gap_is_no_spike():
    plant, q, tau = measured("driven")
    kept = np.r_[0:1000, 1600 : len(q)]
    with pytest.warns(UserWarning, match="gaps"):
        found = warnings_of(plant, q[kept], tau[kept], time=STEP * kept)
    assert not any("jumps" in warning for warning in found)


def test_time_stamp_jitter_is_no_jump():
    """Samples are taken on time and stamped late; scaled by the stamps, fast steps differ."""
    plant, q, tau = measured("wheel", count=COUNT / 50)
    late = np.abs(np.random.default_rng(0).normal(scale=0.1 * STEP, size=len(q)))
    found = warnings_of(plant, q, tau, time=STEP * np.arange(len(q)) + late)
    assert not any("jumps" in warning for warning in found)


def test_sample_stamped_late_is_no_jump():
    """Its step seems slow, and the next one fast."""
    plant, q, tau = measured("wheel", count=COUNT / 50)
    time = STEP * np.arange(len(q))
    time[1000:] += 2 * STEP
    late = np.r_[0:1000, 1003 : len(q)]
    time, q = time[: len(late)], q[late]
    q[1000] = q[999] + (q[999] - q[998])
    found = warnings_of(plant, q, tau[late], time=time)
    assert not any("jumps" in warning for warning in found)


@pytest.mark.parametrize("missing", [1, 3])
def test_samples_missing_with_their_time_stamps_are_no_jump(missing):
    plant, q, tau = measured("wheel", count=COUNT / 50)
    kept = np.r_[0:1000, 1000 + missing : len(q)]
    found = warnings_of(plant, q[kept], tau[kept], time=STEP * kept)
    assert not any("jumps" in warning for warning in found)


def test_a_fit_names_the_mistake_first(caplog):
    plant, q, tau = measured("motor")
    recording = Recording(STEP * np.arange(len(q)), -q, tau, convention="relative,upright")
    prepare_task(CVFM(1), plant, recording, FitOptions())
    assert "the sign of joint1's position is reversed" in caplog.text
    found = fit(CVFM(1), plant, recording, method="equation_error")
    assert "the sign of joint1's position is reversed" in found.warnings[0]
    assert found.usability[0] == "do not use"
    assert "the sign of joint1's position is reversed" in found.usability[1]


def test_fit_states_whether_it_is_usable():
    plant, q, tau = measured("motor")
    recording = Recording(STEP * np.arange(len(q)), q, tau, convention="relative,upright")
    settings = {"windows": (1.0,), "fit_plant": False}
    assert fit(CVFM(1), plant, recording, **settings).usability == ("good", "")
    # Viscous friction alone is far from dry friction.
    wrong = fit(NCFM(1), plant, recording, **settings)
    verdict, reason = wrong.usability
    assert verdict == "doubtful"
    assert "times the measurement noise" in reason
    # Many turns do not excuse an angle error.
    turning = tuple(replace(m, q=50 * m.q) for m in wrong.motions)
    assert replace(wrong, motions=turning).usability[0] == "doubtful"
    # Without gravity all angles are equivalent, and a wheel that turns often has moved far.
    assert replace(wrong, motions=turning, plant=Rotor(0.01)).usability[0] == "good"
    lost = replace(wrong, residual=3.0).usability
    assert lost == ("do not use", "the residual is larger than the motion")
    sd = math.sqrt(np.concatenate([m.q for m in wrong.motions]).var())
    whole = replace(wrong, stages=())
    verdicts = [replace(whole, residual=share * sd).usability[0] for share in (0.65, 0.75)]
    # Half of the variance is 0.71 standard deviations.
    assert verdicts == ["doubtful", "do not use"]
    # Short windows contain less motion.
    assert replace(wrong, residual=0.65 * sd).usability[0] == "do not use"
    assert replace(wrong, residual=math.inf).to_dict()["residual"] is None


@pytest.mark.filterwarnings("ignore:.*looks like degrees")
def test_long_coasting_does_not_excuse_a_wrong_law():
    """Most of its motion needs no torque, so even a wrong friction law follows it."""
    time, speed = np.arange(2001) * 1e-2, [30.0]
    for _ in range(10 * (len(time) - 1)):
        # Dry friction, and air drag proportional to the square of the speed.
        slowed = speed[-1] - 1e-3 / 0.08 * (0.06 + 4e-4 * speed[-1] ** 2)
        speed.append(max(0.0, slowed))
    angle = 1e-3 * (np.cumsum(speed) - np.array(speed) / 2)[::10]
    wheel = Recording(time, quantise(angle[:, None], 4096))
    found = fit("coulomb-viscous", Rotor(0.08), wheel)
    (dry,) = (i for i in found.intervals if i.name == "F_c of joint1")
    assert not dry.low < 0.06 < dry.high
    assert found.residual < DOUBTFUL_ERROR * wheel.q.std()
    assert found.usability[0] == "doubtful"


@pytest.mark.parametrize("scale", [slow(0.93), 1.0, 1.08])
def test_torque_constant_is_named_if_friction_leaves_its_interval(scale):
    plant, q, tau = measured("motor")
    recording = Recording(STEP * np.arange(len(q)), q, scale * tau, convention="relative,upright")
    found = fit(CVFM(1), plant, recording, windows=(1.0,))
    warned = [warning for warning in found.warnings if "torque constant" in warning]
    assert len(warned) == (scale != 1.0)
    for warning in warned:
        assert f"recorded {scale} times as large as they are" in warning


@pytest.mark.slow
def test_torque_noise_is_no_error_of_the_law():
    plant, fine, tau = measured("wheel", COUNT / 16)
    noisy = tau + 0.05 * np.random.default_rng(0).standard_normal(tau.shape)
    recording = Recording(STEP * np.arange(len(fine)), fine, noisy)
    settings = {"windows": (2.0,), "fit_plant": False}
    right = fit(CVFM(1), plant, recording, **settings)
    # Far above quantisation, and just what the torque noise explains.
    assert right.residual > 50 * (COUNT / 16) / 12**0.5
    assert right.residual == pytest.approx(right.noise, rel=0.5)
    assert right.usability == ("good", "")
    assert not any("missing something" in warning for warning in right.warnings)
    assert fit(NCFM(1), plant, recording, **settings).usability[0] == "doubtful"


@pytest.mark.parametrize(("factor", "verdict"), [slow(0.1, "good"), (0.3, "doubtful")])
def test_small_error_is_not_doubtful_with_a_fine_encoder(factor, verdict):
    """An error of the law is judged relative to the motion, however fine the encoder is."""
    plant, fine, tau = measured("wheel", COUNT / 1024)
    # A driver whose gain grows with its torque, an effect that no plant term has.
    recording = Recording(STEP * np.arange(len(fine)), fine, np.sinh(factor * tau) / factor)
    found = fit(CVFM(1), plant, recording, windows=(1.0,), fit_plant=False)
    assert found.residual > 10 * found.noise
    assert found.usability[0] == verdict


@pytest.mark.slow
def test_encoder_without_visible_count_does_not_excuse_a_wrong_law():
    plant, smooth, tau = measured("wheel", None)
    recording = Recording(STEP * np.arange(len(smooth)), smooth, tau)
    settings = {"windows": (1.0,), "fit_plant": False}
    assert fit(CVFM(1), plant, recording, **settings).usability == ("good", "")
    assert fit(NCFM(1), plant, recording, **settings).usability[0] == "doubtful"


@pytest.mark.parametrize("every", [SAMPLES, slow(100)])
def test_torque_spike_is_named_with_its_time(every):
    """Also if so many samples are spikes that they raise the quantiles of the curvature."""
    plant, q, tau = measured("driven")
    tau = tau.copy()
    tau[1000::every, 0] += 50.0 * np.abs(tau).max()
    (found,) = (w for w in warnings_of(plant, q, tau) if "one sample" in w)
    assert "the torque of joint1 jumps for one sample at 2" in found


@pytest.mark.parametrize("factor", [1.0, -1.0, 100.0])
def test_velocities_that_are_not_the_derivative_of_positions_are_named(factor):
    plant, q, tau = measured("driven")
    qd = factor * np.gradient(q, STEP, axis=0)
    recording = Recording(STEP * np.arange(len(q)), q, tau, qd, convention="relative,upright")
    found = [w for w in prepare_task(CVFM(2), plant, recording, FitOptions()).data_warnings
             if "derivative" in w]  # fmt: skip
    assert len(found) == (0 if factor == 1.0 else 2)
    for text in found:
        assert float(re.findall(r"is (\S+) times", text)[0]) == pytest.approx(factor, rel=0.1)


def pushed(q: float, friction: float, weight: float, seed: int) -> Recording:
    """A driven link of 0.08 kg m^2 that dry friction stops exactly, at times for seconds."""
    time, random, h = np.arange(4001) / 500, np.random.default_rng(seed), 1 / 5000
    waves = list(zip((0.8, 0.5, 0.3), (0.3, 0.7, 1.3), random.uniform(0, 6.28, 3), strict=True))
    torque = sum(a * np.sin(2 * np.pi * f * time + phase) for a, f, phase in waves)
    v, angle = 0.0, []
    for given in torque:
        angle.append(q)
        for _ in range(10):
            free = v + h / 0.08 * (given - weight * math.sin(q))
            v = float(np.copysign(max(0.0, abs(free) - h / 0.08 * friction), free))
            q += h * v
    q_read = quantise(np.array(angle)[:, None], 65536)
    torque = torque + 0.003 * random.standard_normal(len(torque))
    return Recording(time, q_read, tau=torque[:, None], convention="relative,hanging")


@pytest.mark.parametrize("seed", range(4))
def test_joint_held_by_friction_is_not_taken_for_a_drive_that_is_off(seed):
    """Noise of a velocity near zero has a direction, too, for tenths of a second."""
    rig = PendulumChain([0.5], [0.3], com=[0.204], inertia=[0.0592])
    recording = pushed(0.0, 0.6, 0.5 * 9.81 * 0.204, seed)
    assert prepare_task("CVFM", rig, recording, FitOptions()).mistakes == ()


def test_presliding_is_not_taken_for_a_spring():
    plant, q, tau = measured("wheel")
    recording = Recording(STEP * np.arange(len(q)), q, tau + 1.5 * q)
    (spring,) = prepare_task("CVFM", plant, recording, FitOptions()).mistakes[:1]
    assert "or it hardly slides and its contact is elastic (fit a law with memory" in spring
    of_contact = prepare_task("dahl", plant, recording, FitOptions()).mistakes
    assert not any("spring" in text for text in of_contact)


@pytest.mark.parametrize(("inertia", "verdict"), [(0.95, None), (0.85, "good"), (0.79, "doubtful")])
def test_undriven_rig_that_disagrees_with_its_motion_is_named(inertia, verdict):
    model = CVFM(1, [[8e-3, 2e-3]], v_smooth=0.01)
    plant = PendulumChain([0.5], [0.4], inertia=[0.0])
    recording = swing(plant, model, seconds=4.0, start=(2.2,))
    wrong = plant.replace(inertia_coupling=inertia * plant.inertia_coupling)
    found = fit(CVFM(1), wrong, recording, windows=(1.0,), drag=False)
    named = [w for w in found.warnings if "times that of the rig" in w]
    assert len(named) == (verdict is not None)
    for text in named:
        assert f"The inertia of joint1 is {1 / inertia:.3g} times that of the rig. The" in text
        assert any("friction is in proportion to the masses" in w for w in found.warnings)
        assert found.usability[0] == verdict


@pytest.mark.parametrize(("scale", "verdict"), [(0.95, None), (0.85, "good"), (0.72, "doubtful")])
@pytest.mark.parametrize("name", [pytest.param("wheel", marks=pytest.mark.slow), "axis"])
def test_torque_scale_of_a_single_inertia_is_named(name, scale, verdict):
    plant, q, tau = measured(name)
    recording = Recording(STEP * np.arange(len(q)), q, scale * tau, unit=plant.unit)
    found = fit(CVFM(1), plant, recording, windows=(1.0,))
    named = [w for w in found.warnings if "times that of the rig" in w]
    assert len(named) == (verdict is not None)
    for text in named:
        assert f"torques are recorded {scale:.2g}" in text
        assert found.usability[0] == verdict


def test_fit_that_determines_no_friction_is_unusable():
    plant, q, tau = measured("wheel")
    recording = Recording(STEP * np.arange(len(q)), q, tau)
    found = fit(CVFM(1), plant, recording, method="equation_error")
    assert found.usability[0] == "good"
    partly = replace(found, unidentifiable=("F_c of joint1",))
    assert partly.usability == ("doubtful", "the data do not determine 1 parameter")
    nothing = replace(found, unidentifiable=("F_c of joint1", "F_v of joint1"))
    assert nothing.usability == ("do not use", "the data determine no coefficient of the friction")


@pytest.mark.parametrize(
    "method", ["equation_error", pytest.param("output_error", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("weight", [5.0, pytest.param(-98.0, marks=pytest.mark.slow)])
def test_weight_missing_in_the_rig_does_not_bias_friction(method, weight):
    plant, q, tau = measured("axis")
    level = Recording(STEP * np.arange(len(q)), q, tau, unit="m")
    recording = replace(level, tau=tau + weight)
    settings = {"method": method, "windows": (0.5, 2.0)}
    expected = fit("CVFM", plant, level, **settings).model
    found = fit("CVFM", plant, recording, **settings)
    by_torque = fit("CVFM", plant, recording, method="equation_error")
    for one in (found, fit("CVFM", plant, recording, start=by_torque, **settings)):
        assert one.usability == ("good", "")
        assert one.model.v_smooth == pytest.approx(expected.v_smooth, rel=1e-6)
        values = one.model.schedule.values, expected.schedule.values
        torch.testing.assert_close(*values, rtol=2e-3, atol=0)
        assert float(one.plant.torque_offset) == pytest.approx(-weight, rel=5e-3)
        (warning,) = (w for w in one.warnings if "constant drive force" in w)
        assert f"add {weight:.2g}"[:6] in warning
        assert "but not if it is a sensor's bias" in warning


@pytest.mark.parametrize("seed", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_offset_does_not_replace_friction_in_one_direction(seed):
    """Nor for a joint at rest."""
    plant = Rotor(**WHEEL)
    tau = 0.25 * torque([3.0], seed) + 1.5
    zero = torch.zeros(1, dtype=torch.float64)
    model = CVFM(1, [[0.3, 0.12]]).requires_grad_(False)
    run = rollout(plant, model, zero, zero, sample_time=STEP, steps=SAMPLES - 1, substeps=8,
                  tau=torch.as_tensor(tau[:-1]))  # fmt: skip
    recording = Recording(STEP * np.arange(SAMPLES), COUNT * np.round(run.q.numpy() / COUNT), tau)
    found = fit("CVFM", plant, recording, method="equation_error")
    assert float(found.model.schedule.values[0, 0]) == pytest.approx(0.3, rel=0.02)
    assert not found.plant.torque_offset.any()
    # Stiction, for which the smoothed sign is as steep as before.
    resting = replace(recording, q=0 * recording.q + 0.1, tau=0.1 + 0 * tau)
    still = fit("CVFM", plant, resting, method="equation_error")
    assert not still.plant.torque_offset.any()


@pytest.mark.parametrize("method", ["equation_error", "output_error"])
def test_blocks_shorter_than_a_window_are_fitted(method):
    plant, q, tau = measured("wheel")
    time = STEP * np.arange(len(q))
    recording = Recording(time, q, tau)[time % 0.45 < 0.4]
    found = fit(CVFM(1), plant, recording, method=method, windows=(0.5,))
    assert float(found.model.schedule.values[0, 0]) == pytest.approx(0.3, rel=0.02)


def test_rows_stamped_in_batches_are_refused():
    """As by a host that reads a bus at 50 Hz."""
    plant, q, tau = measured("wheel")
    row = np.arange(len(q))
    recording = Recording(0.02 * (row // 10) + 1e-5 * (row % 10), q, tau, name="usb")
    with pytest.raises(ValueError, match=r"`time` of usb has 300 gaps.*give them even times"):
        fit(CVFM(1), plant, recording)


@pytest.mark.slow
def test_clipped_or_stuck_torque_sensor_is_named():
    plant, q, tau = measured("wheel")

    def named(torque: np.ndarray) -> list[str]:
        return [w for w in warnings_of(plant, q, torque) if "clipped or stuck" in w]

    noisy = tau + 0.01 * np.random.default_rng(0).standard_normal(tau.shape)
    (clipped,) = named(np.clip(noisy, -1.5, 2.0))
    assert re.search(r"does not change in \d+ % of the samples, at -1.5 and 2:", clipped)
    stuck = noisy.copy()
    stuck[1000:1400] = stuck[1000]
    (held,) = named(stuck)
    assert "13 % of the samples, from 2 s:" in held
    # A coarse sensor, a slower bus, a drive that is off, and a limited command are valid.
    off = noisy.copy()
    off[1000:1400] = 0.0
    for sound in (noisy, 0.05 * np.round(noisy / 0.05), np.repeat(noisy[::5], 5, 0)[: len(q)], off,
                  np.clip(tau, -1.5, 2.0)):  # fmt: skip
        assert not named(sound)
    # So is the command of a controller whose encoder shows no motion.
    q = q.copy()
    q[1000:1400] = q[1000]
    assert not named(stuck)


def test_an_unbalanced_rotor_is_named():
    plant, q, tau = measured("wheel")
    first = warnings_of(plant, q, tau + 0.4 * np.sin(q - 0.5))[0]
    assert "likely: joint1 has an unbalanced mass that the rig lacks (`mass` and `com`)." in first


def test_a_wrong_unit_is_listed_once():
    assert [text for text, _ in corrected_rigs(LinearAxis(2.0), True)] == ["masses are in g"]
