"""Atomic writing of files, used for everything the package writes; strict JSON with checksums."""

import errno
import hashlib
import json
import math
import os
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

_FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
_REFUSED = {errno.EACCES, errno.EPERM, errno.EROFS}


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Provide a temporary file that replaces `path` when the block ends without an error.

    Missing folders are made. Readers see the old file or the new one, never part of one; only a
    killed process leaves its temporary file, hidden and ending in `.part`.
    """
    path = Path(path)
    temporary = path.parent / f".{uuid.uuid4().hex}.part"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Unlike files from tempfile, it has the usual permissions of a new file.
        temporary.open("xb").close()
        yield temporary
        with temporary.open("rb+") as file:
            # Otherwise a power failure could leave the new name without content.
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        remedy = ""
        if error.errno in _FULL:
            remedy = f"; make room in {path.parent}, or write to another folder"
        elif error.errno in _REFUSED:
            remedy = f"; allow writing to {path.parent}, or write to another folder"
        message = f"cannot write the file ({error.strerror or error}{remedy})"
        raise OSError(error.errno, message, str(path)) from error
    finally:
        with suppress(OSError):  # the folder may be gone or read-only by now
            temporary.unlink()


def write_atomically(path: str | Path, content: bytes) -> Path:
    """Write bytes by `atomic_write`; returns the path."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
    return Path(path)


def parse_json(
    text: str | bytes, pairs_hook: Callable[[list[tuple[str, Any]]], dict[str, Any]] | None = None
) -> Any:
    """Parse JSON text whose numbers are finite; see `json.loads` for the hook."""
    return json.loads(
        text, parse_constant=_finite, parse_float=_finite, parse_int=_whole,
        object_pairs_hook=pairs_hook,
    )  # fmt: skip


def checked_json(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content as plain JSON, with a checksum for `is_intact`.

    TypeError or ValueError if it is not plain JSON, or has numbers that are not finite.
    """
    # Through JSON, so that the checksum covers what a reader will see.
    plain: dict[str, Any] = json.loads(json.dumps(content, allow_nan=False))
    return plain | {"checksum": _checksum(plain)}


def is_intact(content: dict[str, Any]) -> bool:
    """True for unchanged content of `checked_json`; removes its checksum."""
    return content.pop("checksum", None) == _checksum(content)


def _checksum(content: Mapping[str, Any]) -> str:
    """SHA-256 of JSON content, independent of its layout."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def numbers(name: str, given: Any, words: Sequence[str] = ()) -> Any:
    """Floats of parsed JSON, in its nested lists; `words` such as "nan" count as numbers too."""
    if isinstance(given, (list, tuple)):
        return [numbers(name, x, words) for x in given]
    # For Python, True is a number.
    if isinstance(given, bool) or not (isinstance(given, (int, float)) or given in words):
        raise ValueError(f"`{name}` must be numbers, got {str(given)[:40]!r}.")
    try:
        return float(given)
    except OverflowError:
        raise ValueError(f"`{name}` is too large: {str(given)[:40]}.") from None


def shortened(text: object, most: int = 500) -> str:
    """A message of bounded length, since it may quote a file."""
    whole = str(text)
    return whole if len(whole) <= most else f"{whole[: most - 3]}..."


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"numbers must be finite, got {text[:40]}.")
    return value


def _whole(text: str) -> int:
    _finite(text)  # float arithmetic would overflow with a larger one
    return int(text)
