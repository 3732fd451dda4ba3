"""Suspicious recordings raise warnings, and valid ones none."""

from dataclasses import replace

import numpy as np
import pytest

from nfriction import CVFM, LFM, NFLFM, PendulumChain, Recording, Rotor, fit
from nfriction.fitting.options import FitOptions
from nfriction.fitting.task import prepare_task
from tests.fitting.recordings import COUNTS, pendulum, swing

COUNT = 2 * np.pi / COUNTS
MODEL = LFM(2, [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]], v_smooth=0.05)


def data_warnings_of(plant: PendulumChain, *recordings: Recording) -> tuple[str, ...]:
    return prepare_task(LFM(plant.joints), plant, recordings, FitOptions()).data_warnings


def as_plant_says(recording: Recording) -> Recording:
    """The same columns without a convention."""
    return Recording(recording.time, recording.q, name=recording.name)


@pytest.mark.parametrize("zero", ["hanging", "upright"])
@pytest.mark.parametrize("start", [(1.6, 0.8), (3.1, 0.02)])
def test_free_swing_determines_the_zero_of_its_angles(zero, start):
    recording = as_plant_says(
        swing(pendulum(), MODEL, seconds=1.0, start=start, convention=f"absolute,{zero}")
    )
    other = {"hanging": "upright", "upright": "hanging"}[zero]
    assert data_warnings_of(pendulum(convention=("absolute", zero)), recording) == ()
    (warning,) = data_warnings_of(pendulum(convention=("absolute", other)), recording)
    assert f"measured from {zero}, not from {other}" in warning
    assert "`convention`" in warning


def test_fit_repeats_the_warning_once_with_either_method():
    recording = as_plant_says(swing(pendulum(), MODEL, seconds=1.0, convention="absolute,hanging"))
    plant = pendulum(convention=("absolute", "upright"))
    for settings in ({"method": "equation_error"}, {"windows": (0.5,), "max_steps": 1}):
        found = fit(LFM(2), plant, recording, **settings)
        assert sum("measured from hanging" in warning for warning in found.warnings) == 1


def resting(counts: int, **settings) -> tuple[PendulumChain, Recording]:
    """A double pendulum at rest except for a flicker of its second encoder."""
    time = np.arange(1000) * 2e-3
    q = np.zeros((1000, 2))
    q[::50, 1] = counts * COUNT
    plant = pendulum(convention=("relative", "hanging"), **settings)
    return plant, Recording(time, q, name="rest")


@pytest.mark.parametrize("quantum", [None, COUNT])
def test_joints_that_do_not_move_are_named(quantum):
    still, flickers = data_warnings_of(*resting(1, position_quantum=quantum))
    assert still.startswith("joint1 never moves")
    assert "joint2 moves by 0.000767 rad, 1 of its encoder's counts" in flickers
    (still,) = data_warnings_of(*resting(10, position_quantum=COUNT))
    assert still.startswith("joint1 never moves")


@pytest.mark.parametrize(("factor", "named"), [(1.0, False), (0.25, False), (4.0, True)])
def test_stated_resolution_coarser_than_the_positions_is_named(factor, named):
    recording = swing(pendulum(), MODEL, seconds=1.0)
    warned = data_warnings_of(pendulum(position_quantum=factor * COUNT), recording)
    assert any("less than the `position_quantum` of 0.00307" in t for t in warned) is named
    assert len(warned) == named


def test_resolution_that_differs_between_recordings_is_named():
    first = swing(pendulum(), MODEL, seconds=1.0)
    # The second joint rests, and shows no count.
    still = replace(first, q=first.q * [1.0, 0.0], name="still")
    assert not any("changes by" in text for text in data_warnings_of(pendulum(), first, still))
    degrees = replace(first, q=np.deg2rad(first.q), name="degrees")
    warned = data_warnings_of(pendulum(), first, degrees)
    assert [text.split(", with")[0] for text in warned if "wrong unit" in text] == [
        f"joint{j} changes by 1.34e-05 rad in degrees, by at least 0.000767 in another: with the "
        "same encoder one of the two is in a wrong unit; read each recording with its own."
        for j in (1, 2)
    ]


def test_a_joint_that_moves_in_one_recording_is_not_named():
    plant, rest = resting(0)
    moving = swing(pendulum(), MODEL, seconds=1.0, convention="relative,hanging")
    assert data_warnings_of(plant, rest, moving) == ()


@pytest.mark.parametrize(("stretch", "named"), [(1.02, 1), (1.0005, 0), (2.0, 0)])
def test_slightly_different_clocks_are_named(stretch, named):
    first = swing(pendulum(), MODEL, seconds=1.0, convention="relative,hanging", name="one")
    other = Recording(stretch * first.time, first.q, name="two", convention="relative,hanging")
    # A third recording with a chosen sample rate hides nothing.
    slow = Recording(10 * first.time, first.q, name="slow", convention="relative,hanging")
    found = data_warnings_of(pendulum(convention=("relative", "hanging")), first, other, slow)
    clocks = [w for w in found if "two has a sample every 2.04 ms, one every 2 ms" in w]
    assert len(clocks) == named


def test_neuro_fuzzy_coefficients_need_some_motion():
    plant, rest = resting(3)
    with pytest.raises(ValueError, match=r"joint1 never moves in rest.*record it moving"):
        fit(NFLFM(2), plant, rest)


def test_locked_joint_is_named_despite_round_off():
    turning = np.sin(5 * 1e-3 * np.arange(1000))
    locked = Recording(1e-3 * np.arange(1000), np.stack([turning, turning + 0.3], 1), name="l",
                       convention="absolute,hanging")  # fmt: skip
    plant = pendulum()
    assert np.ptp(locked.joint_coordinates(plant).q[:, 1]) > 0
    (still,) = (text for text in data_warnings_of(plant, locked) if "moves" in text)
    assert still.startswith("joint2 never moves")
    with pytest.raises(ValueError, match="joint2 never moves"):
        fit(NFLFM(2), plant, locked)


def test_fit_refuses_a_motionless_recording():
    plant, rest = resting(0)
    found = fit(LFM(2), plant, rest, windows=(0.5,), fit_plant=False)
    assert found.residual < 1e-12
    lost = set(" with ".join(found.unidentifiable).split(" with "))
    assert lost == {f"{c} of joint{j}" for c in "BC" for j in (1, 2)}
    assert any("joint2 never moves" in text for text in found.warnings)


def test_zero_residual_raises_no_warning():
    plant = PendulumChain([0.4], [0.4], convention=("absolute", "hanging"))
    rest = Recording(np.arange(1000) * 2e-3, np.zeros((1000, 1)))
    found = fit(CVFM(1), plant, rest, windows=(0.5,), drag=False)
    assert found.residual == 0
    assert {"F_c of joint1", "F_v of joint1", "inertia 11"} < set(found.unidentifiable)


def test_fit_refuses_a_flickering_encoder():
    time = np.arange(2000) * 2e-3
    q = COUNT * (np.random.default_rng(0).random(2000) < 0.5)
    plant = PendulumChain([0.4], [0.4], convention=("absolute", "hanging"))
    found = fit(CVFM(1), plant, Recording(time, q[:, None]), windows=(0.5, 2.0), drag=False)
    assert {"F_c of joint1", "F_v of joint1"} <= set(
        " with ".join(found.unidentifiable).split(" with ")
    )


@pytest.mark.parametrize("method", ["output_error", "equation_error"])
def test_friction_of_a_joint_that_never_moves_is_unidentifiable(method):
    """The smoothed sign of a simulation creeps, which looks like information."""
    time = 2e-3 * np.arange(1500)
    tau = 0.25 * np.sin(3.0 * time)[:, None]
    held = Recording(time, np.zeros((1500, 1)), tau, name="held")
    found = fit("coulomb-viscous", Rotor(inertia=0.05), held, windows=(0.5,), method=method)
    assert {"F_c of joint1", "F_v of joint1"} <= {*found.unidentifiable}
    assert found.usability[0] != "good"
