"""JSON as its standard has it: every number is finite."""

import json
import math
from collections.abc import Callable
from typing import Any


def parse(
    text: str | bytes, pairs_hook: Callable[[list[tuple[str, Any]]], dict[str, Any]] | None = None
) -> Any:
    """What JSON text says.

    Args:
        text: to be read.
        pairs_hook: makes a mapping of an object's names and values; see `json.loads`.

    Raises:
        ValueError: if it is no JSON, cut short, or holds a number that is not finite.
        RecursionError: if it is nested too deeply.
    """
    return json.loads(
        text, parse_constant=_refuse, parse_float=_finite, object_pairs_hook=pairs_hook
    )


def _refuse(name: str) -> float:
    raise ValueError(f"numbers must be finite, got {name}.")


def _finite(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        raise ValueError(f"numbers must be finite, {text[:40]} is beyond all of them.")
    return value
