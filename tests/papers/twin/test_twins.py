"""The twins match their data cards: valid physics, a realistic encoder, reproducible bytes."""

import math
import re
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.integrate import trapezoid

from nfriction import Recording, rigs, rollout
from nfriction.papers import twin
from nfriction.papers.twin.dataset import Encoder, specification
from nfriction.papers.twin.mechanics import HiddenFriction, Links, simulate
from nfriction.recording import read_initial_states
from nfriction.signals import quantise

DATASETS = Path(__file__).resolve().parents[3] / "datasets"
QUANTUM = math.tau / 8192
SWING = (2.5, -0.7, 1.1)


@pytest.fixture(scope="module")
def second() -> twin.Twin:
    return twin.make("tlrip", duration=1.0)


def truth_of(name: str) -> tuple[Links, HiddenFriction]:
    specified = specification(name)
    return Links.of(specified.rig()), specified.friction


# The truth: mechanics, friction


def test_frictionless_motion_equals_the_librarys_rollout() -> None:
    plant = rigs.tlrip()
    own = simulate(Links.of(plant), None, SWING, (1.0, -2.0, 3.0), samples=1001)
    start = torch.tensor(SWING, dtype=torch.float64), torch.tensor([1.0, -2.0, 3.0]).double()
    run = rollout(plant, None, *start, steps=1000, substeps=2, gradients=False)
    # Two implementations of the same steps differ only by rounding.
    np.testing.assert_allclose(own.q, run.q, atol=1e-11)
    np.testing.assert_allclose(own.qd, run.qd, atol=1e-10)


@pytest.mark.parametrize("name", twin.names())
def test_motion_with_friction_satisfies_the_equation_of_motion(name: str) -> None:
    links, friction = truth_of(name)
    motion = simulate(links, friction, SWING, samples=400)
    q, qd, qdd = (torch.from_numpy(x) for x in (motion.q, motion.qd, motion.qdd))
    needed = specification(name).rig().inverse_dynamics(q, qd, qdd)
    np.testing.assert_allclose(needed.numpy(), -motion.tau_f, atol=1e-12)


def test_integrator_has_order_four() -> None:
    links = Links.of(rigs.tlrip())
    ends = [
        simulate(links, None, SWING, samples=51, rate=100, substeps=s).q[-1] for s in (1, 2, 4, 32)
    ]
    errors = [np.abs(end - ends[-1]).max() for end in ends[:-1]]
    slopes = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all((slopes > 3.7) & (slopes < 4.5)), slopes


def test_energy_is_conserved_without_and_dissipated_with_friction() -> None:
    plant = rigs.tlrip()
    links, friction = truth_of("tlrip")

    def energy(q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        kinetic, potential = plant.energy(torch.from_numpy(q), torch.from_numpy(qd))
        return (kinetic + potential).numpy()

    free = simulate(links, None, SWING, samples=1000)
    assert np.ptp(energy(free.q, free.qd)) < 1e-9
    motion = simulate(links, friction, SWING, samples=1000)
    left = energy(motion.q, motion.qd)
    power = np.sum(motion.qd * motion.tau_f, axis=1)
    assert np.all(motion.qd * motion.tau_f >= 0)
    assert np.all(np.diff(left) <= 0)
    # The trapezoidal rule over a few reversals of dry friction is accurate to a part in a thousand.
    assert left[0] - left[-1] == pytest.approx(trapezoid(power, dx=1e-3), rel=1e-3)


def test_bearings_carry_the_links_weight_and_inertia() -> None:
    rig = rigs.tlrip().to_dict()
    arm = 1e-9  # so light a friction only shows the force
    probe = HiddenFriction(
        seal=(0.0, 0.0, 0.0), bearing_arm=(arm,) * 3, stribeck_rise=(0.0,) * 3,
        stribeck_velocity=(1.0,) * 3, asymmetry=(0.0,) * 3, viscous=(0.0,) * 3,
        shear_velocity=(1.0,) * 3,
    )  # fmt: skip
    motion = simulate(Links.of(rigs.tlrip()), probe, SWING, (2.0, -3.0, 4.0), samples=300)
    angle = np.cumsum(motion.q, axis=1)
    along = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    hinge = np.cumsum(np.array(rig["length"])[:, None] * along, axis=1)
    hinge = np.concatenate([np.zeros_like(hinge[:, :1]), hinge[:, :-1]], axis=1)
    centre = hinge + np.array(rig["com"])[:, None] * along
    acceleration = np.diff(centre, n=2, axis=0) / 1e-3**2 + [0.0, rig["gravity"]]
    force = np.array(rig["mass"])[:, None] * acceleration
    carried = np.linalg.norm(np.cumsum(force[:, ::-1], axis=1)[:, ::-1], axis=-1)
    sign = np.tanh(motion.qd / probe.v_smooth)[1:-1]
    # Second differences at 1 ms have errors of about 1e-5 of the acceleration.
    np.testing.assert_allclose(motion.tau_f[1:-1] / arm, carried * sign, rtol=1e-3, atol=1e-2)


def test_friction_has_the_effects_of_its_data_card() -> None:
    _, friction = truth_of("tlrip")
    torque = friction.joint(0)
    dry = replace(friction, viscous=(0.0,) * 3).joint(0)
    assert dry(0.02, 18.0, 1.0) > 1.5 * dry(1.0, 18.0, 1.0)  # Stribeck
    assert torque(1.0, 30.0, 1.0) > torque(1.0, 18.0, 1.0)  # load
    assert torque(1.0, 18.0, 1.0) > -torque(-1.0, 18.0, 1.0)  # direction
    thin = replace(friction, seal=(0.0,) * 3, bearing_arm=(0.0,) * 3).joint(0)
    assert thin(16.0, 18.0, 1.0) < 0.75 * 16.0 * thin(1.0, 18.0, 1.0)  # shear thinning
    assert friction.viscosity(0.0) == 1.0
    assert friction.viscosity(40.0) == pytest.approx(0.85, abs=0.005)  # warming


def test_a_rig_of_another_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="three links on a fixed pivot"):
        Links.of(rigs.tlrip(arm="free"))


# The encoder


def test_ideal_encoder_rounds_to_counts() -> None:
    q = np.linspace(-7.0, 7.0, 5003)
    np.testing.assert_allclose(Encoder().read(q), quantise(q, 8192), atol=1e-12)


def test_imperfect_encoder_is_monotone_and_periodic() -> None:
    encoder = Encoder.drawn(np.random.default_rng(3))
    q = np.arange(-0.3, 0.3, QUANTUM / 50)
    read = encoder.read(q)
    assert set(np.rint(np.diff(read) / QUANTUM).tolist()) == {0.0, 1.0}
    np.testing.assert_allclose(encoder.read(q + math.tau) - read, math.tau, atol=1e-9)
    widths = np.diff(np.flatnonzero(np.diff(read)))
    assert np.ptp(widths) > 1  # counts of unequal width: misplaced edges


@pytest.mark.parametrize("name", twin.names())
def test_recordings_are_integer_counts_near_the_true_motion(name: str) -> None:
    made = twin.make(name, duration=0.5)
    for label, recording in made.recordings.items():
        counts = recording.q / QUANTUM
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
        error = recording.joint_coordinates().q - made.truth[label].q
        # Half a count, 0.3 of eccentricity, four deviations of an edge; 15 µs at 12 rad/s.
        assert np.abs(error).max() < 1.0 * QUANTUM + 15e-6 * 12
        assert np.abs(error).max() > 0.4 * QUANTUM


# The data set


def test_release_starts_at_its_stated_pose(second: twin.Twin) -> None:
    for label, (q0, qd0) in second.initial_states.items():
        np.testing.assert_allclose(second.truth[label].q[0], q0, atol=1e-12)
        np.testing.assert_allclose(second.truth[label].qd[0], qd0, atol=1e-12)
        assert np.ptp(second.recordings[label].q, axis=0).min() > 10 * QUANTUM


def test_both_parts_have_a_hanging_and_an_upright_release(second: twin.Twin) -> None:
    for split in ("train", "test"):
        heights = [math.cos(second.initial_states[r.name][0][0]) for r in second.part(split)]
        assert min(heights) < 0 < max(heights)


def test_a_shorter_twin_is_the_beginning_of_a_longer_one(second: twin.Twin) -> None:
    short = twin.make("tlrip", duration=0.2)
    for label, recording in short.recordings.items():
        assert recording.digest() == second.recordings[label][:200].digest()


def test_seed_is_reproducible_to_the_byte(tmp_path: Path) -> None:
    for folder, seed in (("a", 5), ("b", 5), ("c", 6)):
        twin.build("rtip", tmp_path / folder, seed=seed, duration=0.1)
    first, again, other = (
        {p.name: p.read_bytes() for p in (tmp_path / folder).iterdir()} for folder in "abc"
    )
    assert first == again
    assert first["train_bent.csv.gz"] != other["train_bent.csv.gz"]
    assert first["truth.npz"] == other["truth.npz"]  # the seed affects only the sensor


def test_file_round_trip_is_exact(tmp_path: Path) -> None:
    made = twin.build("tlrip", tmp_path, duration=0.1)
    table = pd.read_csv(tmp_path / "recordings.csv")
    states = read_initial_states(tmp_path / "recordings.csv")
    assert set(table.id) == set(made.recordings) == set(states)
    for row in table.itertuples():
        recording = Recording.read(tmp_path / str(row.file))
        assert recording.digest() == row.digest == made.recordings[str(row.id)].digest()
        assert len(recording) == row.n
        np.testing.assert_array_equal(states[str(row.id)], made.initial_states[str(row.id)])
    assert rigs.read(tmp_path / "rig.json").to_dict() == made.plant.to_dict()
    with np.load(tmp_path / "truth.npz", allow_pickle=False) as truth:
        np.testing.assert_array_equal(truth["test_hanging_tau_f"], made.truth["test_hanging"].tau_f)


def test_invalid_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="no twin 'acrobot'; there are tlrip, rtip"):
        twin.make("acrobot")
    with pytest.raises(ValueError, match="`duration` must be at least"):
        twin.make("tlrip", duration=0.002)


# The full length, as the cards describe it


@pytest.mark.slow
@pytest.mark.parametrize("name", twin.names())
def test_full_twin_comes_to_rest_and_matches_its_data_card(name: str) -> None:
    card = (DATASETS / f"{name}_twin" / "README.md").read_text(encoding="utf-8")
    made = twin.make(name)
    for label, recording in made.recordings.items():
        assert np.ptp(recording.q[-1000:], axis=0).max() <= QUANTUM * 1.001, label
        assert recording.digest() in card, label


@pytest.mark.slow
@pytest.mark.parametrize("name", twin.names())
def test_test_motions_are_predictable(name: str) -> None:
    links, friction = truth_of(name)
    made = twin.make(name, duration=15.0)
    for label in (r.name for r in made.part("test")):
        truth = made.truth[label]
        q0 = truth.q[0] + QUANTUM * np.eye(3)[2]
        shifted = simulate(links, friction, tuple(q0), tuple(truth.qd[0]), samples=15_000)
        assert np.abs(shifted.q - truth.q).max() < 0.05, label


def build_script(*words: object) -> int:
    """Run `datasets/build.py` with these arguments."""
    main = runpy.run_path(str(DATASETS / "build.py"))["main"]
    return int(main([*map(str, words)]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["experiment_twin", "rtip_twin", "tlrip_controller"])
def test_builder_script_writes_twins(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert build_script(name, "--out", tmp_path, "--quick") == 0
    printed, files = capsys.readouterr().out, sorted(tmp_path.glob("*.csv.gz"))
    assert re.findall(r"10000 samples", printed) == ["10000 samples"] * len(files)
    assert len(files) == {"experiment_twin": 1, "rtip_twin": 4, "tlrip_controller": 3}[name]


@pytest.mark.parametrize("name", ["experiment_twin", "rtip_twin", "tlrip_controller"])
def test_builder_script_refuses_invalid_outputs_and_seeds(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "train_upright.csv.gz").write_bytes(b"of the twin of the TLRIP")
    file = tmp_path / "train_upright.csv.gz"
    for words, fault in (
        (["--out", tmp_path], "of this data set, .* with train_upright.csv.gz of another; choose"),
        (["--out", file], "is a file; choose another folder"),
        (["--out", file / "folder"], "is a file; choose another folder"),
        (["--seed", "-1"], "--seed: must be a whole number from 0, got '-1'"),
    ):
        with pytest.raises(SystemExit):
            build_script(name, "--quick", *words)
        assert re.search(fault, capsys.readouterr().err)
    assert [*tmp_path.iterdir()] == [file]
