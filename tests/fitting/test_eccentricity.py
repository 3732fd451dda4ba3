"""Encoder eccentricity is fitted only if a recording contains information about it."""

import pytest
import torch

from nfriction import LFM, LinearAxis, fit
from tests.fitting.recordings import F64, driven_axis, one_link, pendulum, swing

V_SMOOTH = 0.05
SETTINGS = {"windows": (0.5, 1.0), "drag": False, "eccentricity": "auto"}


def model(initial=None):
    return LFM(2, initial, v_smooth=V_SMOOTH)


def recorded(size, seconds=3.0):
    truth = model([[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]])
    turned = pendulum().replace(
        encoder_cosine=torch.tensor([size, -size], dtype=F64),
        encoder_sine=torch.tensor([-size, size / 2], dtype=F64),
    )
    return swing(turned, truth, seconds=seconds)


def encoder_terms(found):
    return {name: value for name, value, _ in found.plant_terms if name.startswith("encoder")}


@pytest.mark.slow
def test_eccentricity_is_detected_and_recovered():
    found = fit(model(), pendulum(), recorded(3e-3), **SETTINGS)
    terms = encoder_terms(found)
    expected = {
        "encoder cosine 1 [rad]": 3e-3, "encoder sine 1 [rad]": -3e-3,
        "encoder cosine 2 [rad]": -3e-3, "encoder sine 2 [rad]": 1.5e-3,
    }  # fmt: skip
    assert terms.keys() == expected.keys()
    intervals = {i.name: i for i in found.intervals}
    for name, value in expected.items():
        # Twice the half-width: four intervals of 95 % each.
        half = (intervals[name].high - intervals[name].low) / 2
        assert abs(terms[name] - value) < 2 * half + 1e-4
    # A fit that starts from one with these terms has them too.
    again = fit(model(), pendulum(), recorded(3e-3), start=found, **SETTINGS)
    assert encoder_terms(again).keys() == expected.keys()


@pytest.mark.slow
def test_centred_encoders_get_no_eccentricity():
    recording = recorded(0.0)
    assert not encoder_terms(fit(model(), pendulum(), recording, **SETTINGS))


def test_option_decides_whether_eccentricity_is_fitted():
    plant = one_link()
    recording = swing(plant, LFM(1, [1.5e-3, 2.5e-3], v_smooth=V_SMOOTH), seconds=1.0)
    quick = {"windows": (0.5,), "max_steps": 1, "drag": False}
    for asked, terms in (("on", 2), ("off", 0)):
        found = fit(LFM(1, v_smooth=V_SMOOTH), plant, recording, eccentricity=asked, **quick)
        assert len(encoder_terms(found)) == terms
    axis = LinearAxis(2.0)
    one = driven_axis(axis, LFM(1, [3.0, 1.0], v_smooth=V_SMOOTH), seconds=0.5)
    with pytest.raises(ValueError, match="no encoders that turn"):
        fit(LFM(1, v_smooth=V_SMOOTH), axis, one, eccentricity="on", **quick)
