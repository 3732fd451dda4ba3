"""Angle conventions of recordings, and their conversion to joint coordinates and back.

Joint coordinates: the first link's angle from upright (0 is up), every further link's angle
relative to the previous link. A free arm's angle about the vertical comes first and has no
convention.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, Protocol, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike

from nfriction.recording.validation import Array

Angles = Literal["relative", "absolute"]
MeasuredFrom = Literal["upright", "hanging"]
_WORDS = {*get_args(Angles), *get_args(MeasuredFrom)}


class Mechanism(Protocol):
    """The convention and unit of a mechanism's encoders, which every plant has."""

    @property
    def convention(self) -> Sequence[str]: ...

    @property
    def first_link(self) -> int: ...

    @property
    def unit(self) -> str: ...

    @property
    def motor_factors(self) -> Mapping[str, Sequence[float]]: ...


@dataclass(frozen=True)
class AngleConvention:
    """A convention of joint positions; the default is the library's joint coordinates.

    Angles are not wrapped or unwrapped. Torques are joint torques in every convention.

    Args:
        angles: of every link, relative to the previous link, or absolute, from the vertical.
        measured_from: zero of the angles from the vertical.
    """

    angles: Angles = "relative"
    measured_from: MeasuredFrom = "upright"

    def __post_init__(self) -> None:
        for field, choices in zip(fields(self), (Angles, MeasuredFrom), strict=True):
            value = getattr(self, field.name)
            if value not in get_args(choices):
                valid = " or ".join(map(repr, get_args(choices)))
                raise ValueError(f"`{field.name}` must be {valid}, got {value!r}.")

    @classmethod
    def of(cls, given: ConventionLike) -> AngleConvention:
        """Convention of a plant, or from words such as "absolute,hanging" or "relative-upright".

        Words come in one or several strings, in any order; an omitted one takes its default.

        Raises:
            ValueError: an unknown or repeated word, or any other value.
        """
        # By attribute, because recordings must not import plants.
        found = getattr(given, "convention", given)
        if isinstance(found, cls):
            return found
        parts = [found] if isinstance(found, str) else found
        if isinstance(parts, Sequence) and all(isinstance(part, str) for part in parts):
            words = re.split(r"[\s,;/_+-]+", ",".join(parts).strip().lower())
            # The two vocabularies share no word, so that the order does not matter.
            settings: dict[str, Any] = {
                "angles" if word in get_args(Angles) else "measured_from": word for word in words
            }
            if len(settings) == len(words) and set(words) <= _WORDS:
                return cls(**settings)
        raise ValueError(
            "`convention` must be one of relative, absolute and one of upright, hanging, such as "
            "['absolute', 'hanging'] or, of a recording, 'absolute,hanging', an AngleConvention, "
            f"or a plant that has one; got {given!r}."
        )

    def __str__(self) -> str:
        return f"{self.angles},{self.measured_from}"

    def position_to_joint(self, q: ArrayLike, first_link: int = 0) -> Array:
        """Joint coordinates [rad] of positions in this convention.

        Args:
            q: positions [rad], joints on the last axis.
            first_link: column of the first link; columns before it (a free arm) are unchanged.
        """
        joint = self.rate_to_joint(q, first_link)
        # The zero cancels in the differences of absolute angles.
        joint[..., first_link : first_link + 1] += self._first_zero
        return joint

    def position_from_joint(self, q: ArrayLike, first_link: int = 0) -> Array:
        """Positions in this convention [rad] of joint coordinates; undoes `position_to_joint`."""
        q = _links(q, first_link)
        q[..., first_link : first_link + 1] -= self._first_zero
        return self.rate_from_joint(q, first_link)

    def rate_to_joint(self, qd: ArrayLike, first_link: int = 0) -> Array:
        """Joint rates of rates (velocities or accelerations) in this convention."""
        qd = _links(qd, first_link)
        if self.angles == "absolute":
            # The first link has no previous link, so that absolute and relative agree.
            qd[..., first_link + 1 :] = np.diff(qd[..., first_link:], axis=-1)
        return qd

    def rate_from_joint(self, qd: ArrayLike, first_link: int = 0) -> Array:
        """Rates in this convention of joint rates; undoes `rate_to_joint`."""
        qd = _links(qd, first_link)
        if self.angles == "absolute":
            qd[..., first_link:] = np.cumsum(qd[..., first_link:], axis=-1)
        return qd

    @property
    def _first_zero(self) -> float:
        """The first angle's zero as an angle from upright [rad]."""
        return math.pi if self.measured_from == "hanging" else 0.0


ConventionLike: TypeAlias = AngleConvention | str | Sequence[str] | Mechanism


def _links(q: ArrayLike, first_link: int) -> Array:
    """A copy of `q`, checked to have a link at `first_link`."""
    q = np.array(q, dtype=np.float64)
    if q.ndim == 0 or not 0 <= first_link < q.shape[-1]:
        raise ValueError(
            f"`first_link` must be a column of `q`, got {first_link} for shape {q.shape}; "
            f"it is 0, or 1 where column 0 is a free arm."
        )
    return q
