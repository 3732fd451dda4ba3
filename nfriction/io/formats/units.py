"""Units that a file's columns may be in, and the way to SI."""

from __future__ import annotations

import math
import re
import unicodedata

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TURN, _HALF_TURN_DEGREES = 2 * math.pi, 180 / math.pi
_ROTATION = {"rad": 1.0, "mrad": 1e3, "deg": _HALF_TURN_DEGREES, "rev": 1 / _TURN}
# How many of each unit make one of SI: values are divided, so that milliseconds stay exact.
_PER_SI: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9},
    "q": _ROTATION | {"m": 1.0, "mm": 1e3},
    "qd": {f"{unit}/s": per for unit, per in _ROTATION.items()}
    | {"rpm": 60 / _TURN, "m/s": 1.0, "mm/s": 1e3},
    "tau": {"N m": 1.0, "mN m": 1e3, "N": 1.0, "mN": 1e3},
}
_SPELLINGS = {
    "°": "deg", "°/s": "deg/s", "degree": "deg", "degrees": "deg", "degrees/s": "deg/s",
    "Grad": "deg", "Grad/s": "deg/s", "radian": "rad", "radians": "rad", "radians/s": "rad/s",
    "1/min": "rpm", "U/min": "rpm", "Nm": "N m", "N*m": "N m", "N.m": "N m", "mNm": "mN m",
    "sec": "s", "msec": "ms", "μs": "us",
}  # fmt: skip


def canonical_unit(text: str) -> str:
    """A unit's own spelling, whatever brackets and signs a file writes it with."""
    text = unicodedata.normalize("NFKC", text).strip().strip("[]()").strip()
    return _SPELLINGS.get(text, text)


def is_unit(text: str) -> bool:
    """Whether text is a unit of some column."""
    return any(_per_si(kind, canonical_unit(text)) is not None for kind in _PER_SI)


def slides(unit: str) -> bool:
    """Whether a position in this unit is that of a sliding joint."""
    return canonical_unit(unit) in ("m", "mm")


def to_si(kind: str, values: Array, unit: str) -> Array:
    """Values in SI.

    Args:
        kind: "time", "q", "qd" or "tau".
        values: any shape.
        unit: s, ms, us, ns; rad, mrad, deg, rev, counts/8192 (any count a revolution), m, mm; those
            per second, rpm; N m, mN m, N, mN.
    Raises:
        ValueError: no unit of that kind.
    """
    per = _per_si(kind, canonical_unit(unit))
    if per is None:
        known = ", ".join(_PER_SI[kind]) + (", counts/N" if kind == "q" else "")
        raise ValueError(f"{unit!r} is no unit of {kind}; known are {known}.")
    return values if per == 1.0 else values / per


def _per_si(kind: str, unit: str) -> float | None:
    counts = re.fullmatch(r"counts?/([1-9][0-9]{0,11})", unit)
    if counts and kind == "q":
        return int(counts[1]) / _TURN
    return _PER_SI[kind].get(unit)
