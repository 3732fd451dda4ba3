"""Control of the rig: gains, balancing, swing-up, and exported C in the loop."""

import ctypes
import math
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from nfriction import LFM, NFLFM, export, rigs
from nfriction.friction.models import FrictionModel
from nfriction.papers.control import study
from nfriction.papers.control.feedback import (
    Compensation,
    Feedback,
    balance_gains,
    gains_along,
    linearise,
    plan_swing_up,
)
from nfriction.simulation.rollout import rollout

PLANT = rigs.rtip("free")
UPRIGHT = torch.zeros(4, dtype=torch.float64)
LINEAR = linearise(PLANT, UPRIGHT, UPRIGHT, UPRIGHT, 1e-3)
TOP = study.top_gains(PLANT)


def test_linearised_plant_agrees_with_the_plant_near_upright() -> None:
    start = 1e-6 * torch.tensor([1.0, -2.0, 3.0, -1.0], dtype=torch.float64)
    tau = 1e-6 * torch.tensor([[1.0, 0.5, -1.0, 2.0]], dtype=torch.float64)
    run = rollout(PLANT, None, start, 2 * start, tau)
    state = np.concatenate([start, 2 * start])
    after = LINEAR.a @ state + LINEAR.b @ tau[0].numpy()
    # RK4 and the exponential differ by (h lambda)^5, the plant and its linearisation by squares.
    np.testing.assert_allclose(after, np.concatenate([run.q[-1], run.qd[-1]]), atol=1e-14)


def test_upright_rig_is_unstable_and_its_closed_loops_are_stable() -> None:
    joints = np.hstack([np.eye(4), np.zeros((4, 4))])
    assert np.abs(np.linalg.eigvals(LINEAR.a)).max() > 1.003
    assert np.abs(np.linalg.eigvals(LINEAR.a - np.outer(LINEAR.b[:, 0], TOP.feedback))).max() < 1.0
    kept = np.eye(8) - TOP.observer @ joints
    assert np.abs(np.linalg.eigvals(kept @ LINEAR.a)).max() < 1.0


def test_a_pose_that_is_no_equilibrium_is_refused() -> None:
    leaning = linearise(PLANT, UPRIGHT + 0.1, UPRIGHT, UPRIGHT, 1e-3)
    with pytest.raises(ValueError, match="not in equilibrium"):
        balance_gains(leaning, study.weights(4))


def test_true_friction_is_passive() -> None:
    friction = study.true_friction(PLANT)
    qd = torch.linspace(-6, 6, 241, dtype=torch.float64)[:, None].expand(-1, 4)
    load = torch.rand_like(qd)
    assert (qd * friction.torque(qd, load, friction.coefficients(qd, qd)) >= 0).all()


@pytest.mark.slow
def test_three_links_stay_upright() -> None:
    runs = study.controlled(
        PLANT, study.true_friction(PLANT), {study.NONE: Feedback(PLANT, TOP)}, seconds=2.0
    )
    found = study.performance(runs[study.NONE], follow=False, settled=1.0)
    assert found["largest tilt [mrad]"] < 200


@pytest.mark.slow
def test_compensation_reduces_the_limit_cycle_of_a_balanced_link() -> None:
    plant = study.single_link()
    friction = study.true_friction(plant)
    given = {study.NONE: None, study.TRUTH: study.compensation_of(friction)}
    top = study.top_gains(plant)
    controllers = {n: Feedback(plant, top, compensation=one) for n, one in given.items()}
    runs = study.controlled(plant, friction, controllers, seconds=12.0)
    found = {n: study.performance(run, follow=False, settled=4.0) for n, run in runs.items()}
    key = "limit cycle [mrad]"
    assert found[study.TRUTH][key] < 0.6 * found[study.NONE][key]


def test_a_fallen_rig_has_no_tracking_error() -> None:
    friction = study.true_friction(PLANT)
    controllers = {study.NONE: Feedback(PLANT, TOP)}
    runs = study.controlled(PLANT, friction, controllers, seconds=0.5)
    run = runs[study.NONE]
    run.q[-1, 1] = 2.0
    assert set(study.performance(run, follow=False, settled=0.1).values()) == {math.inf}


def test_gains_along_a_motion_at_upright_converge_to_those_at_upright() -> None:
    way = linearise(PLANT, *[UPRIGHT[None]] * 3, 1e-3)[np.zeros(3000, dtype=int)]
    found = gains_along(way, np.zeros(3000), LINEAR, study.weights(4))
    np.testing.assert_allclose(found[0].feedback, TOP.feedback, rtol=1e-6)
    np.testing.assert_allclose(found[-1].observer, TOP.observer, rtol=1e-3, atol=1e-6)


def test_a_swing_up_without_time_is_refused() -> None:
    with pytest.raises(ValueError, match="no swing-up within"):
        plan_swing_up(PLANT, None, seconds=0.5, windows=5, max_steps=5)


@pytest.mark.slow
def test_three_links_swing_up_and_stay() -> None:
    """The plan uses approximate friction of the links; the arm's is compensated by a true model."""
    friction = study.true_friction(PLANT)
    guess = LFM(4, [0.01, 0.002]).requires_grad_(False)
    way = study.way_up(PLANT, guess)
    controller = Feedback(PLANT, TOP, way, compensation=study.compensation_of(friction))
    (run,) = study.controlled(PLANT, friction, {"": controller}, seconds=2.0).values()
    assert float(run.q[0, 1]) == math.pi
    upright = run.q[run.time > 6.0, 1:].cumsum(-1).abs()
    assert upright.max() < 0.2
    assert run.tau.abs().max() <= study.ELECTRONICS.torque_limit


def compiled(model: FrictionModel, folder: Path) -> Compensation:
    """The friction torque of a model by its exported C."""
    export.c(model, folder)
    library = folder / "friction.so"
    subprocess.run(
        ["cc", "-O2", "-shared", "-fPIC", "-ffp-contract=off", str(folder / "nfriction.c"),
         "-o", str(library), "-lm"], check=True,
    )  # fmt: skip
    step = ctypes.CDLL(str(library)).nfriction_step
    number = ctypes.POINTER(ctypes.c_double)

    def torque(qd: np.ndarray, qdd: np.ndarray, load: np.ndarray) -> np.ndarray:
        rows = []
        for row in zip(qd.reshape(-1, 4), qdd.reshape(-1, 4), load.reshape(-1, 4), strict=True):
            given = [np.ascontiguousarray(x, dtype=np.float64) for x in row]
            out, coefficients = np.zeros(4), np.zeros(4 * len(model.law.names))
            status = (ctypes.c_int * 4)()
            step(*(x.ctypes.data_as(number) for x in (*given, out, coefficients)), status)
            rows.append(out)
        return np.stack(rows).reshape(qd.shape)

    return torque


@pytest.mark.skipif(not shutil.which("cc"), reason="needs a C compiler")
@pytest.mark.parametrize("kind", [LFM, NFLFM])
def test_exported_c_in_the_loop_gives_the_same_motion(kind: type, tmp_path: Path) -> None:
    model = kind(4, [0.05, 0.17]).requires_grad_(False)
    friction = study.true_friction(PLANT)
    given = {"torch": study.compensation_of(model), "C": compiled(model, tmp_path), "none": None}
    controllers = {
        n: Feedback(PLANT, TOP, reference=study.reference, compensation=one)
        for n, one in given.items()
    }
    runs = study.controlled(PLANT, friction, controllers, seconds=0.4)
    # Torques pass a 16-bit converter, which removes last-bit differences of exp.
    assert torch.equal(runs["torch"].tau, runs["C"].tau)
    assert torch.equal(runs["torch"].q, runs["C"].q)
    assert not torch.equal(runs["none"].q, runs["C"].q)
