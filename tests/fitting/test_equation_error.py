"""The equation-error fit is exact for exact torques, otherwise bounded least squares."""

import math

import numpy as np
import pytest
import torch

from nfriction import LinearAxis, Recording, Stribeck, fit
from nfriction.fitting.data.inputs import require_elementwise
from nfriction.fitting.equation_error import (
    TorqueFit,
    fit_equation_error,
    friction_torque,
    prior_sd,
)
from nfriction.fitting.options import DEFAULTS
from nfriction.friction import model_by_name
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import LINEAR, NONLINEAR, Coefficient, Law
from nfriction.friction.models import FrictionModel
from nfriction.signals import Motion
from tests.fitting.recordings import driven_axis, flywheel, pendulum

V_SMOOTH = 0.05
EDGE = DEFAULTS.edge
TRUTH = {
    "NCFM": [[2e-3], [1e-3]],
    "CFM": [[3e-3], [5e-4]],
    "CVFM": [[3e-3, 2e-3], [5e-4, 1e-3]],
    "LFM": [[2e-3, 3e-3], [1e-3, 5e-4]],
    "NLFM": [[1e-3, 2e-3, 3e-3, 4e-3, 3.0], [-1e-3, 1e-3, 2e-3, 1e-3, 0.3]],
    "Stribeck": [[2e-3, 3e-3, 1e-3, 0.3, 2.0], [1e-3, 2e-3, 2e-3, 1.0, 2.0]],
}


def moved(model, plant, *, driven=True):
    """A synthetic motion in closed form, and the torques that it takes with this friction."""
    time = np.arange(0, 4, 2e-3)
    w, phase = np.array([3.0, 5.0]), np.array([0.0, 0.7])
    angle = w * time[:, None] + phase
    motion = Motion(time, np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle))
    q, qd, qdd = (torch.as_tensor(x) for x in (motion.q, motion.qd, motion.qdd))
    tau_f = model(qd, qdd, plant.load(q, qd)).detach()
    tau = (plant.inverse_dynamics(q, qd, qdd) + tau_f).numpy()
    return Recording(time, motion.q, tau=tau if driven else None), motion, tau_f


@pytest.mark.parametrize("name", TRUTH)
def test_noiseless_torques_give_the_exact_coefficients(name):
    plant = pendulum()
    model = model_by_name(name)(2, TRUTH[name], v_smooth=V_SMOOTH)
    recording, motion, tau_f = moved(model, plant)
    found = fit_equation_error(model.law, plant, [recording], [motion], V_SMOOTH)
    truth = torch.tensor(TRUTH[name], dtype=torch.float64)
    torch.testing.assert_close(found.coefficients, truth, rtol=1e-6, atol=1e-10)
    assert float(found.residual.max()) < 1e-9 * float(found.torque.max())
    inside = slice(round(EDGE / 2e-3), -round(EDGE / 2e-3))
    rms = tau_f[inside].square().mean(0).sqrt()
    torch.testing.assert_close(found.torque, rms, rtol=2e-3, atol=0)


def test_torque_of_a_motion_excludes_the_ends():
    plant = pendulum()
    model = model_by_name("LFM")(2, TRUTH["LFM"], v_smooth=V_SMOOTH)
    recording, motion, tau_f = moved(model, plant)
    qd, load, torque = friction_torque(plant, recording, motion)
    inside = (recording.time > EDGE - 1e-9) & (recording.time < recording.time[-1] - EDGE + 1e-9)
    assert abs(len(torque) - int(inside.sum())) <= 2  # stamps that round to the edge
    middle = slice(100, 200)
    offset = int(np.flatnonzero(recording.time >= recording.time[0] + EDGE)[0])
    torch.testing.assert_close(
        torque[middle], tau_f[offset + 100 : offset + 200], rtol=0, atol=1e-12
    )
    assert qd.shape == load.shape == torque.shape


def test_too_few_samples_are_refused():
    plant, law = pendulum(), model_by_name("LFM")(2, TRUTH["LFM"]).law
    recording, motion, _ = moved(model_by_name("LFM")(2, TRUTH["LFM"]), plant)
    ends = 2 * round(EDGE / 2e-3)
    for count, enough in ((12, False), (ends + 2, False), (ends + 10, True)):
        part = Motion(*(x[:count] for x in (motion.time, motion.q, motion.qd, motion.qdd)))
        if enough:
            fit_equation_error(law, plant, [recording[:count]], [part])
            continue
        with pytest.raises(ValueError, match=r"too few samples.*2 coefficients.*for longer"):
            fit_equation_error(law, plant, [recording[:count]], [part])


def test_recordings_are_weighted_by_their_samples():
    plant = pendulum()
    models = [model_by_name("NCFM")(2, [c], v_smooth=V_SMOOTH) for c in (1e-3, 3e-3)]
    parts = [moved(m, plant) for m in models]
    both = fit_equation_error(
        models[0].law, plant, [p[0] for p in parts], [p[1] for p in parts], V_SMOOTH
    )
    torch.testing.assert_close(both.coefficients, torch.full((2, 1), 2e-3, dtype=torch.float64))


def test_physically_positive_coefficients_stay_positive():
    plant = pendulum()
    model = model_by_name("NLFM")(2, [-5e-3, 1e-3, 1e-3, 0.0, 1.0], v_smooth=V_SMOOTH)
    recording, motion, _ = moved(model, plant)
    backwards = Recording(recording.time, recording.q, tau=2 * np.asarray(
        plant.inverse_dynamics(*(torch.as_tensor(x) for x in (motion.q, motion.qd, motion.qdd)))
    ) - recording.tau)  # fmt: skip
    found = fit_equation_error(LINEAR, plant, [backwards], [motion], V_SMOOTH)
    assert (found.coefficients >= 0).all()
    signed = fit_equation_error(model.law, plant, [recording], [motion], V_SMOOTH)
    assert (signed.coefficients[:, 0] < 0).all()


@pytest.mark.parametrize(("law", "shy"), [(NONLINEAR, "f_o"), (LINEAR, None)])
def test_priors_of_small_terms_scale_with_the_friction(law, shy):
    size = torch.tensor([2e-3, 0.5], dtype=torch.float64)
    nothing = torch.zeros(2, len(law.names), dtype=torch.float64)
    sd = prior_sd(law, TorqueFit(nothing, 0.6 * size, size))
    for k, coefficient in enumerate(law.coefficients):
        assert torch.isfinite(sd[:, k]).all() == (coefficient.name == shy)
        # Residual 0.6 and explained 0.8 add in the square.
        torch.testing.assert_close(sd[:, k], coefficient.prior_scale * 0.8 * size)
    assert (prior_sd(law, TorqueFit(nothing, size, size)) > 0).all()


def test_law_that_returns_nan_is_named_with_joint_and_velocity():
    def root(qd, load, coefficients, v_smooth):
        return coefficients[..., 0] * qd.sqrt()  # NaN at the joint's reversal

    plant = pendulum()
    recording, motion, _ = moved(model_by_name("NCFM")(2, TRUTH["NCFM"]), plant)
    law = Law("root", (Coefficient("R", "N m"),), root)
    with pytest.raises(ValueError, match=r"law 'root' gives nan where R is 1, at joint \d, vel"):
        fit_equation_error(law, plant, [recording], [motion], V_SMOOTH)


def test_friction_that_falls_with_speed_is_found_in_smoothed_torques():
    """A smoother blurs reversals, and with them all features at low speed."""
    truth = [0.35, 0.15, 0.12, 0.3, 2.0]
    recordings = [flywheel(seed, Stribeck(1, truth)) for seed in (3, 4)]
    found = fit(Stribeck(1), LinearAxis(0.13), recordings, method="equation_error")
    values = found.model.schedule.values[0].tolist()
    assert values[:3] == pytest.approx(truth[:3], rel=0.4)
    assert values[0] + values[1] == pytest.approx(0.5, rel=0.15)
    assert 0.15 < values[3] < 0.6
    intervals = {i.name: i for i in found.intervals}
    assert len(intervals) == 4
    assert all(i.low < i.value < i.high for i in intervals.values())
    # The intervals do not include that error.
    assert intervals["F_d of joint1"].high < 0.15
    assert any("blurs friction at low speed" in warning for warning in found.warnings)


@pytest.mark.parametrize("alone", [0, -1])
def test_single_sample_next_to_a_gap_is_handled(alone):
    recording = flywheel(3, Stribeck(1, [0.35, 0.15, 0.12, 0.3, 2.0]))
    time = recording.time.copy()
    time[alone] += -1.0 if alone == 0 else 1.0
    with pytest.warns(match="has gaps"):
        gapped = Recording(time, recording.q, recording.tau, unit="m")
    whole, found = (
        fit("CVFM", LinearAxis(0.13), r, method="equation_error") for r in (recording, gapped)
    )
    assert found.model.schedule.values[0].tolist() == pytest.approx(
        whole.model.schedule.values[0].tolist(), rel=0.01
    )


def test_regression_names_terms_that_are_zero():
    plant = pendulum()
    model = model_by_name("CVFM")(2, [[3e-3, 0.0], [5e-4, 1e-3]], v_smooth=V_SMOOTH)
    recording, motion, _ = moved(model, plant)
    law = model_by_name("CVFM")(2, v_smooth=V_SMOOTH)
    found = fit(law, plant, recording, motions=[motion], method="equation_error")
    assert found.at_bounds == ("F_v of joint1",)
    assert any(w.startswith("At zero: F_v of joint1") for w in found.warnings)
    assert any("smoothed motion" in w for w in found.warnings)


@pytest.mark.slow
def test_fixed_coefficients_keep_the_values_of_the_model():
    """A linear one of a user-defined law, and the exponent of Stribeck friction."""

    def both(qd, load, coefficients, v_smooth):
        f_c, f_v = coefficients.unbind(-1)
        return f_c * torch.tanh(qd / v_smooth) + f_v * qd

    kept = Coefficient("F_v", "N m s/rad", fitted=False)
    law = Law("both", (Coefficient("F_c", "N m"), kept), both)
    axis, given = LinearAxis(2.0), {"windows": (0.5,), "fit_plant": False}
    truth = FrictionModel(law, Constant(law, 1, [0.8, 0.3]), v_smooth=0.05)
    measured = driven_axis(axis, truth)
    for f_v, f_c in ((0.3, pytest.approx(0.8, rel=0.01)), (0.0, pytest.approx(1.0, abs=0.15))):
        model = FrictionModel(law, Constant(law, 1, [0.1, f_v]), v_smooth=0.05)
        found = fit(model, axis, measured, **given).model.schedule.coefficient_sets()["always"]
        assert found.tolist() == [[f_c, pytest.approx(f_v, abs=1e-9)]]
        assert (found[0, 0] > 0.85) == (f_v == 0.0)  # the rest replaces it
    shape = Stribeck(1, [[0.5, 0.1, 0.1, 0.2, 1.5]], v_smooth=0.05)
    for method in ("equation_error", "output_error"):
        found = fit(shape, axis, measured, **given | {"method": method})
        assert float(found.model.schedule.coefficient_sets()["always"][0, 4]) == 1.5


@pytest.mark.parametrize(
    ("torque", "message"),
    [
        (lambda qd, c: torch.tensor(np.tanh(qd.numpy())) * c[..., 0], "it fails: "),
        (lambda qd, c: c[..., 0] * qd if qd > 0 else 0.0 * qd, "it fails: "),
        (lambda qd, c: torch.tanh(qd), "it fails: "),
        (lambda qd, c: (c[..., 0] * qd).sum(-1), r"it gives shape \(3,\) for \(3, 2\)"),
        (lambda qd, c: c[..., 0] * math.tanh(qd), "it fails: "),
        (lambda qd, c: c[..., 0] * (qd - qd.mean(0)), "depend on the other samples"),
        (lambda qd, c: c[..., 0] * qd.sum(-1, keepdim=True), "depend on the first joint"),
    ],
)  # fmt: skip
def test_a_law_that_is_not_elementwise_is_refused_by_name(torque, message):
    def law(qd, load, coefficients, v_smooth):
        return torque(qd, coefficients)

    with pytest.raises(ValueError, match=f"law 'mine' must be an elementwise.*{message}"):
        require_elementwise(Law("mine", (Coefficient("F_c", "N m"),), law), 2)
