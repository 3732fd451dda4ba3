"""Random but reproducible damage to valid files: bytes, text, JSON and archives."""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

Mutation = Callable[[Random, bytes], bytes]

_WORDS = [struct.pack(form, value) for form in ("<I", ">I", "<Q", ">Q")
          for value in (0, 1, 0x7F, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)]  # fmt: skip
_WORDS += [struct.pack("<d", x) for x in (float("nan"), float("inf"), -0.0, 1e308, 5e-324)]
_NUMBERS = ["nan", "inf", "-inf", "NaN", "Infinity", "1e999", "-1e308", "1e308", "5e-324", "-0",
            "99999999999999999999", "0x10", "1_000", "١٢", "1,5", "1.2.3", "", "-", "+", "1e",
            "9" * 400, "true", "null"]  # fmt: skip
_TEXTS = ["", " ", "\0", "﻿", "é", "日本語", "😀", "‮", "a" * 300, "'", '"', '"""',
          "\n", "\r", ",", ";", "\t", "#", "=", "[", "]", "{", "}", "../../x", "/etc/passwd",
          "=cmd()", "%s%n", "__class__", "q1", "q9999", "time", "0"]  # fmt: skip
# Long enough to reveal slow or endless loading, and rare, because they are slow to generate.
_LONG = ["9" * 5000, "a" * 70_000, "é" * 5000, "\n" * 5000, "1," * 5000]
_TOKEN = re.compile(r"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?|\w+|[^\w\s]|\s+")


def damage_bytes(rng: Random, content: bytes) -> bytes:
    """Flipped bits; truncated, duplicated, moved and overwritten parts."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        size = len(data)
        at = rng.randrange(size + 1)
        end = min(size, at + rng.choice((1, 2, 4, 8, 64, 1024, size)))
        match rng.randrange(8):
            case 0 if at < size:
                data[at] ^= 1 << rng.randrange(8)
            case 1 if at < size:
                data[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
            case 2:
                del data[at:]
            case 3:
                del data[at:end]
            case 4:
                data[at:at] = data[at:end] * rng.choice((1, 2, 50 if end - at < 100 else 1))
            case 5:
                word = rng.choice(_WORDS)
                data[at : at + len(word)] = word
            case 6:
                data[at:at] = rng.randbytes(rng.choice((1, 4, 100)))
            case _:
                other = rng.randrange(size + 1)
                data[at:end] = data[other : other + end - at]
    return bytes(data)


def damage_text(rng: Random, content: bytes) -> bytes:
    """Numbers, words, signs and lines exchanged for others; sometimes bytes too."""
    text = content.decode("utf-8", errors="replace")
    for _ in range(rng.choice((1, 1, 2, 3, 8))):
        text = (_damaged_token if rng.random() < 0.7 else _damaged_lines)(rng, text)
    data = text.encode(rng.choice(("utf-8",) * 20 + ("utf-16", "utf-8-sig", "latin-1")), "replace")
    return damage_bytes(rng, data) if rng.random() < 0.1 else data


def _damaged_token(rng: Random, text: str) -> str:
    begin = rng.randrange(max(1, len(text) - 500))
    tokens = list(_TOKEN.finditer(text, begin, begin + 1000))
    if not tokens:
        return rng.choice(_TEXTS)
    token = rng.choice(tokens)
    if rng.random() < 0.01:
        return text[: token.start()] + rng.choice(_LONG) + text[token.end() :]
    new = rng.choice(_NUMBERS if token[0][-1:].isdigit() and rng.random() < 0.8 else _TEXTS)
    if rng.random() < 0.3:
        new = rng.choice(tokens)[0]
    elif rng.random() < 0.2:
        new = token[0] + new
    return text[: token.start()] + new + text[token.end() :]


def _damaged_lines(rng: Random, text: str) -> str:
    lines = text.splitlines(keepends=True) or [""]
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(6):
        case 0:
            del lines[at]
        case 1:
            lines.insert(other, lines[at])
        case 2:
            lines[at], lines[other] = lines[other], lines[at]
        case 3:
            lines[at] = lines[at] * (rng.choice((2, 30, 1000)) if len(lines[at]) < 100 else 2)
        case 4:
            lines[at] = lines[at].rstrip("\n")
        case _:
            return "".join(lines)[: rng.randrange(len(text) + 1)]
    return "".join(lines)


# Spellings that json.dumps cannot write, inserted in place of a marker.
_RAW = ["NaN", "Infinity", "-Infinity", "1e999", "-1e999", "9" * 400, "1e-400", "[" * 2000,
        '{"a":' * 2000, "[" * 900 + "]" * 900, "[[0]]", '"\\ud800"', '{"a":1,"a":2}', "-0",
        "1.0", "0.1e1", "{}", "", "01", "'a'", "//"]  # fmt: skip
_LONG_RAW = ["[" * 100_000, '{"a":' * 50_000, "9" * 5000, json.dumps("a" * 70_000),
             json.dumps([0.0] * 5000)]  # fmt: skip
_VALUES: list[Any] = [None, True, False, 0, 1, -1, 2, 3, 1001, 2**31, 2**63, 2**64, 10**30, 0.5,
    -1.0, 1e308, 1e-308, "", "x", "nan", "a" * 300, "\0", "日本", "../../x", [], {}, [[]],
    [None], [1], [True], ["x"], [1, [2]], [[1], [2, 3]], [0.0] * 300, {"a": 1}, [{}]]  # fmt: skip


def damage_document(rng: Random, document: Any) -> str:
    """JSON text of a document with nodes replaced, dropped, duplicated, renamed, nested."""
    document = json.loads(json.dumps(document))
    raw: dict[str, str] = {}
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        places = list(_places(document))
        if not places:
            break
        holder, key = rng.choice(places)
        match rng.randrange(9):
            case 0 | 1 | 2:
                holder[key] = json.loads(json.dumps(rng.choice(_VALUES)))
            case 3:
                marker = f"<raw {len(raw)}>"
                raw[json.dumps(marker)] = rng.choice(_RAW if rng.random() < 0.98 else _LONG_RAW)
                holder[key] = marker
            case 4:
                del holder[key]
            case 5 if isinstance(holder, dict):
                holder[rng.choice(_TEXTS)] = holder.pop(key)
            case 5:
                holder.insert(key, holder[key])
            case 6:
                holder[key] = [holder[key]]
            case 7:
                other, place = rng.choice(places)
                holder[key] = json.loads(json.dumps(other[place])) if place in _keys(other) else 0
            case _:
                value = holder[key]
                if isinstance(value, (int, float)) and not isinstance(value, bool):
                    holder[key] = rng.choice((-value, value * 1e300, value * 1e-300, value + 1, 0))
                else:
                    holder[key] = str(value)[:100]
    text = json.dumps(document, indent=rng.choice((None, 1)))
    for marker, value in raw.items():
        text = text.replace(marker, value)
    if rng.random() < 0.05:
        # A duplicate key, which dictionaries cannot represent.
        text = text.replace("{", '{"name": 1, "name": 2, ', 1)
    return text


def damage_json(rng: Random, content: bytes) -> bytes:
    """A JSON file, mostly damaged as a document, otherwise as text."""
    if rng.random() < 0.2:
        return damage_text(rng, content)
    text = damage_document(rng, json.loads(content))
    return text.encode("utf-8", "surrogatepass")


def _places(document: Any) -> Sequence[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    waiting = [document]
    while waiting:
        holder = waiting.pop()
        for key in _keys(holder):
            found.append((holder, key))
            if isinstance(holder[key], (dict, list)):
                waiting.append(holder[key])
    return found


def _keys(holder: Any) -> Sequence[Any]:
    return list(holder) if isinstance(holder, dict) else range(len(holder))


_NAMES = ["../../evil.npy", "/tmp/evil.npy", "time.npy", "q.npy", "q", "convention.npy", "", "a\\b",
          "x" * 5000 + ".npy", "C:\\evil.npy", "q1.npy", "日本.npy"]  # fmt: skip


def damage_zip(rng: Random, content: bytes, damage: Mutation = damage_bytes) -> bytes:
    """An archive whose checksums match its contents; sometimes the archive's own bytes are
    damaged."""
    if rng.random() < 0.3:
        return damage_bytes(rng, content)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = [(name, archive.read(name)) for name in archive.namelist()]
    for _ in range(rng.choice((1, 1, 2))):
        at = rng.randrange(len(entries))
        name, data = entries[at]
        match rng.randrange(6):
            case 0 | 1 | 2:
                entries[at] = name, damage(rng, data)
            case 3:
                entries[at] = rng.choice(_NAMES), data
            case 4:
                entries.append((rng.choice([*_NAMES, name]), data))
            case _:
                entries[at] = name, rng.choice(entries)[1]
    buffer = io.BytesIO()
    method = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, data in entries:
            archive.writestr(zipfile.ZipInfo(name), data)
    return buffer.getvalue()


def damage_npy(rng: Random, content: bytes) -> bytes:
    """An array file: its header as text, which defines type and shape, otherwise its bytes."""
    if rng.random() < 0.5 or not content.startswith(b"\x93NUMPY"):
        return damage_bytes(rng, content)
    size = struct.unpack_from("<H", content, 8)[0]
    header = content[10 : 10 + size].decode("latin-1").rstrip()
    new = rng.choice(("(10**9,)", "(2,2)", "(-1,)", "()", "(1,)*64", "(9999999999999999999,)",
                      "(0, 2)", "(40, 0)", "(10, 4)", "(True, 40)"))  # fmt: skip
    if rng.random() < 0.5:
        header = re.sub(r"\([^)]*\)", new, header)
    else:
        kind = rng.choice(("|O", "<M8[ns]", "<f2", "<c16", "|V8", "<U10", "|b1", ">i8", "<f16",
                           "|S0", "x", "[('a', '<f8')]"))  # fmt: skip
        header = re.sub(r"'descr': *'[^']*'", f"'descr': '{kind}'", header)
    if rng.random() < 0.2:
        header = damage_text(rng, header.encode()).decode("latin-1")
    text = header.encode("latin-1") + b"\n"
    return content[:8] + struct.pack("<H", len(text) & 0xFFFF) + text + content[10 + size :]


def repacked(data: bytes) -> bytes:
    """Data compressed by zlib."""
    return zlib.compress(data, 1)
