"""Fits recover true parameters, report how they ended, and refuse inconsistent input."""

import inspect
import logging
import warnings
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from nfriction import (
    ALFM,
    CVFM,
    LFM,
    NCFM,
    NFLFM,
    NLFM,
    LinearAxis,
    PendulumChain,
    Recording,
    Rotor,
    Stribeck,
    fit,
    rigs,
    rollout,
)
from nfriction.fitting.data.inputs import adjustable_terms, turning_velocity
from nfriction.fitting.equation_error import fit_equation_error
from nfriction.fitting.options import FitOptions
from nfriction.fitting.shooting.autocorrelation import effective_noise
from nfriction.fitting.strategy.continuation import HorizonResult, ShootingFitter
from nfriction.fitting.strategy.neurofuzzy import Validation
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import STRIBECK
from nfriction.friction.models import FrictionModel
from nfriction.signals import kalman_smoother
from tests.fitting.recordings import F64, driven_axis, one_link, pendulum, swing

TRUTH = [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]]
V_SMOOTH = 0.05


def true_model():
    return LFM(2, TRUTH, v_smooth=V_SMOOTH)


def assert_coefficients(found, relative):
    torch.testing.assert_close(
        found.model.schedule.values, torch.tensor(TRUTH, dtype=F64), rtol=relative, atol=0
    )


@pytest.mark.parametrize("convention", ["relative,upright", "absolute,hanging"])
def test_known_friction_is_recovered(convention):
    recording = swing(pendulum(), true_model(), convention=convention)
    found = fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, fit_plant=False, windows=(1.0,))
    assert_coefficients(found, 0.03)
    assert found.converged
    assert found.status.startswith("Converged")
    # The residual is the encoder's quantisation and nothing else.
    assert found.residual == pytest.approx(2 * np.pi / 8192 / 12**0.5, rel=0.2)
    assert found.at_bounds == ()
    assert found.plant_terms == ()


@pytest.mark.slow
def test_wrong_plant_is_reported_with_and_without_known_resolution():
    # A count is that of the encoder's own angle, which is not the joint's here.
    recording = swing(pendulum(), true_model(), convention="absolute,hanging", seconds=2.0)
    wrong = {"mass": [0.3, 0.2], "length": [0.2, 0.15], "inertia": [2e-3, 1e-3]}
    residual_warnings = []
    for quantum in (None, 2 * np.pi / 8192):
        plant = PendulumChain(**wrong, position_quantum=quantum)
        found = fit(LFM(2), plant, recording, fit_plant=False, windows=(1.0,))
        residual_warnings.append([warning for warning in found.warnings if "Residual:" in warning])
    assert len(residual_warnings[0]) == 1
    assert residual_warnings[0] == residual_warnings[1]


@pytest.mark.slow
def test_perturbed_plant_ratios_are_recovered():
    plant = pendulum()
    recordings = [swing(plant, true_model(), name="a"),
                  swing(plant, true_model(), start=(2.4, -1.0), name="b")]  # fmt: skip
    given = plant.replace(
        gravity_moment=plant.gravity_moment * torch.tensor([1.0, 0.95], dtype=F64)
    )
    found = fit(LFM(2, v_smooth=V_SMOOTH), given, recordings)
    terms = {name: value for name, value, _ in found.plant_terms}
    assert terms["gravity 2"] == pytest.approx(1 / 0.95 - 1, abs=0.01)
    assert max(abs(v) for n, v in terms.items() if n.startswith("inertia")) < 0.02
    torch.testing.assert_close(found.plant.gravity_moment, plant.gravity_moment, rtol=0.01, atol=0)
    assert_coefficients(found, 0.05)
    assert len(found.motions) == 2


def test_driven_axis_determines_mass_and_offset():
    axis = LinearAxis(2.0, torque_offset=0.3)
    recording = driven_axis(axis, LFM(1, [3.0, 1.0], v_smooth=V_SMOOTH))
    found = fit(LFM(1, v_smooth=V_SMOOTH), LinearAxis(1.9), recording, windows=(0.5,))
    assert float(found.plant.mass) == pytest.approx(2.0, rel=0.01)
    assert float(found.plant.torque_offset) == pytest.approx(0.3, abs=0.03)
    assert not any("times the speed" in warning for warning in found.warnings)
    values = found.model.schedule.values[0].tolist()
    assert values == pytest.approx([3.0, 1.0], rel=0.05)


def test_a_constant_force_is_the_offset_of_a_law_that_has_one():
    """With a plant term as well, only their sum would be identifiable."""
    truth = LFM(1, [3.0, 1.0], v_smooth=V_SMOOTH)
    recording = driven_axis(LinearAxis(2.0, torque_offset=0.3), truth)
    found = fit(NLFM(1, v_smooth=V_SMOOTH), LinearAxis(1.9), recording, windows=(0.5,))
    assert float(found.model.schedule.values[0, 0]) == pytest.approx(-0.3, rel=0.05)
    assert not any("offset" in name for name, *_ in found.plant_terms)
    assert not any("f_o" in text for text in found.unidentifiable)


@pytest.mark.parametrize(("mass", "viscous", "v_smooth"), [(20.0, 20.0, 2e-5), (0.02, 0.05, 1e-3)])
def test_regularisation_velocity_fits_speeds_and_sample_time(mass, viscous, v_smooth):
    """A heavy axis moves at 6 cm/s; friction stops a light one within a few samples."""
    axis, truth = LinearAxis(mass), CVFM(1, [4.0, viscous], v_smooth=v_smooth)
    recording = driven_axis(axis, truth, substeps=300, seconds=2.0)
    found, usual = (
        fit(model, axis, recording, windows=(0.5,), fit_plant=False) for model in ("CVFM", CVFM(1))
    )
    assert (found.model.v_smooth < usual.model.v_smooth) == (mass > 1)
    assert found.residual < 0.5 * usual.residual
    assert found.model.schedule.values[0].tolist() == pytest.approx([4.0, viscous], rel=0.01)


def test_joint_held_by_friction_creeps_by_less_than_the_noise():
    time = np.arange(0.0, 4.0, 2e-3)
    reference = np.clip(np.sin(2 * np.pi * 0.5 * time), -0.8, 0.8)  # rests of 0.41 s
    q = 1e-3 * np.rint(reference[:, None] / 1e-3)
    recording = Recording(time, q, np.zeros_like(q))
    motion = kalman_smoother(time, recording.q)
    noise = np.std(q - motion.q)
    found, _ = turning_velocity(Rotor(1e-3), [recording], [motion])
    assert 0.3 * noise < 0.4 * found <= noise


def test_single_speed_makes_viscous_and_coulomb_unidentifiable():
    """Only their sum is identifiable; either alone may have any value, and the warning says so."""
    axis, truth = LinearAxis(2.0), LFM(1, [3.0, 1.0], v_smooth=V_SMOOTH)
    # Not an integer number of micrometres per sample.
    speed = torch.full((1,), 0.5123, dtype=F64)
    force = torch.full((1000, 1), 3.0 * 0.5123 + 1.0, dtype=F64)
    out = rollout(axis, truth, 0 * speed, speed, force, sample_time=2e-3, substeps=2,
                  gradients=False)  # fmt: skip
    tau = np.append(force.numpy(), force.numpy()[-1:], axis=0)
    q = 1e-6 * np.rint(out.q.numpy() / 1e-6)
    recording = Recording(out.time.numpy(), q, tau=tau, unit="m", name="steady")
    found = fit(LFM(1, v_smooth=V_SMOOTH), axis, recording, windows=(0.5, 1.0), fit_plant=False)
    (direction,) = found.unidentifiable
    assert set(direction.split(" with ")) == {"B of joint1", "C of joint1"}
    assert any("Not identifiable" in warning for warning in found.warnings)
    assert all(i.high - i.low > i.value for i in found.intervals)
    viscous, coulomb = found.model.schedule.values[0].tolist()
    assert 0.5123 * viscous + coulomb == pytest.approx(3.0 * 0.5123 + 1.0, rel=0.01)


def test_joint_that_hardly_moves_is_named_as_unidentifiable():
    """It creeps in the smooth sign's transition, where viscous and Coulomb friction are
    equivalent."""
    truth = LFM(2, [[1.5e-3, 2.5e-3], [8e-4, 0.1]], v_smooth=V_SMOOTH)
    recording = swing(pendulum(), truth, start=(np.pi - 0.5, 0.0), seconds=3.0)
    assert np.ptp(recording.q[:, 1]) < 0.01
    found = fit(
        LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, windows=(0.5, 1.0), fit_plant=False
    )
    assert {"B of joint2", "C of joint2"} <= set(
        " with ".join(found.unidentifiable).split(" with ")
    )
    intervals = {i.name: i for i in found.intervals}
    assert intervals["C of joint2"].high - intervals["C of joint2"].low > 0.1
    for name, true in (("B of joint1", 1.5e-3), ("C of joint1", 2.5e-3)):
        assert name not in found.unidentifiable
        assert intervals[name].value == pytest.approx(true, rel=0.05)


def test_asymmetric_friction_is_separated_from_an_offset():
    axis = LinearAxis(2.0, torque_offset=0.3)
    crooked = axis.replace(asymmetry=torch.tensor([0.8], dtype=F64))
    recording = driven_axis(crooked, LFM(1, [3.0, 1.0], v_smooth=V_SMOOTH))
    found = fit(LFM(1, v_smooth=V_SMOOTH), axis, recording, windows=(0.5,))
    assert float(found.plant.asymmetry) == pytest.approx(0.8, rel=0.1)
    assert float(found.plant.torque_offset) == pytest.approx(0.3, abs=0.03)
    (warning,) = (w for w in found.warnings if "times the speed" in w)
    assert "a drive force of -0." in warning
    assert "larger forwards" in warning
    assert not any("constant drive" in w for w in found.warnings)


def test_weight_on_an_axis_is_not_asymmetric_friction():
    """Its drive carries the weight, which the rig lacks."""
    axis = LinearAxis(2.0)
    level = driven_axis(axis, LFM(1, [3.0, 1.0], v_smooth=V_SMOOTH))
    recording = replace(level, tau=level.tau + 20.0)
    found = fit(LFM(1, v_smooth=V_SMOOTH), axis, recording, windows=(0.5,))
    assert float(found.plant.torque_offset) == pytest.approx(-20.0, rel=0.01)
    (warning,) = (w for w in found.warnings if "constant drive force" in w)
    assert "is larger than its friction: a weight, a spring, or a sensor's bias" in warning
    assert "larger forwards" not in warning


def test_drag_is_fitted_by_default_for_free_swings():
    recording = swing(pendulum(), true_model(), seconds=1.0)

    def drag(**more):
        terms = adjustable_terms(pendulum(), LFM(2).law, [recording], FitOptions(**more))
        return [term.name for term in terms if "drag" in term.name]

    assert drag() == ["drag linear", "drag quadratic", "drag reach"]
    assert drag(drag=False) == []
    assert drag(fit_plant=False) == []


@pytest.mark.slow
def test_air_drag_is_separated_from_joint_friction():
    """With drag in the recording, joint coefficients are unbiased only if drag is fitted."""
    plant = pendulum()
    air = plant.replace(drag_quadratic=torch.full((2,), 0.05, dtype=F64))
    recording = swing(air, true_model(), seconds=6.0)
    errors = []
    for drag in (True, False):
        found = fit(LFM(2, v_smooth=V_SMOOTH), plant, recording, drag=drag, windows=(0.5, 2.0))
        truth = torch.tensor(TRUTH, dtype=F64)
        errors.append(float((found.model.schedule.values / truth - 1).abs().max()))
        if drag:
            interval = {i.name: i for i in found.intervals}["drag quadratic"]
            assert interval.low < 0.05 < interval.high
            assert {"intervals", "unidentifiable", "warnings"} <= found.to_dict().keys()
    assert errors[0] < 0.2 * errors[1]


@pytest.mark.slow
def test_skipped_windows_are_reported(monkeypatch):
    monkeypatch.setattr(HorizonResult, "lost_motion", lambda self, before, options: True)
    recording = swing(pendulum(), true_model(), seconds=2.0)
    found = fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, windows=(0.5, 1.0), max_steps=3)
    assert sum(warning.startswith("Windows of 1 s were skipped") for warning in found.warnings) == 1
    alone = fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, windows=(0.5,), max_steps=3)
    assert not any("were skipped" in warning for warning in alone.warnings)
    assert found.residual == pytest.approx(alone.residual, rel=0.2)
    # Every fit that starts there repeats the warning.
    monkeypatch.setattr(Validation, "trained_on", lambda self, trial: trial)
    for kept in (False, True):
        monkeypatch.setattr(
            "nfriction.fitting.strategy.neurofuzzy.improves", lambda *_, kept=kept, **__: kept
        )
        network = NFLFM(2, v_smooth=V_SMOOTH, terms=(2, 2), head_units=2)
        further = fit(network, pendulum(), recording, start=found, windows=(0.5,), max_steps=2)
        assert sum("were skipped" in warning for warning in further.warnings) == 1
    # A network must not follow what its law could not.
    assert found.skipped_horizons == (1.0,)
    assert fit(network, pendulum(), recording, start=found, max_steps=2).skipped_horizons == (1.0,)
    stages = set()
    fit(
        network, pendulum(), recording, start=found, windows=(0.5, 1.0, 2.0), max_steps=2,
        callback=lambda stage, step: stages.add(stage),
    )  # fmt: skip
    assert "0.5 s windows" in stages
    assert not {"1 s windows", "2 s windows"} & stages
    later = fit(
        CVFM(2, v_smooth=V_SMOOTH), pendulum(), recording, windows=(0.5, 1.0, 1.5), max_steps=3
    )
    assert later.skipped_horizons == (1.0, 1.5)
    assert sum("Windows of 1 and 1.5 s were skipped" in warning for warning in later.warnings) == 1


def test_irregular_time_stamps_are_simulated():
    step = np.random.default_rng(0).uniform(1e-3, 3e-3, 1500)
    recording = swing(pendulum(), true_model(), sample_time=step)
    found = fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, fit_plant=False, windows=(1.0,))
    assert_coefficients(found, 0.05)


def test_equation_error_fit_can_start_another_fit():
    recording = swing(pendulum(), true_model(), seconds=2.0)
    first = fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, method="equation_error")
    assert first.steps == 0
    # Accelerations of a coarse encoder bias the friction, but it explains part of the torque.
    assert (first.model.schedule.values >= 0).all()
    assert first.residual > 0
    assert first.plant_terms == ()
    second = fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, start=first,
                 motions=first.motions, windows=(1.0,), max_steps=2)  # fmt: skip
    assert second.plant_terms
    third = fit(
        LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, method="equation_error", start=second
    )
    assert third.plant is second.plant
    assert third.plant_terms == second.plant_terms
    with pytest.raises(ValueError, match="neuro-fuzzy"):
        fit(NFLFM(2), pendulum(), recording, method="equation_error")


def test_terms_of_an_earlier_fit_are_taken_by_name():
    """The earlier fit may have had other terms, or none."""
    recording = swing(pendulum(), true_model(), seconds=1.0)
    settings = {"windows": (0.5,), "max_steps": 1}
    bare = fit(NCFM(2), pendulum(), recording, fit_plant=False, **settings)
    full = fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, start=bare, **settings)
    assert full.plant_terms
    less = fit(
        LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, fit_plant=False, start=full, **settings
    )
    assert less.plant_terms == ()


def test_early_stop_keeps_the_best_result():
    recording = swing(pendulum(), true_model(), seconds=2.0)
    seen = []

    def stop(stage, step):
        seen.append((stage, step.cost))
        return True

    model = LFM(2, v_smooth=V_SMOOTH)
    found = fit(model, pendulum(), recording, fit_plant=False, windows=(0.5, 1.0), callback=stop)
    assert [stage for stage, _ in seen] == ["0.5 s windows"]
    assert not found.converged
    assert "topped" in found.status
    assert found.steps == 1
    assert torch.equal(*(m.schedule.parameter_vector() for m in (found.model, model)))


@pytest.mark.slow
def test_neuro_fuzzy_model_with_little_data_is_near_its_constant_law():
    recording = swing(pendulum(), true_model(), seconds=1.5)
    constant = fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, fit_plant=False)
    model = NFLFM(2, v_smooth=V_SMOOTH)
    found = fit(model, pendulum(), recording, fit_plant=False, start=constant)
    qd, qdd = torch.as_tensor(found.motions[0].qd), torch.as_tensor(found.motions[0].qdd)
    load = torch.ones_like(qd)
    with torch.no_grad():
        bent, flat = model(qd, qdd, load), constant.model(qd, qdd, load)
    assert float((bent - flat).square().mean()) ** 0.5 < 0.1 * float(flat.square().mean()) ** 0.5
    assert found.residual < 1.05 * constant.residual


def test_effective_noise_of_white_and_of_correlated_residuals():
    g = torch.Generator().manual_seed(0)
    white = 0.3 * torch.randn(20, 4000, 2, generator=g, dtype=F64)
    assert effective_noise(white) == pytest.approx(0.3, rel=0.05)
    phi = 0.9
    noise = torch.randn(20, 4000, 2, generator=g, dtype=F64)
    rows = [noise[:, 0] / (1 - phi**2) ** 0.5]
    for k in range(1, 4000):
        rows.append(phi * rows[-1] + noise[:, k])
    ar = torch.stack(rows, 1)
    expected = ((1 + phi) / (1 - phi)) ** 0.5 / (1 - phi**2) ** 0.5
    assert effective_noise(ar) == pytest.approx(expected, rel=0.05)
    assert effective_noise(10 * ar) == pytest.approx(10 * effective_noise(ar))


def test_inconsistent_input_is_refused():
    recording = swing(pendulum(), true_model(), seconds=0.5)
    other = swing(pendulum(), true_model(), seconds=0.5, convention="absolute,hanging", name="o")
    for arguments, message in (
        ((LFM(2), pendulum(), []), "at least one recording"),
        ((LFM(3), pendulum(), recording), "equally many joints"),
        ((LFM(2), LinearAxis(1.0), recording), "equally many joints"),
        ((LFM(2), pendulum(), [recording, other]), "convention"),
        ((LFM(2), pendulum(), replace(recording, unit="m")), "swing is in m, .* in rad"),
        ((LFM(2), pendulum(), [recording, recording]), "recordings 1 .swing. and 2 .swing."),
        (
            (LFM(2), pendulum(), [other, recording, replace(other, name="copy")]),
            "3 .copy. contain the same data; leave one",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            fit(*arguments)
    for model in (LFM, NFLFM, ALFM):
        for windows in ((), 2.0, np.array(0.5), (-1.0,), (np.inf,), ("1",), "12"):
            with pytest.raises(ValueError, match=r"`windows` must be positive lengths \[s\]"):
                fit(model(2), pendulum(), recording, windows=windows)


@pytest.mark.parametrize(
    "setting", [{"fit_plant": "no"}, {"drag": "no"}, {"fit_delay": 2}, {"max_steps": 2.5}]
)
def test_settings_of_wrong_type_are_refused(setting):
    """They are neither taken as true nor rounded down."""
    (name,) = setting
    with pytest.raises(ValueError, match=rf"`{name}` must be .*, got "):
        fit(LFM(2), pendulum(), swing(pendulum(), true_model(), seconds=0.5), **setting)


def test_internal_constant_fit_has_the_defaults_of_fit():
    offered = inspect.signature(fit).parameters
    defaults = {f.name: f.default for f in fields(FitOptions)}
    own = {"model", "plant", "recordings", "start", "motions", "callback"}
    assert {name: p.default for name, p in offered.items() if name not in own} == {
        name: defaults[name] for name in offered if name not in own
    }


@pytest.mark.parametrize("model", [LFM, NFLFM])
def test_motions_must_be_those_of_the_recordings(model):
    one, other = (swing(pendulum(), true_model(), seconds=s, name=n)
                  for s, n in ((0.5, "one"), (0.6, "other")))  # fmt: skip
    motion = kalman_smoother(one.time, one.q)
    for recordings, motions in (([one, other], [motion]), ([other], [motion])):
        with pytest.raises(ValueError, match=r"`motions` must match the recordings.*got 1 of"):
            fit(model(2), pendulum(), recordings, motions=motions)


def test_recordings_without_torque_among_driven_ones_are_named():
    free, other = (swing(pendulum(), true_model(), seconds=0.5, start=s, name=n)
                   for s, n in (((1.6, 0.8), "free"), ((2.0, 0.2), "other")))  # fmt: skip
    torque = replace(other, tau=np.full_like(other.q, 1e-3), name="driven")
    for recordings in ([free, torque], [torque, free]):
        with pytest.warns(UserWarning, match=r"no torque is recorded in free, unlike") as caught:
            fit(LFM(2), pendulum(), recordings, method="equation_error")
        assert len([w for w in caught if "no torque" in str(w.message)]) == 1
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="no torque is recorded")
        for pair in ([free, other], [torque, replace(free, tau=np.zeros_like(free.q))]):
            fit(LFM(2), pendulum(), pair, method="equation_error")


def test_plain_fit_logs_no_warnings(caplog):
    recording: Recording = swing(pendulum(), true_model(), seconds=1.0)
    with caplog.at_level(logging.WARNING, "nfriction"):
        fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, fit_plant=False, windows=(0.5,))
    assert not caplog.records


def test_convention_of_the_recording_precedes_that_of_the_plant():
    hanging = pendulum(convention=("absolute", "hanging"))
    stated = swing(pendulum(), true_model(), convention="absolute,hanging", seconds=1.0)
    unstated = replace(stated, convention=None)
    settings = {"fit_plant": False, "windows": (0.5,), "max_steps": 3}
    found = [
        fit(LFM(2, v_smooth=V_SMOOTH), plant, recording, **settings)
        for plant, recording in ((hanging, unstated), (pendulum(), stated))
    ]
    assert torch.equal(found[0].model.schedule.values, found[1].model.schedule.values)
    assert found[0].residual == found[1].residual
    with pytest.raises(ValueError, match=r"absolute,hanging and relative,upright"):
        fit(LFM(2), pendulum(), [stated, unstated])


def test_fitted_model_requires_no_gradients_and_may_be_refitted():
    plant = one_link()
    recording = swing(plant, LFM(1, TRUTH[:1], v_smooth=V_SMOOTH), seconds=0.5)
    model = LFM(1, v_smooth=V_SMOOTH)
    first = fit(model, plant, recording, method="equation_error")
    assert torch.equal(*(m.schedule.parameter_vector() for m in (first.model, model)))
    assert not model.schedule.raw.requires_grad
    assert (first.residual_unit, first.to_dict()["residual_unit"]) == ("N m", "N m")
    settings = {"fit_plant": False, "windows": (0.25,), "max_steps": 2}
    again = fit(model, plant, recording, **settings)
    assert (again.residual_unit, again.steps > 0) == ("rad", True)
    bent = NFLFM(1, v_smooth=V_SMOOTH, terms=(2, 2), head_units=2)
    for _ in range(2):
        found = fit(bent, plant, recording, start=again, **settings)
        assert found.steps > 0
        assert not any(p.requires_grad for p in bent.parameters())


def test_unknown_method_is_named():
    recording = swing(pendulum(), true_model(), seconds=0.5)
    with pytest.raises(
        ValueError, match=r"one of \('equation_error', 'output_error'\), got 'torqe'"
    ):
        fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), recording, method="torqe")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (lambda m, p, r: (LFM, p, r), "`model` must be a friction model .*LFM"),
        (lambda m, p, r: (m, r, p), "`plant` must be a mechanism"),
        (lambda m, p, r: (m, p, r.q), "a recording is a Recording, the path"),
        (lambda m, p, r: (m, p, 5), "a recording is a Recording, the path"),
    ],
)
def test_wrong_argument_types_are_named(arguments, message):
    recording = swing(pendulum(), LFM(2, v_smooth=0.05), seconds=0.2)
    with pytest.raises(TypeError, match=message):
        fit(*arguments(LFM(2), pendulum(), recording))
    with pytest.raises(TypeError, match="`start` must be the result of a fit, got a LFM"):
        fit(LFM(2), pendulum(), recording, start=LFM(2))


def test_names_paths_and_tables_are_accepted(tmp_path):
    recording = swing(pendulum(), LFM(2, v_smooth=0.05), seconds=0.5)
    recording.write(tmp_path / "run.csv")
    rigs.write(pendulum(), tmp_path / "rig.json")
    settings = {"windows": (0.2,), "max_steps": 0, "fit_plant": False}
    wanted = fit(CVFM(2), pendulum(), recording, **settings)
    for given in (str(tmp_path / "run.csv"), [tmp_path / "run.csv"], recording.to_pandas()):
        found = fit("coulomb-viscous", tmp_path / "rig.json", given, **settings)
        assert type(found.model) is CVFM
        assert found.residual == pytest.approx(wanted.residual, rel=1e-6)
    with pytest.raises(ValueError, match=r"no friction model is called 'coulom'.*did you mean"):
        fit("coulom", pendulum(), recording)
    with pytest.raises(FileNotFoundError):
        fit("coulomb", pendulum(), "absent.csv")


FALLING = [[4e-4, 6e-3, 3e-4, 0.8, 2.0], [3e-4, 4e-3, 2e-4, 0.8, 2.0]]
POOR = [[3e-3, 0.0, 1e-4, 20.0, 2.0]] * 2


@pytest.fixture
def misled_searches(monkeypatch):
    """Make the first equation-error fit of a law return useless coefficients."""
    asked = []

    def by_torque(law, plant, *rest):
        asked.append(plant)
        found = fit_equation_error(law, plant, *rest)
        if len(asked) > 1:
            return found
        poor = torch.tensor(POOR, dtype=F64)[:, : found.coefficients.shape[1]]
        return replace(found, coefficients=poor)

    monkeypatch.setattr("nfriction.fitting.task.fit_equation_error", by_torque)
    return asked


@pytest.mark.slow
def test_stribeck_friction_is_recovered():
    recording = swing(pendulum(), Stribeck(2, FALLING, v_smooth=V_SMOOTH), seconds=3.0)
    found = fit(Stribeck(2, v_smooth=V_SMOOTH), pendulum(), recording, windows=(0.5,))
    # The residual is the encoder's quantisation.
    assert found.residual == pytest.approx(2 * np.pi / 8192 / 12**0.5, rel=0.02)
    truth = torch.tensor(FALLING, dtype=F64)
    torch.testing.assert_close(found.model.schedule.values, truth, rtol=0.05, atol=0)


@pytest.mark.slow
def test_no_search_is_repeated(monkeypatch):
    """With a fixed plant, equation error leads to the same start as before."""
    begun, search = [], ShootingFitter.search

    def counted(fitter, problem, start, *rest):
        begun.append(start)
        return search(fitter, problem, start, *rest)

    monkeypatch.setattr(ShootingFitter, "search", counted)
    # Friction of another law, so that the encoder's quantisation does not end the restarts.
    recording = swing(pendulum(), Stribeck(2, FALLING, v_smooth=V_SMOOTH), seconds=1.0)
    settings = {"windows": (0.5,), "fit_plant": False, "max_steps": 1}
    fit(NLFM(2, v_smooth=V_SMOOTH), pendulum(), recording, **settings)
    assert len(begun) > 3
    assert not any(torch.equal(a, b) for k, a in enumerate(begun) for b in begun[:k])


@pytest.mark.slow
def test_stribeck_friction_is_recovered_despite_a_wrong_plant():
    recording = swing(pendulum(), Stribeck(2, FALLING, v_smooth=V_SMOOTH))
    given = PendulumChain([0.27, 0.22], [0.2, 0.15], inertia=[1.5e-3, 4e-4])
    found = fit(Stribeck(2, v_smooth=V_SMOOTH), given, recording, windows=(0.5, 2.0))
    assert found.residual == pytest.approx(2 * np.pi / 8192 / 12**0.5, rel=0.05)


def mine(joints, **settings):
    """A user-defined law that does not declare its nested law."""
    law = replace(STRIBECK, name="mine", nested_law=None, nested_coefficients=())
    return FrictionModel(law, Constant(law, joints), **settings)


@pytest.mark.slow
@pytest.mark.parametrize("law", [Stribeck, mine])
def test_misled_law_restarts_from_the_fitted_plant(misled_searches, monkeypatch, law):
    recording = swing(pendulum(), Stribeck(2, FALLING, v_smooth=V_SMOOTH), seconds=2.0)

    def fitted():
        misled_searches.clear()
        return fit(law(2, v_smooth=V_SMOOTH), pendulum(), recording, windows=(0.5,))

    found = fitted()
    assert misled_searches[1] is not misled_searches[0]
    assert found.residual == pytest.approx(2 * np.pi / 8192 / 12**0.5, rel=0.2)
    better = "nfriction.fitting.strategy.continuation.restart_from_equation_error"
    monkeypatch.setattr(better, lambda fitter, found, *rest: found)
    monkeypatch.setattr(
        "nfriction.fitting.strategy.constant.best_of_starts", lambda fitter, own, *rest: own
    )
    assert fitted().residual > 1.02 * found.residual


@pytest.mark.slow
def test_failed_search_from_the_nested_law_keeps_the_model(monkeypatch):
    recording = swing(pendulum(), Stribeck(2, FALLING, v_smooth=V_SMOOTH))
    settings = {"windows": (0.5, 1.0), "fit_plant": False}
    simpler = []

    def by_torque(law, plant, *rest):
        found = fit_equation_error(law, plant, *rest)
        if not simpler:
            simpler.extend([1] if law.nested_law is None else [])
            return found
        return replace(found, coefficients=torch.tensor(POOR, dtype=F64))

    monkeypatch.setattr("nfriction.fitting.task.fit_equation_error", by_torque)
    found = fit(Stribeck(2, v_smooth=V_SMOOTH), pendulum(), recording, **settings)
    assert simpler
    monkeypatch.setattr(
        "nfriction.fitting.strategy.constant.best_of_starts", lambda fitter, own, *rest: own
    )
    simpler.clear()
    alone = fit(Stribeck(2, v_smooth=V_SMOOTH), pendulum(), recording, **settings)
    assert torch.equal(found.model.schedule.values, alone.model.schedule.values)
    assert found.residual == alone.residual


@pytest.mark.slow
@pytest.mark.parametrize("law", [Stribeck, NLFM])
def test_residual_is_at_most_that_of_the_nested_law(law, monkeypatch):
    """However poor the start from equation error is."""

    def by_torque(law, plant, *rest):
        found = fit_equation_error(law, plant, *rest)
        if law.nested_law is None:
            return found
        return replace(found, coefficients=0 * found.coefficients + 10.0)

    monkeypatch.setattr("nfriction.fitting.task.fit_equation_error", by_torque)
    recording = swing(pendulum(), Stribeck(2, FALLING, v_smooth=V_SMOOTH), seconds=2.0)
    simpler, found = (
        fit(of(2, v_smooth=V_SMOOTH), pendulum(), recording, windows=(0.5, 1.0), max_steps=8)
        for of in (CVFM, law)
    )
    assert found.residual <= 1.001 * simpler.residual
    # Its own search diverged in all windows, and so skipped the longer ones.
    assert not any("were skipped" in warning for warning in found.warnings)


@pytest.mark.slow
@pytest.mark.parametrize(
    "last", ["0.5 s windows, coulomb_viscous law", "from the coulomb_viscous law"]
)
def test_interrupt_of_a_further_search_keeps_the_best_fit(last):
    recording = swing(pendulum(), Stribeck(2, FALLING, v_smooth=V_SMOOTH), seconds=2.0)
    alone = fit(CVFM(2, v_smooth=V_SMOOTH), pendulum(), recording, windows=(0.5,))
    stages = []

    def stop(stage, step):
        stages.append(stage)
        return stage == last

    model = Stribeck(2, v_smooth=V_SMOOTH)
    found = fit(model, pendulum(), recording, windows=(0.5,), callback=stop)
    assert stages[0] == "0.5 s windows"
    assert stages.count(last) == 1
    assert not found.converged
    assert "Stopped" in found.status
    assert found.residual < alone.residual


def test_law_without_a_nested_law_is_searched_once(misled_searches):
    fit(LFM(2, v_smooth=V_SMOOTH), pendulum(), swing(pendulum(), true_model(), seconds=1.0),
        windows=(0.5,), max_steps=1)  # fmt: skip
    assert len(misled_searches) == 1


def test_coefficient_at_zero_is_reported_as_absent():
    truth = LFM(2, [[0.0, 2e-3], [0.0, 1e-3]], v_smooth=0.05)
    recording = swing(pendulum(), truth, seconds=3.0)
    found = fit(LFM(2, v_smooth=0.05), pendulum(), recording, windows=(0.5,), max_steps=10)
    assert {"B of joint1", "drag quadratic"} <= set(found.at_bounds)
    assert f"At zero: {', '.join(found.at_bounds)}; the data show no such effect." in found.warnings
    assert not any("beyond" in w for w in found.warnings)


@pytest.mark.parametrize(
    ("device", "dtype", "message"),
    [("cpu", torch.float32, "float32 on cpu"), ("meta", F64, "float64 on meta")],
)
def test_fits_need_double_precision_on_the_cpu(device, dtype, message) -> None:
    link = one_link()
    swung = swing(link, NCFM(1), seconds=0.3)
    with pytest.raises(ValueError, match=f"needs float64 on the CPU, got torch.{message} in the m"):
        fit(NCFM(1).to(device, dtype), link, swung)
    with pytest.raises(ValueError, match=f"got torch.{message} in the plant"):
        fit(NCFM(1), link.to(device, dtype), swung)
