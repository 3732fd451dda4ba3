"""Artefacts of torch, read without torch, and refused unless they are arithmetic of tensors.

torch evaluates sizes and guards of a `.pt2` as Python, resolves names of functions in it, and a
TorchScript may read and write files. Whatever is not on a list here is refused unread.
"""

import io
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import torch

from nfriction.codegen.operations import supported_operations
from nfriction.export.contract import Contract, ExportError, first_line

# Name under which the metadata lie in an artefact.
METADATA = "nfriction.json"
LARGEST = 256 * 2**20
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError,
            ValueError, LookupError, OverflowError)  # fmt: skip


def contents(path: str | Path, ours: re.Pattern[str], what: str) -> dict[str, bytes]:
    """All files of an archive by their name inside its one folder."""
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
    """Read the contract of an artefact of torch."""
    found = contents(path, re.compile(r"(?s).*"), "artefact")
    return Contract.from_json(found.get(f"extra/{METADATA}", b""))


# ATen operations on tensors besides those that can be compiled, without the "_" of in-place forms.
_MORE = """
    __and__ __or__ __xor__ _assert_tensor_metadata _log_softmax acosh addcdiv addcmul all any
    arange argmax argmin asinh atanh broadcast_to bucketize clamp_max concat copysign cummax
    cummin cumprod deg2rad diff einsum elu empty erf erfc exp2 expand_as eye flatten
    floor_divide fmax fmin frac full gelu hardtanh heaviside index_select isfinite isinf
    leaky_relu lerp linalg_norm linalg_vector_norm linear linspace log10 log2 log_sigmoid
    log_softmax logaddexp logit logsumexp masked_fill matmul moveaxis movedim nan_to_num narrow
    norm ones outer positive rad2deg reshape_as roll round rsub scalar_tensor searchsorted silu
    sinc size softmax split square std swapaxes sym_size take tile to tril triu true_divide
    type_as unflatten unfold var vdot view_as xlogy zeros
"""
# One of those that can be compiled sees memory beyond its tensor, unchecked.
_TENSORS = {*supported_operations(), *_MORE.split()} - {"_reshape_alias"}
# Numbers, lists and words of the TorchScript language.
_WORDS_OF_SCRIPT = """
    Bool Float FloatImplicit Int IntImplicit ScalarImplicit __contains__ __getitem__ __is__
    __isnot__ __not__ __range_length append dim extend format is_floating_point item len list numel
    range tensor prim::Constant prim::If prim::Loop prim::ListConstruct prim::ListUnpack
    prim::NumToTensor prim::RaiseException prim::TupleConstruct prim::TupleIndex prim::TupleUnpack
    prim::Uninitialized prim::device prim::dtype prim::layout prim::max prim::min
    prim::unchecked_cast
"""
_LANGUAGE = set(_WORDS_OF_SCRIPT.split())
# Kinds of arguments in a `.pt2`, after "as_".
_ARGUMENTS = """
    bool bools device expr float floats int ints layout memory_format name none optional_tensors
    scalar_type string sym_int sym_ints tensor tensors
"""
_KINDS = {f"as_{kind}" for kind in _ARGUMENTS.split()}
_EXPRESSION = (
    r"(?:\b(?:Symbol|Integer|Add|Mul|positive|integer|True)\b|'[a-z]+\d+'|\b[a-z]+\d+\b"
    r"|\b\d{1,18}\b|\*(?!\*)|[()+,= -])*"
)
_SIZE = r"L\['\w+'\]\.size\(\)\[\d+\]"
_SPEC = (
    r"(?:null|\"(?:type|context|children_spec|null|\[\]|builtins\.(?:tuple|list|dict))\""
    r"|[][{}:, 0-9])*"
)
# Strings of a program by their key; all others, and all keys, are plain words.
_WORDS = re.compile(r"-?[\w.]*", re.ASCII)
_STRINGS = {
    key: re.compile(pattern, re.ASCII)
    for key, pattern in {
        "target": r"torch\.ops\.aten\.\w+\.\w+",
        "expr_str": _EXPRESSION,
        "guards_code": rf"{_SIZE} (?:==|!=|<=|>=|<|>) (?:{_SIZE}|\d+)",
        "in_spec": _SPEC,
        "out_spec": _SPEC,
        "torch_version": r"[\w.+]*",
    }.items()
}
# In the source of a TorchScript: words after a dot, and what else leads to an operator.
_DOTTED = re.compile(rb"\.(?:\s|\\|#[^\n]*)*([A-Za-z_]\w*)")
_DETOUR = re.compile(rb"__setstate__|\bgetattr\b|\bops\b(?!\.(?:aten|prim)\.)")


def check_program(document: Any) -> None:
    """Refuse the graph of a `.pt2`, parsed from JSON, that is more than arithmetic of tensors."""
    for key, value in _strings("", document):
        sound = _STRINGS.get(key, _WORDS).fullmatch(value) is not None
        if key == "target":
            sound = sound and _is_overload(*value.split(".")[3:])
        elif key == "":
            sound = sound and (not value.startswith("as_") or value in _KINDS)
        if not sound:
            raise _foreign(value)


def check_source(name: str, content: bytes) -> None:
    """Refuse a file in a TorchScript that does more than arithmetic of tensors as it is loaded."""
    # torch evaluates defaults of arguments and constants of classes then, before a graph is there,
    # and lets objects of its own classes restore themselves.
    found: set[bytes] = set()
    if name.endswith(".py"):
        found |= {*_DETOUR.findall(content)} | (_foreign_words() & {*_DOTTED.findall(content)})
    elif name.endswith(".pkl"):
        found |= {*re.findall(rb"__setstate__|\bclasses\b", content)}
    if found:
        raise _foreign(min(found).decode())


@cache
def _foreign_words() -> frozenset[bytes]:
    """Names of torch's operators that are more than arithmetic, and of the home of its classes."""
    names = {schema.name.partition("::")[2] for schema in torch._C._jit_get_all_schemas()}
    own = {n for n in names if any(map(_is_allowed, (n, f"prim::{n}", f"aten::{n}")))}
    return frozenset(word.encode() for word in {"classes", *(names - own)})


def check_script(graph: Any) -> None:
    """Refuse a graph of TorchScript, its calls inlined, that is more than arithmetic of tensors."""
    for node in _nodes(graph):
        if not _is_allowed(node.kind()):
            raise _foreign(node.kind())


def _is_allowed(kind: str) -> bool:
    """True for a kind of node of TorchScript that is arithmetic of tensors, or of the language."""
    name = kind.removeprefix("aten::")
    return name in _LANGUAGE or (name != kind and _is_arithmetic(name))


def _is_overload(name: str, overload: str) -> bool:
    """True for an operator on tensors, not some other attribute of torch's object."""
    known = getattr(torch.ops.aten, name, None) if _is_arithmetic(name) else None
    return known is not None and overload in known.overloads()


def _is_arithmetic(name: str) -> bool:
    return name in _TENSORS or (not name.startswith("_") and name.removesuffix("_") in _TENSORS)


def _foreign(what: str) -> ExportError:
    return ExportError(f"it holds {what[:80]!r}, which is no part of a controller.")


def _strings(key: str, value: Any) -> Iterator[tuple[str, str]]:
    """Every string of nested JSON with the key that it lies under, and every key under ""."""
    if isinstance(value, str):
        yield key, value
    elif isinstance(value, dict):
        for inner_key, inner in value.items():
            yield "", inner_key
            yield from _strings(inner_key, inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _strings(key, inner)


def _nodes(block: Any) -> Iterator[Any]:
    for node in block.nodes():
        yield node
        for inner in node.blocks():
            yield from _nodes(inner)
