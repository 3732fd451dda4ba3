"""Files that are written whole or not at all; the one place where the package writes."""

import errno
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
_REFUSED = {errno.EACCES, errno.EPERM, errno.EROFS}


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary file that takes the place of `path` where the block ends without an error.

    Missing folders are made. Readers see the old file or the new one, never half of one; only a
    process that is killed leaves its temporary file, hidden and ending in `.part`.

    Raises:
        OSError: if the file cannot be written; the message names folder, reason and mend.
    """
    path = Path(path)
    temporary = path.parent / f".{uuid.uuid4().hex}.part"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Unlike tempfile's, it has the rights that any new file gets.
        temporary.open("xb").close()
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise OSError(error.errno, _told(error, path), str(path)) from error
    finally:
        with suppress(OSError):  # of a folder that is none, or is read-only by now
            temporary.unlink()


def write_atomically(path: str | Path, content: bytes) -> Path:
    """Write a file whole or not at all; see `replacing`."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)
    return Path(path)


def _told(error: OSError, path: Path) -> str:
    reason = error.strerror or str(error)
    if error.errno in _FULL:
        mend = f"; make room in {path.parent}, or write to another folder"
    elif error.errno in _REFUSED:
        mend = f"; allow writing to {path.parent}, or write to another folder"
    else:
        mend = ""
    return f"cannot write the file ({reason}{mend})"
