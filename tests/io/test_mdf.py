"""MDF files with asammdf, and the error without it."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nfriction.io.formats import measurements
from nfriction.recording import Recording

TIME = np.arange(40) / 1000
Q = np.random.default_rng(0).normal(size=(40, 2)) / 7


def test_without_asammdf_the_error_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "asammdf", None)
    (tmp_path / "run.mf4").write_bytes(b"MDF     ")
    with pytest.raises(ImportError, match=r"pip install nfriction\[mdf\]"):
        Recording.read(tmp_path / "run.mf4")


@pytest.fixture
def asammdf() -> Any:
    return pytest.importorskip("asammdf", reason="the extra nfriction[mdf] is not installed")


def write(asammdf: Any, path: Path, *groups: list[tuple[str, np.ndarray, str]]) -> None:
    with asammdf.MDF(version="4.10") as file:
        for k, group in enumerate(groups):
            file.append([
                asammdf.Signal(values, TIME + 1e-4 * k, name=name, unit=unit)
                for name, values, unit in group
            ])  # fmt: skip
        file.save(path, overwrite=True)


def test_channels_are_read_by_name_with_their_units(
    asammdf: Any, tmp_path: Path, without_worker: Callable[[], None]
) -> None:
    path = tmp_path / "run.mf4"
    channels = [("enc_1", np.rad2deg(Q[:, 0]), "deg"), ("enc_2", Q[:, 1], ""), ("gas", TIME, "bar")]
    write(asammdf, path, channels)
    back = Recording.read(path, columns={"q1": "enc_1", "q2": "enc_2:rad"})
    np.testing.assert_allclose(back.q, Q, rtol=6e-16)
    np.testing.assert_allclose(back.time, TIME, rtol=4e-16)
    without_worker()
    with pytest.raises(ValueError, match="given as 'rad', but the file says 'deg'"):
        Recording.read(path, columns={"q1": "enc_1:rad"})
    with pytest.raises(ValueError, match="'bar' is not a unit of q"):
        Recording.read(path, columns={"q1": "gas"})
    with pytest.raises(ValueError, match="columns time, q1 are missing; found enc_1, enc_2, gas"):
        Recording.read(path)


def test_channels_of_different_rasters_are_refused(
    asammdf: Any, tmp_path: Path, without_worker: Callable[[], None]
) -> None:
    without_worker()
    path = tmp_path / "run.mf4"
    write(asammdf, path, [("q1", Q[:, 0], "rad")], [("q2", Q[:, 1], "rad")])
    with pytest.raises(ValueError, match="q2 was not sampled together with q1"):
        Recording.read(path)


def test_channels_of_arrays_are_refused() -> None:
    """Damaged files contain them, although none can be written."""
    arrays = SimpleNamespace(samples=Q, timestamps=TIME, unit="rad")
    file = SimpleNamespace(channels_db={"q1": ((0, 1),)}, get=lambda _: arrays)
    with pytest.raises(ValueError, match="channel q1 has arrays"):
        measurements.choose_channels(file, ())


@pytest.mark.parametrize(
    "part", [0.5, *(pytest.param(part, marks=pytest.mark.slow) for part in (0.25, 64, 10))]
)
def test_truncated_file_is_refused(asammdf: Any, tmp_path: Path, part: float) -> None:
    path = tmp_path / "run.mf4"
    write(asammdf, path, [("q1", Q[:, 0], "rad")])
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content) if part < 1 else part)])
    with pytest.raises(ValueError, match=r"run\.mf4"):
        Recording.read(path)


def test_crash_of_the_reader_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurements, "find_spec", lambda _: True)
    monkeypatch.setattr(measurements, "__name__", "there.is_none")
    (tmp_path / "run.mf4").write_bytes(b"MDF     ")
    with pytest.raises(ValueError, match=r"run\.mf4.*cannot read it .ModuleNotFoundError"):
        Recording.read(tmp_path / "run.mf4")


def test_modules_in_the_working_directory_are_not_run(
    asammdf: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(asammdf, tmp_path / "run.mf4", [("q1", Q[:, 0], "rad")])
    (tmp_path / "struct.py").write_text("raise SystemExit('run')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    assert Recording.read(tmp_path / "run.mf4").joints == 1
