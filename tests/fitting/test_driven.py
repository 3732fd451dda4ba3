"""Geared, driven mechanisms with irregular time stamps, and the priors of a law."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from nfriction import LFM, NLFM, Motor, PendulumChain, Recording, Rotor, fit, rollout
from nfriction.evaluation.cross_validation import block_errors, blocked_k_fold
from nfriction.fitting.result.of_search import rotor_warning
from nfriction.friction.coefficients import Constant
from nfriction.friction.models import CFM, CVFM, FrictionModel
from nfriction.friction.neurofuzzy import NFCVFM
from nfriction.papers.afem.adaptive import ACVFM
from nfriction.signals import quantise
from tests.fitting.recordings import F64, pendulum, swing

V_SMOOTH = 0.05
DRY = [[0.20, 0.010], [0.15, 0.005]]


def geared() -> PendulumChain:
    """A double pendulum with the masses and rotor inertias of quasi-direct drives."""
    return PendulumChain(
        [0.5, 0.6], [0.2, 0.3], inertia=[8e-3, 9e-3], armature=[3e-3, 3e-3],
        convention=("relative", "hanging"),
    )  # fmt: skip


def driven(
    plant: PendulumChain, model: FrictionModel, seed: int, seconds: float = 3.0, late: int = 0
) -> Recording:
    """Sums of sines in torque from rest, with a host's time stamps, which are occasionally late.

    The torque acts `late` samples after it is logged.
    """
    random = np.random.default_rng(seed)
    step = np.abs(2e-3 + 1e-4 * random.standard_normal(round(seconds / 2e-3)))
    step[random.integers(0, len(step), 5)] = 5e-3
    time = np.concatenate([[0.0], np.cumsum(step)])
    rate = random.uniform(3.0, 12.0, (3, 2))
    tau = 0.35 * np.sin(rate * time[:, None, None] + random.uniform(0, 6, (3, 2))).sum(1)
    rest = torch.tensor([np.pi, 0.0], dtype=F64)
    acting = np.concatenate([np.zeros((late, 2)), tau])[: len(tau) - 1]
    out = rollout(
        plant, model, rest, torch.zeros_like(rest), torch.as_tensor(acting),
        sample_time=torch.as_tensor(step), substeps=4, gradients=False,
    )  # fmt: skip
    q = quantise(out.q.numpy() - [np.pi, 0.0], 16384)
    return Recording(time, q, tau=tau, convention="relative,hanging", name=f"driven {seed}")


@pytest.mark.slow
def test_friction_and_masses_are_recovered_from_irregular_stamps():
    plant = geared()
    recordings = [driven(plant, CVFM(2, DRY, v_smooth=V_SMOOTH), seed) for seed in (0, 1)]
    given = plant.replace(armature=plant.armature * 0.9, gravity_moment=1.05 * plant.gravity_moment)
    found = fit(CVFM(2, v_smooth=V_SMOOTH), given, recordings, windows=(1.0,))
    assert found.converged, found.status
    truth = torch.tensor(DRY, dtype=F64)
    # An encoder of 16384 counts leaves an uncertainty of some thousandths.
    torch.testing.assert_close(found.model.schedule.values, truth, rtol=0.01, atol=1e-4)
    # The first rotor turns with the first link, so only their sum is identifiable.
    pose = torch.tensor([[0.0, 0.0], [1.0, 2.0]], dtype=F64)
    for term in ("mass_matrix", "gravity"):
        torch.testing.assert_close(
            getattr(found.plant, term)(pose), getattr(plant, term)(pose), rtol=0.01, atol=1e-3
        )


@pytest.mark.slow
def test_drive_gain_below_one_is_recovered():
    plant = geared()
    truth = plant.replace(torque_gain=torch.tensor([1.0, 0.85], dtype=F64))
    law = CVFM(2, DRY, v_smooth=V_SMOOTH)
    recordings = [driven(truth, law, seed) for seed in (0, 1)]
    found = fit(CVFM(2, v_smooth=V_SMOOTH), plant, recordings, windows=(1.0,))
    assert found.converged, found.status
    (gain,) = (i for i in found.intervals if i.name == "torque gain 2")
    assert gain.low < -0.15 < gain.high
    assert gain.high - gain.low < 0.02
    # Friction is expressed in the torques that the drive reports.
    torch.testing.assert_close(
        found.model.schedule.values, law.schedule.values, rtol=0.02, atol=2e-4
    )


def test_direction_dependent_friction_is_named_as_a_constant_torque():
    plant, one_way = geared(), [[0.0, 0.2, 0.01, 0.0, 1.0], [0.03, 0.15, 0.005, 0.0, 1.0]]
    recordings = [driven(plant, NLFM(2, one_way, v_smooth=V_SMOOTH), seed) for seed in (0, 1)]
    found = fit(CVFM(2, v_smooth=V_SMOOTH), plant, recordings, windows=(1.0,))
    (warning,) = (w for w in found.warnings if "constant drive torque" in w)
    assert "-0.03 N m at joint2" in warning
    assert "0.06 N m larger forwards" in warning
    assert "add 0.03 N m to a command" in warning


def test_gear_losses_are_separated_from_dry_friction():
    plant = geared()
    truth = plant.replace(gear_loss=torch.tensor([0.05, 0.12], dtype=F64))
    law = CFM(2, [[0.20], [0.15]], v_smooth=V_SMOOTH)
    recordings = [driven(truth, law, seed) for seed in (0, 1, 2)]
    found = fit(CFM(2, v_smooth=V_SMOOTH), plant, recordings, windows=(1.0,))
    intervals = {i.name: i for i in found.intervals}
    for name, loss in (("gear loss 1", 0.05), ("gear loss 2", 0.12)):
        assert intervals[name].low < loss < intervals[name].high, intervals[name]
        assert intervals[name].high - intervals[name].low < 0.05
    torch.testing.assert_close(found.model.schedule.values, law.schedule.values, rtol=0.02, atol=0)


@pytest.mark.slow
def test_encoders_may_be_zeroed_at_the_start_of_each_recording():
    """Only the true model's offsets differ; a plant with one offset for all cannot follow."""
    plant = geared()
    law = CVFM(2, DRY, v_smooth=V_SMOOTH)
    off = ([0.06, -0.08], [-0.03, 0.05])
    recordings = [driven(plant, law, seed) for seed in (0, 1)]
    recordings = [replace(r, q=r.q - o) for r, o in zip(recordings, off, strict=True)]
    once, each = (
        fit(
            CVFM(2, v_smooth=V_SMOOTH),
            plant,
            recordings,
            windows=(1.0,),
            encoder_reference=reference,
        )
        for reference in ("shared", "per_recording")
    )
    truth = torch.tensor(DRY, dtype=F64)
    assert each.converged, each.status
    assert each.residual < 0.05 * once.residual
    torch.testing.assert_close(each.model.schedule.values, truth, rtol=0.01, atol=1e-4)
    assert torch.equal(each.plant.angle_offset, plant.angle_offset)


@pytest.mark.slow
def test_hold_out_block_has_the_encoder_offset_of_its_recording():
    """The encoder offsets follow from the last and the first third of a recording."""
    plant = geared()
    truth, off = CVFM(2, DRY, v_smooth=V_SMOOTH), ([0.06, -0.08], [-0.03, 0.05])
    recordings = [driven(plant, truth, seed) for seed in (0, 1)]
    moved = [replace(r, q=r.q - o) for r, o in zip(recordings, off, strict=True)]
    splits = [blocked_k_fold(plant, r, 3)[1] for r in moved]
    seen = [split.train.recording for split in splits]
    found = fit(
        CVFM(2, v_smooth=V_SMOOTH), plant, seen, windows=(1.0,), encoder_reference="per_recording"
    )
    np.testing.assert_allclose(found.encoder_offsets, off, atol=3e-3)
    blocks = [split.test for split in splits]
    for error, block in zip(block_errors(found, blocks, 0.5), blocks, strict=True):
        assert error < 2e-3
        assert block_errors(replace(found, encoder_offsets=()), [block], 0.5)[0] > 5 * error


@pytest.mark.slow
def test_recordings_starting_at_rest_at_zero_are_taken_as_zeroed_there():
    plant = geared()
    law = CVFM(2, DRY, v_smooth=V_SMOOTH)
    recordings = [driven(plant, law, seed, seconds=2.0) for seed in (0, 1)]
    zeroed = [replace(r, q=r.q - r.q[0]) for r in recordings]
    cases = {
        "zeroed": (zeroed, True),
        "alone": (zeroed[:1], False),
        "off zero": ([zeroed[0], replace(zeroed[1], q=zeroed[1].q + 0.01)], False),
        "in motion": (
            [zeroed[0], replace(r := zeroed[1][len(zeroed[1]) // 2 :], q=r.q - r.q[0])],
            False,
        ),
    }
    for name, (given, each) in cases.items():
        found = fit(CVFM(2, v_smooth=V_SMOOTH), plant, given, windows=(0.5,), max_steps=2)
        assert bool(found.encoder_offsets) == each, name
        assert any("begins at rest" in w for w in found.warnings) == each, name
    further = fit(
        NFCVFM(2, v_smooth=V_SMOOTH), plant, zeroed, windows=(0.5,), max_steps=2,
        start=fit(CVFM(2, v_smooth=V_SMOOTH), plant, zeroed, windows=(0.5,), max_steps=2),
    )  # fmt: skip
    assert len(further.encoder_offsets) == 2
    assert sum("begins at rest" in w for w in further.warnings) == 1
    free = [replace(r, tau=None) for r in zeroed]
    assert not fit(CVFM(2), plant, free, windows=(0.5,), max_steps=1).encoder_offsets


@pytest.mark.slow
def test_initial_velocity_is_zero_if_zeroed_at_rest():
    """A law with too smooth a sign lets the links creep away; a free start would hide it."""
    plant = geared()
    recording = driven(plant, CVFM(2, DRY, v_smooth=V_SMOOTH), 0)
    starts = {}
    for reference in ("shared", "per_recording"):
        found = fit(CVFM(2, v_smooth=0.5), plant, recording, windows=(0.5, 1.0),
                    encoder_reference=reference)  # fmt: skip
        starts[reference] = float(found.residuals[0, 0].abs().max())
    # Within one encoder count of its pose if it is held, and far from it if not.
    assert starts["per_recording"] < 4e-4 < starts["shared"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", [ACVFM, NFCVFM])
def test_motion_dependent_models_use_the_encoder_offsets_of_their_law(kind):
    plant = geared()
    law = CVFM(2, DRY, v_smooth=V_SMOOTH)
    off = ([0.06, -0.08], [-0.03, 0.05])
    recordings = [driven(plant, law, seed, seconds=2.0) for seed in (0, 1)]
    moved = [replace(r, q=r.q - o) for r, o in zip(recordings, off, strict=True)]
    found = fit(
        kind(2, v_smooth=V_SMOOTH), plant, moved, windows=(1.0,), encoder_reference="per_recording"
    )
    np.testing.assert_allclose(found.encoder_offsets, off, atol=2e-3)
    np.testing.assert_allclose(found.to_dict()["encoder_offsets"], found.encoder_offsets)
    assert found.residual < 1e-3
    assert torch.equal(found.plant.angle_offset, plant.angle_offset)
    for recording, motion in zip(moved, found.motions, strict=True):
        assert np.abs(motion.q - recording.joint_coordinates(plant).q).max() < 0.01


@pytest.mark.slow
def test_encoder_offsets_of_other_recordings_are_fitted_again():
    plant = geared()
    law = CVFM(2, DRY, v_smooth=V_SMOOTH)
    recordings = [driven(plant, law, seed, seconds=2.0) for seed in (0, 1)]
    settings = {"windows": (0.5,), "encoder_reference": "per_recording", "max_steps": 2}
    start = fit(CVFM(2, v_smooth=V_SMOOTH), plant, recordings, **settings)
    found = fit(NFCVFM(2, v_smooth=V_SMOOTH), plant, recordings[:1], start=start, **settings)
    assert len(start.encoder_offsets) == 2
    assert len(found.encoder_offsets) == 1
    turned = fit(NFCVFM(2, v_smooth=V_SMOOTH), plant, recordings[::-1], start=start, **settings)
    np.testing.assert_allclose(turned.encoder_offsets[0], start.encoder_offsets[1], atol=1e-2)
    assert not np.allclose(turned.encoder_offsets, start.encoder_offsets, atol=1e-6)


def test_encoder_reference_without_meaning_is_refused():
    plant = geared()
    recording = driven(plant, CVFM(2, DRY, v_smooth=V_SMOOTH), 0, seconds=0.5)
    with pytest.raises(ValueError, match="`encoder_reference` must be one of"):
        fit(CVFM(2), plant, recording, encoder_reference="never")
    with pytest.raises(ValueError, match="needs `method"):
        fit(CVFM(2), plant, recording, encoder_reference="per_recording", method="equation_error")


@pytest.mark.slow
def test_load_dependent_friction_explains_geared_mechanisms_less_well():
    plant = geared()
    recording = driven(plant, CVFM(2, DRY, v_smooth=V_SMOOTH), 0)
    plain, loaded = (
        fit(make(2, v_smooth=V_SMOOTH), plant, recording, fit_plant=False, windows=(0.5,))
        for make in (CVFM, LFM)
    )
    assert plain.residual < 0.1 * loaded.residual


@pytest.mark.slow
def test_informative_recording_overrides_the_prior_of_an_offset():
    plant, offset = pendulum(), 4e-4
    truth = NLFM(2, [[offset, 2e-3, 1e-3, 0.0, 1.0]] * 2, v_smooth=V_SMOOTH)
    recording = swing(plant, truth, seconds=1.5)
    fitted, denied = (fitted_offset(plant, truth, recording, share) for share in (None, 1e-6))
    # A recording counts for many times the prior, unless that is almost certain.
    assert (fitted - offset).abs().max() < 0.05 * offset
    assert denied.abs().max() < 0.05 * offset


def fitted_offset(plant, truth, recording, share):
    """The fitted offset, with a prior within a share of the friction."""
    law = truth.law
    if share is not None:
        expected = tuple(replace(c, prior_scale=share) if c.name == "f_o" else c
                         for c in law.coefficients)  # fmt: skip
        law = replace(law, coefficients=expected)
    model = FrictionModel(law, Constant(law, 2), V_SMOOTH)
    fit(model, plant, recording, fit_plant=False, windows=(1.0,))
    return model.schedule.values[:, 0]


@pytest.mark.slow
@pytest.mark.parametrize("bare", [True, False])
def test_missing_rotor_inertia_is_named_if_it_biases_other_terms(bare):
    truth = geared().replace(armature=torch.tensor([0.03, 0.03], dtype=F64))
    given = geared().replace(armature=(0.0 if bare else 0.9) * truth.armature)
    recording = driven(truth, CVFM(2, DRY, v_smooth=V_SMOOTH), 0)
    found = fit(CVFM(2, v_smooth=V_SMOOTH), given, recording, windows=(0.5,), max_steps=20)
    assert any("has no rotor inertia" in text for text in found.warnings) == bare


@pytest.mark.parametrize("motor", [None, Motor(50), Motor(50, rotor_inertia=1.2e-5)])
def test_rotor_inertia_of_a_wheels_motor_is_added(motor):
    """A `Rotor` adds it to its single inertia."""
    jacobian = SimpleNamespace(plant=Rotor(0.02, motor=motor))
    problem = SimpleNamespace(windows=SimpleNamespace(tau=torch.ones(1)), jacobian=jacobian)
    has_rotor = motor is not None and bool(motor.rotor_inertia)
    assert (rotor_warning(problem, (), ("inertia 11",)) == ()) == has_rotor


@pytest.mark.slow
def test_delay_is_recovered_with_encoders_zeroed_at_rest():
    """At first nothing acts, although torques are logged."""
    plant, law = geared(), CVFM(2, [[0.05, 0.010], [0.03, 0.005]], v_smooth=V_SMOOTH)
    early = [driven(plant, law, seed, seconds=2.0, late=4) for seed in (0, 1)]
    found = fit(CVFM(2, v_smooth=V_SMOOTH), plant, early, windows=(0.5,), fit_delay=True)
    assert found.encoder_offsets
    assert found.torque_delay == pytest.approx(-8e-3, rel=0.1)
    assert found.residual < 1e-3
