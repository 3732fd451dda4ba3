"""Friction over several sessions: mean, spread between sessions, prediction for the next one."""

import math

import numpy as np
import pytest
import torch

from nfriction import (
    CVFM,
    NFCVFM,
    LinearAxis,
    PendulumChain,
    Recording,
    Stribeck,
    fit_sessions,
    rollout,
)
from nfriction.evaluation import sessions as sessions_module
from nfriction.evaluation.sessions import SessionFit, random_effects
from nfriction.friction.memory import Dahl

COUNT = 2 * math.pi / 8192
PLANT = PendulumChain([0.4], [0.4], position_quantum=COUNT)


def session(coefficients: np.ndarray) -> Recording:
    """A free swing with this friction, rounded to encoder counts."""
    model = CVFM(1, torch.as_tensor(coefficients)[None]).requires_grad_(False)
    start = torch.tensor([math.pi + 1.5], dtype=torch.float64)
    found = rollout(PLANT, model, start, 0 * start, sample_time=0.01, steps=400, substeps=6)
    q = COUNT * np.round(found.q.numpy() / COUNT)
    return Recording(0.01 * np.arange(401), q, convention="relative,upright")


def test_mean_and_spread_between_sessions_are_recovered(tmp_path):
    rng = np.random.default_rng(0)
    truth = np.array([0.02, 0.006]) * (1 + 0.2 * rng.normal(size=(6, 2)))
    sessions = {f"day {k}": session(c) for k, c in enumerate(truth)}
    path = tmp_path / "day.csv"
    sessions["day 0"].write(path)
    sessions["day 0"] = path  # read where it is fitted
    found = fit_sessions(CVFM(1), PLANT, sessions, windows=(0.5, 2.0), drag=False)
    assert list(found.fits) == list(sessions)
    assert not found.failed
    for column, spread in zip(truth.T, found.spreads, strict=False):
        assert spread.mean == pytest.approx(column.mean(), rel=0.02)
        assert spread.between == pytest.approx(column.std(ddof=1), rel=0.1)
        assert spread.next_low < column.min() < column.max() < spread.next_high
    means = [s.mean for s in found.spreads[:2]]
    assert found.model.schedule.parameter_vector().tolist() == pytest.approx(means)
    assert found.to_pandas().loc["F_c of joint1", "sessions"] == 6


def test_failed_session_is_listed(tmp_path):
    sessions = {f"day {k}": session(np.array([0.02 + 1e-3 * k, 0.006])) for k in range(3)}
    sessions["lost"] = tmp_path / "missing.csv"
    found = fit_sessions(CVFM(1), PLANT, sessions, windows=(0.5,), drag=False)
    assert "missing.csv" in found.failed["lost"]
    with pytest.raises(ValueError, match=r"1 of 3 sessions could not be fitted.*missing.csv"):
        fit_sessions(CVFM(1), PLANT, {k: sessions[k] for k in ("day 0", "day 1", "lost")},
                     windows=(0.5,), drag=False)  # fmt: skip


@pytest.mark.slow
def test_contact_stiffness_has_a_spread() -> None:
    axis, sessions, truth = LinearAxis(0.5), {}, {"a": 250.0, "b": 300.0, "c": 380.0}
    time = 2e-3 * np.arange(2001)
    tau = ((0.7 + 2.0 * np.sin(math.pi * time / 4) ** 2) * np.sin(7 * time))[:, None]
    for name, stiffness in truth.items():
        model = Dahl(1, [1.0, 0.4, stiffness]).requires_grad_(False)
        rest = torch.zeros(1, dtype=torch.float64)
        run = rollout(axis, model, rest, rest, torch.tensor(tau[:-1]), sample_time=2e-3)
        sessions[name] = Recording(time, COUNT * np.round(run.q.numpy() / COUNT), tau=tau, unit="m")
    found = fit_sessions(Dahl(1), axis, sessions, windows=(0.5,), fit_plant=False)
    spread = next(s for s in found.spreads if s.name == "sigma_0 of joint1")
    assert spread.mean == pytest.approx(310.0, rel=0.02)
    assert spread.between == pytest.approx(65.6, rel=0.1)


def test_inputs_without_a_defined_spread_are_refused():
    one = session(np.array([0.02, 0.006]))
    with pytest.raises(ValueError, match="at least 3 sessions, got 1"):
        fit_sessions(CVFM(1), PLANT, {"a": one})
    with pytest.raises(ValueError, match="constant coefficients only"):
        fit_sessions(NFCVFM(1), PLANT, dict.fromkeys("abc", one))


def test_intervals_cover_the_mean_and_the_next_session():
    rng = np.random.default_rng(1)
    mean_hit, next_hit, trials = 0, 0, 500
    for _ in range(trials):
        sd = rng.uniform(0.05, 0.3, 12)
        values = 1 + rng.normal(size=12) * 0.2 + rng.normal(size=12) * sd
        found = random_effects("x", values, sd)
        mean_hit += found.low < 1 < found.high
        next_hit += found.next_low < 1 + 0.2 * rng.normal() < found.next_high
    assert 0.92 <= mean_hit / trials <= 0.98
    assert 0.88 <= next_hit / trials <= 0.98


def test_without_spread_only_estimation_errors_count():
    rng = np.random.default_rng(0)
    sd = np.full(200, 0.1)
    found = random_effects("x", 1 + sd * rng.normal(size=200), sd)
    assert found.between < 0.05
    assert found.high - found.low == pytest.approx(2 * 1.97 * 0.1 / math.sqrt(200), rel=0.3)


def test_parameter_determined_in_few_sessions_has_no_interval():
    found = random_effects("x", np.ones(5), np.array([0.1, 0.1, *[math.inf] * 3]))
    assert math.isnan(found.mean)
    assert (found.next_low, found.next_high) == (-math.inf, math.inf)


@pytest.mark.slow
def test_fixed_coefficients_are_kept_in_the_mean_model():
    rng, sessions = np.random.default_rng(0), {}
    for k in range(3):
        one = session(np.array([0.02, 0.006]) * (1 + 0.1 * rng.normal(size=2)))
        sessions[f"day {k}"] = one
    model = Stribeck(1, [[0.02, 0.0, 0.006, 0.3, 1.5]], v_smooth=0.05)
    found = fit_sessions(model, PLANT, sessions, windows=(0.5,), drag=False)
    values = found.model.schedule.coefficient_sets()["always"][0]
    assert float(values[4]) == 1.5
    means = {s.name: s.mean for s in found.spreads}
    assert float(values[2]) == pytest.approx(means["F_v of joint1"])


def test_session_with_an_unusable_fit_is_excluded():
    sessions = {f"day {k}": session(np.array([0.02 + 1e-3 * k, 0.006])) for k in range(4)}
    sound = sessions["day 1"]
    # With reversed time, the motion gains energy.
    sessions["day 1"] = Recording(sound.time, sound.q[::-1], convention=sound.convention)
    found = fit_sessions(CVFM(1), PLANT, sessions, windows=(0.5,), drag=False)
    assert list(found.failed) == ["day 1"]
    assert found.failed["day 1"].startswith("do not use: ")
    assert {one.usability[0] for one in found.fits.values()} == {"good"}
    assert found.spreads[0].sessions == 3


def estimates(values: dict[str, float]) -> SessionFit:
    return SessionFit(values, dict.fromkeys(values, 0.1), 1e-4, "", ("good", ""), (), 1e-3)


@pytest.mark.parametrize("first", [0, 1, 4])
def test_terms_are_summarised_over_sessions_that_have_them(monkeypatch, first):
    some = {"F_c of joint1": 1.0, "F_v of joint1": 2.0}
    given = {"a": some | {"inertia": 1.0}, **dict.fromkeys("bcd", some), "e": some | {"drag": 3.0}}
    order = [*given][first:] + [*given][:first]
    monkeypatch.setattr(sessions_module, "_read", lambda *_: iter(()))
    monkeypatch.setattr(sessions_module, "_fit_session", lambda *a: estimates(given[a[2]]))
    found = fit_sessions("coulomb-viscous", PLANT, {k: k for k in order})
    counts = {s.name: s.sessions for s in found.spreads}
    assert counts == {**dict.fromkeys(some, 5), "inertia": 1, "drag": 1}
    assert found.model.schedule.parameter_vector().tolist() == pytest.approx([1.0, 2.0])
    assert found.model.v_smooth == 1e-3


def test_recording_of_several_sessions_is_refused():
    one = session(np.array([0.02, 0.006]))
    with pytest.raises(ValueError, match=r"of session a\) and 2 \(.* of session b\) contain"):
        fit_sessions(CVFM(1), PLANT, dict.fromkeys("abc", one))


def test_ctrl_c_keeps_the_sessions_that_were_fitted(monkeypatch):
    def fitted(*arguments):
        if arguments[2] == "d":
            raise KeyboardInterrupt
        return estimates({"F_c of joint1": 1.0, "F_v of joint1": 2.0})

    monkeypatch.setattr(sessions_module, "_read", lambda *_: iter(()))
    monkeypatch.setattr(sessions_module, "_fit_session", fitted)
    found = fit_sessions(CVFM(1), PLANT, {k: k for k in "abcd"})
    assert found.failed == {"d": "interrupted"}
