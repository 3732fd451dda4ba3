"""Recordings: round trips through every format, slices, validation, the real files."""

import gzip
import io
import sys
import warnings
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from nfriction.plant import LinearAxis, Motor, PendulumChain, Rotor
from nfriction.recording import Recording, RecordingWarning, read_initial_states
from nfriction.recording.angles import AngleConvention

ENDINGS = [".csv", ".csv.gz", ".parquet", ".npz"]


@dataclass
class Rig:
    """The part of a plant that a recording needs."""

    convention: tuple[str, str]
    first_link: int
    unit: str = "rad"


def swing(n: int = 60, joints: int = 2, **settings: object) -> Recording:
    """A recording whose numbers have all their digits."""
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.8e-3, 1.2e-3, n))
    q, qd, tau = rng.normal(size=(3, n, joints)).cumsum(axis=1) / 300
    return Recording(time, q, tau=tau, qd=qd, **settings)  # type: ignore[arg-type]


# --- files -----------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("joints", [1, 3, 11])
def test_file_round_trip_is_exact(tmp_path: Path, ending: str, joints: int) -> None:
    recording = swing(
        joints=joints,
        convention=AngleConvention("absolute", "hanging"),
        names=tuple(f"link {k}" for k in range(joints)),
    )
    recording.write(tmp_path / f"run{ending}")
    back = Recording.read(tmp_path / f"run{ending}")
    assert back.digest() == recording.digest()
    assert back.name == "run"
    assert [path.name for path in tmp_path.iterdir()] == [f"run{ending}"]


@pytest.mark.parametrize("ending", ENDINGS)
def test_optional_columns_and_unit_are_kept(tmp_path: Path, ending: str) -> None:
    full = swing()
    axis = Recording(full.time, full.q, tau=full.tau, unit="m")
    axis.write(tmp_path / f"axis{ending}")
    back = Recording.read(tmp_path / f"axis{ending}")
    assert back.qd is None
    assert back.unit == "m"
    assert back.digest() == axis.digest()


def test_pandas_round_trip_is_exact() -> None:
    recording = swing(convention=AngleConvention("absolute"))
    assert Recording.from_pandas(recording.to_pandas()).digest() == recording.digest()
    with pytest.raises(TypeError, match=r"`table` must be a pandas\.DataFrame, got dict"):
        Recording.from_pandas({"time": [0.0, 1.0], "q1": [0.0, 1.0]})


def test_arguments_override_the_file(tmp_path: Path) -> None:
    swing(convention=AngleConvention("absolute", "hanging")).write(tmp_path / "run.csv")
    back = Recording.read(tmp_path / "run.csv", convention="relative,upright", unit="m", name="a")
    assert (back.convention, back.unit, back.name) == (AngleConvention(), "m", "a")


def test_degrees_are_converted_on_entry() -> None:
    recording = swing()
    table = recording.to_pandas()
    for column in ("q1", "q2", "qd1", "qd2"):
        table[column] = np.rad2deg(table[column])
    back = Recording.from_pandas(table, degrees=True)
    # Two roundings, to degrees and back.
    np.testing.assert_allclose(back.q, recording.q, rtol=1e-15)
    assert back.qd is not None
    np.testing.assert_allclose(back.qd, recording.qd, rtol=1e-15)
    assert np.array_equal(back.tau, recording.tau)
    with pytest.raises(ValueError, match="`degrees=True` needs angles"):
        Recording.from_pandas(table, degrees=True, unit="m")


def test_columns_option_maps_swaps_and_shifts_names() -> None:
    recording = swing()
    table = recording.to_pandas().rename(columns={"time": "t", "q1": "enc_1"})
    back = Recording.from_pandas(table, columns={"time": "t", "q1": "enc_1"})
    assert back.digest() == recording.digest()
    swapped = Recording.from_pandas(recording.to_pandas(), columns={"q1": "q2", "q2": "q1"})
    assert np.array_equal(swapped.q, recording.q[:, ::-1])
    shifted = recording.to_pandas().rename(columns={"q1": "q2", "q2": "q3"})
    renumbered = Recording.from_pandas(shifted, columns={"q1": "q2", "q2": "q3"})
    assert np.array_equal(renumbered.q, recording.q)


def test_extra_columns_and_partial_velocities_are_ignored() -> None:
    recording = swing()
    table = recording.to_pandas().drop(columns=["qd1"])
    table["remark"] = "fine"
    with pytest.warns(RecordingWarning, match="column qd1 is missing, so no measured velocity"):
        back = Recording.from_pandas(table)
    assert back.qd is None
    assert np.array_equal(back.q, recording.q)
    assert np.array_equal(back.tau, recording.tau)  # type: ignore[arg-type]


@pytest.mark.parametrize("columns", [{}, {"tau2": "tau2"}])
def test_joint_without_torque_column_is_undriven_with_a_warning(
    tmp_path: Path, columns: dict[str, str]
) -> None:
    """As for an acrobot, whose only motor is between its links."""
    recording = swing()
    table = recording.to_pandas().drop(columns=["tau1"])
    message = r"'run': no column tau1, .* to be passive.*columns=\{\"tau1\": \"\.\.\.\"\}"
    with pytest.warns(RecordingWarning, match=message):
        back = Recording.from_pandas(table, columns=columns, name="run")
    table.to_csv(tmp_path / "run.csv", index=False)
    with pytest.warns(RecordingWarning, match=message):
        read = Recording.read(tmp_path / "run.csv", columns=columns)
    assert recording.tau is not None
    for found in (back, read):
        assert found.tau is not None
        assert not found.tau[:, 0].any()
        assert np.array_equal(found.tau[:, 1], recording.tau[:, 1])


def test_unit_in_a_column_name_applies_in_every_table() -> None:
    recording = swing(joints=1)
    names = {"time": "t [ms]", "q1": "angle [deg]", "tau1": "torque_Ncm", "qd1": "speed (deg/s)"}
    table = recording.to_pandas() * {
        "time": 1e3,
        "q1": 180 / np.pi,
        "tau1": 1e2,
        "qd1": 180 / np.pi,
    }
    back = Recording.from_pandas(table.rename(columns=names), columns=names)
    for found, given in ((back.q, recording.q), (back.tau, recording.tau), (back.qd, recording.qd)):
        np.testing.assert_allclose(found, given, rtol=1e-14)
    np.testing.assert_allclose(back.time, recording.time, rtol=1e-14)


@pytest.mark.parametrize(
    ("name", "joints", "own"),
    [
        ("tau", 1, "tau1"), ("tau", 2, "tau1"), ("Tau1", 1, "tau1"), ("tau_2", 2, "tau2"),
        ("torque1", 2, "tau1"), ("motorTorque2 [Nm]", 2, "tau2"), ("tau0", 1, "tau1"),
        ("tau1_Ncm", 1, "tau1"), ("torque_2_Nm", 2, "tau2"),
    ],
)  # fmt: skip
def test_ignored_column_that_looks_like_torque_raises_a_warning(
    name: str, joints: int, own: str
) -> None:
    table = swing(joints=joints).to_pandas().filter(regex="time|q")
    table[name] = 1.0
    with pytest.warns(RecordingWarning, match="looks like torque and is not read") as caught:
        assert Recording.from_pandas(table).tau is None
    assert len(caught) == 1
    assert f'columns={{"{own}": "{name}"}}' in str(caught[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # If all torques are named, the other columns are ignored on purpose.
        named = {f"tau{k + 1}": f"motor {k}" if k else name for k in range(joints)}
        Recording.from_pandas(table.assign(**{"motor 1": 2.0}), columns=named)
        Recording.from_pandas(table.rename(columns={name: "torque_on"}))


@pytest.mark.parametrize("name", ["current", "current1 [A]", "Motorstrom_1"])
def test_ignored_motor_current_raises_a_warning(name: str) -> None:
    table = swing(joints=1).to_pandas().filter(regex="time|q")
    table[name] = 1.0
    match = "looks like motor current and is not read; .* give the rig a `motor` with its `torque_"
    with pytest.warns(RecordingWarning, match=match):
        assert Recording.from_pandas(table).tau is None


@pytest.mark.parametrize(("unit", "kind"), [("mA", "motor current"), ("Nm", "torque")])
def test_unit_distinguishes_torque_from_current(tmp_path: Path, unit: str, kind: str) -> None:
    rows = "".join(f"{k / 100};{k % 3 / 9};1\n" for k in range(20))
    (tmp_path / "log.csv").write_text(f"time;q1;X\ns;rad;{unit}\n{rows}")
    with pytest.warns(RecordingWarning, match=f"column X looks like {kind} and is not read"):
        Recording.read(tmp_path / "log.csv")


@pytest.mark.parametrize("columns", [{"q1": "q2"}, {"q1": "q1", "tau2": "q1"}, {"time": "q1:ms"}])
def test_column_may_be_used_only_once(columns: dict[str, str]) -> None:
    table = swing().to_pandas().drop(columns="tau2", errors="ignore")
    columns = {"q1": "q1", "q2": "q2"} | columns
    with pytest.raises(
        ValueError, match=r"names column q\d for q\d and .*; each needs its own column"
    ):
        Recording.from_pandas(table, columns=columns)


def test_named_columns_and_joints_must_exist() -> None:
    table = swing().to_pandas()
    with pytest.raises(ValueError, match="column motor is missing; found time"):
        Recording.from_pandas(table, columns={"tau1": "motor"})
    with pytest.raises(ValueError, match="names tau3, but the last position is q2"):
        Recording.from_pandas(table, columns={"tau3": "tau1"})
    with pytest.raises(ValueError, match=r"`columns` must be like .*, got 'q1=enc:deg'"):
        Recording.read("log.csv", columns="q1=enc:deg")  # type: ignore[arg-type]


def test_csv_with_blanks_and_byte_order_mark_is_read(tmp_path: Path) -> None:
    rows = "".join(f"{k / 1000}, {k / 7!r}\r\n" for k in range(20))
    (tmp_path / "a.csv").write_bytes(("\ufefftime, q1\r\n" + rows).encode())
    back = Recording.read(tmp_path / "a.csv")
    assert np.array_equal(back.q[:, 0], np.arange(20) / 7)


def test_compressed_files_do_not_contain_the_time(tmp_path: Path) -> None:
    swing().write(tmp_path / "a.csv.gz")
    swing().write(tmp_path / "b.csv.gz")
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()


def test_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.csv"
    swing().write(path)
    before = path.read_bytes()

    def full(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr("nfriction.io.formats.os.replace", full)
    with pytest.raises(OSError, match="no space"):
        swing(n=30).write(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


# --- broken files ----------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".csv.gz", ".parquet", ".npz"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.9, 0.99])
def test_truncated_files_are_named(tmp_path: Path, ending: str, share: float) -> None:
    path = tmp_path / f"run{ending}"
    swing(n=500).write(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=rf"run{ending}.*truncated"):
        Recording.read(path)


def test_absent_empty_and_unknown_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no recording at .*lost\.csv"):
        Recording.read(tmp_path / "lost.csv")
    with pytest.raises(ValueError, match=r"run\.doc.*must end in one of \.csv"):
        Recording.read(tmp_path / "run.doc")
    for ending in ENDINGS:
        (tmp_path / f"empty{ending}").touch()
        with pytest.raises(ValueError, match="is empty"):
            Recording.read(tmp_path / f"empty{ending}")


def test_pickled_objects_are_never_loaded(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", time=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ValueError, match="neither numbers nor text"):
        Recording.read(tmp_path / "run.npz")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,q1\n", "at least 8 samples, got 0"),
        ("t,q1\n0,0\n", "column time is missing; found t, q1.*columns="),
        ("time,q1,q3\n0,0,0\n", "column q2 is missing"),
        ("time,angle\n0,0\n", "column q1 is missing; found time, angle"),
        ("time,speed\n0,0\n", "Without positions, add the integral of speed over time"),
        ("Zeit,Motorwinkel,Strom\n0,0,0\n", '"motor1": "Motorwinkel", "current1": "Strom"'),
        ("Zeit;Motorwinkel;Iq\n[ms];[deg];[mA]\n0;0;0\n", '"current1": "Iq"'),
        ("t_s,ang1,M1 (Nm)\n0,0,0\n", '"q1": "ang1", "tau1": "M1'),
        ("time,q1\n0,0\n1,zero\n", "column q1, row 1 .*got 'zero'"),
        ("time,q1\n0,0\n1,2,3\n", "ragged"),
        ("time,q1\n0,0,1\n1,2,3\n", "more cells than its header"),
        ("# unit: deg\ntime,q1\n" + "0,0\n" * 9, "`unit` must be 'rad' or 'm', got 'deg'"),
        ("# convention: odd\ntime,q1\n" + "0,0\n" * 9, "`convention` must be one of"),
    ],
)
def test_malformed_csv_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "run.csv.gz"
    path.write_bytes(gzip.compress(text.encode()))
    with pytest.raises(ValueError, match=message) as caught:
        Recording.read(path)
    assert "run.csv.gz" in str(caught.value)


def test_parquet_without_pyarrow_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    swing().write(tmp_path / "run.parquet")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ImportError, match=r"pip install nfriction\[parquet\]"):
        Recording.read(tmp_path / "run.parquet")


def test_array_that_declares_more_data_than_it_has_is_refused(tmp_path: Path) -> None:
    header = io.BytesIO()
    claim = {"descr": "<f8", "fortran_order": False, "shape": (10**15,)}
    np.lib.format.write_array_header_1_0(header, claim)  # type: ignore[arg-type]
    with zipfile.ZipFile(tmp_path / "run.npz", "w") as archive:
        archive.writestr("q1.npy", header.getvalue() + bytes(80))
    with pytest.raises(ValueError, match=r"run\.npz.*80 bytes, which do not fit its shape"):
        Recording.read(tmp_path / "run.npz")


def test_missing_folders_are_created(tmp_path: Path) -> None:
    recording = Recording(np.arange(9.0) / 100, np.zeros((9, 1)))
    recording.write(tmp_path / "a" / "b" / "run.csv")
    assert Recording.read(tmp_path / "a" / "b" / "run.csv").digest() == recording.digest()


def test_text_in_foreign_tables_is_refused() -> None:
    table = swing().to_pandas().astype({"q1": object})
    table["q1"] = "35,000"
    with pytest.raises(ValueError, match=r"column q1, row 0 .* must be a number, got '35,000'"):
        Recording.from_pandas(table)


def test_foreign_tables_may_have_numbered_or_repeated_columns() -> None:
    time, q = np.arange(20) / 1000, np.arange(20) / 50
    numbered = pd.DataFrame({0: time, 1: q})
    for columns in ({"time": "0", "q1": "1"}, {"time": 0, "q1": 1}):
        found = Recording.from_pandas(numbered, columns=columns)  # type: ignore[arg-type]
        assert np.array_equal(found.q[:, 0], q)
    assert list(numbered.columns) == [0, 1]
    repeated = pd.DataFrame(np.stack([time, q, q], axis=1), columns=["time", "q1", "q1"])
    with pytest.raises(ValueError, match="column q1 occurs more than once"):
        Recording.from_pandas(repeated)


# --- validation ------------------------------------------------------------------------------


def changed(**parts: object) -> Recording:
    recording = swing()
    arrays = {key: getattr(recording, key).copy() for key in ("time", "q", "tau", "qd")}
    return Recording(**(arrays | parts))  # type: ignore[arg-type]


def poked(shape: tuple[int, ...], index: tuple[int, ...], value: float) -> np.ndarray:
    array = np.zeros(shape)
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"q": np.zeros(60)}, r"`q` must be \(time, joint\), got shape \(60,\).*q\[:, None\]"),
        ({"q": [[0.0, 1.0], [2.0]]}, "`q` must be a rectangular array"),
        ({"q": poked((60, 2), (7, 1), np.nan)}, "`q2` must be finite, .* nan at sample 7 .*remove"),
        ({"tau": poked((60, 2), (9, 0), np.inf)}, "`tau1` must be finite, got inf at sample 9"),
        ({"tau": np.zeros((60, 1))}, r"`tau` must be shaped like `q` \(60, 2\)"),
        ({"qd": np.zeros((59, 2))}, "`qd` must be shaped like"),
        ({"time": np.arange(59.0)}, "as many samples"),
        ({"time": poked((60,), (0,), np.nan)}, "`time` must be finite"),
        ({"time": np.repeat(np.arange(30.0), 2)}, r"sample 1 \(30 such.*drop repeated rows; if"),
        ({"time": -np.arange(60.0)}, "`time` must increase"),
        ({"time": np.r_[0.0:30, 28:58]}, r"got 29\.0 then 28\.0 s at sample 30 .*sort the rows"),
        ({"time": 1.7e9 + np.r_[0.0:30, 28:58]}, "sort the rows"),
        ({"time": np.r_[0.0:30, 0:30]}, r"got 29\.0 then 0\.0 s .*read each part of the file as"),
        (
            {"time": 1.7e9 + np.repeat(np.arange(30.0), 2)},
            r"got 1700000000\.0 then 1700000000\.0 s .*with more digits, or count from",
        ),
        ({"names": ("a",)}, "`names` must name each of 2 joints once"),
        ({"names": ("a", "a")}, "once"),
        ({"names": ("a", "b,c")}, "free of commas"),
        ({"unit": "deg"}, "`unit` must be 'rad' or 'm'"),
    ],
)
def test_bad_arrays_are_refused(parts: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        changed(**parts)


def test_too_few_samples_are_refused() -> None:
    assert len(swing()[:8]) == 8
    with pytest.raises(ValueError, match="at least 8 samples, got 7"):
        swing()[:7]


def test_tensors_are_accepted_without_warnings() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording = Recording(torch.arange(20) / 100, torch.ones(20, 1))  # type: ignore[arg-type]
    assert recording.q.dtype == np.float64


def test_arrays_are_copies_and_read_only() -> None:
    q = np.zeros((60, 2))
    recording = changed(q=q)
    q[0] = 1
    assert recording.q[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        recording.q[0] = 1


@pytest.mark.parametrize("count", [2 * np.pi / 4096, 1e-12])
@pytest.mark.parametrize("held", [2, 5])
def test_positions_of_a_slower_sensor_raise_a_warning(count: float, held: int) -> None:
    time = 2e-3 * np.arange(2000)
    q = count * np.round(np.sin(3 * time)[:, None] / count)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Slow joints rest between counts, and jerky ones stop at once.
        Recording(time, q)
        Recording(time, 0.05 * q)
        Recording(time, count * np.round(np.abs(np.sin(3 * time))[:, None] / count))
    slow = np.repeat(q[::held], held, 0)
    with pytest.warns(RecordingWarning, match=f"of joint1 is repeated for about {held} samples"):
        found = Recording(time, slow)
    assert len(found[::held]) == 2000 // held


@pytest.mark.parametrize(
    ("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")]
)
def test_wrong_time_unit_raises_a_warning(factor: float, unit: str) -> None:
    recording = swing()
    with pytest.warns(RecordingWarning, match=unit):
        Recording(recording.time * factor, recording.q)


def test_an_axis_in_milliseconds_is_not_taken_for_a_wrapped_angle() -> None:
    q = 1e-3 * np.arange(100)[:, None]
    q[50:] -= 2 * np.pi
    with pytest.warns(RecordingWarning) as caught:
        Recording(np.arange(100.0), q, unit="m")
    assert not any("wrapped" in str(w.message) for w in caught)


def test_gaps_raise_a_warning_and_jitter_does_not() -> None:
    time = np.arange(100) / 100
    jitter = np.random.default_rng(0).uniform(-4e-3, 4e-3, 100)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Recording(time + jitter, np.zeros((100, 1)))
    with pytest.warns(RecordingWarning, match=r"'a': `time` has gaps \(2\), .* 2\.01 s at 1\.39 s"):
        Recording(time + 1.0 * (time >= 0.2) + 2.0 * (time >= 0.4), np.zeros((100, 1)), name="a")


def test_packet_time_stamps_are_distinguished_from_gaps() -> None:
    """Five samples within microseconds, every 10 ms."""
    time = np.arange(100) // 5 / 100 + np.arange(100) % 5 * 1e-6
    with pytest.warns(RecordingWarning, match=r"gaps \(19\).* if samples came in packets, give"):
        Recording(time, np.zeros((100, 1)))


def test_mask_removes_samples_and_does_not_repeat_warnings() -> None:
    time = np.arange(100) / 100
    columns = {"tau": 2.0 * time[:, None], "qd": 3.0 * time[:, None]}
    recording = Recording(time, time[:, None], **columns, convention="relative,upright", name="a")
    keep = (time < 0.3) | (time > 0.6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        part = recording[keep]
        again = part[:60].joint_coordinates()
    assert part.name == "a"
    for key in ("time", "q", "tau", "qd"):
        np.testing.assert_array_equal(getattr(part, key), getattr(recording, key)[keep])
    assert part.segments == [(0, 29), (30, len(part) - 1)]
    assert len(again) == 60
    assert recording[pd.Series(keep)].digest() == part.digest()
    for wrong in (keep[:50], np.arange(10), True):
        with pytest.raises(TypeError, match=r"mask of 100 booleans, got .* of shape"):
            recording[wrong]


@pytest.mark.parametrize(
    ("column", "options", "warning_count"),
    [
        ("position", {"columns": {"q1": "position:counts/4096"}}, 0),
        ("position [deg]", {"columns": {"q1": "position [deg]"}}, 0),
        ("position", {"columns": {"q1": "position:rad"}}, 0),
        ("q1", {"degrees": True}, 0),
        ("q1", {}, 1),
    ],
)
def test_stated_unit_of_a_wheel_is_not_doubted(
    column: str, options: dict[str, Any], warning_count: int
) -> None:
    time = 0.01 * np.arange(100)
    table = pd.DataFrame({"time": time, column: np.rint(1e4 * np.sqrt(time)) / 2})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Recording.from_pandas(table, **options)
    assert sum("degrees" in str(warning.message) for warning in caught) == warning_count


def test_rotating_joints_are_not_taken_for_degrees_or_wrapped() -> None:
    time = np.arange(2000) * 1e-3
    whirling = 25.0 * time[:, None]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Recording(time, whirling)
    with pytest.warns(RecordingWarning) as caught:
        Recording(time, np.remainder(whirling, 2 * np.pi))
    assert not any("degrees" in str(warning.message) for warning in caught)


@pytest.mark.parametrize("low", [0.0, -np.pi])
@pytest.mark.parametrize("sample_time", [1e-3, 0.05])
def test_wrapped_angles_raise_a_warning_with_their_joint(low: float, sample_time: float) -> None:
    """The second joint of two rotates, by up to a quarter of a turn per sample."""
    time = np.arange(400) * sample_time
    q = np.stack([np.sin(time), 25.0 * time]).T
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Recording(time, q)
    wrapped = np.remainder(q - low, 2 * np.pi) + low
    with pytest.warns(RecordingWarning, match=r"'a': `q` of elbow looks wrapped .*numpy\.unwrap"):
        Recording(time, np.stack([q[:, 0], wrapped[:, 1]]).T, names=("hip", "elbow"), name="a")


def test_other_jumps_by_a_turn_are_not_taken_for_wrapped_angles() -> None:
    time = np.arange(400) * 1e-2
    turn = 2 * np.pi * (time >= 2)[:, None]
    # Steps in degrees grow to a turn of 2π and beyond.
    degrees = 180 * np.sin(6 * time)[:, None]
    assert np.abs(np.diff(degrees, axis=0)).max() > 3 * np.pi
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message=".*wrapped")
        Recording(time, degrees)
        Recording(time + 5.0 * (time >= 2), turn)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Recording(time, turn, unit="m")


# --- cutting ---------------------------------------------------------------------------------


def test_slices_keep_everything_else() -> None:
    recording = swing(names=("a", "b"), convention=AngleConvention("absolute"), name="run")
    part = recording[10:40:2]
    assert np.array_equal(part.time, recording.time[10:40:2])
    assert np.array_equal(part.tau, recording.tau[10:40:2])  # type: ignore[index]
    assert (part.names, part.convention, part.name) == (("a", "b"), recording.convention, "run")
    with pytest.raises(TypeError, match="slice of samples"):
        recording[3]  # type: ignore[index]


def test_irregular_time_stamps_are_kept_and_reported() -> None:
    assert not swing().is_uniform
    time = np.round(np.arange(100) / 700, 6)
    assert Recording(time, np.zeros((100, 1))).is_uniform
    text = repr(swing(name="run"))
    assert all(part in text for part in ("'run'", "samples=60", "irregular", "'tau'", "joint2"))


def test_digest_depends_only_on_the_content() -> None:
    base = swing().digest()
    assert swing(name="other").digest() == base
    assert len(base) == 64
    q = swing().q.copy()
    q[3, 1] = np.nextafter(q[3, 1], 1)
    others = [
        changed(q=q),
        changed(tau=None),
        changed(names=("a", "b")),
        changed(unit="m"),
        changed(convention=AngleConvention("absolute")),
    ]
    assert len({base, *(other.digest() for other in others)}) == 6


def test_joint_coordinates_follow_the_convention() -> None:
    recording = swing(joints=3, convention=AngleConvention("absolute", "hanging"))
    on_arm = Rig(("relative", "upright"), 1)
    joint = recording.joint_coordinates(on_arm)
    assert joint.convention == AngleConvention()
    assert np.array_equal(joint.q[:, 0], recording.q[:, 0])
    np.testing.assert_allclose(joint.q[:, 1], recording.q[:, 1] + np.pi, atol=1e-15)
    np.testing.assert_allclose(joint.qd[:, 2], recording.qd[:, 2] - recording.qd[:, 1])  # type: ignore[index]
    assert np.array_equal(joint.tau, recording.tau)  # type: ignore[arg-type]
    assert joint.joint_coordinates(on_arm).digest() == joint.digest()
    axis = changed(unit="m", convention=AngleConvention("absolute", "hanging"))
    assert axis.joint_coordinates() is axis


def test_unit_must_match_the_plant() -> None:
    turns, slides = (Rig(("relative", "upright"), 0, unit) for unit in ("rad", "m"))
    for unit, plant in (("m", turns), ("rad", slides)):
        recording = swing(unit=unit, name="run")
        message = rf"run is in {unit}, the plant's joints are in .*`unit='{plant.unit}'`"
        with pytest.raises(ValueError, match=message):
            recording.resolve_convention(plant)
        with pytest.raises(ValueError, match=message):
            recording.joint_coordinates(plant)


def test_plant_supplies_a_missing_convention() -> None:
    hanging = Rig(("absolute", "hanging"), 0)
    stated = swing(convention="absolute,hanging")
    unstated = replace(stated, convention=None)
    assert unstated.convention is None
    assert unstated.resolve_convention(hanging) == stated.convention
    assert unstated.joint_coordinates(hanging).digest() == stated.joint_coordinates().digest()
    # Its own convention takes precedence.
    assert stated.resolve_convention(Rig(("relative", "upright"), 0)) == stated.convention
    with pytest.raises(ValueError, match="has no angle convention; give the plant"):
        unstated.joint_coordinates()
    assert unstated.digest() != stated.digest()
    assert "that of the plant" in repr(unstated)


@pytest.mark.parametrize("ending", ENDINGS)
def test_unstated_convention_remains_unstated(tmp_path: Path, ending: str) -> None:
    swing().write(tmp_path / f"run{ending}")
    back = Recording.read(tmp_path / f"run{ending}")
    assert back.convention is None
    assert back.digest() == swing().digest()
    assert Recording.from_pandas(swing().to_pandas()).convention is None


@pytest.mark.parametrize(
    "given",
    [
        "absolute,hanging",
        ("absolute", "hanging"),
        ["hanging", "absolute"],
        AngleConvention("absolute", "hanging"),
        Rig(("absolute", "hanging"), 0),
    ],
)
def test_convention_may_be_given_in_several_forms(tmp_path: Path, given: Any) -> None:
    swing().write(tmp_path / "run.csv")
    expected = AngleConvention("absolute", "hanging")
    assert Recording.read(tmp_path / "run.csv", convention=given).convention == expected
    assert Recording.from_pandas(swing().to_pandas(), convention=given).convention == expected
    assert swing(convention=given).convention == expected


@pytest.mark.parametrize("given", ["", "sideways", (), ("absolute", 3), 7, object(), True])
def test_a_wrong_convention_is_refused_at_once(given: Any) -> None:
    # Before the file is opened.
    with pytest.raises(ValueError, match="`convention` must be one of"):
        Recording.read("absent.csv", convention=given)
    with pytest.raises(ValueError, match="`convention` must be one of"):
        swing(convention=given)


# --- the real files --------------------------------------------------------------------------


def test_real_files_read_silently_and_degrees_raise_a_warning(data_dir: Path) -> None:
    # Some sets are tables of friction over velocity, not recordings of a motion.
    paths = [
        path
        for path in sorted(data_dir.glob("*/*.csv*"))
        if {"time", "q1"} <= set(pd.read_csv(path, nrows=0)) and path.name != "recordings.csv"
    ]
    assert paths
    for path in paths:
        unit = "m" if path.parent.name == "emps" else "rad"
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            recording = Recording.read(path, unit=unit)  # type: ignore[arg-type]
        table = pd.read_csv(path)
        assert len(recording) == len(table)
        np.testing.assert_allclose(recording.q[:, -1], table[f"q{recording.joints}"], rtol=1e-12)
        assert (recording.tau is not None) == ("tau1" in table)
        if unit == "rad":
            with pytest.warns(RecordingWarning, match="degrees"):
                Recording(recording.time, np.rad2deg(recording.q))


@pytest.mark.slow
def test_initial_states_of_the_real_sets_match_the_recordings(data_dir: Path) -> None:
    multiarm = read_initial_states(data_dir / "multiarm_pendulum" / "recordings.csv")
    assert {key: len(q0) for key, (q0, _) in multiarm.items() if key.endswith("b0")} == {
        "single_b0": 1,
        "double_b0": 2,
        "triple_b0": 3,
    }
    for table in data_dir.glob("*/recordings.csv"):
        if "qd0_1" not in pd.read_csv(table, nrows=0):
            continue
        for key, (q0, qd0) in read_initial_states(table).items():
            path = next(table.parent.glob(f"{key}.csv*"))
            recording = Recording.read(path)
            assert q0.shape == qd0.shape == (recording.joints,)
            # A state belongs to the first sample: within a few counts of it.
            assert np.abs(q0 - recording.q[0]).max() < 3e-3


def test_invalid_initial_states_raise_clear_errors(tmp_path: Path) -> None:
    path = tmp_path / "recordings.csv"
    path.write_text("id,q0_1\na,0.5\n")
    with pytest.raises(ValueError, match=r"lacks columns qd0_1;"):
        read_initial_states(path)
    path.write_text("id,q0_1,qd0_1\n")
    with pytest.raises(
        ValueError, match="has no rows; write one per recording with id, q0_1, qd0_1"
    ):
        read_initial_states(path)
    path.write_text(f"id,q0_1,qd0_1,q0_{'1' * 5000}\na,0.5,0,1\n")
    assert list(read_initial_states(path)) == ["a"]
    path.write_text("id,q0_1,qd0_1\n,0.5,0\n")
    with pytest.raises(ValueError, match="row 1 has no id"):
        read_initial_states(path)
    path.write_text("id,q0_1,qd0_1,q0_2,qd0_2\na,0.5,0,1,\n")
    with pytest.raises(ValueError, match="finite q0 and qd0 of the same joints"):
        read_initial_states(path)
    path.write_text("id,q0_1,qd0_1,q0_2,qd0_2\na,0.5,0,inf,inf\n")
    with pytest.raises(ValueError, match="with finite q0"):
        read_initial_states(path)
    path.write_text("qd0_10,q0_2,id,q0_10,qd0_2\n4,1,a,3,2\n,7,b,,8\n")
    states = read_initial_states(path)
    assert [list(part) for part in states["a"]] == [[1, 3], [2, 4]]
    assert [list(part) for part in states["b"]] == [[7], [8]]
    for label, parts in read_initial_states(path, degrees=True).items():
        np.testing.assert_allclose(np.rad2deg(parts), states[label], rtol=4e-16)


def test_missing_columns_error_suggests_similar_names() -> None:
    table = (
        swing().to_pandas().rename(columns={"time": "Zeit [ms]", "q1": "Winkel 1", "q2": "enc_2"})
    )
    offered = r'columns={"time": "Zeit \[ms\]", "q1": "Winkel 1", "q2": "enc_2"}'
    with pytest.raises(ValueError, match=offered):
        Recording.from_pandas(table)
    with pytest.raises(ValueError, match=r'columns={"time": "..."}'):
        Recording.from_pandas(table.rename(columns={"Zeit [ms]": "a"}))


GEARED = Rotor(0.02, motor=Motor(gear_ratio=50, torque_constant=0.03))


def motor_log(**columns: object) -> pd.DataFrame:
    """A table with a motor's encoder counts, 1000 per turn, and its current."""
    log = {"time": 0.01 * np.arange(20), "enc": 1000 * np.arange(20), "I": np.linspace(-1, 1, 20)}
    return pd.DataFrame(log | columns)


def test_motor_angle_and_current_are_converted_to_the_joint() -> None:
    columns = {"motor1": "enc:counts/1000", "current1": "I"}
    recording = Recording.from_pandas(motor_log(), columns=columns, plant=GEARED)
    np.testing.assert_allclose(recording.q[:, 0], 2 * np.pi / 50 * np.arange(20))
    assert recording.tau is not None
    np.testing.assert_allclose(recording.tau[:, 0], 50 * 0.03 * np.linspace(-1, 1, 20))
    milli = Recording.from_pandas(
        motor_log(I=1e3 * np.linspace(-1, 1, 20)),
        columns=columns | {"current1": "I:mA"},
        plant=GEARED,
    )
    np.testing.assert_allclose(milli.tau, recording.tau)


def test_a_motor_on_a_screw_may_be_logged_in_degrees() -> None:
    axis = LinearAxis(2.0, motor=Motor(gear_ratio=1000, torque_constant=0.03))
    table = motor_log(motor1=360.0 * np.arange(20))
    found = Recording.from_pandas(table, degrees=True, plant=axis)
    np.testing.assert_allclose(found.q[:, 0], 2 * np.pi * np.arange(20) / 1000)
    with pytest.raises(ValueError, match="needs angles, but `unit` is 'm'"):
        Recording.from_pandas(table.assign(qd1=0.0), degrees=True, plant=axis)


def test_joint_columns_precede_motor_columns_unless_named() -> None:
    table = motor_log(q1=0.1, tau1=2.0, motor1=5.0, current1=1.0)
    recording = Recording.from_pandas(table, plant=GEARED)
    assert recording.q[0, 0] == 0.1
    assert recording.tau is not None
    assert recording.tau[0, 0] == 2.0
    named = Recording.from_pandas(table, columns={"motor1": "motor1:deg"}, plant=GEARED)
    assert named.q[0, 0] == pytest.approx(np.deg2rad(5.0) / 50)
    with pytest.raises(ValueError, match="names q1 and motor1, but one follows"):
        Recording.from_pandas(table, columns={"q1": "q1", "motor1": "enc"}, plant=GEARED)


def test_joint_without_a_current_is_named_by_its_motor() -> None:
    arm = PendulumChain([1.0, 0.5], [0.3, 0.2], motor=Motor(50, torque_constant=0.03))
    table = motor_log(motor1=1.0, motor2=0.5, current1=0.1)
    with pytest.warns(RecordingWarning, match=r"no column current2, .* columns={\"current2\": "):
        Recording.from_pandas(table, plant=arm)


def test_a_motor_unknown_to_the_rig_is_named() -> None:
    with pytest.raises(ValueError, match=r"motor1 belongs to a motor.*`gear_ratio`.*plant=rig"):
        Recording.from_pandas(motor_log(motor1=1.0))
    table = motor_log(q1=0.1)
    rig = Rotor(0.02, motor=Motor(50))
    with pytest.raises(ValueError, match=r"current1 belongs to a motor.*`torque_constant`"):
        Recording.from_pandas(table, columns={"current1": "I"}, plant=rig)
    # An unused column is no reason to stop.
    with pytest.warns(RecordingWarning, match="looks like motor current"):
        found = Recording.from_pandas(table.rename(columns={"I": "current1"}), plant=rig)
    assert found.tau is None


@pytest.mark.parametrize("size", [1.0, 20.0])
def test_positions_in_integer_degrees_or_counts_are_refused(size):
    q, time = np.rint(np.linspace(0, 360 * size, 50))[:, None], np.arange(50) / 100
    with pytest.raises(ValueError, match=r"radians, got only whole numbers, from 0 to .*counts"):
        Recording(time, q)
    assert Recording(time, q, unit="m").unit == "m"
    assert Recording(time, np.ones_like(q)).joints == 1


@pytest.mark.parametrize(("torque", "doubted"), [(1.0, False), (0.0, True), (None, True)])
def test_fast_rotation_is_doubted_only_without_torques(torque: float | None, doubted: bool) -> None:
    """With torques, their balance shows whether a wheel is fast or its angles are in degrees."""
    time = np.linspace(0.0, 1.0, 60)
    q, tau = 50.0 * time[:, None], None if torque is None else np.full((60, 1), torque)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Recording(time, q, tau)
    assert any("looks like degrees" in str(w.message) for w in caught) == doubted


def test_masked_samples_count_as_missing() -> None:
    time, q = 1e-3 * np.arange(20), np.zeros((20, 1))
    masked = np.ma.masked_array(q, mask=np.arange(20)[:, None] == 3)
    with pytest.raises(ValueError, match=r"`q1` must be finite, .* nan at sample 3"):
        Recording(time, masked)
    assert len(Recording(time, np.ma.masked_array(q))) == 20


def test_rows_without_a_number_are_left_out_with_a_warning() -> None:
    time = 2e-3 * np.arange(1000)
    table = pd.DataFrame({"t": time, "enc": np.cos(time), "cur": np.sin(time)})
    table.loc[100:109, "enc"] = np.nan
    table.loc[900, "cur"] = np.nan
    columns = {"time": "t", "q1": "enc", "tau1": "cur"}
    with pytest.warns(RecordingWarning, match=r"11 of 1000 rows .* row 100\) .* in enc, cur, so"):
        read = Recording.from_pandas(table, columns=columns)
    kept = table.dropna()
    assert np.array_equal(read.time, kept["t"])
    assert np.array_equal(read.q[:, 0], kept["enc"])
    assert read.tau is not None
    assert np.array_equal(read.tau[:, 0], kept["cur"])


def test_rows_left_out_are_named_in_later_errors() -> None:
    table = pd.DataFrame({"time": np.arange(60.0), "q1": 0.0, "qd2": np.nan, "q2": 0.0})
    table.loc[:9, "q2"] = np.nan
    table.loc[30, "q1"] = np.inf
    with pytest.raises(ValueError, match=r"inf at sample 20 .* 10 rows without a number were left"):
        Recording.from_pandas(table)
    table.loc[30, "q1"] = 0.0
    with pytest.warns(RecordingWarning, match=r"10 of 60 rows .* have no number in q2, so"):
        Recording.from_pandas(table)


def test_columns_of_different_rates_are_refused() -> None:
    time = 1e-3 * np.arange(100)
    table = pd.DataFrame({"time": time, "q1": time})
    table.loc[np.arange(100) % 3 > 0, "q1"] = np.nan
    with pytest.raises(ValueError, match=r"66 of 100 rows .* in q1; drop empty columns"):
        Recording.from_pandas(table)
