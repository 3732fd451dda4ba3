"""What looks wrong about a recording is said, and of a sound one nothing."""

import numpy as np
import pytest

from nfriction import LFM, PendulumChain, Recording, fit
from nfriction.fitting.misgivings import misgivings
from nfriction.signals import kalman_smoother
from tests.fitting.recordings import pendulum, swing

MODEL = LFM(2, [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]], v_smooth=0.05)


def said(plant: PendulumChain, *recordings: Recording) -> tuple[str, ...]:
    joint = [r.joint_coordinates(plant) for r in recordings]
    motions = [kalman_smoother(r.time, r.q) for r in joint]
    return misgivings(plant, recordings, joint, motions)


def as_plant_says(recording: Recording) -> Recording:
    """The same columns without a word on how they are written."""
    return Recording(recording.time, recording.q, name=recording.name)


@pytest.mark.parametrize("zero", ["hanging", "upright"])
@pytest.mark.parametrize("start", [(1.6, 0.8), (3.1, 0.02)])
def test_a_free_swing_tells_which_zero_its_angles_have(zero, start):
    recording = as_plant_says(
        swing(pendulum(), MODEL, seconds=1.0, start=start, convention=f"absolute,{zero}")
    )
    other = {"hanging": "upright", "upright": "hanging"}[zero]
    assert said(pendulum(convention=("absolute", zero)), recording) == ()
    (told,) = said(pendulum(convention=("absolute", other)), recording)
    assert f"measured from {zero}, not from {other}" in told
    assert "`convention`" in told


def test_what_a_torque_may_hold_up_is_not_judged():
    hanging = swing(pendulum(), MODEL, seconds=1.0, convention="absolute,hanging")
    held = Recording(hanging.time, hanging.q, tau=np.full(hanging.q.shape, 0.1))
    assert said(pendulum(convention=("absolute", "upright")), held) == ()


def test_a_fit_says_it_once_and_by_either_method():
    recording = as_plant_says(swing(pendulum(), MODEL, seconds=1.0, convention="absolute,hanging"))
    plant = pendulum(convention=("absolute", "upright"))
    for settings in ({"method": "torque"}, {"windows": (0.5,), "max_steps": 1}):
        found = fit(LFM(2), plant, recording, **settings)
        assert sum("measured from hanging" in told for told in found.warnings) == 1
