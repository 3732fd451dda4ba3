"""Reading tables of friction torque, and refusing invalid ones."""

import math
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nfriction.recording.torque_table import TorqueTable

QD = np.concatenate([np.linspace(-1.0, -0.1, 10), np.linspace(0.1, 1.0, 10)])


def table(**columns: object) -> pd.DataFrame:
    return pd.DataFrame({"qd": QD, "tau": np.sign(QD) + QD} | columns)


def test_wide_and_long_tables_are_equivalent() -> None:
    wide = pd.DataFrame({"qd1": QD, "tau_f1": QD, "qd2": 2 * QD, "tau_f2": 3 * QD, "load": 1 + QD})
    parts = [
        pd.DataFrame({"joint": k, "velocity": k * QD, "torque": tau * QD, "load": 1 + QD})
        for k, tau in ((1, 1.0), (2, 3.0))
    ]
    long = pd.concat(parts, ignore_index=True)
    for given in (wide, long):
        found = TorqueTable.from_pandas(given)
        assert found.joint_names == ("joint1", "joint2")
        np.testing.assert_array_equal(found.joints[1].qd, 2 * QD)
        np.testing.assert_array_equal(found.joints[1].tau, 3 * QD)
        np.testing.assert_array_equal(found.joints[1].load, 1 + QD)


def test_units_and_names_of_a_german_file_are_understood(tmp_path: Path) -> None:
    path = tmp_path / "tests.csv"
    rows = [f"{np.rad2deg(v):.6f};{1e3 * v:.6f}".replace(".", ",") for v in QD]
    path.write_text("Drehzahl [deg/s];tau [mN m]\n" + "\n".join(rows) + "\n")
    found = TorqueTable.read(path, columns={"qd": "Drehzahl"})
    assert found.name == "tests"
    np.testing.assert_allclose(found.joints[0].qd, QD, atol=1e-7)
    np.testing.assert_allclose(found.joints[0].tau, QD, atol=1e-7)
    degrees = TorqueTable.from_pandas(table(qd=np.rad2deg(QD)), degrees=True)
    np.testing.assert_allclose(degrees.joints[0].qd, QD)


def test_unit_in_a_speed_column_name_is_used() -> None:
    given = pd.DataFrame({"speed_rpm": QD * 30 / np.pi, "torque": QD})
    found = TorqueTable.from_pandas(given, columns={"qd": "speed_rpm"})
    np.testing.assert_allclose(found.joints[0].qd, QD)


def test_velocity_is_computed_from_positions_and_time() -> None:
    time = np.arange(400) * 0.01
    given = pd.DataFrame({"time": time, "position": np.sin(time), "friction": np.cos(time)})
    joint = TorqueTable.from_pandas(given, unit="m").joints[0]
    np.testing.assert_allclose(joint.qd, np.cos(time), atol=1e-3)
    np.testing.assert_allclose(joint.qdd[10:-10], -np.sin(time)[10:-10], atol=1e-2)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (table().drop(columns="tau"), "no column of friction torque; found qd"),
        (table().drop(columns="qd"), "column qd is missing; found tau"),
        (
            table().rename(columns={"qd": "Drehzahl [1/min]", "tau": "Reibmoment [Nm]"}),
            r'columns={"qd": "Drehzahl \[1/min\]", "tau": "Reibmoment \[Nm\]"}',
        ),
        (table(qd=0.0), "joint1 does not move"),
        (table(tau=2.0), "is 2 in every row"),
        (table(qd=np.where(QD > 0.9, np.nan, QD)), "column qd, row 19 .* is nan, one of 1"),
        (table(tau=["x"] * 20), "column tau, row 0 .* must be a number"),
        (table(time=QD[::-1]), "time of joint1 must increase.*; sort the rows"),
        (table(time=np.arange(len(QD)) % (len(QD) // 2)), "the clock starts again there"),
        (table().iloc[:5], "joint1 has 5 rows; at least 8"),
        (table(torque=QD), "are both tau; rename one"),
        (table(joint=1, qd2=QD, tau2=QD), "drop the column joint"),
        (table(joint=[1.0] * 19 + [np.nan]), "column joint, row 19 .* names no joint"),
    ],
)
def test_files_that_are_no_table_are_refused(given: pd.DataFrame, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TorqueTable.from_pandas(given)


def test_wrong_column_names_are_refused() -> None:
    with pytest.raises(ValueError, match="no column 'speed'; found qd, tau"):
        TorqueTable.from_pandas(table(), columns={"qd": "speed"})
    with pytest.raises(ValueError, match="got the key 'voltage'"):
        TorqueTable.from_pandas(table(), columns={"voltage": "qd"})
    with pytest.raises(ValueError, match='`unit` must be "rad" or "m"'):
        TorqueTable.from_pandas(table(), unit="deg")  # type: ignore[arg-type]


def test_unit_of_sliding_joints_must_be_stated(tmp_path: Path) -> None:
    path = tmp_path / "axis.csv"
    table(qd=1e3 * QD).rename(columns={"qd": "qd [mm/s]"}).to_csv(path, index=False)
    with pytest.raises(ValueError, match=r"column qd .*is in mm/s; .*--unit m"):
        TorqueTable.read(path)
    np.testing.assert_allclose(TorqueTable.read(path, unit="m").joints[0].qd, QD)


def test_suspicious_tables_raise_remarks() -> None:
    reversed_sign = TorqueTable.from_pandas(table(tau=-np.sign(QD) - QD))
    assert "wrong sign" in reversed_sign.remarks[0]
    time = np.arange(2000) * 0.01
    q = (3.0 * time + np.pi) % (2 * np.pi) - np.pi
    wheel = {"time": time, "q": q, "qd": 3.0, "tau": 1.0 + q}
    assert "looks wrapped (10 jumps" in TorqueTable.from_pandas(pd.DataFrame(wheel)).remarks[-1]
    one_way = TorqueTable.from_pandas(table(qd=np.abs(QD), tau=np.abs(QD)))
    assert "one direction only" in one_way.remarks[0]
    unsigned = TorqueTable.from_pandas(table(tau=np.abs(table().tau)))
    assert "has one sign in both directions" in unsigned.remarks[0]
    # Noise may let such a torque drive the joint on average.
    tau = np.where(QD > 0, 0.1, 0.2) + np.abs(QD)
    assert "has one sign" in TorqueTable.from_pandas(table(tau=tau)).remarks[0]
    fast = TorqueTable.from_pandas(table(qd=np.rad2deg(2 * QD)))
    assert "degrees per second or revolutions per minute" in fast.remarks[0]
    assert not TorqueTable.from_pandas(table(qd=1e3 * QD), columns={"qd": "qd:rpm"}).remarks
    assert not TorqueTable.from_pandas(table()).remarks


def test_positions_that_contradict_velocity_and_time_are_reported() -> None:
    """Laws with memory follow q, and would take any unit, sign or joint for the truth."""
    time = np.arange(1000) * 0.01
    q = np.sin(time) + 0.3 * np.sin(5.3 * time)
    qd = np.cos(time) + 1.59 * np.cos(5.3 * time)
    sound = pd.DataFrame({"time": time, "q": q, "qd": qd, "tau": np.tanh(9 * qd) + qd})
    rng = np.random.default_rng(0)
    counted = sound.assign(q=np.round(sound.q / 0.02) * 0.02, qd=qd + 0.5 * rng.normal(size=1000))
    # Nor do positions have to follow across a pause, or turns of a whole one there.
    paused = sound.drop(index=range(300, 700)).assign(q=q[np.r_[:300, 700:1000]])
    paused.loc[700:, "q"] += 2 * np.pi
    for good in (sound, counted, paused):
        assert not TorqueTable.from_pandas(good).remarks
    other = np.sin(2.7 * time)
    cases = ((-q, "-1"), (np.rad2deg(q), "57.3"), (100 * q, "100"), (other, "-?0.[01]"))
    for wrong, factor in cases:
        (remark,) = TorqueTable.from_pandas(sound.assign(q=wrong)).remarks
        assert re.match(
            f"q of joint1 changes {factor}.* times as much as qd and time imply", remark
        )
    slow = sound.assign(time=1e3 * time)
    (remark,) = TorqueTable.from_pandas(slow).remarks
    assert "0.001 times" in remark
    (remark,) = TorqueTable.from_pandas(slow.drop(columns="qd")).remarks
    assert remark.startswith("`time` looks like milliseconds")


def test_digest_depends_on_the_content() -> None:
    one, same = (TorqueTable.from_pandas(table()) for _ in range(2))
    assert one.digest() == same.digest()
    assert one.digest() != TorqueTable.from_pandas(table(tau=QD)).digest()


def speeds(noise: float = 0.005, repeats: int = 1, seed: int = 0) -> pd.DataFrame:
    """Stribeck friction at eight speeds in both directions."""
    qd = np.repeat([0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0, 3.0], repeats)
    qd = np.r_[qd, -qd]
    tau = np.sign(qd) * (0.3 + 0.15 * np.exp(-((qd / 0.5) ** 2))) + 0.08 * qd
    return pd.DataFrame(
        {"qd": qd, "tau": tau + noise * np.random.default_rng(seed).normal(size=len(qd))}
    )


def test_copied_rows_are_not_distinct_but_coarse_readings_are() -> None:
    def kept(table: pd.DataFrame) -> int:
        return len(TorqueTable.from_pandas(table).joints[0].distinct)

    fine, coarse = speeds(0.01, 10), speeds(0.01, 30)
    coarse["tau"] = coarse.tau.round(2)
    assert coarse.duplicated().sum() > 300
    # The whole table several times, in any order.
    for table in (fine, coarse):
        assert kept(table) == len(table)
        assert kept(pd.concat([table] * 3)) == len(table)
        assert kept(pd.concat([table] * 3).sort_values("tau")) == len(table)
    # A quiet coarse sensor repeats its reading; counted as copies, too few rows would remain.
    quiet = pd.DataFrame({"qd": np.repeat([1.0, 2.0, -1.0, -2.0], 10)})
    assert kept(quiet.assign(tau=0.1 * quiet.qd)) == 40
    # With time stamps there is no doubt.
    timed = fine.assign(time=np.arange(160.0))
    copied = TorqueTable.from_pandas(pd.concat([timed, timed[40:]]))
    assert len(copied.joints[0]) == 160
    assert copied.remarks[0].startswith("120 of 280 rows equal others in every column, time")
    with pytest.raises(ValueError, match=r"row 10 "):
        TorqueTable.from_pandas(
            pd.concat([timed[:1], timed]).assign(tau=[1.0] * 10 + [math.nan] * 151)
        )
