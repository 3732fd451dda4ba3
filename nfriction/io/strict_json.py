"""JSON by its standard: every number is finite."""

import json
import math
from collections.abc import Callable
from typing import Any


def parse(
    text: str | bytes, pairs_hook: Callable[[list[tuple[str, Any]]], dict[str, Any]] | None = None
) -> Any:
    """Parse JSON text.

    Args:
        text: JSON.
        pairs_hook: as `object_pairs_hook` of `json.loads`.

    Raises:
        ValueError: no JSON, cut short, or with a number that is not finite.
        RecursionError: nested too deeply.
    """
    return json.loads(
        text, parse_constant=_finite, parse_float=_finite, object_pairs_hook=pairs_hook
    )


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"numbers must be finite, got {text[:40]}.")
    return value
