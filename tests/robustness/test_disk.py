"""A full disk or read-only folder: errors state where and what to do, and leave no partial file."""

import errno
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from nfriction import LFM, ModelInfo, save
from nfriction.export import torchscript
from nfriction.io.files import atomic_write, write_atomically
from nfriction.plant import rigs
from nfriction.recording import Recording
from nfriction.recording.angles import AngleConvention

ROOT = Path(__file__).resolve().parents[2]
INFO = ModelInfo(
    sample_time=1e-3, input_ranges={"qd": [[-9.0, 9.0]] * 3, "qdd": [[-90.0, 90.0]] * 3}
)


def recording(samples: int = 2000) -> Recording:
    q = np.random.default_rng(0).normal(size=(samples, 3)) / 9
    return Recording(np.arange(samples) / 1000, q, convention=AngleConvention(), name="run")


WRITERS: dict[str, Callable[[Path], object]] = {
    "model.json": lambda path: save(LFM(3), path, INFO),
    "model.pt": lambda path: torchscript(LFM(3), path, INFO),
    "run.csv": lambda path: recording().write(path),
    "run.csv.gz": lambda path: recording().write(path),
    "run.npz": lambda path: recording().write(path),
    "run.parquet": lambda path: recording().write(path),
    "rig.json": lambda path: rigs.write(rigs.tlrip(), path),
    "rest.bin": lambda path: write_atomically(path, bytes(10_000)),
}


@contextmanager
def full_disk(room: int) -> Iterator[None]:
    """Limit every file to `room` bytes, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


@pytest.mark.parametrize("name", WRITERS)
def test_full_disk_keeps_the_old_file(name: str, tmp_path: Path) -> None:
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    path = tmp_path / name
    WRITERS[name](path)
    before = path.read_bytes()
    with full_disk(100), pytest.raises(OSError, match="too large") as refusal:
        WRITERS[name](path)
    assert refusal.value.errno == errno.EFBIG
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_error_names_the_path_and_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    with full_disk(100), pytest.raises(OSError, match=f"make room in {tmp_path}") as refusal:
        save(LFM(3), path, INFO)
    assert str(path) in str(refusal.value)
    assert not list(tmp_path.iterdir())


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 KiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no file system may be mounted here ({error})")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.parametrize("name", ["model.json", "model.pt", "run.csv", "run.npz"])
def test_full_file_system_keeps_the_old_file(name: str, tiny_disk: Path) -> None:
    (tiny_disk / "ballast").write_bytes(bytes(64 * 1024))
    with pytest.raises(OSError, match=r"No space left.*make room in") as refusal:
        WRITERS[name](tiny_disk / name)
    assert refusal.value.errno == errno.ENOSPC
    assert [p.name for p in tiny_disk.iterdir()] == ["ballast"]


def test_read_only_folder_raises_a_clear_error(tmp_path: Path) -> None:
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(0o500)
    if os.access(folder, os.W_OK):
        pytest.skip("this user may write anywhere")
    with pytest.raises(OSError, match=r"allow writing to .*locked"):
        save(LFM(3), folder / "model.json")
    assert not list(folder.iterdir())


@pytest.fixture
def read_only_disk(tiny_disk: Path) -> Path:
    command = ["mount", "-o", "remount,ro", str(tiny_disk)]
    subprocess.run(command, check=True, capture_output=True)
    return tiny_disk


@pytest.mark.parametrize("name", ["model.json", "model.pt", "run.csv"])
def test_read_only_file_system_raises_a_clear_error(name: str, read_only_disk: Path) -> None:
    with pytest.raises(OSError, match=r"Read-only.*allow writing to") as refusal:
        WRITERS[name](read_only_disk / name)
    assert refusal.value.errno == errno.EROFS


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["-m", "nfriction", "export", "{model}", "--format", "torchscript", "--out", "{disk}"],
        ["-m", "nfriction", "demo", "--out", "{disk}/demo", "--models", "NCFM"],
        [str(ROOT / "trainers" / "train_constant.py"), "--seconds", "1", "--windows", "0.5",
         "--max-steps", "1", "--model", "NCFM", "--out", "{disk}/train"],
    ],
    ids=["export", "demo", "train"],
)  # fmt: skip
def test_commands_report_it_in_one_line(words: list[str], tiny_disk: Path, tmp_path: Path) -> None:
    model = save(LFM(3), tmp_path / "model.json", INFO)
    (tiny_disk / "ballast").write_bytes(bytes(56 * 1024))
    words = [word.format(disk=tiny_disk, model=model) for word in words]
    done = subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, cwd=ROOT, timeout=500,
        check=False, env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode in (1, 2)
    assert "Traceback" not in done.stderr
    assert "No space left" in done.stderr
    assert str(tiny_disk) in done.stderr
    assert not [p for p in tiny_disk.rglob("*") if p.suffix == ".part"]


def test_failed_block_leaves_no_file(tmp_path: Path) -> None:
    path = tmp_path / "a" / "file"

    def fail() -> None:
        with atomic_write(path) as unfinished:
            unfinished.write_text("half")
            raise KeyError("in its middle")

    with pytest.raises(KeyError, match="middle"):
        fail()
    assert not list(path.parent.iterdir())


def test_new_files_have_the_users_default_permissions(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_atomically(tmp_path / "file", b"x")
    finally:
        os.umask(before)
    assert (tmp_path / "file").stat().st_mode & 0o777 == 0o640
