"""Slip elements on torque tables: recovery, choice over memoryless laws, initial state."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

import nfriction
from nfriction.evaluation.torque_tables import TorqueFits, fit_torque, read_models, score_models
from nfriction.fitting.hysteresis import deflections, fit_slip
from nfriction.fitting.torque_table import predict
from nfriction.friction.hysteresis import DROP, ELEMENTS, FIRST, LOAD_SLIP, OFFSET, SLIP, Slip
from nfriction.recording.torque_table import JointTorque, TorqueTable, blocks
from nfriction.report.torque import write_torque_fits

WIDTHS, FORCES = np.array([0.002, 0.02]), np.array([0.7, 0.4])


def strokes(rows: int = 1500, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Time, and positions of strokes from far below the widths to far above."""
    time = np.linspace(0.0, 15.0, rows)
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, 2)
    q = 0.06 * np.sin(1.1 * time + phase[0]) * (0.1 + np.sin(0.23 * time) ** 2)
    return time, q + 0.003 * np.sin(6.1 * time + phase[1])


def slip_table(
    seed: int = 0, load: np.ndarray | None = None, start: float = 0.0, sd: float = 0.01
) -> pd.DataFrame:
    time, q = strokes(seed=seed)
    path = np.diff(q, prepend=q[0])
    z = deflections(path, WIDTHS, np.clip(start / WIDTHS, -1, 1))
    qd = np.gradient(q, time)
    force = np.ones_like(q) if load is None else load
    tau = force * (z @ FORCES) + 0.2 * qd + np.random.default_rng(seed).normal(0, sd, len(q))
    table = pd.DataFrame({"time": time, "q": q, "qd": qd, "tau": tau})
    return table if load is None else table.assign(load=load)


def test_elements_follow_the_displacement_and_slip_at_their_width() -> None:
    path = np.array([0.0, 0.5, 1.0, -0.5, -2.0])
    z = deflections(path, np.array([1.0]), np.zeros(1))[:, 0]
    np.testing.assert_allclose(z, [0.0, 0.5, 1.0, 0.5, -1.0])


def test_positions_that_do_not_change_are_refused() -> None:
    with pytest.raises(ValueError, match="column q of joint1 does not change"):
        fit_torque(slip_table().assign(q=0.1), "slip")


def test_law_and_fit_advance_the_state_equally() -> None:
    table = TorqueTable.from_pandas(slip_table()).joints[0]
    found = fit_slip(table, blocks(table, 5), loaded=False)
    model = Slip(1, found.coefficients)
    blind = predict(model, without_torque(table))
    np.testing.assert_allclose(blind, found.torque, atol=0.02)
    at_rest = SLIP.memory
    assert at_rest is not None
    state = torch.rand(5, 1, at_rest.size).double() * 2 - 1
    still = torch.zeros(5, 1).double()
    c = torch.tensor(found.coefficients)[None].expand(5, 1, -1)
    assert torch.equal(at_rest.advance(state, still, still, c, 0.1), state)


def without_torque(joint: JointTorque) -> JointTorque:
    """Rows whose torque gives no information on the deflection before them."""
    return replace(joint, tau=np.full_like(joint.tau, np.nan))


@pytest.fixture(scope="module")
def found() -> TorqueFits:
    return fit_torque(slip_table(), "coulomb-viscous,arctan,stribeck,slip", folds=5)


def test_another_run_is_predicted_to_noise_level(found: TorqueFits) -> None:
    assert found.chosen == {"joint1": "Slip"}
    other = slip_table(seed=7)
    scores = {name: float(found.score(other, name)["rmse"].iloc[0]) for name in found.fits}
    assert scores["Slip"] < 0.03
    assert min(e for name, e in scores.items() if name != "Slip") > 4 * scores["Slip"]
    shown = found.intervals()["value"]
    assert (shown[shown.index.str.match(r"F_\d")] > 1e-6).all()
    # There was no long rest.
    assert not shown.index.str.startswith("d_r").any()
    widths = shown.index.str.startswith("d_").sum()
    assert 0 < widths < ELEMENTS
    force = found.model("slip").schedule.values[0, FIRST : FIRST + ELEMENTS].sum()
    assert abs(float(force) - FORCES.sum()) < 0.1 * FORCES.sum()


def test_memoryless_law_is_chosen_for_friction_without_memory() -> None:
    time, q = strokes()
    qd = 20 * np.gradient(q, time)
    tau = np.tanh(qd / 3e-3) + 0.4 * qd + np.random.default_rng(1).normal(0, 0.05, len(q))
    table = pd.DataFrame({"time": time, "q": 20 * q, "qd": qd, "tau": tau})
    found = fit_torque(table, "coulomb-viscous,slip", folds=5)
    assert found.chosen == {"joint1": "CVFM"}


@pytest.mark.slow
def test_load_proportional_friction_is_recognised() -> None:
    load = np.linspace(0.2, 2.0, 1500)
    found = fit_torque(slip_table(load=load), folds=5)
    assert found.chosen == {"joint1": "LoadSlip"}
    other = slip_table(seed=3, load=load[::-1].copy())
    assert float(found.score(other)["rmse"].iloc[0]) < 0.05


def test_initial_deflection_is_estimated_from_the_lead_in(found: TorqueFits) -> None:
    deflected = TorqueTable.from_pandas(slip_table(seed=4, start=-1.0))
    model, joint = found.fits["Slip"][0].model, deflected.joints[0]
    first = slice(20, 60)
    known, blank = (
        predict(model, of).numpy()[first] - joint.tau[first]
        for of in (joint, without_torque(joint))
    )
    assert np.abs(known).max() < 0.15
    assert np.abs(blank).max() > 0.5


def test_friction_rise_after_a_long_rest_decays_in_the_first_motion() -> None:
    def rested(seed: int, excess: float) -> pd.DataFrame:
        """A table that begins with a rest of 0.3 s, after a move there and a longer rest."""
        table = slip_table(seed=seed, start=np.sign(excess))
        still = table.iloc[[0] * 30].assign(qd=0.0, tau=np.sign(excess) * FORCES.sum())
        table = pd.concat([still, table], ignore_index=True)
        path = np.cumsum(np.abs(np.diff(table["q"], prepend=table["q"][0])))
        noise = np.random.default_rng(seed).normal(0, 0.01, len(table))
        tau = table["tau"] + excess * np.exp(-path / 0.01) + noise * (path == 0)
        return table.assign(tau=tau, time=np.arange(len(table)) * 0.01)

    found = fit_torque(rested(0, 1.5), "slip", folds=5)
    for seed, excess in ((2, 1.5), (3, -1.0), (4, 0.0)):
        # A tenth of the smallest excess, all of which the first strokes otherwise show.
        assert float(found.score(rested(seed, excess))["rmse"].iloc[0]) < 0.1


def test_table_without_torque_is_predicted_from_zero_deflection(found: TorqueFits) -> None:
    other = slip_table(seed=5)
    blind = found.predict(other.drop(columns="tau"))[0]
    # Once the elements have slipped, the start is forgotten.
    np.testing.assert_allclose(blind[800:], found.predict(other)[0][800:], atol=0.02)
    with pytest.raises(ValueError, match="no column of friction torque"):
        found.score(other.drop(columns="tau"))


def test_files_of_a_law_with_memory_give_the_predictions_of_the_fit(
    found: TorqueFits, tmp_path: Path
) -> None:
    write_torque_fits(found, tmp_path)
    other = slip_table(seed=5)
    again = score_models(read_models(tmp_path), TorqueTable.from_pandas(other))
    pd.testing.assert_frame_equal(again, found.score(other))
    assert (tmp_path / "figures" / "friction.png").stat().st_size > 10_000
    assert nfriction.load_info(tmp_path / "models" / "Slip.json").sample_time == pytest.approx(
        0.01, rel=0.01
    )


def test_rows_in_no_order_have_no_memory() -> None:
    table = slip_table().drop(columns="time")[::5]
    with pytest.raises(ValueError, match="fitted to recordings of motion, not to tables"):
        fit_torque(table, "neuro-fuzzy:lugre")
    with pytest.raises(ValueError, match="has no column time"):
        fit_torque(table, "slip")
    assert "Slip" not in fit_torque(table, folds=2).fits


def test_negative_forces_are_refused() -> None:
    values = Slip(1).schedule.parameter_vector().clone()
    values[FIRST] = -0.1
    with pytest.raises(ValueError, match="`F_1` of joint 1 must be finite and not negative"):
        Slip(1, values)


def test_closed_motions_dissipate_energy() -> None:
    rng = np.random.default_rng(0)
    for law in (SLIP, LOAD_SLIP):
        memory = law.memory
        assert memory is not None
        c = torch.tensor(rng.uniform(0.1, 1.0, (1, 1, len(law.names))))
        c[..., OFFSET] = 0.0
        # No drop with speed: the first element's force then depends on the velocity.
        c[..., DROP] = 0.0
        time = np.linspace(0, 2 * np.pi, 400)
        qd = torch.tensor(np.cos(time) + 0.5 * np.cos(3 * time))[:, None]
        one, state, work = torch.ones(1, 1).double(), torch.zeros(1, 1, memory.size).double(), []
        for _ in range(3):
            work.append(0.0)
            for v in qd:
                state = memory.advance(state, v[None], one, c, 0.02)
                work[-1] += 0.02 * float(v * memory.torque(state, v[None], one, c))
        assert work[-1] > 0
