"""Tables of friction torque: recovery, intervals, choice by hold-out blocks, files."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

import nfriction
from nfriction.evaluation.cross_validation import Candidate
from nfriction.evaluation.torque_tables import (
    _choose,
    fit_torque,
    read_models,
    score_models,
    split,
)
from nfriction.export.controller import controller_of
from nfriction.fitting.torque_table import fit_joint, join
from nfriction.recording.torque_table import TorqueTable, blocks
from nfriction.report.torque import write_torque_fits
from tests.export.artefacts import runner_of


def motion(rows: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Time, and a velocity of a few sines that passes zero often."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 10.0, rows)
    phases = rng.uniform(0, 2 * np.pi, 4)
    qd = sum(
        a * np.sin(w * time + p)
        for a, w, p in zip((1.0, 0.6, 0.3, 0.2), (1.3, 2.9, 5.1, 7.7), phases, strict=True)
    )
    return time, np.asarray(qd)


def coloured(rows: int, sd: float, memory: float, rng: np.random.Generator) -> np.ndarray:
    """First-order autoregressive noise."""
    found = np.empty(rows)
    found[0] = rng.normal(0, sd)
    for k in range(1, rows):
        found[k] = memory * found[k - 1] + rng.normal(0, sd * np.sqrt(1 - memory**2))
    return found


def stribeck_table(rows: int = 1500, seed: int = 0, sd: float = 0.05) -> pd.DataFrame:
    time, qd = motion(rows, seed)
    drop = np.exp(-((qd / 0.1) ** 2))
    tau = (1.0 + 0.6 * drop) * np.tanh(qd / 3e-3) + 0.5 * qd
    return pd.DataFrame(
        {"time": time, "qd": qd, "tau": tau + np.random.default_rng(seed).normal(0, sd, rows)}
    )


def test_known_coefficients_are_recovered_within_their_intervals() -> None:
    found = fit_torque(stribeck_table(), "viscous, coulomb-viscous, stribeck")
    assert found.chosen == {"joint1": "Stribeck"}
    table = found.intervals()
    for name, true in (("F_c", 1.0), ("F_d", 0.6), ("F_v", 0.5), ("v_s", 0.1)):
        row = table.loc[f"{name} of joint1"]
        assert row["low"] < true < row["high"]
        assert abs(row["value"] - true) < 0.1 * true
    errors = found.to_frame().loc["joint1"]
    assert errors["Stribeck"] < errors["CVFM"] < errors["NCFM"]


@pytest.mark.parametrize("scale", [pytest.param(1e-2, marks=pytest.mark.slow), 1e-4])
def test_slow_axis_has_the_friction_of_a_fast_joint(scale: float) -> None:
    """Start values and bounds in rad/s would give an axis in m neither a peak nor a bend."""
    time, qd = motion(800, 0)
    noise = 0.03 * np.random.default_rng(0).normal(size=800)
    peak = np.tanh(qd / 1e-2) * (1 + 0.8 * np.exp(-((qd / 0.3) ** 2))) + 0.2 * qd + noise
    bend = 0.5 * np.tanh(qd / 1e-2) + 0.3 * qd + 0.6 * np.arctan(5 * qd) + noise
    for tau, law, name, true in ((peak, "stribeck", "v_s", 0.3), (bend, "arctan", "f_b", 5.0)):
        table = pd.DataFrame({"time": time, "qd": scale * qd, "tau": tau})
        found = fit_torque(table, law, unit="m")
        factor = scale if name == "v_s" else 1 / scale
        row = found.intervals().loc[f"{name} of joint1"]
        assert abs(row["value"] / factor - true) < 0.15 * true
        assert row["low"] < row["value"] < row["high"] < 2 * true * factor
        assert float(found.to_frame().loc["joint1"].iloc[0]) < 0.1


def test_interval_of_a_slow_bristle_contains_its_estimate() -> None:
    time = 0.02 * np.arange(300)
    qd = 1e-4 * (np.sin(time) + 0.5 * np.sin(2.7 * time))
    tau = np.tanh(qd / 1e-6) * (1 + 0.5 * np.exp(-((qd / 5e-5) ** 2)))
    tau += 0.02 * np.random.default_rng(0).normal(size=300)
    found = fit_torque(pd.DataFrame({"time": time, "qd": qd, "tau": tau}), "lugre", unit="m")
    row = found.intervals().loc["v_s of joint1"]
    assert row["low"] < row["value"] < row["high"]


def test_intervals_of_autocorrelated_residuals_cover_the_truth() -> None:
    """White-noise intervals would cover only about half here: the correlation time is 20 rows."""
    rng, inside, wide = np.random.default_rng(5), 0, 0.0
    for seed in range(60):
        time, qd = motion(800, seed)
        tau = 1.0 * np.tanh(qd / 3e-3) + 0.5 * qd + coloured(800, 0.2, 0.95, rng)
        table = TorqueTable.from_pandas(pd.DataFrame({"time": time, "qd": qd, "tau": tau}))
        found = fit_joint("CVFM", table.joints[0], 3e-3)
        for interval, true in zip(found.intervals, (1.0, 0.5), strict=True):
            inside += interval.low < true < interval.high
            wide += interval.high - interval.low
    assert inside >= 0.88 * 120
    # Nor are they much wider than the scatter of the estimates.
    assert wide / 120 < 0.6


@pytest.mark.slow
def test_network_is_kept_only_if_friction_depends_on_acceleration() -> None:
    time, qd = motion(1200, 3)
    qdd = np.gradient(qd, time)
    noise = np.random.default_rng(0).normal(0, 0.02, 1200)
    level = {"level": np.ones(1200), "rising": 1.0 + 0.08 * qdd * np.sign(qd)}
    tables = {
        name: pd.DataFrame({"time": time, "qd": qd, "qdd": qdd, "tau":
                            c * np.tanh(qd / 3e-3) + 0.3 * qd + noise})
        for name, c in level.items()
    }  # fmt: skip
    models = "coulomb-viscous,neuro-fuzzy:coulomb-viscous"
    rising = fit_torque(tables["rising"], models)
    assert rising.chosen["joint1"] == "NFCVFM"
    errors = rising.to_frame().loc["joint1"]
    assert errors["NFCVFM"] < 0.5 * errors["CVFM"]
    steady = fit_torque(tables["level"], models)
    assert steady.chosen["joint1"] == "CVFM"


def test_unordered_rows_are_split_by_velocity() -> None:
    qd = np.repeat(np.linspace(-1, 1, 40), 5)
    table = TorqueTable.from_pandas(pd.DataFrame({"qd": qd, "tau": qd}))
    parts = blocks(table.joints[0], 4)
    assert sorted(np.concatenate(parts)) == list(range(200))
    assert all(np.ptp(qd[rows]) > 1.9 for rows in parts)
    timed = TorqueTable.from_pandas(pd.DataFrame({"time": np.arange(200), "qd": qd, "tau": qd}))
    assert all(np.all(np.diff(rows) == 1) for rows in blocks(timed.joints[0], 4))


def two_joints() -> pd.DataFrame:
    first, second = stribeck_table(seed=1), stribeck_table(seed=2)
    return pd.DataFrame({
        "time": first["time"],
        "qd1": first["qd"], "tau_f1": first["tau"], "load1": 1 + first["qd"] ** 2,
        "qd2": second["qd"], "tau_f2": 2 * second["tau"], "load2": 1 + second["qd"] ** 2,
    })  # fmt: skip


def test_few_rows_are_left_out_one_at_a_time() -> None:
    qd = np.array([-1.0, -0.7, -0.4, -0.1, 0.1, 0.4, 0.7, 1.0])
    tau = 0.3 * np.sign(qd) + 0.1 * qd + 1e-3 * np.random.default_rng(0).normal(size=8)
    found = fit_torque(pd.DataFrame({"qd": qd, "tau": tau}), "coulomb-viscous", folds=10)
    assert len(found.candidates["joint1"][0].errors) == 8
    assert 0 < found.to_frame().loc["joint1", "CVFM"] < 0.02


def test_peak_below_the_slowest_velocity_is_bounded_by_the_friction() -> None:
    qd = np.repeat([-2.0, -1.0, -0.5, 0.5, 1.0, 2.0], 40)
    truth = np.sign(qd) * (1.2 + 0.5 / (1 + (qd / 0.3) ** 2)) + 0.35 * qd
    for sd in (0.0, 0.05):
        tau = truth + sd * np.random.default_rng(0).normal(size=240)
        (joint,) = TorqueTable.from_pandas(pd.DataFrame({"qd": qd, "tau": tau})).joints
        coulomb, peak, *_ = fit_joint("stribeck", joint, 1e-3).model.schedule.values[0].tolist()
        assert coulomb + peak < 2.2


@pytest.mark.slow
def test_every_file_of_a_run_gives_the_predictions_of_the_fit(tmp_path: Path) -> None:
    table = two_joints()
    models = "coulomb-viscous,load-coulomb,stribeck,neuro-fuzzy:coulomb"
    found = fit_torque(table, models)
    other = two_joints().iloc[::3]
    written = write_torque_fits(found, tmp_path, command="nfriction fit-torque <b>.csv")
    assert all(path.is_file() for path in written)
    chosen = score_models(read_models(tmp_path), TorqueTable.from_pandas(other))
    pd.testing.assert_frame_equal(chosen, found.score(other))
    for name in found.fits:
        of_file = score_models(
            read_models(tmp_path / "models" / f"{name}.json"), TorqueTable.from_pandas(other)
        )
        pd.testing.assert_frame_equal(of_file, found.score(other, name))
    page = (tmp_path / "report.html").read_text()
    assert "stribeck" in page
    assert "&lt;b&gt;.csv" in page
    assert "<b>.csv" not in page
    assert "data:image/png;base64," in page


def test_exports_give_the_predicted_torque(tmp_path: Path) -> None:
    table = two_joints()
    found = fit_torque(table, "stribeck")
    model, info = found.model("stribeck"), found.info("stribeck")
    path = nfriction.export.torchscript(model, tmp_path / "model.pt", info)
    run = runner_of(path, controller_of(model, info))
    qd = torch.tensor(table[["qd1", "qd2"]].to_numpy())
    torque = run(qd, torch.zeros_like(qd), torch.ones_like(qd))[0].numpy()
    np.testing.assert_allclose(torque, np.stack(found.predict(table), 1), rtol=1e-12)


def test_split_and_join_are_inverse() -> None:
    model = nfriction.NFCVFM(2, terms=(3, 2), head_units=3).requires_grad_(False)
    for value in model.parameters():
        value += torch.linspace(0.0, 0.1, value.numel()).reshape(value.shape)
    again = join(split(model))
    for name, value in model.state_dict().items():
        assert torch.equal(value, again.state_dict()[name])


def test_models_unsuitable_for_a_table_are_refused_with_the_reason() -> None:
    table = stribeck_table()
    found = fit_torque(table, ["coulomb-viscous", "load-coulomb", "adaptive:viscous"])
    assert list(found.fits) == ["CVFM"]
    assert "column load" in found.failed["LFM"]
    assert "acceleration classes" in found.failed["ANCFM"]
    with pytest.raises(ValueError, match="column load"):
        fit_torque(table, "load-coulomb")
    with pytest.raises(ValueError, match="did you mean stribeck"):
        fit_torque(table, "stribek")
    with pytest.raises(ValueError, match="was not fitted; there are CVFM"):
        found.predict(table, "stribeck")
    with pytest.raises(ValueError, match="`folds` must be at least 2"):
        fit_torque(table, "viscous", folds=1)
    with pytest.raises(ValueError, match="give a table of the same joints"):
        found.predict(two_joints())
    with pytest.raises(TypeError, match="a path or a DataFrame"):
        fit_torque(3)


def test_folder_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no folder written by fit-torque"):
        read_models(tmp_path)
    (tmp_path / "results.json").write_text('{"chosen": 3}')
    with pytest.raises(ValueError, match="no folder written by fit-torque"):
        read_models(tmp_path)


@pytest.mark.parametrize("sd", [pytest.param(0.0, marks=pytest.mark.slow), 0.02])
def test_outliers_and_misfit_of_all_laws_are_reported(sd: float) -> None:
    rng = np.random.default_rng(3)
    qd = rng.uniform(-10, 10, 200)
    noise = sd * rng.normal(size=200)
    table = pd.DataFrame({"qd": qd, "tau": 1.5 * np.sign(qd) + 0.12 * qd + noise})
    laws = ["coulomb", "coulomb-viscous", "stribeck"]
    assert fit_torque(table, laws).table.remarks == ()
    wrong = table.assign(tau=table.tau.where(~table.index.isin([10, 50]), 30.0))
    (remark,) = fit_torque(wrong, laws).table.remarks
    assert f"30 at {qd[10]:.4g} rad/s" in remark
    assert f"30 at {qd[50]:.4g} rad/s" in remark
    assert "more" not in remark
    windage = table.assign(tau=0.02 * qd * np.abs(qd) + noise)
    (remark,) = fit_torque(windage, laws).table.remarks
    assert "follows the velocity" in remark


def test_load_independent_friction_is_reported() -> None:
    rng = np.random.default_rng(0)
    load, qd = rng.uniform(0, 2, 60), rng.choice([-1, 1], 60) * rng.uniform(0.3, 8, 60)
    noise = 0.002 * rng.normal(size=60)
    for constant in (0.0, 0.05):
        tau = (constant + 0.08 * load) * np.sign(qd) + 0.02 * qd + noise
        table = pd.DataFrame({"qd": qd, "tau": tau, "load": load})
        remarks = fit_torque(table, "coulomb-viscous,load-coulomb").table.remarks
        assert len(remarks) == (constant > 0)
        assert all("follows the velocity and the load" in remark for remark in remarks)


def test_rows_at_rest_are_excluded() -> None:
    rng = np.random.default_rng(0)
    qd = np.r_[np.zeros(200), np.repeat([-4, -2, -1, -0.5, 0.5, 1, 2, 4], 10)]
    sliding = 0.1 * np.sign(qd) + 0.02 * qd + 0.002 * rng.normal(size=280)
    table = pd.DataFrame({"qd": qd, "tau": np.where(qd, sliding, rng.uniform(-0.1, 0.1, 280))})
    found = fit_torque(table, "coulomb-viscous")
    assert "joint1 is at rest in 200 of 280 rows, which are left out" in found.table.remarks[0]
    dry, viscous = found.fits["CVFM"][0].intervals
    assert dry.low < 0.1 < dry.high < dry.low + 0.01
    assert viscous.low < 0.02 < viscous.high < viscous.low + 0.002
    assert float(found.score(table).rmse.iloc[0]) < 0.003


def test_torque_at_rest_does_not_shift_a_law_without_memory() -> None:
    moving = stribeck_table(600)
    still = pd.DataFrame({"time": 10.1 + 0.01 * np.arange(600), "qd": 1e-5, "tau": 0.9})
    both = pd.concat([moving, still], ignore_index=True)
    offset, alone = (
        float(fit_torque(t, "arctan").intervals().loc["f_o of joint1", "value"])
        for t in (both, moving)
    )
    assert abs(offset - alone) < 0.02
    # Their error counts all the same, as for a law that does know what holds the joint.
    assert fit_torque(both, "arctan").fits["NLFM"][0].residual > 0.5


def speeds(rows: int = 10, noise: float = 0.01, seed: int = 0, ramp: float = 0.0) -> pd.DataFrame:
    """Stribeck friction at eight speeds in both directions, every 0.01 s, after ramps [rad/s²]."""
    speed = np.repeat([0.1, 0.2, 0.4, 0.8, 1.5, 3.0, 6.0, 10.0], 2 * rows)
    sign = np.tile(np.repeat([1, -1], rows), 8)
    rising = abs(ramp) * np.tile(0.01 * np.arange(1, rows + 1), 16)
    qd = sign * (np.minimum(rising, speed) if ramp else speed)
    qdd = sign * ramp * (rising < speed)
    tau = np.sign(qd) * (0.3 + 0.15 * np.exp(-((qd / 0.5) ** 2))) + 0.08 * qd + 0.05 * qdd
    tau += noise * np.random.default_rng(seed).normal(size=len(qd))
    time = 0.01 * np.arange(len(qd)) + np.repeat(np.arange(16.0), rows)
    return pd.DataFrame({"time": time, "qd": qd, "tau": tau})


LAWS = "viscous,coulomb-viscous,stribeck"


def test_duplicated_rows_do_not_narrow_the_intervals() -> None:
    once = speeds(1)[["qd", "tau"]]
    five = fit_torque(pd.concat([once] * 5), "stribeck")
    assert "64 of 80 rows of joint1 equal others in every column" in five.table.remarks[0]
    pd.testing.assert_frame_equal(five.intervals(), fit_torque(once, "stribeck").intervals())


@pytest.mark.parametrize("rows", [1, pytest.param(20, marks=pytest.mark.slow)])
@pytest.mark.parametrize("timed", [True, False])
def test_offset_and_direction_dependent_friction_are_reported(rows: int, timed: bool) -> None:
    table = speeds(rows)
    table = table if timed else table.drop(columns="time")
    (remark,) = fit_torque(table.assign(tau=table.tau + 0.1), LAWS).table.remarks
    assert remark.startswith(("The torque is 0.09", "The torque is 0.1"))
    assert "in both directions, as with an offset of the sensor" in remark
    less = table.assign(tau=table.tau.where(table.qd > 0, 0.7 * table.tau))
    (remark,) = fit_torque(less, LAWS).table.remarks
    assert remark.startswith(("Friction is 30 %", "Friction is 29 %", "Friction is 31 %"))
    assert "lower in the negative direction than in the positive" in remark


def test_direction_is_not_split_into_joints_for_a_law_with_memory() -> None:
    """Rows of one direction alone lack the motion that a law with memory remembers."""
    time, qd = motion(600, 1)
    tau = qd * np.where(qd > 0, 1.0, 0.7) + 0.02 * np.random.default_rng(1).normal(size=600)
    table = pd.DataFrame({"time": time, "qd": qd, "tau": tau})
    (remark,) = fit_torque(table, "slip").table.remarks
    assert "lower in the negative direction" in remark
    assert "neuro-fuzzy:slip follows the direction" in remark
    assert "separate joint" not in remark


def test_law_no_better_than_the_mean_torque_is_reported() -> None:
    """A robot's whole torque, in which gravity hides the friction."""
    time, qd = motion(1000, 1)
    q = np.cumsum(qd) * (time[1] - time[0])
    noise = 0.3 * np.random.default_rng(0).normal(size=1000)
    table = pd.DataFrame({"time": time, "qd": qd, "tau": np.tanh(qd / 3e-3) + 0.5 * qd + noise})
    assert not fit_torque(table, "coulomb-viscous").table.remarks
    whole = table.assign(tau=table.tau + 60 * np.sin(q))
    remarks = fit_torque(whole, "coulomb-viscous").table.remarks
    assert any("blocks of joint1 no better than the mean torque" in r for r in remarks)
    # In one direction, dry friction is the mean torque.
    one_way = table.assign(qd=2 + 0.1 * qd, tau=1 + noise)
    remarks = fit_torque(one_way, "coulomb").table.remarks
    assert not any("mean torque" in r for r in remarks)
    # Velocity noise at rest is no motion in the other direction.
    resting = one_way.assign(qd=np.where(np.arange(len(qd)) % 50, one_way.qd, -1e-3))
    remarks = fit_torque(resting, "coulomb").table.remarks
    assert not any("mean torque" in r for r in remarks)


def test_single_mistakes_along_a_motion_are_reported() -> None:
    table = stribeck_table()
    table.loc[[100, 900], "tau"] = 300.0
    remarks = fit_torque(table, "coulomb-viscous").table.remarks
    assert any(r.startswith("Torques far off coulomb-viscous at joint1: 300 at ") for r in remarks)
    # A torque that is far off for several rows is no single mistake.
    burst = stribeck_table()
    burst.loc[500:540, "tau"] *= 30.0
    remarks = fit_torque(burst, "coulomb-viscous").table.remarks
    assert not any("far off" in r for r in remarks)


def test_load_with_a_sign_is_reported_for_laws_of_its_magnitude() -> None:
    table = stribeck_table(400)
    load = 3.0 * np.sin(1.7 * table.time)
    table = table.assign(tau=table.tau * np.abs(load))
    (remark,) = fit_torque(table.assign(load=load), "coulomb,load-coulomb").table.remarks
    assert remark.startswith(
        "The load of joint1 is also negative, but laws of the load (load-coulo"
    )
    assert "(load-coulomb) take it for a normal force; give its magnitude" in remark
    noise = 0.05 * np.random.default_rng(0).normal(size=len(load))
    noisy = np.maximum(np.abs(load) - 1.0, 0.0) + noise
    assert noisy.min() < -0.1
    for given, models in ((noisy, "load-coulomb"), (load, "coulomb")):
        remarks = fit_torque(table.assign(load=given), models).table.remarks
        assert not any("normal force" in r for r in remarks)


@pytest.mark.parametrize(
    "seeds", [range(10), pytest.param(range(10, 40), marks=pytest.mark.slow)], ids=["10", "30"]
)
def test_sound_tables_raise_no_warning(seeds: range) -> None:
    for seed in seeds:
        for table in (speeds(1, seed=seed).drop(columns="time"), speeds(10, seed=seed)):
            remarks = fit_torque(table, "stribeck", folds=2).table.remarks
            assert not any("offset" in r or "direction" in r or "accel" in r for r in remarks)


@pytest.mark.parametrize(("share", "reported"), [(0.6, True), (0.0, False)])
def test_error_of_the_load_along_a_motion_is_reported(share: float, reported: bool) -> None:
    time = 5e-3 * np.arange(4000)
    qd, load = 2.0 * np.sin(3.0 * time) + np.sin(5.0 * time), 1.0 + 0.5 * np.cos(0.7 * time)
    tau = 0.3 * np.sign(qd) * (1.0 + share * (load - 1.0)) + 0.05 * qd
    tau += np.random.default_rng(0).normal(0.0, 0.03, len(qd))
    table = pd.DataFrame({"time": time, "qd": qd, "load": load, "tau": tau})
    remarks = fit_torque(table, "coulomb-viscous").table.remarks
    (size,) = [re.match(r"([\d.]+) N m .* follow the load", x) for x in remarks] or [None]
    assert bool(size) == reported
    if size:
        assert float(size[1]) == pytest.approx(0.3 * share * load.std(), rel=0.1)


def test_acceleration_phases_are_reported() -> None:
    (remark,) = fit_torque(speeds(300, ramp=5.0), LAWS).table.remarks
    assert "at joint1 follows the acceleration, as with an inertia of 0.0" in remark
    # Without time stamps, they are at least not reported as single outliers.
    both = pd.concat([speeds(200, ramp=20.0), speeds(200, seed=1, ramp=-20.0)])
    (remark,) = fit_torque(both.drop(columns="time"), LAWS).table.remarks
    assert remark.startswith("412 of 6400 torques are far off ")
    assert "as with rows recorded while accelerating" in remark


def test_summary_and_notebook_show_choice_and_intervals() -> None:
    found = fit_torque(stribeck_table(), "coulomb-viscous,stribeck")
    for text in (repr(found), found.summary(), found._repr_html_()):
        assert "stribeck" in text
        assert "F_d of joint1" in text
    assert found.plot().axes[0].get_title() == "joint1: stribeck"


def test_rejected_network_is_not_chosen_over_its_law() -> None:
    law = Candidate("CVFM", (1.0, 1.0), 2, True)
    network = Candidate("NFCVFM", (1.0, 1.0 - 1e-12), 2, True)
    assert _choose([network, law])[0] == _choose([law, network])[0] == "CVFM"
    assert _choose([law, network])[1].endswith("with no more parameters")


@pytest.mark.slow
@pytest.mark.parametrize("speeds", [(0.5, 1.0, 2.0, 4.0), (0.1, 0.3, 0.6, 1.0, 2.0, 4.0)])
def test_noise_in_repeated_rows_does_not_select_a_larger_law(speeds: tuple[float, ...]) -> None:
    """A few speeds do not show the shape of a curve, however often each is repeated."""
    rng = np.random.default_rng(5)
    # A drive keeps its speed to 0.1 %.
    qd = np.repeat(speeds, 5) * (1 + 1e-3 * rng.standard_normal(5 * len(speeds)))
    tau = 1.0 + 0.2 * qd + 0.05 * rng.standard_normal(len(qd))
    found = fit_torque(pd.DataFrame({"qd": qd, "tau": tau}), "coulomb-viscous,arctan,stribeck")
    assert found.chosen["joint1"] == "CVFM"
    hidden = "measure at more speeds to judge arctan, stribeck" in found.summary()
    assert hidden == (len(speeds) < 5)
    peak = fit_torque(
        pd.DataFrame({"qd": qd, "tau": tau + 0.5 * np.exp(-((qd / 0.4) ** 2))}),
        "coulomb-viscous,stribeck",
    )
    assert peak.chosen["joint1"] == ("CVFM" if hidden else "Stribeck")


def test_memory_and_load_must_improve_by_more_than_the_block_scatter() -> None:
    plain = Candidate("CVFM", (1.0, 1.2, 0.8, 1.1, 0.9, 2.0), 2, True)
    # Only one block improves.
    once = Candidate("Slip", (1.0, 1.2, 0.8, 1.1, 0.9, 1.4), 9, True)
    steady = Candidate("Slip", (0.5, 0.7, 0.4, 0.6, 0.5, 1.0), 9, True)
    loaded = Candidate("LoadSlip", (0.4, 0.8, 0.3, 0.5, 0.5, 0.9), 9, True)
    assert once.error < 0.9 * plain.error
    name, why = _choose([plain, once])
    assert name == "CVFM"
    assert why == (
        "no other needs as little memory or load; the hold-out error of slip is 12 % smaller, "
        "which the blocks' scatter explains"
    )
    assert _choose([plain])[1] == "the only model"
    assert _choose([loaded, steady, plain])[0] == "Slip"
    assert _choose([steady, plain])[1] == "hold-out error 47 % smaller than that of coulomb-viscous"


def test_order_of_rows_without_time_does_not_matter() -> None:
    rng = np.random.default_rng(0)
    qd = np.repeat(np.r_[-np.linspace(2, 0.05, 20), np.linspace(0.05, 2, 20)], 3)
    tau = np.sign(qd) * (0.5 + 0.3 * np.exp(-((qd / 0.2) ** 2))) + 0.1 * qd
    table = pd.DataFrame({"qd": qd, "tau": tau + 0.01 * rng.standard_normal(len(qd))})
    one, other = (
        fit_torque(t, "coulomb-viscous") for t in (table, table.sample(frac=1, random_state=0))
    )
    pd.testing.assert_frame_equal(one.intervals(), other.intervals(), rtol=1e-12)
    # Of a wrong law, errors of neighbouring velocities are alike.
    assert one.intervals()["high"].iloc[0] - one.intervals()["value"].iloc[0] > 0.03


@pytest.mark.parametrize("jitter", [0.0, 2e-3])
def test_table_at_one_speed_does_not_tell_dry_from_viscous(jitter: float) -> None:
    rng = np.random.default_rng(0)
    qd = np.repeat([-1.0, 1.0], 10) * (1 + jitter * rng.standard_normal(20))
    tau = 0.3 * np.sign(qd) + 0.01 * rng.standard_normal(20)
    found = fit_torque(pd.DataFrame({"qd": qd, "tau": tau}), "viscous,coulomb")
    assert "rad/s only, where dry and viscous friction cannot be" in found.table.remarks[-1]


@pytest.mark.parametrize("unit", [1.0, 1e-8])
def test_choice_of_a_law_does_not_depend_on_the_unit_of_torque(unit: float) -> None:
    qd = np.linspace(-1, 1, 40)
    table = pd.DataFrame({"qd": qd, "tau": unit * (0.3 * np.sign(qd) + 0.2 * qd)})
    found = fit_torque(table, "coulomb,coulomb-viscous,stribeck", folds=4)
    assert found.chosen == {"joint1": "CVFM"}


def test_columns_that_no_law_reads_are_named() -> None:
    table = speeds(1).drop(columns="time").assign(temperature=20.0, voltage=1.0)
    remarks = fit_torque(table, "coulomb-viscous").table.remarks
    assert "Columns that are not read: voltage." in remarks
    assert any(text.startswith("The column temperature is not used") for text in remarks)
