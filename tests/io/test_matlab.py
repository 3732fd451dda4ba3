"""MATLAB 5 files: variables, structs, cells, ControlDesk records, damage."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from nfriction.io.formats.measurements import read_mat
from nfriction.recording import Recording

TIME = np.arange(40) / 1000
Q = np.random.default_rng(0).normal(size=(40, 2)) / 7


@pytest.fixture(autouse=True)
def _in_this_process(request: pytest.FixtureRequest, without_worker: Callable[[], None]) -> None:
    if request.function.__name__ not in IN_A_WORKER:
        without_worker()


# These tests include the worker process.
IN_A_WORKER = {
    "test_plain_variables_as_rows_or_columns_are_read",
    "test_values_that_cannot_be_a_recording_are_named",
    "test_invalid_shapes_are_refused",
    "test_damaged_files_are_read_or_refused",
}


def read(folder: Path, content: dict[str, Any], **settings: Any) -> Recording:
    savemat(folder / "run.mat", content, do_compression=True)
    return Recording.read(folder / "run.mat", **settings)


def structs(*elements: dict[str, Any]) -> np.ndarray:
    """A 1 x n array of structs."""
    array = np.empty((1, len(elements)), dtype=[(name, object) for name in elements[0]])
    for k, element in enumerate(elements):
        for name, value in element.items():
            array[0, k][name] = value
    return array


def controldesk(**axes: Any) -> dict[str, Any]:
    """ControlDesk format: one variable, X and Y arrays of structs, names in quotes."""
    y = [
        {"Name": f'"Model Root/enc {k + 1}/Out1"', "Type": "double", "Data": Q[None, :, k],
         "Unit": "", "XIndex": 1}
        for k in range(2)
    ]  # fmt: skip
    x = {"Name": "HostService", "Type": "double", "Data": TIME[None], "Unit": "s"}
    return {"run_001": {"X": structs(x), "Y": structs(*y), "Description": {"General": "test"}}}


@pytest.mark.parametrize("rows", [True, False])
def test_plain_variables_as_rows_or_columns_are_read(tmp_path: Path, rows: bool) -> None:
    turn = (lambda x: x) if rows else np.transpose
    back = read(tmp_path, {"time": TIME, "q": turn(Q), "tau": turn(2 * Q), "remark": "fine"})
    assert np.array_equal(back.q, Q)
    assert back.tau is not None
    assert np.array_equal(back.tau, 2 * Q)
    assert back.name == "run"


@pytest.mark.parametrize(
    ("content", "columns"),
    [
        ({"data": {"t": TIME * 1e3, "Y": {"a": np.rad2deg(Q[:, 0]), "b": np.rad2deg(Q[:, 1])}}},
         {"time": "data.t:ms", "q1": "data.Y.a:deg", "q2": "data.Y.b:deg"}),
        ({"t": TIME, "enc": Q}, {"time": "t", "q1": "enc[0]", "q2": "enc[1]"}),
        ({"log": structs({"v": TIME}, {"v": Q[:, 0]}, {"v": Q[:, 1]})},
         {"time": "log[0].v", "q1": "log[1].v", "q2": "log[2].v"}),
    ],
)  # fmt: skip
def test_paths_select_fields_of_structs(
    tmp_path: Path, content: dict[str, Any], columns: dict[str, str]
) -> None:
    back = read(tmp_path, content, columns=columns)
    # Conversion to degrees and back: three roundings.
    np.testing.assert_allclose(back.q, Q, rtol=6e-16)
    np.testing.assert_allclose(back.time, TIME, rtol=4e-16)


@pytest.mark.parametrize("prefix", ["", "run_001.Y."])
def test_controldesk_records_are_read_by_name(tmp_path: Path, prefix: str) -> None:
    columns = {f"q{k}": f"{prefix}Model Root/enc {k}/Out1" for k in (1, 2)}
    back = read(tmp_path, controldesk(), columns=columns)
    assert np.array_equal(back.q, Q)
    assert np.array_equal(back.time, TIME)
    inside = {"time": "run_001.X.Data", "q1": "run_001.Y[1].Data"}
    assert np.array_equal(read(tmp_path, controldesk(), columns=inside).q[:, 0], Q[:, 1])


def test_name_of_two_signals_is_ambiguous(tmp_path: Path) -> None:
    content = controldesk() | {"run_002": controldesk()["run_001"]}
    with pytest.raises(ValueError, match="Model Root/enc 1/Out1 are missing; found run_001"):
        read(tmp_path, content, columns={"q1": "Model Root/enc 1/Out1"})


def test_values_that_cannot_be_a_recording_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="columns time, q1 are missing; found a, b"):
        read(tmp_path, {"a": TIME, "b": TIME})
    with pytest.raises(ValueError, match="different numbers of samples: q1 20, time 40"):
        read(tmp_path, {"time": TIME, "q1": Q[:20, 0]})
    (tmp_path / "old.mat").write_bytes(b"\0" * 300)
    with pytest.raises(ValueError, match=r"old\.mat.*not a MATLAB file of version 5 or 7\.3"):
        Recording.read(tmp_path / "old.mat")


def test_every_numeric_type_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    kinds = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")
    numbers = {kind: (50 * rng.random(40)).astype(kind) for kind in kinds}
    columns = {f"q{k + 1}": f"deep.a.{kind}" for k, kind in enumerate(kinds)}
    columns |= {"qd1": "cell[0]"}
    records = structs({"b": "text"}, {"b": TIME[:7]})
    cell = np.array([[TIME, "b"], [np.arange(3), "d"]], dtype=object)
    content = {"time": TIME, "deep": {"a": numbers, "c": records}, "cell": cell, "text": "Übung",
               "flag": rng.random((2, 5)) > 0.5, "empty": np.zeros((0, 3)), "one": 7.0}  # fmt: skip
    for packed in (True, False):
        savemat(tmp_path / "run.mat", content, do_compression=packed)
        back = read_mat(tmp_path / "run.mat", list(columns.values()))
        assert list(back) == sorted([*columns.values(), "time"])
        for kind in kinds:
            assert np.array_equal(back[f"deep.a.{kind}"], numbers[kind])
        assert np.array_equal(back["cell[0]"], TIME)
        assert set(back.attrs["found"]) == {
            "time", "cell[0]", "cell[1]", "deep.c[1].b", "flag[0]", "flag[1]", *columns.values(),
        }  # fmt: skip


def test_the_other_byte_order_is_read(tmp_path: Path) -> None:
    body = b"".join(
        struct.pack(">II", kind, len(content)) + content + bytes(-len(content) % 8)
        for kind, content in (
            (6, struct.pack(">II", 6, 0)), (5, struct.pack(">ii", 40, 1)), (1, b"time"),
            (9, TIME.astype(">f8").tobytes()),
        )
    )  # fmt: skip
    header = b"x" * 124 + struct.pack(">H", 0x0100) + b"MI"
    (tmp_path / "run.mat").write_bytes(header + struct.pack(">II", 14, len(body)) + body)
    assert np.array_equal(read_mat(tmp_path / "run.mat")["time"], TIME)


@pytest.mark.parametrize("skipped", [scipy.sparse.eye(3).tocsc(), np.ones(3) * 1j])
def test_variables_that_are_no_signals_are_skipped(tmp_path: Path, skipped: Any) -> None:
    assert np.array_equal(read(tmp_path, {"s": skipped, "time": TIME, "q": Q}).q, Q)


def test_decompression_bombs_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    savemat(tmp_path / "run.mat", {"time": np.zeros(10**6)}, do_compression=True)
    assert (tmp_path / "run.mat").stat().st_size < 20_000
    monkeypatch.setattr("nfriction.io.formats.LARGEST", 10**6)
    with pytest.raises(ValueError, match="unpacked bytes, more than the limit of 1000000"):
        Recording.read(tmp_path / "run.mat")


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


@pytest.mark.parametrize(
    "shape",
    [
        element(9, struct.pack("<dd", 2.0, 1.0)),
        element(5, struct.pack("<ii", -2, -1)),
        element(5, struct.pack("<ii", 2**30, 2**30)),
    ],
)
@pytest.mark.parametrize("kind", [1, 6])
def test_invalid_shapes_are_refused(tmp_path: Path, shape: bytes, kind: int) -> None:
    flags = element(6, struct.pack("<II", kind, 0))
    array = flags + shape + element(1, b"q1") + element(9, struct.pack("<dd", 1.0, 2.0))
    refused(tmp_path, element(14, array))


def test_truncated_compressed_variable_is_refused(tmp_path: Path) -> None:
    packed = zlib.compress(b"abc")
    refused(tmp_path, struct.pack("<II", 15, len(packed)) + packed)


def refused(folder: Path, content: bytes) -> None:
    header = b"x" * 124 + struct.pack("<H", 0x0100) + b"IM"
    (folder / "run.mat").write_bytes(header + content)
    with pytest.raises(ValueError, match=r"run\.mat"):
        Recording.read(folder / "run.mat")


@settings(
    max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    compressed=st.booleans(),
    edits=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=3),
    share=st.floats(0.5, 1),
)
@pytest.mark.filterwarnings("ignore")
def test_damaged_files_are_read_or_refused(
    tmp_path: Path, compressed: bool, edits: list[tuple[float, int]], share: float
) -> None:
    path = tmp_path / "run.mat"
    savemat(path, {"time": TIME, "q": Q, "s": {"a": [1.0, "b"]}}, do_compression=compressed)
    content = bytearray(path.read_bytes())
    for place, value in edits:
        content[int(place * (len(content) - 1))] = value
    path.write_bytes(content[: int(share * len(content))])
    refused: ValueError | None = None
    try:
        back = Recording.read(path)
    except ValueError as error:
        refused = error
    assert str(path) in str(refused) if refused else np.isfinite(back.q).all()
