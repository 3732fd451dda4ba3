"""Compiled rollouts equal those of eager torch."""

from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import nn

from nfriction import codegen
from nfriction.codegen import SelfCheckFailed, UnsupportedOperation, ir
from nfriction.simulation.rk4 import rk4_step, simulate_eager
from tests.codegen.mechanisms import F64, Coulomb, NeuroFuzzy, Pendulum, reference

# Rounding differs by an ulp or two per step; one second of a falling chain amplifies it tenfold.
TOLERANCE = {"rtol": 0.0, "atol": 1e-12}


class Motion(NamedTuple):
    q: torch.Tensor
    qd: torch.Tensor
    qdd: torch.Tensor
    diverged_at: torch.Tensor  # sample index, -1 if it did not diverge


def run(
    compiled, q0, qd0, *, steps, time_step, tau=None, drive=None, substeps=1, memory=None,
    parameters=None, threads=1,
):  # fmt: skip
    """Rollouts of compiled code; torque, drive and stamps are passed by name."""
    step = torch.as_tensor(time_step, dtype=F64)
    step = step if step.ndim else step.expand(steps)
    tau = torch.zeros(q0.shape[-1], dtype=F64).expand(steps, -1) if tau is None else tau
    inputs = codegen.RolloutInputs(q0, qd0, tau, step, substeps, drive, memory)
    q, qd, qdd = compiled(inputs, parameters, threads)
    lost = q.isnan().any(-1)
    return Motion(q, qd, qdd, torch.where(lost.any(-1), lost.int().argmax(-1), -1))


def compile_rollout(plant, friction, **settings):
    compiled = codegen.CompiledRollout(plant, friction, rk4_step, **settings)
    compiled.check(lambda inputs: simulate_eager(plant, friction, inputs))
    return compiled


def start(joints=3, batch=1, seed=0):
    g = torch.Generator().manual_seed(seed)
    q = 0.5 * torch.randn(batch, joints, generator=g, dtype=F64) + 1.0
    return q, 0.1 * torch.randn(batch, joints, generator=g, dtype=F64)


@pytest.fixture(scope="module")
def coulomb():
    plant, friction = Pendulum(), Coulomb()
    return plant, friction, compile_rollout(plant, friction)


@pytest.fixture(scope="module")
def neurofuzzy():
    plant, friction = Pendulum(), NeuroFuzzy()
    return plant, friction, compile_rollout(plant, friction)


def assert_same(got, expected):
    for ours, theirs in zip((got.q, got.qd), expected, strict=True):
        torch.testing.assert_close(ours, theirs.transpose(0, 1), **TOLERANCE)


@pytest.mark.slow
def test_constant_coefficients_agree_after_1000_steps(coulomb):
    plant, friction, compiled = coulomb
    q, qd = start(batch=3)
    got = run(compiled, q, qd, steps=1000, time_step=1e-3)
    assert_same(got, reference(plant, friction, q, qd, 1000, 1e-3))
    assert got.diverged_at.tolist() == [-1, -1, -1]


@pytest.mark.slow
def test_held_coefficients_agree_after_1000_steps(neurofuzzy):
    plant, friction, compiled = neurofuzzy
    q, qd = start()
    got = run(compiled, q, qd, steps=1000, time_step=1e-3)
    assert_same(got, reference(plant, friction, q, qd, 1000, 1e-3))


def test_irregular_steps_and_torque_agree(neurofuzzy):
    plant, friction, compiled = neurofuzzy
    q, qd = start(batch=2)
    h = torch.linspace(5e-4, 2e-3, 200, dtype=F64)
    tau = torch.sin(torch.arange(600, dtype=F64)).reshape(200, 3)
    expected = reference(plant, friction, q, qd, 200, h, tau)
    assert_same(run(compiled, q, qd, steps=200, time_step=h, tau=tau), expected)
    each = run(
        compiled, q, qd, steps=200, time_step=h.expand(2, -1), tau=torch.stack([tau, 0 * tau])
    )
    np.testing.assert_array_equal(
        each.q[0], run(compiled, q, qd, steps=200, time_step=h, tau=tau).q[0]
    )
    np.testing.assert_array_equal(each.q[1], run(compiled, q, qd, steps=200, time_step=h).q[1])


def test_measured_drive_agrees(neurofuzzy):
    plant, friction, compiled = neurofuzzy
    q, qd = start(batch=2)
    g = torch.Generator().manual_seed(3)
    drive = [s * torch.randn(200, 3, generator=g, dtype=F64) for s in (1.0, 10.0)]
    expected = reference(plant, friction, q, qd, 200, 1e-3, drive=drive)
    assert_same(run(compiled, q, qd, steps=200, time_step=1e-3, drive=drive), expected)
    each = [d.expand(2, -1, -1) for d in drive]
    assert_same(run(compiled, q, qd, steps=200, time_step=1e-3, drive=each), expected)


def test_each_candidate_has_its_own_parameters(coulomb):
    _, friction, compiled = coulomb
    q, qd = start()
    log = friction.log.detach() + torch.linspace(-1, 1, 5, dtype=F64)[:, None, None]
    gravity = torch.linspace(8, 10, 5, dtype=F64)
    overrides = {"friction.log": log, "plant.gravity": gravity}
    many = q.expand(5, -1), qd.expand(5, -1)
    got = run(compiled, *many, steps=100, time_step=1e-3, parameters=overrides)
    for i in (0, 3):
        other_plant, other = Pendulum(), Coulomb()
        other_plant.gravity = gravity[i]
        other.log = nn.Parameter(log[i])
        expected = reference(other_plant, other, q, qd, 100, 1e-3)
        torch.testing.assert_close(got.q[i], expected[0][:, 0], **TOLERANCE)


def test_parameters_are_read_at_every_call():
    plant, friction = Pendulum(2), Coulomb(2)
    compiled = compile_rollout(plant, friction)
    with torch.no_grad():
        friction.log += 1.0
    q, qd = start(2)
    got = run(compiled, q, qd, steps=100, time_step=1e-3)
    assert_same(got, reference(plant, friction, q, qd, 100, 1e-3))


def test_threads_change_nothing(coulomb):
    _, _, compiled = coulomb
    q, qd = start(batch=9)
    whole = run(compiled, q, qd, steps=100, time_step=1e-3)
    np.testing.assert_array_equal(
        run(compiled, q, qd, steps=100, time_step=1e-3, threads=3).q, whole.q
    )


@pytest.mark.parametrize("model", ["coulomb", "neurofuzzy"])
@pytest.mark.parametrize("batch", [2, 3, 8, 13])
def test_batch_equals_its_candidates_bit_for_bit(model, batch, request):
    """Several candidates are computed together, each with its own torque, stamps and drive."""
    _, _, compiled = request.getfixturevalue(model)
    q, qd = start(batch=batch)
    g = torch.Generator().manual_seed(4)
    tau, fast, faster = torch.randn(3, batch, 60, 3, generator=g, dtype=F64).unbind()
    h = 5e-4 + 1e-3 * torch.rand(batch, 60, generator=g, dtype=F64)
    drive = (fast, 10 * faster)
    for given in ({}, {"drive": drive}):
        whole = run(compiled, q, qd, steps=60, time_step=h, tau=tau, substeps=2, **given)
        for i in range(batch):
            own = {name: tuple(x[i] for x in pair) for name, pair in given.items()}
            alone = run(compiled, q[i : i + 1], qd[i : i + 1], steps=60, time_step=h[i], tau=tau[i],
                             substeps=2, **own)  # fmt: skip
            for ours, theirs in zip(whole[:3], alone[:3], strict=True):
                np.testing.assert_array_equal(ours[i], theirs[0])


def test_substeps_are_finer_steps_at_the_same_torque(neurofuzzy):
    _, _, compiled = neurofuzzy
    q, qd = start(batch=2)
    tau = torch.sin(torch.arange(120, dtype=F64)).reshape(40, 3)
    some = run(compiled, q, qd, steps=40, time_step=4e-3, tau=tau, substeps=4)
    fine = run(compiled, q, qd, steps=160, time_step=1e-3, tau=tau.repeat_interleave(4, 0))
    np.testing.assert_array_equal(some.q, fine.q[:, ::4])
    np.testing.assert_array_equal(some.qdd, fine.qdd[:, ::4])


def test_a_diverging_candidate_stops_alone(coulomb):
    _, _, compiled = coulomb
    q, qd = start(batch=3)
    tau = torch.zeros(3, 200, 3, dtype=F64)
    tau[1, 50:] = 1e9
    tau[2, 80] = torch.nan
    got = run(compiled, q, qd, steps=200, time_step=1e-3, tau=tau, threads=2)
    assert got.diverged_at.tolist() == [-1, 51, 81]
    for i, step in ((1, 51), (2, 81)):
        assert torch.isfinite(got.q[i, :step]).all()
        assert torch.isnan(got.q[i, step:]).all()
        assert torch.isnan(got.qd[i, step:]).all()
    alone = run(compiled, q[:1], qd[:1], steps=200, time_step=1e-3)
    np.testing.assert_array_equal(got.q[0], alone.q[0])
    slow = run(compiled, q, qd + 2e6, steps=4, time_step=0.05, substeps=50)
    assert (slow.diverged_at == 1).all()
    assert torch.isnan(slow.q[:, 1:]).all()


def test_rk4_converges_with_order_four(coulomb):
    _, friction, compiled = coulomb
    q, qd = start()
    # Viscous friction alone: the smoothed sign would need steps of a microsecond.
    smooth = {"friction.log": friction.log.detach() + torch.tensor([0.0, -40.0], dtype=F64)}

    def end(steps):
        got = run(compiled, q, qd, steps=1, time_step=0.4, substeps=steps, parameters=smooth)
        return got.q[0, -1]

    exact = end(6400)
    errors = [(end(n) - exact).abs().max().item() for n in (50, 100, 200)]
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(slopes - 4) < 0.3)


def test_infinite_torque_stops_only_its_candidate():
    plant, friction = Pendulum(2), Coulomb(2)
    compiled = compile_rollout(plant, friction)
    q, qd = start(2, batch=11)
    tau = 0.1 * torch.cos(torch.arange(2000, dtype=F64)).reshape(1000, 2)
    got = run(compiled, q, qd, steps=1000, time_step=1e-3, tau=tau, threads=2)
    assert_same(got, reference(plant, friction, q, qd, 1000, 1e-3, tau))
    tau = tau.expand(11, -1, -1).clone()
    tau[9, 10] = torch.inf
    stopped = run(compiled, q, qd, steps=1000, time_step=1e-3, tau=tau)
    assert stopped.diverged_at.tolist() == [-1] * 9 + [11, -1]
    assert torch.isnan(stopped.q[9, 11:]).all()
    assert torch.isfinite(stopped.q[9, :11]).all()
    others = [i for i in range(11) if i != 9]
    np.testing.assert_array_equal(stopped.q[others], got.q[others])


def test_strided_inputs_are_read_without_copies(coulomb):
    """Transposed, strided and repeated arrays give the same results as their copies."""
    _, _, compiled = coulomb
    q, qd = start(batch=4)
    tau = torch.randn(3, 4, 80, dtype=F64).permute(1, 2, 0)[:, ::2]
    given = {"steps": 40, "time_step": torch.tensor(1e-3, dtype=F64).expand(40)}
    got = run(compiled, q.T.contiguous().T, qd, tau=tau, **given)
    np.testing.assert_array_equal(
        got.q, run(compiled, q, qd, tau=tau.clone().contiguous(), **given).q
    )


def test_source_code_is_deterministic(coulomb):
    _, _, compiled = coulomb
    assert compile_rollout(Pendulum(), Coulomb()).kernel.source() == compiled.kernel.source()


def test_parameter_only_operations_are_computed_once(coulomb):
    _, _, compiled = coulomb
    functions = {
        part.split("(")[0]: part for part in compiled.kernel.source().split("define internal ")
    }
    assert "@exp(" in functions["void @nf_once"]  # of the logarithms of coefficients
    assert "fmul" not in functions["void @nf_held"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tau": torch.ones(4, 3)}, "`tau` must be"),
        ({"parameters": {"friction.nothing": 1.0}}, "friction.log"),
        ({"parameters": {"friction.log": np.ones(7)}}, "must be"),
        ({"qd0": torch.ones(4, 3)}, "`q0` 2, `qd0` 4"),
        ({"threads": 0}, "`threads`"),
        ({"substeps": 0}, "`substeps`"),
        ({"drive": (torch.ones(5, 3), torch.ones(4, 3))}, "`measured` must be"),
    ],
)
def test_bad_arguments_raise_clear_errors(coulomb, change, message):
    _, _, compiled = coulomb
    given = {"q0": torch.ones(2, 3), "qd0": torch.ones(2, 3), "steps": 5, "time_step": 1e-3}
    with pytest.raises(ValueError, match=message):
        run(compiled, **{**given, **change})


class PathDependent(Coulomb):
    """Friction that grows with the distance travelled, one hidden state per joint."""

    state_size = 1

    def initial_state(self, qd, qdd):
        return qd.abs()[..., None]

    def advance(self, qd, qdd, state):
        return 0.99 * state + qd.abs()[..., None]

    def coefficients_from(self, qd, qdd, state):
        return self.log.exp() * (1.0 + 0.1 * state)

    def coefficients(self, qd, qdd):
        return self.coefficients_from(qd, qdd, self.initial_state(qd, qdd))


def test_hidden_state_agrees_with_eager_steps():
    plant, friction = Pendulum(2), PathDependent(2)
    compiled = compile_rollout(plant, friction)

    class ReferencePathDependent(Coulomb):
        """The same friction for `reference`, which calls it once per step."""

        state = None

        def coefficients(self, qd, qdd):
            begun = self.state is None
            self.state = (
                friction.initial_state(qd, qdd) if begun else friction.advance(qd, qdd, self.state)
            )
            return friction.coefficients_from(qd, qdd, self.state)

    q, qd = start(2, batch=2)
    got = run(compiled, q, qd, steps=1000, time_step=1e-3)
    assert_same(got, reference(plant, ReferencePathDependent(2), q, qd, 1000, 1e-3))
    memory = torch.tensor([[[5.0], [1.0]], [[0.0], [9.0]]], dtype=F64)
    given = run(compiled, q, qd, steps=50, time_step=1e-3, memory=memory, threads=2)
    for i in range(2):
        alone = run(compiled, q[i : i + 1], qd[i : i + 1], steps=50, time_step=1e-3,
                         memory=memory[i : i + 1])  # fmt: skip
        np.testing.assert_array_equal(given.q[i], alone.q[0])
    assert not np.allclose(given.q, got.q[:, :51], atol=1e-6)
    many = run(
        compiled, *start(2, batch=5), steps=50, time_step=1e-3, substeps=3, memory=memory[1:]
    )
    for i in range(5):
        alone = run(compiled, *(x[i : i + 1] for x in start(2, batch=5)), steps=50, time_step=1e-3,
                         substeps=3, memory=memory[1:])  # fmt: skip
        np.testing.assert_array_equal(many.q[i], alone.q[0])
    with pytest.raises(ValueError, match="memory"):
        run(compiled, q, qd, steps=5, time_step=1e-3, memory=torch.ones(2, 3, 1))


def test_wrong_code_fails_the_self_check(monkeypatch):
    true = ir.Body.text
    monkeypatch.setattr(ir.Body, "text", lambda b: true(b).replace("fsub double", "fadd double"))
    with pytest.raises(SelfCheckFailed, match=r'backend="torch"'):
        compile_rollout(Pendulum(2), Coulomb(2))


def test_unknown_operation_error_names_it_and_the_fallback():
    class Sorted(Coulomb):
        def torque(self, qd, load, c):
            return super().torque(qd.sort(-1).values, load, c)

    with pytest.raises(UnsupportedOperation, match=r'`sort`.*backend="torch"'):
        compile_rollout(Pendulum(), Sorted())


def test_objects_that_are_no_modules_are_refused():
    with pytest.raises(TypeError, match="friction"):
        compile_rollout(Pendulum(), object())
