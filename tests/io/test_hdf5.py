"""HDF5 and MATLAB 7.3 files with h5py, and the error without it."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nfriction.recording import Recording

TIME = np.arange(40) / 1000
Q = np.random.default_rng(0).normal(size=(40, 2)) / 7


@pytest.fixture
def h5py() -> Any:
    return pytest.importorskip("h5py", reason="the extra nfriction[hdf5] is not installed")


def test_without_h5py_the_error_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    for name, start in (("run.h5", b""), ("run.mat", b"\0" * 512)):
        (tmp_path / name).write_bytes(start + b"\x89HDF\r\n\x1a\n" + b"\0" * 600)
        with pytest.raises(ImportError, match=r"pip install nfriction\[hdf5\].*-v7"):
            Recording.read(tmp_path / name)


@pytest.mark.parametrize("spec", ["log/enc[0]:deg", "/log/enc[0]:deg", "log.enc[0]:deg"])
def test_datasets_are_named_by_their_path(h5py: Any, tmp_path: Path, spec: str) -> None:
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["time"] = TIME
        file["number"] = np.dtype("f8")  # a type is not a signal
        file.create_dataset("log/enc", data=np.rad2deg(Q), compression="gzip")
    back = Recording.read(tmp_path / "run.h5", columns={"q1": spec})
    np.testing.assert_allclose(back.q[:, 0], Q[:, 0], rtol=6e-16)


def matlab(h5py: Any, path: Path) -> None:
    """As MATLAB 7.3 writes `data.Y(k).Name, .Data` and `data.X.Data`: fields of references."""
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("data")
        group.create_dataset("X/Data", data=TIME[:, None])
        fields: dict[str, list[Any]] = {"Name": [], "Data": []}
        for k in range(2):
            name = file.create_dataset(f"#refs#/n{k}", data=[[ord(c)] for c in f"enc_{k + 1}"],
                                       dtype="u2")  # fmt: skip
            name.attrs["MATLAB_class"] = np.bytes_("char")
            fields["Name"].append(name.ref)
            fields["Data"].append(file.create_dataset(f"#refs#/d{k}", data=Q[:, k, None]).ref)
        for field, references in fields.items():
            group.create_dataset(f"Y/{field}", data=references, dtype=h5py.ref_dtype)


def test_matlab_7_3_records_are_read_by_name_and_path(h5py: Any, tmp_path: Path) -> None:
    matlab(h5py, tmp_path / "run.mat")
    for names in (("enc_1", "enc_2"), ("data.Y[0].Data", "data.Y[1].Data"),
                  ("data.Y.enc_1", "data.Y.enc_2")):  # fmt: skip
        back = Recording.read(tmp_path / "run.mat", columns={"q1": names[0], "q2": names[1]})
        assert np.array_equal(back.q, Q)
        assert np.array_equal(back.time, TIME)


def test_matrices_of_matlab_7_3_are_transposed_and_empty_ones_skipped(
    h5py: Any, tmp_path: Path
) -> None:
    square = np.arange(64.0).reshape(8, 8)
    with h5py.File(tmp_path / "run.mat", "w", userblock_size=512) as file:
        file["time"] = TIME[None, :8]
        # MATLAB's q(:, 1) is the first row here.
        file["q"] = square.T
        file["tau1"] = np.zeros(2, "u8")  # the shape, 0 x 0
        for name in ("time", "q", "tau1"):
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        file["tau1"].attrs["MATLAB_empty"] = np.uint8(1)
    back = Recording.read(tmp_path / "run.mat", unit="m")
    assert np.array_equal(back.q, square)
    assert back.tau is None


def test_links_outside_the_file_are_not_followed(h5py: Any, tmp_path: Path) -> None:
    (tmp_path / "secret.bin").write_bytes(TIME.tobytes())
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = TIME
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["time"] = TIME
        file["q1"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "x")
        file.create_dataset("q2", (40,), "f8", external=[(str(tmp_path / "secret.bin"), 0, 320)])
        layout = h5py.VirtualLayout((40,), "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "x", shape=(40,))
        file.create_virtual_dataset("q3", layout)
    with pytest.raises(ValueError, match="column q1 is missing; found time"):
        Recording.read(tmp_path / "run.h5")


def test_loops_bombs_and_damage_are_refused(h5py: Any, tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("a")
        group["b"] = group
    with pytest.raises(ValueError, match="too deeply, or in a loop"):
        Recording.read(path)
    with h5py.File(path, "w") as file:
        file.create_dataset("time", (2**40,), "f8", chunks=(1024,), fillvalue=1.0)
    with pytest.raises(ValueError, match="cut it into parts"):
        Recording.read(path)
    with h5py.File(path, "w") as file:
        file["time"], file["q"] = TIME, Q
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(100):
        damaged = bytearray(content[: int(rng.uniform(0.3, 1) * len(content))])
        for at in rng.integers(0, len(damaged), 5):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        refused: ValueError | None = None
        try:
            back = Recording.read(path)
        except ValueError as error:
            refused = error
        assert str(path) in str(refused) if refused else np.isfinite(back.q).all()
