"""Strict readers of the entries of a results file; what does not fit is told in words."""

from collections.abc import Callable
from typing import Any, TypeVar

LARGEST_NUMBER = 10**100

T = TypeVar("T")


class UnfitError(ValueError):
    """What is wrong with an entry."""


def mapping(value: object, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise UnfitError(f"{where} must be an object")
    return value


def mapped(value: object, where: str, of: Callable[[Any, str], T]) -> dict[str, T]:
    return {key: of(entry, f"{where}, {key}") for key, entry in mapping(value, where).items()}


def text(value: object, where: str) -> str:
    if not isinstance(value, str):
        raise UnfitError(f"{where} must be text")
    return value


def texts(value: object, where: str) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise UnfitError(f"{where} must be a list of texts")
    return tuple(text(v, where) for v in value)


def number(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise UnfitError(f"{where} must be a number")
    # Squares of what is shown stay finite; an int may be too large for a comparison with floats.
    if abs(value) > LARGEST_NUMBER:
        raise UnfitError(f"{where} is too large a number")
    return float(value)


def seconds(given: str, where: str) -> float:
    try:
        return float(given)
    except ValueError:
        raise UnfitError(f"{where} has windows of {given!r} seconds") from None
