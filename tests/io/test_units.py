"""Units: every spelling is converted to SI, and nothing else is accepted as a unit."""

import math

import numpy as np
import pytest

from nfriction.io.formats.selection import is_unit, slides, to_si


@pytest.mark.parametrize(
    ("kind", "unit", "value"),
    [
        ("time", "s", 1.0),
        ("time", "[ms]", 1e-3),
        ("time", "µs", 1e-6),
        ("time", "us", 1e-6),
        ("q", "deg", math.pi / 180),
        ("q", "(°)", math.pi / 180),
        ("q", "rev", 2 * math.pi),
        ("q", "counts/8192", 2 * math.pi / 8192),
        ("q", "mm", 1e-3),
        ("qd", "rpm", 2 * math.pi / 60),
        ("qd", "deg/s", math.pi / 180),
        ("tau", "mNm", 1e-3),
        ("tau", "Nm", 1.0),
        ("tau", "[Nmm]", 1e-3),
        ("tau", "N mm", 1e-3),
        ("tau", "Ncm", 1e-2),
        ("tau", "kN", 1e3),
        ("time", "min", 60.0),
        ("q", "turns", 2 * math.pi),
        ("q", "[µm]", 1e-6),
        ("qd", "cm/s", 1e-2),
        ("tau", "N m", 1.0),
    ],
)
def test_units_are_converted_to_si(kind: str, unit: str, value: float) -> None:
    assert is_unit(unit)
    # Two roundings: the factor's and the quotient's.
    np.testing.assert_allclose(to_si(kind, np.array([1.0, -3.0]), unit), [value, -3 * value], 4e-16)


def test_milliseconds_are_exact() -> None:
    stamps = np.arange(5000)
    assert np.array_equal(to_si("time", stamps * 1.0, "ms"), [float(f"{k}e-3") for k in stamps])


@pytest.mark.parametrize(
    ("kind", "unit"),
    [("time", "deg"), ("q", "ms"), ("q", "deg/s"), ("qd", "counts/8192"), ("tau", "m"),
     ("q", "counts/0"), ("q", "counts/"), ("q", "gon"), ("q", "")],
)  # fmt: skip
def test_unit_of_another_quantity_is_refused(kind: str, unit: str) -> None:
    with pytest.raises(ValueError, match=f"is not a unit of {kind}; known units are"):
        to_si(kind, np.ones(2), unit)


def test_lengths_are_distinguished_from_angles() -> None:
    assert [u for u in ("m", "cm", "um", "[mm]", "deg", "rad", "counts/4") if slides(u)] == [
        "m", "cm", "um", "[mm]"]  # fmt: skip
