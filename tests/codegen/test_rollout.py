"""Every executor runs the same rollout as eager torch."""

import numpy as np
import pytest
import torch
from torch import nn

from nfriction.codegen import SelfCheckFailed, UnsupportedOperation, compile_rollout
from nfriction.codegen import rollout as rollout_module
from tests.codegen.mechanisms import F64, Coulomb, NeuroFuzzy, Pendulum, reference

# Rounding differs by an ulp or two a step; a second of a falling chain amplifies that tenfold.
TOLERANCE = {"rtol": 0.0, "atol": 1e-12}


def start(joints=3, batch=1, seed=0):
    g = torch.Generator().manual_seed(seed)
    q = 0.5 * torch.randn(batch, joints, generator=g, dtype=F64) + 1.0
    return q, 0.1 * torch.randn(batch, joints, generator=g, dtype=F64)


@pytest.fixture(scope="module")
def coulomb():
    plant, friction = Pendulum(), Coulomb()
    return plant, friction, compile_rollout(plant, friction, backend="c")


@pytest.fixture(scope="module")
def neurofuzzy():
    plant, friction = Pendulum(), NeuroFuzzy()
    return plant, friction, compile_rollout(plant, friction, backend="c")


def assert_same(got, expected):
    for ours, theirs in zip((got.q, got.qd), expected, strict=True):
        torch.testing.assert_close(ours, theirs.transpose(0, 1), **TOLERANCE)


def test_constant_coefficients_agree_after_1000_steps(coulomb):
    plant, friction, compiled = coulomb
    q, qd = start(batch=3)
    got = compiled(q, qd, steps=1000, time_step=1e-3)
    assert_same(got, reference(plant, friction, q, qd, 1000, 1e-3))
    assert got.diverged_step.tolist() == [-1, -1, -1]


def test_held_coefficients_agree_after_1000_steps(neurofuzzy):
    plant, friction, compiled = neurofuzzy
    q, qd = start()
    got = compiled(q, qd, steps=1000, time_step=1e-3)
    assert_same(got, reference(plant, friction, q, qd, 1000, 1e-3))


def test_coefficients_in_every_stage_agree_and_differ_from_held_ones(neurofuzzy):
    plant, friction, held = neurofuzzy
    compiled = compile_rollout(plant, friction, backend="c", hold=False)
    q, qd = start()
    got = compiled(q, qd, steps=100, time_step=1e-3)
    assert_same(got, reference(plant, friction, q, qd, 100, 1e-3, hold=False))
    assert (got.q - held(q, qd, steps=100, time_step=1e-3).q).abs().max() > 1e-9


def test_irregular_steps_and_torque_agree(neurofuzzy):
    plant, friction, compiled = neurofuzzy
    q, qd = start(batch=2)
    h = torch.linspace(5e-4, 2e-3, 200, dtype=F64)
    tau = torch.sin(torch.arange(600, dtype=F64)).reshape(200, 3)
    expected = reference(plant, friction, q, qd, 200, h, tau)
    assert_same(compiled(q, qd, steps=200, time_step=h, tau=tau), expected)
    each = compiled(q, qd, steps=200, time_step=h.expand(2, -1), tau=torch.stack([tau, 0 * tau]))
    np.testing.assert_array_equal(each.q[0], compiled(q, qd, steps=200, time_step=h, tau=tau).q[0])
    np.testing.assert_array_equal(each.q[1], compiled(q, qd, steps=200, time_step=h).q[1])


def test_measured_drive_agrees(neurofuzzy):
    plant, friction, compiled = neurofuzzy
    q, qd = start(batch=2)
    g = torch.Generator().manual_seed(3)
    drive = [s * torch.randn(200, 3, generator=g, dtype=F64) for s in (1.0, 10.0)]
    expected = reference(plant, friction, q, qd, 200, 1e-3, drive=drive)
    assert_same(compiled(q, qd, steps=200, time_step=1e-3, drive=drive), expected)
    each = [d.expand(2, -1, -1) for d in drive]
    assert_same(compiled(q, qd, steps=200, time_step=1e-3, drive=each), expected)


def test_each_candidate_has_its_own_parameters(coulomb):
    _, friction, compiled = coulomb
    q, qd = start()
    log = friction.log.detach() + torch.linspace(-1, 1, 5, dtype=F64)[:, None, None]
    gravity = torch.linspace(8, 10, 5, dtype=F64)
    overrides = {"friction.log": log, "plant.gravity": gravity}
    got = compiled(q, qd, steps=100, time_step=1e-3, parameters=overrides)
    for i in (0, 3):
        other_plant, other = Pendulum(), Coulomb()
        other_plant.gravity = gravity[i]
        other.log = nn.Parameter(log[i])
        expected = reference(other_plant, other, q, qd, 100, 1e-3)
        torch.testing.assert_close(got.q[i], expected[0][:, 0], **TOLERANCE)


def test_parameters_are_read_at_every_call():
    plant, friction = Pendulum(2), Coulomb(2)
    compiled = compile_rollout(plant, friction, backend="c")
    with torch.no_grad():
        friction.log += 1.0
    q, qd = start(2)
    got = compiled(q, qd, steps=100, time_step=1e-3)
    assert_same(got, reference(plant, friction, q, qd, 100, 1e-3))


def test_threads_and_records_change_nothing_else(coulomb):
    _, _, compiled = coulomb
    q, qd = start(batch=9)
    whole = compiled(q, qd, steps=100, time_step=1e-3)
    np.testing.assert_array_equal(compiled(q, qd, steps=100, time_step=1e-3, threads=3).q, whole.q)
    for every in (1, 7, 100):
        some = compiled(q, qd, steps=100, time_step=1e-3, record_every=every)
        np.testing.assert_array_equal(some.q, whole.q[:, ::every])
    ends = compiled(q, qd, steps=100, time_step=1e-3, record_every=None)
    np.testing.assert_array_equal(ends.qd, whole.qd[:, [0, -1]])


def test_a_diverging_candidate_stops_alone(coulomb):
    _, _, compiled = coulomb
    q, qd = start(batch=3)
    tau = torch.zeros(3, 200, 3, dtype=F64)
    tau[1, 50:] = 1e9
    tau[2, 80] = torch.nan
    got = compiled(q, qd, steps=200, time_step=1e-3, tau=tau, threads=2)
    assert got.diverged_step.tolist() == [-1, 51, 81]
    for i, step in ((1, 51), (2, 81)):
        assert torch.isfinite(got.q[i, :step]).all()
        assert torch.isnan(got.q[i, step:]).all()
        assert torch.isnan(got.qd[i, step:]).all()
    alone = compiled(q[:1], qd[:1], steps=200, time_step=1e-3)
    np.testing.assert_array_equal(got.q[0], alone.q[0])
    slow = compiled(q, qd, steps=200, time_step=1e-3, speed_limit=1e-3, record_every=50)
    assert (slow.diverged_step == 1).all()
    assert torch.isnan(slow.q[:, 1:]).all()


def test_rk4_converges_with_order_four(coulomb):
    _, friction, compiled = coulomb
    q, qd = start()
    # Viscous friction alone: the smoothed sign would need steps of a microsecond.
    smooth = {"friction.log": friction.log.detach() + torch.tensor([0.0, -40.0], dtype=F64)}

    def end(steps):
        run = compiled(q, qd, steps=steps, time_step=0.4 / steps, parameters=smooth,
                       record_every=None)  # fmt: skip
        return run.q[0, -1]

    exact = end(6400)
    errors = [(end(n) - exact).abs().max().item() for n in (50, 100, 200)]
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(slopes - 4) < 0.3)


def test_numba_agrees_with_eager_and_with_c():
    plant, friction = Pendulum(2), Coulomb(2)
    numba, c = (compile_rollout(plant, friction, backend=b) for b in ("numba", "c"))
    q, qd = start(2, batch=2)
    tau = 0.1 * torch.cos(torch.arange(2000, dtype=F64)).reshape(1000, 2)
    got = numba(q, qd, steps=1000, time_step=1e-3, tau=tau, threads=2)
    assert_same(got, reference(plant, friction, q, qd, 1000, 1e-3, tau))
    torch.testing.assert_close(got.q, c(q, qd, steps=1000, time_step=1e-3, tau=tau).q, **TOLERANCE)
    tau = tau.expand(2, -1, -1).clone()
    tau[1, 10] = torch.inf
    for compiled in (numba, c):
        got = compiled(q, qd, steps=1000, time_step=1e-3, tau=tau, record_every=3)
        assert got.diverged_step.tolist() == [-1, 11]
        assert torch.isnan(got.q[1, 4:]).all()
        assert torch.isfinite(got.q[1, :4]).all()


@pytest.mark.slow
def test_numba_agrees_on_held_coefficients_and_measured_drive():
    plant, friction = Pendulum(), NeuroFuzzy()
    compiled = compile_rollout(plant, friction, backend="numba")
    q, qd = start()
    got = compiled(q, qd, steps=1000, time_step=1e-3)
    assert_same(got, reference(plant, friction, q, qd, 1000, 1e-3))
    drive = [torch.ones(50, 3, dtype=F64), 5 * torch.ones(50, 3, dtype=F64)]
    got = compiled(q, qd, steps=50, time_step=1e-3, drive=drive)
    assert_same(got, reference(plant, friction, q, qd, 50, 1e-3, drive=drive))


def test_numpy_in_numpy_out(coulomb):
    _, _, compiled = coulomb
    got = compiled(np.ones((2, 3)), np.zeros((1, 3)), steps=5, time_step=1e-3)
    assert isinstance(got.q, np.ndarray)
    assert got.q.shape == (2, 6, 3)


def test_the_same_model_gives_the_same_source(coulomb):
    _, _, compiled = coulomb
    assert compile_rollout(Pendulum(), Coulomb(), backend="c").source == compiled.source


def test_nothing_that_only_needs_parameters_is_left_in_the_stage(coulomb):
    _, _, compiled = coulomb
    stage = compiled.source.split("static void nf_stage")[1].split("\n}")[0]
    assert "exp(" not in stage  # exp(log coefficient) is computed once a rollout
    assert "exp(" in compiled.source


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q0": np.ones(3)}, r"`q0\[None\]`"),
        ({"tau": np.ones((4, 3))}, "`tau` must be"),
        ({"time_step": np.ones(4)}, "`time_step` must be"),
        ({"parameters": {"friction.nothing": 1.0}}, "friction.log"),
        ({"parameters": {"friction.log": np.ones(7)}}, "must be"),
        ({"q0": np.ones((2, 3)), "qd0": np.ones((4, 3))}, "`q0` 2, `qd0` 4"),
        ({"steps": -1}, "`steps`"),
        ({"threads": 0}, "`threads`"),
        ({"drive": (np.ones((5, 3)), np.ones((2, 5, 3)))}, "`drive`"),
    ],
)
def test_bad_arguments_are_told(coulomb, change, message):
    _, _, compiled = coulomb
    given = {"q0": np.ones((1, 3)), "qd0": np.ones((1, 3)), "steps": 5, "time_step": 1e-3}
    with pytest.raises(ValueError, match=message):
        compiled(**{**given, **change})


class Remembering(Coulomb):
    """Friction that grows with the path travelled, a memory of one number a joint."""

    state_size = 1

    def initial_state(self, qd, qdd):
        return qd.abs()[..., None]

    def advance(self, qd, qdd, state):
        return 0.99 * state + qd.abs()[..., None]

    def coefficients_from(self, qd, qdd, state):
        return self.log.exp() * (1.0 + 0.1 * state)

    def coefficients(self, qd, qdd):
        return self.coefficients_from(qd, qdd, self.initial_state(qd, qdd))


@pytest.mark.parametrize("backend", ["c", pytest.param("numba", marks=pytest.mark.slow)])
def test_a_memory_agrees_with_eager_steps(backend):
    plant, friction = Pendulum(2), Remembering(2)
    compiled = compile_rollout(plant, friction, backend=backend)

    class Replayed(Coulomb):
        """The same friction for `reference`, which calls once a step."""

        state = None

        def coefficients(self, qd, qdd):
            begun = self.state is None
            self.state = (
                friction.initial_state(qd, qdd) if begun else friction.advance(qd, qdd, self.state)
            )
            return friction.coefficients_from(qd, qdd, self.state)

    q, qd = start(2, batch=2)
    got = compiled(q, qd, steps=1000, time_step=1e-3)
    assert_same(got, reference(plant, Replayed(2), q, qd, 1000, 1e-3))
    memory = torch.tensor([[[5.0], [1.0]], [[0.0], [9.0]]], dtype=F64)
    given = compiled(q, qd, steps=50, time_step=1e-3, memory=memory, threads=2)
    for i in range(2):
        alone = compiled(q[i : i + 1], qd[i : i + 1], steps=50, time_step=1e-3,
                         memory=memory[i : i + 1])  # fmt: skip
        np.testing.assert_array_equal(given.q[i], alone.q[0])
    assert not np.allclose(given.q, got.q[:, :51], atol=1e-6)
    with pytest.raises(ValueError, match="memory"):
        compiled(q, qd, steps=5, time_step=1e-3, memory=memory[0])


def test_a_memory_is_always_held():
    with pytest.raises(ValueError, match="hold=True"):
        compile_rollout(Pendulum(2), Remembering(2), backend="c", hold=False)
    with pytest.raises(ValueError, match="hold_for"):
        compile_rollout(Pendulum(2), Coulomb(2), backend="c")(
            np.ones((1, 2)), np.ones((1, 2)), steps=5, time_step=1e-3, hold_for=0
        )


def test_measured_drive_needs_held_coefficients():
    compiled = compile_rollout(Pendulum(2), Coulomb(2), backend="c", hold=False)
    drive = (np.ones((5, 2)), np.ones((5, 2)))
    with pytest.raises(ValueError, match="hold=True"):
        compiled(np.ones((1, 2)), np.ones((1, 2)), steps=5, time_step=1e-3, drive=drive)


def test_wrong_code_fails_the_self_check(monkeypatch):
    true = rollout_module.driver_c.c_source

    def wrong(parts):
        return true(parts).replace("qdd[0] = ", "qdd[0] = 1e-6 + ")

    monkeypatch.setattr(rollout_module.driver_c, "c_source", wrong)
    with pytest.raises(SelfCheckFailed, match=r'backend="torch"'):
        compile_rollout(Pendulum(2), Coulomb(2), backend="c")


def test_an_unknown_operation_names_itself_and_the_fallback():
    class Sorted(Coulomb):
        def torque(self, qd, load, c):
            return super().torque(qd.sort(-1).values, load, c)

    with pytest.raises(UnsupportedOperation, match=r'`sort`.*backend="torch"'):
        compile_rollout(Pendulum(), Sorted(), backend="c")


def test_what_is_no_module_is_refused():
    with pytest.raises(TypeError, match="friction"):
        compile_rollout(Pendulum(), object(), backend="c")
