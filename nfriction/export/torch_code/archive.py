"""Archives of torch, read without torch."""

import io
import re
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

from nfriction.export.contract import Contract
from nfriction.export.errors import ExportError, first_line

# Name under which the metadata lie in an artefact.
METADATA = "nfriction.json"
LARGEST = 256 * 2**20
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError,
            ValueError, LookupError, OverflowError)  # fmt: skip


def contents(path: str | Path, ours: re.Pattern[str], what: str) -> dict[str, bytes]:
    """All files of an archive by their name inside its one folder.

    Args:
        path: the archive.
        ours: what such names look like.
        what: what the archive should be, for errors.

    Raises:
        ExportError: it is damaged, too large, or holds something else.
        OSError: it cannot be read.
    """
    found: dict[str, bytes] = {}
    known: set[str] = set()
    if Path(path).stat().st_size > LARGEST:
        raise ExportError(f"{path}: too large for a {what} of nfriction.")
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            if sum(max(entry.file_size, entry.compress_size) for entry in entries) > LARGEST:
                raise ExportError(f"{path}: too large for a {what} of nfriction.")
            for entry in entries:
                name = entry.filename.partition("/")[2]
                # torch looks for names without regard to case.
                if name.lower() in known or not ours.fullmatch(name):
                    raise ExportError(f"{path}: holds {entry.filename[:80]!r}, which is not ours.")
                known.add(name.lower())
                found[name] = archive.read(entry)
    except _DAMAGED as error:
        if isinstance(error, ExportError):
            raise
        raise ExportError(f"{path}: no {what} of nfriction ({first_line(error)}).") from error
    return found


def repacked(files: Mapping[str, bytes]) -> io.BytesIO:
    """An archive of just these files, so that torch reads what was looked at."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files.items():
            archive.writestr(f"archive/{name}", content)
    buffer.seek(0)
    return buffer


def contract_of_archive(path: str | Path) -> Contract:
    """Read the contract of an artefact of torch.

    Raises:
        ExportError: it is no archive, or too large.
        ContractError: its metadata are absent or damaged.
        OSError: it cannot be read.
    """
    found = contents(path, re.compile(r"(?s).*"), "artefact")
    return Contract.from_json(found.get(f"extra/{METADATA}", b""))
