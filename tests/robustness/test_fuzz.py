"""Loaders on damaged files: a short run of each, and small files that once broke one."""

import gzip
import io
import json
import os
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from nfriction.io import formats as files
from nfriction.papers.controller.rules import load_rules
from nfriction.plant import rigs
from nfriction.recording import Recording, read_initial_states
from tests.robustness.fuzz import fuzz
from tests.robustness.loaders import LOADERS, Loader

# An ONNX graph is written again in each case, which takes a second, and a .pt2 in the first.
QUICK = [name for name in LOADERS if name not in ("onnx", "pt2")]


def needed(name: str) -> Loader:
    loader = LOADERS[name]
    if not loader.available:
        pytest.skip(f"{loader.needs} is not installed")
    return loader


@pytest.mark.parametrize("name", QUICK)
def test_damaged_files_give_valid_objects_or_are_refused(name: str) -> None:
    needed(name)
    outcome = fuzz(name, 200, budget=1.0)
    assert not outcome.faults, str(outcome)
    assert outcome.loaded + outcome.refused > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", LOADERS)
def test_many_damaged_files_give_valid_objects_or_are_refused(name: str) -> None:
    needed(name)
    outcome = fuzz(name, 10_000, first=10_000_000, budget=60.0)
    assert not outcome.faults, str(outcome)


def test_harness_detects_every_kind_of_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every way in which a loader can fail is detected."""

    def load(path: Path) -> None:
        content = path.read_bytes()
        if content == b"sound" or b"crash" in content:
            os.abort() if b"crash" in content else None
        elif b"hang" in content:
            while True:
                pass
        elif b"hoard" in content:
            bytearray(2**30)
        elif b"wrong" in content:
            raise KeyError("wrong")
        else:
            raise ValueError("without a name")

    kinds = [b"hang", b"hoard", b"wrong", b"nameless", b"crash", b"sound"]
    broken = Loader(
        "broken", ".x", lambda _: [b"sound"], load,
        lambda rng, _: kinds[rng.randrange(len(kinds))],
    )  # fmt: skip
    monkeypatch.setitem(LOADERS, "broken", broken)
    outcome = fuzz("broken", 40, seconds=0.05, memory=2**28)
    faults = " ".join(outcome.faults)
    for kind in ("Hang", "MemoryError", "KeyError", "without the file's name", "SIGABRT"):
        assert kind in faults
    assert outcome.loaded + outcome.refused + sum(n for n, *_ in outcome.faults.values()) == 40


def test_crash_in_a_worker_process_is_a_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(path: Path) -> None:
        content = path.read_bytes()
        if content == b"crash":
            os.abort()
        while content == b"hang":
            pass
        if content == b"hoard":
            bytearray(2**30)

    kinds = [b"hang", b"hoard", b"crash", b"sound"]
    broken = Loader(
        "broken", ".x", lambda _: [b"sound"], load,
        lambda rng, _: kinds[rng.randrange(len(kinds))], apart=True,
    )  # fmt: skip
    monkeypatch.setitem(LOADERS, "broken", broken)
    outcome = fuzz("broken", 20, seconds=0.05, memory=2**28)
    assert not outcome.faults
    assert outcome.loaded + outcome.refused == 20
    assert outcome.refused == sum(outcome.perished.values()) > 0
    for kind in ("SIGPROF", "SIGABRT", "an error"):
        assert kind in str(outcome)


@pytest.mark.parametrize(
    "text",
    [
        '{"kind": [1], "mass": [1], "length": [1]}',
        '{"kind": null, "mass": [1], "length": [1]}',
        '{"mass": [1], "length": [1], "buffers": [1]}',
        '{"mass": [1], "length": [1], "buffers": {"armature": [0, [1]]}}',
        '{"mass": [1], "length": [1], "buffers": {"armature": null}}',
        '{"mass": [1], "length": [1], "joint_names": [{}]}',
        '{"mass": [1], "length": [1], "convention": 3}',
        '{"mass": [1], "length": [1], "arm": [{}]}',
        '{"mass": [1], "length": [1], "arm": {"inertia": 1, "length": 1e200}}',
        '{"mass": [1e999], "length": [1]}',
        '{"mass": [true], "length": [1]}',
        '{"mass": [NaN], "length": [1]}',
        json.dumps({"mass": [1.0] * 5000, "length": [1.0] * 5000}),
        "[" * 100_000,
        '{"mass": ' * 5000,
        "\xff",
    ],
)
def test_invalid_rigs_are_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=r"rig\.json") as refusal:
        rigs.read(path)
    assert len(str(refusal.value)) < 1000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        # Seconds of counting each name among all.
        (",".join(f"c{k}" for k in range(20_000)) + "\n" + "1," * 20_000, "columns"),
        # Rows longer than their header become a multi-level index.
        ("time,q1\n" + "1," * 20_000, "columns"),
        ("x" * 70_000 + ",q1\n1,2\n", "time is missing"),
        # Finite, but no difference or square of it is.
        ("time,q1\n" + "\n".join(f"{k},{(-1) ** k * 1e308}" for k in range(9)), "within 1e"),
    ],
)
def test_invalid_recordings_are_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"(?s)run\.csv.*{message}") as refusal:
        Recording.read(path)
    assert len(str(refusal.value)) < 5000


def test_invalid_unicode_is_refused(tmp_path: Path) -> None:
    """NumPy makes a string of them that crashes the interpreter on the next access."""
    path = tmp_path / "run.npz"
    arrays = {
        "time": np.arange(9.0) / 100,
        "q": np.zeros((9, 1)),
        "convention": np.array("relative"),
    }
    np.savez(path, **arrays)  # type: ignore[arg-type]
    assert Recording.read(path).convention is not None
    with zipfile.ZipFile(path) as archive:
        text = archive.read("convention.npy")
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("names.npy", text[:-4] + b"\xff\xff\xff\x7f")
    with pytest.raises(ValueError, match=r"run\.npz.*utf-32"):
        Recording.read(path)


def test_errors_of_states_and_rules_name_their_file_and_are_short(tmp_path: Path) -> None:
    path = tmp_path / "states.csv"
    path.write_text("id,q0_1,qd0_1\na,x,0\n")
    with pytest.raises(ValueError, match=r"states\.csv.*must be a number"):
        read_initial_states(path)
    rules = tmp_path / "rules.json"
    for content in (
        '{"format": "' + "a" * 70_000 + '"}',
        json.dumps({"a" * 70_000: 1}),
        "[" * 9999,
    ):
        rules.write_text(content)
        with pytest.raises(ValueError, match=r"rules\.json") as refusal:
            load_rules(rules)
        assert len(str(refusal.value)) < 1000


def test_endless_decompression_is_refused() -> None:
    unpacked = 2 * files.UNSUSPECTED
    files.refuse_bomb(files.UNSUSPECTED, 1)
    files.refuse_bomb(unpacked, unpacked // files.LARGEST_RATIO + 1)
    with pytest.raises(ValueError, match="times its size"):
        files.refuse_bomb(unpacked, unpacked // files.LARGEST_RATIO - 1)


@pytest.mark.parametrize("ending", [".csv.gz", ".npz", ".mat", ".h5", ".parquet"])
def test_small_files_of_many_zeros_are_refused(
    ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Megabytes of zeros in a few kilobytes, where so much would be too much."""
    monkeypatch.setattr(files, "UNSUSPECTED", 2**20)
    path = tmp_path / f"run{ending}"
    _write_bomb(path, 500_000)
    assert path.stat().st_size < 2**16
    with pytest.raises(ValueError, match=r"(?s)run.*unpacks"):
        Recording.read(path)


def _write_bomb(path: Path, count: int) -> None:
    zeros = bytes(8 * count)
    if path.name.endswith(".csv.gz"):
        path.write_bytes(gzip.compress(b"time,q1\n" + b"0,0\n" * (2 * count)))
    elif path.suffix == ".npz":
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            header, {"descr": "<f8", "fortran_order": False, "shape": (count,)}
        )
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("q1.npy", header.getvalue() + zeros)
    elif path.suffix == ".mat":
        parts = struct.pack("<IIIIIIII", 6, 8, 6, 0, 5, 8, count, 1)
        name = struct.pack("<HH4s", 1, 2, b"q1\0\0")
        body = parts + name + struct.pack("<II", 9, 8 * count) + zeros
        packed = zlib.compress(struct.pack("<II", 14, len(body)) + body)
        head = b"MATLAB 5.0".ljust(124) + b"\x00\x01IM"
        path.write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)
    elif path.suffix == ".h5":
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            file.create_dataset("q1", (count,), "f8", chunks=(2**16,), compression="gzip")[:] = 0.0
    else:
        pa = pytest.importorskip("pyarrow")
        from pyarrow import parquet

        table = pa.table({"time": np.zeros(count), "q1": np.zeros(count)})
        parquet.write_table(table, path)
