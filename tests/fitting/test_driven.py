"""Geared mechanisms that torques drive, read at irregular times, and what a law expects of them."""

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
    """A double pendulum as heavy, and with rotors as large, as quasi-direct drives have."""
    return PendulumChain(
        [0.5, 0.6], [0.2, 0.3], inertia=[8e-3, 9e-3], armature=[3e-3, 3e-3],
        convention=("relative", "hanging"),
    )  # fmt: skip


def driven(
    plant: PendulumChain, model: FrictionModel, seed: int, seconds: float = 3.0, late: int = 0
) -> Recording:
    """Sums of sines in torque from rest, stamped as a host's clock does: late now and then.

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
def test_friction_and_masses_of_a_driven_mechanism_are_recovered_from_irregular_stamps():
    plant = geared()
    recordings = [driven(plant, CVFM(2, DRY, v_smooth=V_SMOOTH), seed) for seed in (0, 1)]
    given = plant.replace(armature=plant.armature * 0.9, gravity_moment=1.05 * plant.gravity_moment)
    found = fit(CVFM(2, v_smooth=V_SMOOTH), given, recordings, windows=(1.0,))
    assert found.converged, found.status
    truth = torch.tensor(DRY, dtype=F64)
    # An encoder of 16384 counts leaves some thousandths open.
    torch.testing.assert_close(found.model.schedule.values, truth, rtol=0.01, atol=1e-4)
    # The first rotor turns with the first link, so only their sum can be told.
    pose = torch.tensor([[0.0, 0.0], [1.0, 2.0]], dtype=F64)
    for term in ("mass_matrix", "gravity"):
        torch.testing.assert_close(
            getattr(found.plant, term)(pose), getattr(plant, term)(pose), rtol=0.01, atol=1e-3
        )


def test_a_drive_that_gives_less_torque_than_it_reports_is_found():
    plant = geared()
    truth = plant.replace(torque_gain=torch.tensor([1.0, 0.85], dtype=F64))
    law = CVFM(2, DRY, v_smooth=V_SMOOTH)
    recordings = [driven(truth, law, seed) for seed in (0, 1)]
    found = fit(CVFM(2, v_smooth=V_SMOOTH), plant, recordings, windows=(1.0,))
    assert found.converged, found.status
    (gain,) = (i for i in found.intervals if i.name == "torque gain 2")
    assert gain.low < -0.15 < gain.high
    assert gain.high - gain.low < 0.02
    # Friction is told in the torques that the drive reports.
    torch.testing.assert_close(
        found.model.schedule.values, law.schedule.values, rtol=0.02, atol=2e-4
    )


def test_friction_that_is_larger_one_way_is_named_as_a_constant_torque():
    plant, one_way = geared(), [[0.0, 0.2, 0.01, 0.0, 1.0], [0.03, 0.15, 0.005, 0.0, 1.0]]
    recordings = [driven(plant, NLFM(2, one_way, v_smooth=V_SMOOTH), seed) for seed in (0, 1)]
    found = fit(CVFM(2, v_smooth=V_SMOOTH), plant, recordings, windows=(1.0,))
    (warning,) = (w for w in found.warnings if "constant drive torque" in w)
    assert "-0.03 N m at joint2" in warning
    assert "0.06 N m larger forwards" in warning
    assert "add 0.03 N m to a command" in warning


def test_what_gears_lose_is_told_from_dry_friction():
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
def test_encoders_zeroed_anew_at_the_start_of_each_recording():
    """Only the truth's zeros differ; a plant with one offset for all cannot follow."""
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


def test_a_block_left_out_has_the_zero_of_its_recording():
    """Two thirds of a recording, the last and the first, tell where its encoders read zero."""
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
def test_recordings_that_all_begin_at_rest_at_zero_are_taken_for_zeroed_there():
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
def test_zeroed_at_rest_no_velocity_makes_up_for_friction_at_the_start():
    """A law with too smooth a sign lets the links creep away; a free start would hide it."""
    plant = geared()
    recording = driven(plant, CVFM(2, DRY, v_smooth=V_SMOOTH), 0)
    starts = {}
    for reference in ("shared", "per_recording"):
        found = fit(CVFM(2, v_smooth=0.5), plant, recording, windows=(0.5, 1.0),
                    encoder_reference=reference)  # fmt: skip
        starts[reference] = float(found.residuals[0, 0].abs().max())
    # Within a step of the encoder where it is held, and far from it where it is not.
    assert starts["per_recording"] < 4e-4 < starts["shared"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", [ACVFM, NFCVFM])
def test_models_that_follow_the_motion_take_the_zeros_of_their_constant_law(kind):
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
def test_a_start_with_the_zeros_of_other_recordings_is_fitted_anew():
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


def test_zeroed_is_refused_where_it_means_nothing():
    plant = geared()
    recording = driven(plant, CVFM(2, DRY, v_smooth=V_SMOOTH), 0, seconds=0.5)
    with pytest.raises(ValueError, match="`encoder_reference` must be one of"):
        fit(CVFM(2), plant, recording, encoder_reference="never")
    with pytest.raises(ValueError, match="needs `method"):
        fit(CVFM(2), plant, recording, encoder_reference="per_recording", method="equation_error")


@pytest.mark.slow
def test_load_dependent_friction_leaves_more_of_a_geared_mechanism_unexplained():
    plant = geared()
    recording = driven(plant, CVFM(2, DRY, v_smooth=V_SMOOTH), 0)
    plain, loaded = (
        fit(make(2, v_smooth=V_SMOOTH), plant, recording, fit_plant=False, windows=(0.5,))
        for make in (CVFM, LFM)
    )
    assert plain.residual < 0.1 * loaded.residual


@pytest.mark.slow
def test_an_offset_that_the_law_does_not_expect_is_found_where_the_recording_tells_it():
    plant, offset = pendulum(), 4e-4
    truth = NLFM(2, [[offset, 2e-3, 1e-3, 0.0, 1.0]] * 2, v_smooth=V_SMOOTH)
    recording = swing(plant, truth, seconds=1.5)
    fitted, denied = (fitted_offset(plant, truth, recording, share) for share in (None, 1e-6))
    # A recording counts for many times what the law expects, unless that is next to certainty.
    assert (fitted - offset).abs().max() < 0.05 * offset
    assert denied.abs().max() < 0.05 * offset


def fitted_offset(plant, truth, recording, share):
    """The offset of a fit, expected to be within a share of the friction."""
    law = truth.law
    if share is not None:
        expected = tuple(replace(c, prior_scale=share) if c.name == "f_o" else c
                         for c in law.coefficients)  # fmt: skip
        law = replace(law, coefficients=expected)
    model = FrictionModel(law, Constant(law, 2), V_SMOOTH)
    fit(model, plant, recording, fit_plant=False, windows=(1.0,))
    return model.schedule.values[:, 0]


@pytest.mark.parametrize("bare", [True, False])
def test_a_rotor_inertia_that_the_rig_lacks_is_named_where_it_bends_other_terms(bare):
    truth = geared().replace(armature=torch.tensor([0.03, 0.03], dtype=F64))
    given = geared().replace(armature=(0.0 if bare else 0.9) * truth.armature)
    recording = driven(truth, CVFM(2, DRY, v_smooth=V_SMOOTH), 0)
    found = fit(CVFM(2, v_smooth=V_SMOOTH), given, recording, windows=(0.5,), max_steps=20)
    assert any("has no rotor inertia" in text for text in found.warnings) == bare


@pytest.mark.parametrize("motor", [None, Motor(50), Motor(50, rotor_inertia=1.2e-5)])
def test_the_rotor_of_a_wheels_motor_counts_as_one(motor):
    """A `Rotor` adds it to its single inertia."""
    jacobian = SimpleNamespace(plant=Rotor(0.02, motor=motor))
    problem = SimpleNamespace(windows=SimpleNamespace(tau=torch.ones(1)), jacobian=jacobian)
    has_rotor = motor is not None and bool(motor.rotor_inertia)
    assert (rotor_warning(problem, (), ("inertia 11",)) == ()) == has_rotor


def test_a_delay_is_found_where_encoders_were_zeroed_at_rest():
    """At first nothing acts, although torques are logged."""
    plant, law = geared(), CVFM(2, [[0.05, 0.010], [0.03, 0.005]], v_smooth=V_SMOOTH)
    early = [driven(plant, law, seed, seconds=2.0, late=4) for seed in (0, 1)]
    found = fit(CVFM(2, v_smooth=V_SMOOTH), plant, early, windows=(0.5,), fit_delay=True)
    assert found.encoder_offsets
    assert found.torque_delay == pytest.approx(-8e-3, rel=0.1)
    assert found.residual < 1e-3
