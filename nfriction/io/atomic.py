"""Atomic writes: a file is written whole or not at all. Nothing else in the package writes."""

import errno
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
_REFUSED = {errno.EACCES, errno.EPERM, errno.EROFS}


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Give a temporary file that replaces `path` when the block ends without an error.

    Missing folders are made. Readers see the old file or the new one, never half of one; only a
    killed process leaves its temporary file, hidden and ending in `.part`.

    Raises:
        OSError: the file cannot be written; the message names folder, reason and remedy.
    """
    path = Path(path)
    temporary = path.parent / f".{uuid.uuid4().hex}.part"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Unlike tempfile's, it has the permissions of any new file.
        temporary.open("xb").close()
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise OSError(error.errno, _message(error, path), str(path)) from error
    finally:
        with suppress(OSError):  # the folder may be none, or read-only by now
            temporary.unlink()


def write_atomically(path: str | Path, content: bytes) -> Path:
    """Write bytes by `atomic_write`; returns the path."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
    return Path(path)


def _message(error: OSError, path: Path) -> str:
    remedy = ""
    if error.errno in _FULL:
        remedy = f"; make room in {path.parent}, or write to another folder"
    elif error.errno in _REFUSED:
        remedy = f"; allow writing to {path.parent}, or write to another folder"
    return f"cannot write the file ({error.strerror or error}{remedy})"
