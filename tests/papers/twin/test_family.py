"""Random twins: valid physics of every truth, meaningful releases, reproducibility."""

import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import cumulative_trapezoid

from nfriction import Comparison, Recording, cli, rigs
from nfriction.evaluation.score import RMSE, Score
from nfriction.papers import twin
from nfriction.papers.twin import family
from nfriction.papers.twin.mechanics import Links, TrueMotion
from nfriction.recording import read_initial_states

POSES = [(60.0, 20.0, -30.0), (250.0, 40.0, 10.0)]
TOGETHER = "+".join(family.TRUTHS)
EVERY = [family.PLAIN, *family.TRUTHS, TOGETHER]


def motions(truth: str, samples: int, **settings: float) -> list[TrueMotion]:
    motion = family._Motion(Links.of(rigs.tlrip()), family.parameters(truth, 3))
    return motion.simulate(POSES, samples, **settings)[0]  # type: ignore[arg-type]


@pytest.fixture(scope="module", params=EVERY)
def one_second(request: pytest.FixtureRequest) -> tuple[str, list[TrueMotion]]:
    return request.param, motions(request.param, 1000)


@pytest.fixture(scope="module")
def plain() -> list[TrueMotion]:
    return motions(family.PLAIN, 1000)


@pytest.fixture(scope="module")
def drawn() -> twin.Twin:
    return twin.draw("shear+ripple", seed=1, duration=0.5)


# The physics


def test_motion_satisfies_the_equation_of_motion(one_second: tuple[str, list[TrueMotion]]) -> None:
    for motion in one_second[1]:
        q, qd, qdd = (torch.from_numpy(x) for x in (motion.q, motion.qd, motion.qdd))
        needed = rigs.tlrip().inverse_dynamics(q, qd, qdd)
        np.testing.assert_allclose(needed.numpy(), -motion.tau_f, atol=1e-10)


def test_friction_is_passive(one_second: tuple[str, list[TrueMotion]]) -> None:
    truth, found = one_second
    for motion in found:
        power = motion.qd * motion.tau_f
        # Bristles at rest cannot return energy that was not put in.
        work = cumulative_trapezoid(power, dx=1e-3, axis=0)
        assert work.min() > -1e-6
        if "bristle" in truth:
            assert power.min() < 0  # they do return some
            continue
        assert power.min() >= 0
        kinetic, potential = rigs.tlrip().energy(*map(torch.from_numpy, (motion.q, motion.qd)))
        assert np.diff((kinetic + potential).numpy()).max() <= 1e-9


def test_every_effect_changes_the_motion(
    one_second: tuple[str, list[TrueMotion]], plain: list[TrueMotion]
) -> None:
    truth, found = one_second
    apart = max(np.abs(a.q - b.q).max() for a, b in zip(found, plain, strict=True))
    assert (apart > 10 * family.COUNT) == (truth != family.PLAIN)


@pytest.mark.slow
def test_steps_are_short_enough() -> None:
    coarse_and_fine = motions(TOGETHER, 500), motions(TOGETHER, 2000, step=2.5e-4)
    for coarse, fine in zip(*coarse_and_fine, strict=True):
        assert np.abs(coarse.q - fine.q[::4]).max() < 0.1 * family.COUNT


def test_bearings_carry_the_links_weight_and_inertia() -> None:
    rig = rigs.tlrip().to_dict()
    (motion, _) = motions(family.PLAIN, 400)
    angle, rate, acceleration = (np.cumsum(x, axis=1) for x in (motion.q, motion.qd, motion.qdd))
    along = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    hinge = np.cumsum(np.array(rig["length"])[:, None] * along, axis=1)
    hinge = np.concatenate([np.zeros_like(hinge[:, :1]), hinge[:, :-1]], axis=1)
    centre = hinge + np.array(rig["com"])[:, None] * along
    lifted = np.diff(centre, n=2, axis=0) / 1e-3**2 + [0.0, rig["gravity"]]
    force = np.array(rig["mass"])[:, None] * lifted
    carried = np.linalg.norm(np.cumsum(force[:, ::-1], axis=1)[:, ::-1], axis=-1)
    made = family._Motion(Links.of(rigs.tlrip()), {})
    own = made.reaction(np.exp(1j * angle.T), rate.T, acceleration.T).T
    np.testing.assert_allclose(own[1:-1], carried, rtol=1e-3, atol=1e-2)
    hanging = made.reaction(np.exp(1j * np.pi * np.ones((3, 1))), *np.zeros((2, 3, 1)))
    np.testing.assert_allclose(hanging, made.at_rest)


# Random choices of a seed


def test_an_effect_is_the_same_in_every_truth_of_a_seed() -> None:
    one, two = family.parameters("warming", 4), family.parameters("load+warming", 4)
    other = family.parameters("warming", 5)
    for name, parameter in family.PARAMETERS.items():
        if parameter.effect in ("", "warming"):
            np.testing.assert_array_equal(one[name], two[name])
            assert not np.array_equal(one[name], other[name])
    assert not one["share"].any()
    assert two["share"].all()


def test_releases_are_many_and_differ_by_seed(drawn: twin.Twin) -> None:
    train, test = drawn.part("train"), drawn.part("test")
    assert len(train) == 2
    assert len(test) >= 10
    other = twin.draw("shear+ripple", seed=2, duration=0.5)
    for label, (q0, qd0) in drawn.initial_states.items():
        np.testing.assert_allclose(drawn.truth[label].q[0], q0, atol=1e-12)
        assert not qd0.any()
        assert np.abs(q0 - other.initial_states[label][0]).max() > 0.01


def test_encoders_quantise_to_counts(drawn: twin.Twin) -> None:
    for label, recording in drawn.recordings.items():
        counts = recording.q / family.COUNT
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
        assert np.abs(recording.q - drawn.truth[label].q).max() < 1.5 * family.COUNT


@pytest.mark.slow
def test_scored_releases_are_predictable() -> None:
    made = twin.draw("direction", seed=0, duration=2.0)
    motion = family._Motion(Links.of(made.plant), family.parameters("direction", 0))
    starts = np.degrees([made.initial_states[r.name][0] for r in made.part("test")])
    _, growth = motion.simulate([tuple(row) for row in starts.tolist()], 2000)
    assert growth.max() <= family.PREDICTABLE * family.COUNT


def test_invalid_arguments_are_refused() -> None:
    for truth in ("glue", "load+load", "plain+load", ""):
        with pytest.raises(ValueError, match="a truth is plain or different ones of load, dir"):
            twin.draw(truth)
    for duration in (0.002, 1e9):
        with pytest.raises(ValueError, match=r"`duration` must be at least .*, at most 1000"):
            twin.draw("load", duration=duration)


# Files and results


def test_command_writes_files_that_compare_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], drawn: twin.Twin
) -> None:
    words = ["twin", "--truth", "shear+ripple", "--seed", "1", "--seconds", "0.5"]
    assert cli.main([*words, "--out", str(tmp_path)]) == 0
    assert {p.name for p in tmp_path.glob("*.csv.gz")} == {f"{x}.csv.gz" for x in drawn.truth}
    for label, recording in drawn.recordings.items():
        assert Recording.read(tmp_path / f"{label}.csv.gz").digest() == recording.digest()
    assert set(read_initial_states(tmp_path / "recordings.csv")) == set(drawn.truth)
    card = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert shlex.join(["nfriction", *words]) in card
    assert f"{family.parameters('shear+ripple', 1)['ripple'][0, 0]:.4g}" in card
    assert "| share |" not in card
    advice = shlex.split(capsys.readouterr().out.rpartition("next: nfriction ")[2])
    globbed = [
        str(p) for w in advice for p in (sorted(tmp_path.glob(Path(w).name)) if "*" in w else [w])
    ]
    arguments = cli.make_parser().parse_args(globbed)
    assert (len(arguments.train), len(arguments.test)) == (2, 10)
    assert cli.main(["twin", "--truth", "glue", "--out", str(tmp_path)]) == 2
    assert "a truth is plain or" in capsys.readouterr().err


def test_hold_out_errors_are_pooled_and_have_a_median() -> None:
    def score(name: str, error: float) -> Score:
        rmse = RMSE((error,), error)
        return Score(rmse, {}, None, name, np.arange(3.0), np.zeros((3, 1)), np.inf)

    scores = {"LFM": [score(str(k), error) for k, error in enumerate((3.0, 1.0, 50.0))]}
    table = family.held_out(Comparison({}, {}, scores, "rad", ("joint1",)))
    assert table["median"].loc["LFM", "joint1"] == 3.0
    assert table["pooled"].loc["LFM", "all"] == pytest.approx(np.sqrt((9 + 1 + 2500) / 3))
