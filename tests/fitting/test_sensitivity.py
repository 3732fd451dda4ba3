"""Derivatives of one integration step: compiled, eager and torch's own agree."""

import pytest
import torch

from nfriction import LFM, LinearAxis
from nfriction.codegen import CodegenError
from nfriction.fitting.adjusted_plant import adjusted_buffers
from nfriction.fitting.plant_parameters import plant_parameters
from nfriction.fitting.shooting.sensitivity import CHUNK, StepJacobian, Trajectory, propagate
from nfriction.friction import model_by_name
from nfriction.simulation.memory_step import memory_step
from nfriction.simulation.protocols import RolloutInputs
from nfriction.simulation.rk4 import rk4_step
from nfriction.simulation.rollout import integrate
from tests.fitting.recordings import F64, pendulum


def samples(joints, k, parameters, count=5, seed=0, memory=0):
    g = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=g, dtype=F64)

    states = 2 * draw(count, joints), 3 * draw(count, joints), 1e-3 * draw(count, memory)
    return (
        torch.cat(states, -1), 0.01 * draw(count, joints, k).abs() + 0.1,
        0.1 * draw(count, joints), 1e-3 * (1 + draw(count, 1).abs()), 0.05 * draw(parameters),
    )  # fmt: skip


def without_compiler(monkeypatch, plant, model, terms):
    def nothing(*_, **__):
        raise CodegenError("none")

    with monkeypatch.context() as patch:
        patch.setattr("nfriction.codegen.CompiledFunction", nothing)
        return StepJacobian(plant, model, terms)


CASES = {
    "pendulum": (pendulum(), {"driven": (0, 1), "largest_torque": 1.0}),
    "drag": (pendulum(), {"driven": (), "drag": True}),
    "armature": (pendulum(armature=[1e-4, 2e-4]), {"driven": ()}),
    "axis": (LinearAxis(2.0), {"driven": (0,), "largest_torque": 1.0}),
}


@pytest.mark.parametrize(
    ("case", "law"),
    [
        ("pendulum", "LFM"),
        ("axis", "Stribeck"),
        ("axis", "LuGre"),
        pytest.param("pendulum", "MaxwellSlip", marks=pytest.mark.slow),
        pytest.param("drag", "Stribeck", marks=pytest.mark.slow),
        pytest.param("armature", "NLFM", marks=pytest.mark.slow),
    ],
)
def test_compiled_and_eager_and_autograd_agree(case, law, monkeypatch, caplog):
    plant, settings = CASES[case]
    terms = plant_parameters(plant, **settings)
    model = model_by_name(law)(plant.joints, v_smooth=0.5)
    k = len(model.law.coefficients)
    joints, size = plant.joints, model.law.state_size
    given = samples(joints, k, len(terms), memory=joints * size)
    compiled = StepJacobian(plant, model, terms)
    assert not caplog.records
    found = compiled.after_step(*given)
    eager = without_compiler(monkeypatch, plant, model, terms)
    assert "eager torch" in caplog.text
    torch.testing.assert_close(found, eager.after_step(*given), rtol=1e-10, atol=1e-10)

    def after(state, held, vector, tau, step):
        moved = plant.replace(**adjusted_buffers(plant, terms, vector))
        q, qd, z = state.tensor_split([joints, 2 * joints], -1)
        if not size:
            return torch.cat(rk4_step(moved, model, q, qd, tau, held, step), -1)
        z = z.reshape(joints, size)
        q, qd, qdd, z = memory_step(moved, model, q, qd, tau, held, step, z)
        return torch.cat([q, qd, z.flatten(), qdd], -1)

    state, held, tau, step, vector = given
    for i in range(len(state)):
        blocks = torch.func.jacrev(after, (0, 1, 2))(state[i], held[i], vector, tau[i], step[i])
        exact = torch.cat([b.flatten(1) for b in blocks], -1)
        torch.testing.assert_close(found[i], exact, rtol=1e-10, atol=1e-10)


def test_eager_chunks_do_not_change_the_result(monkeypatch):
    """More samples than are linearised together give the same derivatives."""
    plant, model = LinearAxis(2.0), model_by_name("NCFM")(1)
    terms = plant_parameters(plant, driven=(0,), largest_torque=1.0)
    given = samples(1, 1, len(terms), count=CHUNK + 3)
    found = without_compiler(monkeypatch, plant, model, terms).after_step(*given)
    whole = StepJacobian(plant, model, terms).after_step(*given)
    torch.testing.assert_close(found, whole, rtol=1e-10, atol=1e-12)


def test_a_plant_may_have_no_adjustable_terms(monkeypatch):
    plant, model = pendulum(), LFM(2, v_smooth=0.5)
    given = samples(2, 2, 0)
    found = StepJacobian(plant, model, []).after_step(*given)
    assert found.shape == (5, 6, 8)
    eager = without_compiler(monkeypatch, plant, model, [])
    torch.testing.assert_close(found, eager.after_step(*given), rtol=1e-10, atol=1e-10)


def test_start_derivative_is_that_of_the_frictionless_acceleration():
    plant = pendulum()
    terms = plant_parameters(plant, driven=(0, 1), largest_torque=1.0)
    state, _, tau, _, vector = samples(2, 2, len(terms))
    q, qd = state.chunk(2, -1)
    found = StepJacobian(plant, LFM(2), terms).initial_acceleration(q, qd, tau, vector)
    step = 1e-6
    columns = []
    for i, x in enumerate((q, qd, vector)):
        for unit in torch.eye(x.shape[-1], dtype=F64):
            ends = []
            for sign in (1, -1):
                moved = [q, qd, vector]
                moved[i] = x + sign * step * unit
                ends.append(
                    plant.replace(**adjusted_buffers(plant, terms, moved[2])).forward_dynamics(
                        moved[0], moved[1], tau
                    )
                )
            columns.append((ends[0] - ends[1]) / (2 * step))
    torch.testing.assert_close(found, torch.stack(columns, -1), rtol=1e-6, atol=1e-5)


def rows_of(name, steps, substeps, stride):
    """Samples of a short motion and the derivatives of the positions there, in one piece."""
    plant, model = pendulum(), model_by_name(name)(2, v_smooth=0.5)
    q0, qd0 = torch.ones(2, 2, dtype=F64), torch.zeros(2, 2, dtype=F64)
    tau, step = torch.zeros(2, steps, 2, dtype=F64), torch.full((2, steps), 1e-3, dtype=F64)
    motion = integrate(plant, model, RolloutInputs(q0, qd0, tau, step))
    run = Trajectory(model, torch.zeros(0, dtype=F64), motion, tau, step)
    pieces = list(propagate(StepJacobian(plant, model, []), run, substeps, stride))
    samples = [k for part, _ in pieces for k in range(steps // substeps + 1)[part]]
    return samples, torch.cat([rows[:, :, :2] for _, rows in pieces], 1), pieces[-1][1]


@pytest.mark.parametrize("piece", [6, 100])
def test_chunks_of_a_run_equal_the_whole(piece, monkeypatch):
    _, whole, end = rows_of("NFLFM", 10, 1, 1)
    monkeypatch.setattr("nfriction.fitting.shooting.sensitivity.PIECE", piece)
    samples, found, last = rows_of("NFLFM", 10, 1, 1)
    assert samples == list(range(11))
    torch.testing.assert_close(found, whole, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(last, end, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("name", ["LFM", "NFLFM"])
@pytest.mark.parametrize(("substeps", "stride"), [(1, 3), (3, 1), (3, 2)])
def test_block_is_the_product_of_its_steps(name, substeps, stride):
    """Also if steps remain after the last complete block."""
    steps = 21 if substeps > 1 else 7
    _, every, end = rows_of(name, steps, 1, 1)
    samples, found, last = rows_of(name, steps, substeps, stride)
    for k, sample in enumerate(samples):
        torch.testing.assert_close(found[:, k], every[:, sample * substeps], rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(last, end, rtol=1e-12, atol=1e-14)
