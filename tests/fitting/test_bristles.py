"""Dahl, LuGre, elasto-plastic and gear friction recovered from tables of torque."""

from functools import cache

import numpy as np
import pandas as pd
import pytest

from nfriction.evaluation.torque_tables import TorqueFits, fit_torque
from nfriction.fitting.bristles import torques
from nfriction.fitting.torque_table import predict
from nfriction.friction import model_by_name
from nfriction.recording.torque_table import TorqueTable

TRUE = {
    "Dahl": (1.0, 0.5, 300.0),
    "Gear": (0.5, 0.1, 0.25, 0.4, 300.0),
    "LuGre": (1.0, 0.5, 0.02, 500.0, 2.0, 0.4),
    "ElastoPlastic": (1.0, 0.5, 0.02, 500.0, 2.0, 0.4, 0.5),
}


def table_of(name: str, seed: int = 0, reach: float = 1.0) -> pd.DataFrame:
    """Presliding and sliding, with the torque of a law and noise."""
    time = np.linspace(0.0, 8.0, 800)
    q = reach * 0.06 * np.sin(1.7 * time + seed) * (0.1 + np.sin(0.43 * time) ** 2)
    q += reach * 0.003 * np.sin(6.1 * time + 1)
    # Drives the joint and is backdriven; only the gear law uses it.
    load = 1.0 + 6.0 * np.sin(2.3 * time + 0.5 * seed)
    given = pd.DataFrame({"time": time, "q": q, "qd": np.gradient(q, time), "tau": q, "load": load})
    joint = TorqueTable.from_pandas(given).joints[0]
    model = model_by_name(name)(1, TRUE[name])
    noise = np.random.default_rng(seed).normal(0, 0.014, len(q))
    return given.assign(tau=predict(model, joint, 0.0).numpy() + noise)


@cache
def fitted(name: str) -> TorqueFits:
    """Fit of the true law to the table."""
    return fit_torque(table_of(name), name, folds=2)


# LuGre has all coefficients of the bristle laws but one.
@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=[pytest.mark.slow] * (x in {"ElastoPlastic", "Gear"})) for x in TRUE],
)
def test_coefficients_are_recovered_within_their_intervals(name: str) -> None:
    found = fitted(name)
    values = found.intervals()
    for coefficient, true in zip(model_by_name(name)(1).law.coefficients, TRUE[name], strict=True):
        row = values.loc[f"{coefficient.name} of joint1"]
        assert abs(row["value"] - true) < 0.15 * true
        if coefficient.fitted:
            # Twice the interval, outside which one in a thousand lies.
            assert abs(row["value"] - true) < row["high"] - row["low"]
    assert float(found.score(table_of(name, seed=3))["rmse"].iloc[0]) < 0.018


def test_batched_coefficients_give_the_torque_of_each() -> None:
    joint = TorqueTable.from_pandas(table_of("LuGre")).joints[0]
    sets = np.array([TRUE["LuGre"], (0.5, 0.1, 0.05, 100.0, 1.0, 0.1)])
    found = torques(model_by_name("LuGre")(1).law, joint, sets)
    for values, torque in zip(sets, found, strict=True):
        alone = predict(model_by_name("LuGre")(1, values), joint, 0.0)
        np.testing.assert_allclose(torque, alone, rtol=1e-12)


@pytest.mark.slow
def test_rows_without_presliding_do_not_determine_the_stiffness() -> None:
    """Strokes of thousands of rad pass the presliding of 2 mrad within a sample, even near rest."""
    found = fit_torque(table_of("Dahl", reach=1e5), "dahl", folds=2)
    assert found.intervals().loc["sigma_0 of joint1", "note"] == "not identifiable"
    assert fitted("Dahl").intervals().loc["sigma_0 of joint1", "note"] == ""


@pytest.mark.slow
def test_rows_with_sliding_only_are_fitted() -> None:
    time = np.arange(1000) * 0.02
    qd = np.where(time < 10.0, 1.0, -0.9) * (1.5 + 0.5 * np.sin(0.7 * time))
    tau = 0.3 * np.sign(qd) + 0.1 * qd + 0.005 * np.random.default_rng(0).normal(size=len(time))
    found = fit_torque(pd.DataFrame({"time": time, "qd": qd, "tau": tau}), "lugre", folds=2)
    assert found.to_frame().loc["joint1", "LuGre"] < 0.1
    assert "sigma_0 of joint1" in found.fits["LuGre"][0].unidentifiable


def test_maxwell_slip_is_redirected_to_slip() -> None:
    with pytest.raises(ValueError, match="use slip"):
        fit_torque(table_of("Dahl"), "maxwell-slip", folds=2)
