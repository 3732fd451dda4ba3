"""A user's own mechanism as a small JSON or TOML file.

The keys are the constructor arguments of `PendulumChain` (kind "chain", the default) or
`LinearAxis` (kind "axis"), SI units:

    {"kind": "chain", "name": "bench", "mass": [0.26, 0.12], "length": [0.17, 0.23],
     "com": [0.16, 0.18], "inertia": [1e-4, 1.7e-4], "convention": ["absolute", "hanging"],
     "position_quantum": 1.571e-4}

Only `mass` and, for a chain, `length` are required. `buffers` may hold values that take the place
of derived constants, such as `{"drag_quadratic": [0.01, 0.01]}`; a fitted plant is written so.
"""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nfriction.plant.axis import LinearAxis
from nfriction.plant.chain import PendulumChain

_KINDS: dict[str, type[PendulumChain] | type[LinearAxis]] = {
    plant.kind: plant for plant in (PendulumChain, LinearAxis)
}


def from_dict(data: Mapping[str, Any]) -> PendulumChain | LinearAxis:
    """The plant of a `to_dict`, whichever its kind.

    Raises:
        ValueError: for an unknown kind, missing or unknown keys, or impossible values.
    """
    kind = data.get("kind", "chain")
    if kind not in _KINDS:
        raise ValueError(f"rig: no kind {kind!r}; there are {sorted(_KINDS)}.")
    return _KINDS[kind].from_dict(data)


def read(path: str | Path) -> PendulumChain | LinearAxis:
    """Read a rig file (.json, or .toml from Python 3.11 on).

    Raises:
        ValueError: for another ending, a file that does not parse, or parameters that
            `from_dict` refuses; the message names the file.
        OSError: where the file cannot be read.
    """
    path = Path(path)
    text = path.read_text(encoding="utf-8")
    try:
        data = _parse(text, path.suffix.lower())
        if not isinstance(data, dict):
            raise ValueError("a rig file holds one table of keys and values.")
        return from_dict(data)
    except ValueError as error:  # JSON and TOML errors are ValueErrors too
        raise ValueError(f"{path}: {error}") from error


def write(plant: PendulumChain | LinearAxis, path: str | Path) -> None:
    """Write a plant, fitted buffers included, as JSON that `read` takes.

    Raises:
        ValueError: for an ending other than .json.
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        raise ValueError(f"a rig is written as .json, got {path.name!r}.")
    path.write_text(json.dumps(plant.to_dict(), indent=2) + "\n", encoding="utf-8")


def _parse(text: str, suffix: str) -> Any:
    if suffix == ".json":
        return json.loads(text)
    if suffix != ".toml":
        raise ValueError(f"a rig file ends in .json or .toml, not {suffix!r}.")
    if sys.version_info < (3, 11):
        raise ValueError("reading .toml needs Python 3.11 or newer; write the rig as .json.")
    import tomllib

    return tomllib.loads(text)
