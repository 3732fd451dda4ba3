"""Slip elements with friction that depends on a table's temperature, load, direction, position."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from nfriction import LinearAxis, cli, load, rollout, save
from nfriction.evaluation.torque_tables import TorqueFits, fit_torque
from nfriction.export.controller import controller_of
from nfriction.fitting.hysteresis import deflections
from nfriction.fitting.recorded import _Ripple
from nfriction.friction.hysteresis import NFSlip
from nfriction.io.model_file import ModelInfo
from nfriction.recording.torque_table import TorqueTable, blocks

PERIOD = 2.3e-3


def recorded(
    seed: int = 0, rows: int = 1500, ripple: float = 0.2, warm: float = 0.4
) -> pd.DataFrame:
    """Strokes; friction that falls while the joint warms up, with a ripple over the position."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 15.0, rows)
    phase = rng.uniform(0, 2 * np.pi, 2)
    q = 0.06 * np.sin(1.1 * time + phase[0]) + 0.02 * np.sin(2.9 * time + phase[1])
    qd = np.gradient(q, time)
    temperature = 20.0 + 30.0 * (0.5 + 0.5 * np.sin(0.7 * time + phase[1]))
    z = deflections(np.diff(q, prepend=q[0]), np.array([0.002, 0.02]), np.zeros(2))
    tau = (z @ [0.7, 0.4] + 0.2 * qd) * (1.0 - warm * (temperature - 20.0) / 30.0)
    tau += ripple * np.abs(qd / 0.07) * np.cos(2 * np.pi * q / PERIOD + 1.0 + 0.5 * np.sign(qd))
    tau += rng.normal(0, 0.02, rows)
    return pd.DataFrame({"time": time, "q": q, "qd": qd, "temperature": temperature, "tau": tau})


@pytest.fixture(scope="module")
def found() -> TorqueFits:
    return fit_torque(recorded(), "slip,neuro-fuzzy:slip")


def test_temperature_and_ripple_are_found_and_predict_another_run(found: TorqueFits) -> None:
    assert found.chosen == {"joint1": "NFSlip"}
    fit = found.fits["NFSlip"][0]
    assert set(fit.model.schedule.followed()) == {"temperature", "ripple"}
    assert "temperature" in found.summary()
    assert abs(float(fit.model.schedule.period[0]) - PERIOD) < 1e-3 * PERIOD
    other = recorded(seed=5)
    plain, own = (float(found.score(other, name)["rmse"].iloc[0]) for name in found.fits)
    assert own < 0.2 * plain
    # The noise is 0.02.
    assert own < 0.04


def test_different_encoder_zero_is_named(
    found: TorqueFits, caplog: pytest.LogCaptureFixture
) -> None:
    other = recorded(seed=6)
    found.score(other)
    assert not caplog.records
    found.score(other.assign(q=other["q"] - 0.25 * PERIOD))
    (record,) = caplog.records
    assert "out of phase with this table" in record.getMessage()
    assert record.args is not None
    assert record.args[1] == pytest.approx(0.25 * PERIOD, abs=PERIOD / 24)  # type: ignore[index]


def test_temperatures_that_the_fit_did_not_have_are_named(
    found: TorqueFits, caplog: pytest.LogCaptureFixture
) -> None:
    hot = recorded(seed=6)
    hot["temperature"] += 20.0
    for judge in (found.score, found.predict):
        caplog.clear()
        judge(hot)
        (record,) = caplog.records
        assert "temperature from 40 to 70, but 20 to 50 in the fit" in record.getMessage()


def test_inputs_without_effect_on_friction_are_dropped() -> None:
    found = fit_torque(recorded(ripple=0.0, warm=0.0), "slip,neuro-fuzzy:slip")
    assert found.chosen == {"joint1": "Slip"}
    assert found.fits["NFSlip"][0].model.schedule.followed() == ()
    errors = found.to_frame()
    assert errors["Slip"].iloc[0] == pytest.approx(errors["NFSlip"].iloc[0], rel=1e-9)


def test_table_without_a_required_column_is_refused(found: TorqueFits) -> None:
    with pytest.raises(ValueError, match="no column temperature"):
        found.predict(recorded(seed=5).drop(columns="temperature"), "neuro-fuzzy:slip")


def test_files_keep_the_input_dependence(found: TorqueFits, tmp_path: Path) -> None:
    save(found.model("neuro-fuzzy:slip"), tmp_path / "model.json")
    again = load(tmp_path / "model.json")
    assert isinstance(again, NFSlip)
    for name, value in found.model("neuro-fuzzy:slip").state_dict().items():
        assert torch.equal(again.state_dict()[name], value)


def test_info_lists_the_inputs_of_friction(
    found: TorqueFits, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = save(found.model("neuro-fuzzy:slip"), tmp_path / "model.json", ModelInfo(unit="m"))
    assert cli.main(["info", str(file)]) == 0
    printed = capsys.readouterr().out
    period = float(found.fits["NFSlip"][0].model.schedule.period[0])
    assert "joint1 follows: temperature from 20 to 50, ripple with a period" in printed
    assert f"a period of {period:.4g} m\n" in printed


def test_period_is_found_in_a_long_table() -> None:
    joint = TorqueTable.from_pandas(recorded(rows=12000)).joints[0]
    ripple = _Ripple.of(joint, joint.tau, blocks(joint, 10))
    assert ripple is not None
    assert 2 * np.pi / ripple.wave() == pytest.approx(PERIOD, rel=1e-3)


def test_simulations_and_controllers_refuse_unavailable_inputs(found: TorqueFits) -> None:
    model, zero = found.model("neuro-fuzzy:slip"), torch.zeros(1).double()
    with pytest.raises(ValueError, match="take slip"):
        rollout(LinearAxis(1.0), model, zero, zero, steps=2, sample_time=1e-3)
    with pytest.raises(ValueError, match="take slip"):
        controller_of(model, ModelInfo(sample_time=1e-3))
