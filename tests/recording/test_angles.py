"""Angle conventions: exact round trips, consistent geometry, clear errors."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from nfriction.recording.angles import AngleConvention

CONVENTIONS = [
    AngleConvention(angles, zero)
    for angles in ("relative", "absolute")
    for zero in ("upright", "hanging")
]
positions = arrays(np.float64, (5, 4), elements=st.floats(-50, 50))


@given(q=positions, convention=st.sampled_from(CONVENTIONS), first_link=st.sampled_from([0, 1]))
def test_conversions_are_inverse(
    q: np.ndarray, convention: AngleConvention, first_link: int
) -> None:
    # Four additions of numbers below 200: a few of their rounding errors.
    close = {"rtol": 0, "atol": 1e-13}
    there = convention.position_to_joint(q, first_link)
    np.testing.assert_allclose(convention.position_from_joint(there, first_link), q, **close)
    back = convention.position_from_joint(q, first_link)
    np.testing.assert_allclose(convention.position_to_joint(back, first_link), q, **close)
    rate = convention.rate_to_joint(q, first_link)
    np.testing.assert_allclose(convention.rate_from_joint(rate, first_link), q, **close)


@given(q=positions)
def test_default_convention_changes_nothing(q: np.ndarray) -> None:
    convention = AngleConvention()
    assert np.array_equal(convention.position_to_joint(q), q)
    assert np.array_equal(convention.rate_to_joint(q), q)


@given(q=positions, convention=st.sampled_from(CONVENTIONS))
def test_columns_before_the_first_link_are_unchanged(
    q: np.ndarray, convention: AngleConvention
) -> None:
    assert np.array_equal(convention.position_to_joint(q, 1)[:, 0], q[:, 0])
    assert np.array_equal(
        convention.position_to_joint(q, 1)[:, 1:], convention.position_to_joint(q[:, 1:])
    )


@pytest.mark.parametrize("convention", CONVENTIONS, ids=str)
def test_every_convention_describes_the_same_mechanism(convention: AngleConvention) -> None:
    """Tip of a chain of unit links, from each convention's definition and from joint angles."""
    written = np.random.default_rng(1).uniform(-3, 3, (20, 3))
    absolute = np.cumsum(written, axis=1) if convention.angles == "relative" else written
    up = -1.0 if convention.measured_from == "hanging" else 1.0
    tip = up * np.stack([np.sin(absolute).sum(1), np.cos(absolute).sum(1)])
    from_upright = np.cumsum(convention.position_to_joint(written), axis=1)
    expected = np.stack([np.sin(from_upright).sum(1), np.cos(from_upright).sum(1)])
    np.testing.assert_allclose(tip, expected, atol=1e-13)


def test_rates_are_the_derivative_of_positions() -> None:
    rng = np.random.default_rng(2)
    q, qd = rng.normal(size=(2, 3))
    step = 1e-6
    for convention in CONVENTIONS:
        ahead, behind = (convention.position_to_joint(q + s * step * qd) for s in (1, -1))
        difference = (ahead - behind) / (2 * step)
        # Rounding of positions near 3 over 2e-6 s.
        np.testing.assert_allclose(convention.rate_to_joint(qd), difference, atol=2e-9)


def test_argument_is_not_modified() -> None:
    q = np.ones((2, 3))
    AngleConvention("absolute", "hanging").position_to_joint(q)
    AngleConvention("absolute", "hanging").position_from_joint(q)
    assert np.array_equal(q, np.ones((2, 3)))


@pytest.mark.parametrize("convention", CONVENTIONS, ids=str)
def test_text_round_trip_is_exact(convention: AngleConvention) -> None:
    assert AngleConvention.of(str(convention)) == convention
    swapped = f" {convention.measured_from}-{convention.angles.upper()} "
    assert AngleConvention.of(swapped) == convention


def test_omitted_words_have_defaults() -> None:
    assert AngleConvention.of("hanging") == AngleConvention("relative", "hanging")
    assert AngleConvention.of("absolute") == AngleConvention("absolute", "upright")


@pytest.mark.parametrize("text", ["", "sideways", "absolute,relative", "hanging hanging"])
def test_bad_text_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"one of upright, hanging.*got"):
        AngleConvention.of(text)


def test_bad_fields_are_refused() -> None:
    with pytest.raises(ValueError, match="'relative' or 'absolute', got 'polar'"):
        AngleConvention("polar")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="`first_link` must be a column"):
        AngleConvention().position_to_joint(np.zeros((4, 1)), first_link=1)


@pytest.mark.parametrize("convention", CONVENTIONS, ids=str)
def test_every_form_of_a_convention_is_accepted(convention: AngleConvention) -> None:
    class Plant:
        first_link = 0

    plant = Plant()
    plant.convention = (convention.angles, convention.measured_from)  # type: ignore[attr-defined]
    for form in (convention, str(convention), str(convention).split(","), plant):
        assert AngleConvention.of(form) == convention  # type: ignore[arg-type]


@pytest.mark.parametrize("given", [None, 3, "", (), [1, 2], {"absolute": "hanging"}, b"absolute"])
def test_objects_without_a_convention_are_refused(given: object) -> None:
    with pytest.raises(ValueError, match="`convention` must be one of"):
        AngleConvention.of(given)  # type: ignore[arg-type]
