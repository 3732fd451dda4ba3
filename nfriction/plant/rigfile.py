"""A user's own mechanism as a small JSON or TOML file, or a robot description (URDF, MJCF).

The keys are the constructor arguments of `PendulumChain` (kind "chain", the default) or
`LinearAxis` (kind "axis"), SI units:

    {"kind": "chain", "name": "bench", "mass": [0.26, 0.12], "length": [0.17, 0.23],
     "com": [0.16, 0.18], "inertia": [1e-4, 1.7e-4], "convention": ["absolute", "hanging"],
     "position_quantum": 1.571e-4}

Only `mass` and, for a chain, `length` are required; angles of a chain without a `convention` are
relative, from upright. `buffers` may hold values that take the place of derived constants, such as
`{"drag_quadratic": [0.01, 0.01]}`; a fitted plant is written so.
"""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nfriction.io import strict_json
from nfriction.io.atomic import write_atomically
from nfriction.plant import robot_file
from nfriction.plant.axis import LinearAxis
from nfriction.plant.base import Plant
from nfriction.plant.chain import PendulumChain

_KINDS: dict[str, type[PendulumChain] | type[LinearAxis]] = {
    plant.kind: plant for plant in (PendulumChain, LinearAxis)
}
# Far beyond any rig; the memory of a chain's matrices grows with the square of its links.
LARGEST_FILE, MOST_LINKS, LARGEST_NUMBER = 2**20, 100, 1e30
_TEXTS, _LISTS_OF_TEXT, _TABLES = (
    ("kind", "name"),
    ("convention", "joint_names"),
    ("arm", "buffers"),
)
_MAY_BE_NULL = ("com", "inertia", "arm", "armature", "joint_names", "position_quantum")


def from_dict(data: Mapping[str, Any]) -> Plant:
    """The plant of a `to_dict`, whichever its kind.

    Raises:
        ValueError: for an unknown kind, missing or unknown keys, or impossible values.
    """
    for key, value in data.items():
        _check_entry(key, value)
    kind = data.get("kind", "chain")
    if kind not in _KINDS:
        raise ValueError(f"rig: no kind {_short(kind)}; there are {sorted(_KINDS)}.")
    try:
        return _KINDS[kind].from_dict(data)
    except RuntimeError as error:  # torch, of shapes that do not fit
        raise ValueError(f"its values do not fit together ({_short(error)}).") from error


def read(path: str | Path) -> Plant:
    """Read a rig file: .json, .toml from Python 3.11 on, .urdf, or .xml (MJCF or URDF).

    Raises:
        ValueError: for another ending, a file that does not parse, or parameters that
            `from_dict` refuses; the message names the file.
        OSError: where the file cannot be read.
        ImportError: for an MJCF where MuJoCo is not installed.
    """
    path = Path(path)
    if path.suffix.lower() in robot_file.ENDINGS:
        try:
            return robot_file.read_robot(path)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    if path.is_file() and path.stat().st_size > LARGEST_FILE:
        raise ValueError(f"{path}: rig files are at most {LARGEST_FILE} bytes.")
    content = path.read_bytes()
    try:
        data = _parse(content.decode(), path.suffix.lower())
        if not isinstance(data, dict):
            raise ValueError("a rig file holds one table of keys and values.")
        return from_dict(data)
    except RecursionError:
        raise ValueError(f"{path}: nested too deeply for a rig.") from None
    except ValueError as error:  # those of JSON, TOML and Unicode too
        raise ValueError(f"{path}: {_short(error)}") from error


def write(plant: Plant, path: str | Path) -> None:
    """Write a plant, fitted buffers included, as JSON that `read` takes; whole or not at all.

    Raises:
        ValueError: for an ending other than .json.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        raise ValueError(f"a rig is written as .json, got {path.name!r}.")
    write_atomically(path, (json.dumps(plant.to_dict(), indent=2) + "\n").encode())


def _check_entry(key: str, value: Any) -> None:
    """Refuse an entry of the wrong type, before it is taken for numbers or names."""
    if value is None and key in _MAY_BE_NULL:
        return
    if key in _TEXTS:
        sound, wanted = isinstance(value, str), "text"
    elif key in _LISTS_OF_TEXT:
        sound = isinstance(value, (list, tuple)) and all(isinstance(v, str) for v in value)
        wanted = "a list of texts"
    elif key in _TABLES:
        sound, wanted = isinstance(value, Mapping), "a table"
        for name, numbers in value.items() if sound else ():
            _check_entry(f"{key}.{name}", numbers)
    else:
        sound, wanted = _are_numbers(value), f"finite numbers, at most {MOST_LINKS} in a row"
    if not sound:
        raise ValueError(f"`{key[:100]}` must be {wanted}, got {_short(value)}.")


def _are_numbers(value: Any, depth: int = 0) -> bool:
    """Whether a value is a finite number, or a list or matrix of such."""
    if isinstance(value, (list, tuple)):
        alike = len({isinstance(v, (list, tuple)) for v in value}) < 2
        small = len(value) <= MOST_LINKS and depth < 2
        return alike and small and all(_are_numbers(v, depth + 1) for v in value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) <= LARGEST_NUMBER  # false of NaN


def _short(value: object) -> str:
    text = str(value) if isinstance(value, Exception) else repr(value)
    return text if len(text) <= 300 else f"{text[:297]}..."


def _parse(text: str, suffix: str) -> Any:
    if suffix == ".json":
        return strict_json.parse(text)
    if suffix != ".toml":
        raise ValueError(f"a rig file ends in .json or .toml, .urdf or .xml, not {suffix!r}.")
    if sys.version_info < (3, 11):
        raise ValueError("reading .toml needs Python 3.11 or newer; write the rig as .json.")
    import tomllib

    return tomllib.loads(text)
