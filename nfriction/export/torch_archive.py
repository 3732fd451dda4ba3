"""Archives that torch writes, read as data.

A program in a file may do anything as it is loaded. So none is: what torch runs is the program that
it writes for the model here and now, with the numbers of the file, if both programs are the same.
"""

import io
import re
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO

import torch

from nfriction.export.contract import Contract, ExportError, first_line
from nfriction.version import __version__

# Name under which the metadata lie in an artefact.
METADATA = "nfriction.json"
LARGEST = 256 * 2**20
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError,
            ValueError, LookupError, OverflowError)  # fmt: skip
# Files of plain numbers, and those in which one program may differ: metadata and line numbers.
_NUMBERS = re.compile(r"constants/\d+|data/weights/weight_\d+|data/constants/tensor_\d+")
_BESIDE = re.compile(r"extra/nfriction\.json|code/.*\.debug_pkl|\.data/serialization_id")
# torch numbers the classes that it has scripted since the process began.
_COUNTED = re.compile(rb"___torch_mangle_\d+")


def contract_of_archive(path: str | Path) -> Contract:
    """Read the contract of an artefact of torch."""
    return Contract.from_json(_contents(path, path).get(f"extra/{METADATA}", b""))


def own_program(path: str | Path, own: bytes) -> io.BytesIO:
    """An archive of our own with the numbers of an artefact.

    Args:
        path: of the artefact.
        own: what torch writes for the model that it should be.

    Raises:
        ExportError: if it is no archive, or its program is another one.
    """
    given, ours = _contents(path, path), _contents(path, io.BytesIO(own))
    if _program(given) != _program(ours):
        raise ExportError(another_program(path, f"torch {torch.__version__}"))
    numbers = {name: given[name] for name in ours if _NUMBERS.fullmatch(name)}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in (ours | numbers).items():
            archive.writestr(f"archive/{name}", content)
    buffer.seek(0)
    return buffer


def another_program(path: str | Path, writer: str) -> str:
    """The error of an artefact whose program is not the model's."""
    return (
        f"{path}: its program is not the one that nfriction {__version__} with {writer} writes "
        "for this model, and foreign programs are not run; verify it with the versions that wrote "
        "it, or export the model anew."
    )


def _program(files: Mapping[str, bytes]) -> list[tuple[bytes, bytes]]:
    """All files that say what is computed; of numbers their size alone."""
    return sorted(
        (
            _COUNTED.sub(b"", name.encode(errors="backslashreplace")),
            b"%d" % len(content) if _NUMBERS.fullmatch(name) else _COUNTED.sub(b"", content),
        )
        for name, content in files.items()
        if not _BESIDE.fullmatch(name)
    )


def _contents(path: str | Path, source: str | Path | IO[bytes]) -> dict[str, bytes]:
    """All files of an archive by their name inside its one folder; `path` names it in errors."""
    found: dict[str, bytes] = {}
    known: set[str] = set()
    try:
        if Path(path).stat().st_size > LARGEST:
            raise ExportError(f"{path}: too large for an artefact of nfriction.")
        with zipfile.ZipFile(source) as archive:
            entries = archive.infolist()
            if sum(max(entry.file_size, entry.compress_size) for entry in entries) > LARGEST:
                raise ExportError(f"{path}: too large for an artefact of nfriction.")
            for entry in entries:
                name = entry.filename.partition("/")[2]
                # torch looks for names without regard to case.
                if name.lower() in known:
                    raise ExportError(f"{path}: holds {entry.filename[:80]!r} twice.")
                known.add(name.lower())
                found[name] = archive.read(entry)
    except _DAMAGED as error:
        if isinstance(error, ExportError):
            raise
        raise ExportError(f"{path}: no artefact of nfriction ({first_line(error)}).") from error
    return found
