"""Derivatives of one integration step: compiled, eager and torch's own agree."""

import pytest
import torch

from nfriction import LFM, NFLFM, LinearAxis
from nfriction.codegen import NoBackend
from nfriction.fitting.plant_parameters import adjusted_buffers, plant_parameters
from nfriction.fitting.shooting.sensitivity import CHUNK, StepJacobian, start_slope, step_maps
from nfriction.friction.registry import model_by_name
from nfriction.simulation.protocols import RolloutInputs
from nfriction.simulation.rk4 import rk4_step
from nfriction.simulation.rollout import integrate
from tests.fitting.recordings import F64, pendulum


def samples(joints, k, parameters, count=5, seed=0):
    g = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=g, dtype=F64)

    return (
        2 * draw(count, joints), 3 * draw(count, joints), 0.01 * draw(count, joints, k).abs() + 0.1,
        0.1 * draw(count, joints), 1e-3 * (1 + draw(count, 1).abs()), 0.05 * draw(parameters),
    )  # fmt: skip


def without_compiler(monkeypatch, plant, model, terms):
    def nothing(*_, **__):
        raise NoBackend("none")

    with monkeypatch.context() as patch:
        patch.setattr("nfriction.codegen.compile_function", nothing)
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
        pytest.param("drag", "Stribeck", marks=pytest.mark.slow),
        pytest.param("armature", "NLFM", marks=pytest.mark.slow),
    ],
)
def test_compiled_and_eager_and_autograd_agree(case, law, monkeypatch):
    plant, settings = CASES[case]
    terms = plant_parameters(plant, **settings)
    model = model_by_name(law)(plant.joints, v_smooth=0.5)
    k = len(model.law.coefficients)
    given = samples(plant.joints, k, len(terms))
    compiled = StepJacobian(plant, model, terms)
    assert compiled._compiled is not None
    found = compiled(*given)
    eager = without_compiler(monkeypatch, plant, model, terms)
    assert eager._compiled is None
    torch.testing.assert_close(found, eager(*given), rtol=1e-10, atol=1e-10)

    def after(q, qd, held, vector, tau, step):
        moved = plant.replace(**adjusted_buffers(plant, terms, vector))
        return torch.cat(rk4_step(moved, model, q, qd, tau, held, step), -1)

    q, qd, held, tau, step, vector = given
    for i in range(len(q)):
        blocks = torch.func.jacrev(after, (0, 1, 2, 3))(
            q[i], qd[i], held[i], vector, tau[i], step[i]
        )
        exact = torch.cat([b.flatten(1) for b in blocks], -1)
        torch.testing.assert_close(found[i], exact, rtol=1e-10, atol=1e-10)


def test_eager_pieces_do_not_show(monkeypatch):
    """More samples than are linearised together give the same derivatives."""
    plant, model = LinearAxis(2.0), model_by_name("NCFM")(1)
    terms = plant_parameters(plant, driven=(0,), largest_torque=1.0)
    given = samples(1, 1, len(terms), count=CHUNK + 3)
    found = without_compiler(monkeypatch, plant, model, terms)(*given)
    torch.testing.assert_close(found, StepJacobian(plant, model, terms)(*given), rtol=1e-10,
                               atol=1e-12)  # fmt: skip


def test_a_plant_may_have_no_adjustable_terms(monkeypatch):
    plant, model = pendulum(), LFM(2, v_smooth=0.5)
    given = samples(2, 2, 0)
    found = StepJacobian(plant, model, [])(*given)
    assert found.shape == (5, 6, 8)
    torch.testing.assert_close(
        found, without_compiler(monkeypatch, plant, model, [])(*given), rtol=1e-10, atol=1e-10
    )


def test_the_start_slope_is_the_frictionless_acceleration_s():
    plant = pendulum()
    terms = plant_parameters(plant, driven=(0, 1), largest_torque=1.0)
    q, qd, _, tau, _, vector = samples(2, 2, len(terms))
    found = start_slope(StepJacobian(plant, LFM(2), terms), q, qd, tau, vector)
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


@pytest.mark.parametrize("run", [3, 50])
def test_pieces_of_a_run_are_the_whole(run):
    plant, model = pendulum(), NFLFM(2, v_smooth=0.5)
    jacobian = StepJacobian(plant, model, [])
    q0, qd0 = torch.ones(2, 2, dtype=F64), torch.zeros(2, 2, dtype=F64)
    tau, step = torch.zeros(2, 10, 2, dtype=F64), torch.full((2, 10), 1e-3, dtype=F64)
    motion = integrate(plant, model, RolloutInputs(q0, qd0, tau, step))
    empty = torch.zeros(0, dtype=F64)
    maps = list(step_maps(jacobian, motion, tau, step, empty, run))
    whole = next(step_maps(jacobian, motion, tau, step, empty, 10))
    assert sum(len(m.state) for m in maps) == 10
    for name in ("state", "parameters", "plant"):
        joined = torch.cat([getattr(m, name) for m in maps])
        torch.testing.assert_close(joined, getattr(whole, name), rtol=1e-13, atol=1e-13)
    assert whole.parameters.shape[-1] == model.schedule.parameter_vector().numel()


@pytest.mark.parametrize("name", ["LFM", "NFLFM"])
def test_a_block_is_the_chain_of_its_steps(name):
    """Two blocks of three steps; the seventh step is a block of its own."""
    plant, model = pendulum(), model_by_name(name)(2, v_smooth=0.5)
    jacobian = StepJacobian(plant, model, [])
    q0, qd0 = torch.ones(2, 2, dtype=F64), torch.zeros(2, 2, dtype=F64)
    tau, step = torch.zeros(2, 7, 2, dtype=F64), torch.full((2, 7), 1e-3, dtype=F64)
    motion = integrate(plant, model, RolloutInputs(q0, qd0, tau, step))
    empty = torch.zeros(0, dtype=F64)
    single = next(step_maps(jacobian, motion, tau, step, empty, 7))
    blocks, rest = step_maps(jacobian, motion, tau, step, empty, 7, block=3)
    assert len(blocks.state) == 2
    assert len(rest.state) == 1
    torch.testing.assert_close(rest.state[0], single.state[6], rtol=1e-13, atol=1e-14)
    torch.testing.assert_close(rest.parameters[0], single.parameters[6], rtol=1e-13, atol=1e-14)
    for b in range(2):
        state = torch.eye(6, dtype=F64).expand(2, -1, -1)
        parameters = torch.zeros_like(single.parameters[0])
        for k in range(3 * b, 3 * b + 3):
            state = single.state[k] @ state
            parameters = single.state[k] @ parameters + single.parameters[k]
        torch.testing.assert_close(blocks.state[b], state, rtol=1e-12, atol=1e-14)
        torch.testing.assert_close(blocks.parameters[b], parameters, rtol=1e-12, atol=1e-14)
