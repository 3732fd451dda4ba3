"""Content of a model file, checked for form, size and damage before anything is made of it."""

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nfriction.io import strict_json
from nfriction.io.model_info import FORMAT, SCHEMA

# A neuro-fuzzy model of ten joints takes less than a megabyte.
LARGEST_FILE = 64 * 2**20
MOST_JOINTS, DEEPEST = 1000, 32


class ModelFileError(ValueError):
    """A model file is absent, damaged or not one of ours."""


# Type of every entry, by key.
ENTRIES: dict[str, type | tuple[type, ...]] = {
    "model": str,
    "law": str,
    "joints": int,
    "v_smooth": float,
    "options": dict,
    "coefficients": list,
    "parameter_hash": str,
    "joint_names": list,
    "unit": str,
    "sample_time": (float, int, type(None)),
    "input_ranges": dict,
    "training_data": dict,
    "rig": (dict, type(None)),
    "fit": dict,
    "state": dict,
    "checksum": str,
}


def read_model_file(path: str | Path) -> dict[str, Any]:
    """Content of a model file, checked for form, size and damage but not yet a model.

    Raises:
        ModelFileError: if it is not a sound model file.
    """
    path = Path(path)
    size, content = _read_json(path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ModelFileError(f"{path}: not a model file of nfriction.")
    if content.get("schema") != SCHEMA:
        raise ModelFileError(
            f"{path}: schema {short(content.get('schema'))} is not {SCHEMA}; another version "
            "wrote it."
        )
    for key, kind in ENTRIES.items():
        value = content.get(key)
        # JSON's true is an int to Python.
        if key not in content or not isinstance(value, kind) or isinstance(value, bool):
            raise ModelFileError(f"{path}: `{key}` is missing or of the wrong type.")
    if content.pop("checksum") != checksum_of(content):
        raise ModelFileError(f"{path}: the checksum does not match; damaged or edited.")
    _check_sizes(path, content, size)
    _check_names(path, content)
    _check_depth(path, [v for k, v in content.items() if k != "state"])
    return content


def checksum_of(content: Mapping[str, Any]) -> str:
    """SHA-256 of JSON content, however it was laid out."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _read_json(path: Path) -> tuple[int, Any]:
    """Size and content of a JSON file."""
    try:
        if path.exists() and not path.is_file():
            raise ModelFileError(f"{path}: not a file.")
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise ModelFileError(f"{path}: {size} bytes are too many for a model file.")
        text = path.read_text(encoding="utf-8")
        return size, strict_json.parse(text)
    except FileNotFoundError:
        raise ModelFileError(f"{path}: no such file.") from None
    except OSError as error:
        raise ModelFileError(f"{path}: cannot be read ({error.strerror}).") from error
    except RecursionError:
        raise ModelFileError(f"{path}: nested too deeply for a model file.") from None
    except ModelFileError:
        raise
    except ValueError as error:
        raise ModelFileError(f"{path}: not a model file, or cut short ({error}).") from error


def _check_names(path: Path, content: Mapping[str, Any]) -> None:
    """Refuse what would pass for names of joints and recordings, and is none."""
    names, digests, step = (content[k] for k in ("joint_names", "training_data", "sample_time"))
    if not all(isinstance(n, str) for n in names) or len(names) not in (0, content["joints"]):
        raise ModelFileError(f"{path}: `joint_names` must be {content['joints']} texts, or none.")
    if not all(isinstance(digest, str) for digest in digests.values()):
        raise ModelFileError(f"{path}: `training_data` must map names to digests.")
    if step is not None and not 0 < step < 1e6:
        raise ModelFileError(f"{path}: `sample_time` must be positive seconds, got {short(step)}.")


def _check_depth(path: Path, content: list[Any]) -> None:
    """Refuse what is nested beyond what copying and writing it again can take."""
    for _ in range(DEEPEST):
        parts = [v.values() if isinstance(v, dict) else v for v in content if _holds(v)]
        content = [value for part in parts for value in part]
    if content:
        raise ModelFileError(f"{path}: nested too deeply for a model file.")


def _holds(value: object) -> bool:
    return isinstance(value, (dict, list))


def _check_sizes(path: Path, content: Mapping[str, Any], size: int) -> None:
    """Refuse networks larger than what the file can hold, before they take memory."""
    joints, options = content["joints"], content["options"]
    terms = options.get("terms", [])
    terms = terms if isinstance(terms, list) else [terms]
    sizes = [joints, options.get("head_units", 1), *terms]
    sound = all(isinstance(n, int) and not isinstance(n, bool) and n > 0 for n in sizes)
    # Every rule and every unit has a number of its own in the file.
    if not sound or joints > MOST_JOINTS or joints * max(sizes[1], math.prod(terms)) > size:
        raise ModelFileError(f"{path}: a network of sizes {short(sizes)} is refused.")
