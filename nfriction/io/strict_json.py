"""JSON by its standard: every number is finite."""

import json
import math
from collections.abc import Callable, Sequence
from typing import Any


def parse(
    text: str | bytes, pairs_hook: Callable[[list[tuple[str, Any]]], dict[str, Any]] | None = None
) -> Any:
    """Parse JSON text.

    Args:
        text: JSON.
        pairs_hook: as `object_pairs_hook` of `json.loads`.

    Raises:
        ValueError: no JSON, cut short, or with a number that is not finite or beyond all floats.
        RecursionError: nested too deeply.
    """
    return json.loads(
        text, parse_constant=_finite, parse_float=_finite, parse_int=_whole,
        object_pairs_hook=pairs_hook,
    )  # fmt: skip


def numbers(name: str, given: Any, words: Sequence[str] = ()) -> Any:
    """Nested lists of floats, or one float, of nested lists of numbers.

    Args:
        name: of the entry, for errors.
        given: parsed JSON.
        words: that count as numbers too, such as "nan".

    Raises:
        ValueError: anything else is among them, such as true and false.
    """
    if isinstance(given, (list, tuple)):
        return [numbers(name, x, words) for x in given]
    # To Python true is a number.
    if isinstance(given, bool) or not (isinstance(given, (int, float)) or given in words):
        raise ValueError(f"`{name}` must be numbers, got {str(given)[:40]!r}.")
    try:
        return float(given)
    except OverflowError:
        raise ValueError(f"`{name}` is too large: {str(given)[:40]}.") from None


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"numbers must be finite, got {text[:40]}.")
    return value


def _whole(text: str) -> int:
    _finite(text)  # arithmetic with floats would overflow on a larger one
    return int(text)
