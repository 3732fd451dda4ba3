"""Rollouts: order, energy, passivity, agreement of all executors, gradients, clear errors."""

import logging
import math
import re
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from nfriction import LFM, NFLFM, LinearAxis, PendulumChain, rigs, rollout
from nfriction.friction import model_by_name, model_names
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import Coefficient, Law
from nfriction.friction.models import FrictionModel
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.simulation.protocols import at_sample_time
from nfriction.simulation.validate import RK4_STABILITY, required_substeps

F64 = torch.float64
CHAIN = PendulumChain([0.3, 0.2], [0.2, 0.15], inertia=[1e-3, 4e-4])
Q0 = torch.tensor([2.2, 0.6], dtype=F64)
QD0 = torch.tensor([0.5, -0.3], dtype=F64)
MOVING = (torch.tensor([2.2, 0.6], dtype=F64), torch.tensor([4.0, -3.0], dtype=F64))


def quadratic_drag(qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
    return coefficients[..., 0] * qd * qd.abs() + coefficients[..., 1] * load * qd


DRAG = Law("drag", (Coefficient("D", "N m s^2/rad^2"), Coefficient("L", "N m s/rad")),
           quadratic_drag)  # fmt: skip


def smooth_model() -> FrictionModel:
    """Friction without a steep transition, so that RK4 shows its order."""
    return LFM(2, [2e-3, 1e-3], v_smooth=2.0)


def named_model(name: str) -> FrictionModel:
    # A signed coefficient of zero would have no scale, and a network's offset would move
    # everything.
    initial = [1e-3, 1e-3, 1e-3, 1e-3, 1.0] if name == "NFNLFM" else None
    model = model_by_name(name)(2, initial, v_smooth=0.05)
    generator = torch.Generator().manual_seed(3)
    if isinstance(model.schedule, Adaptive):
        # Classes far apart, and a memory short enough to change them within a thousand steps.
        model = model_by_name(name)(2, v_smooth=0.05, time_constant=0.1, sample_time=5e-4)
        with torch.no_grad():
            model.schedule.raw.add_(
                0.7 * torch.randn(model.schedule.raw.shape, generator=generator, dtype=F64)
            )
        model.schedule.set_classes([[30.0, 70.0], [40.0, 120.0]])
    elif not isinstance(model.schedule, Constant):
        # A network with clearly motion-dependent coefficients.
        vector = model.schedule.parameter_vector()
        model.schedule.set_parameter_vector(
            0.1 * torch.randn(vector.shape, generator=generator, dtype=F64)
        )
    return model


def run(model, q0=Q0, qd0=QD0, plant=CHAIN, **settings):
    return rollout(plant, model, q0, qd0, **({"gradients": False} | settings))


# Physical laws


@pytest.mark.parametrize("friction", [False, True])
def test_order_of_convergence_is_four(friction):
    # A law without load, whose absolute value has kinks.
    model = (
        model_by_name("NLFM")(2, [1e-4, 1e-3, 2e-3, 1e-3, 0.5], v_smooth=2.0) if friction else None
    )

    def end(steps):
        out = run(model, sample_time=0.8 / steps, steps=steps, backend="compiled")
        return torch.cat([out.q[-1], 0.1 * out.qd[-1]])

    exact = end(12800)
    errors = [float((end(n) - exact).norm()) for n in (400, 800, 1600)]
    slopes = [torch.log2(torch.tensor(a / b)).item() for a, b in pairwise(errors)]
    assert slopes == pytest.approx([4.0, 4.0], abs=0.25)


def test_frictionless_energy_is_conserved():
    out = run(None, sample_time=1e-3, steps=2000)
    energy = sum(CHAIN.energy(out.q, out.qd))
    assert float((energy - energy[0]).abs().max()) < 1e-7 * float(energy.abs().max())


@pytest.mark.parametrize("name", model_names())
def test_passive_friction_never_adds_energy(name):
    model = named_model(name) if name != "NFNLFM" else model_by_name(name)(2, v_smooth=0.05)
    if name == "ANLFM":
        with torch.no_grad():
            model.schedule.raw[..., 0] = 0.0  # f_o pushes, so it is not dissipative
    out = run(model, *MOVING, sample_time=1e-3, steps=1000)
    energy = sum(CHAIN.energy(out.q, out.qd))
    assert float(energy.diff().max()) < 1e-9  # rounding and the integrator's own error
    assert float(energy[-1]) < float(energy[0]) - 1e-4


def test_force_on_an_axis_gives_the_closed_form():
    """m qdd = u - b qd from rest: qd = u/b (1 - exp(-b t / m))."""
    axis, b, u = LinearAxis(2.0), 3.0, 1.5
    model = model_by_name("NCFM")(1, [b])
    tau = torch.full((500, 1), u, dtype=F64)
    out = run(model, torch.zeros(1, dtype=F64), torch.zeros(1, dtype=F64), axis, tau=tau)
    exact = u / b * (1 - torch.exp(-b / 2.0 * out.time))
    torch.testing.assert_close(out.qd[:, 0], exact, rtol=1e-10, atol=1e-12)


# Shapes, batches, options


def test_shapes_times_and_first_acceleration_are_correct():
    out = run(smooth_model(), sample_time=2e-3, steps=10)
    assert out.q.shape == out.qd.shape == out.qdd.shape == (11, 2)
    torch.testing.assert_close(out.time, 2e-3 * torch.arange(11, dtype=F64))
    zero = torch.zeros(2, dtype=F64)
    torch.testing.assert_close(out.qdd[0], CHAIN.forward_dynamics(Q0, QD0, zero))
    assert not bool(out.diverged)


@pytest.mark.parametrize("backend", ["torch", "compiled"])
def test_a_batch_equals_single_runs(backend):
    generator = torch.Generator().manual_seed(0)
    q0, qd0 = torch.randn(2, 2, 3, 2, generator=generator, dtype=F64)
    tau = 1e-2 * torch.randn(3, 30, 2, generator=generator, dtype=F64)
    together = run(smooth_model(), q0, qd0, tau=tau, backend=backend)
    assert together.q.shape == (2, 3, 31, 2)
    assert together.diverged_at.shape == (2, 3)
    for i in range(2):
        for j in range(3):
            one = run(smooth_model(), q0[i, j], qd0[i, j], tau=tau[j], backend=backend)
            for name in ("q", "qd", "qdd"):
                got = getattr(together, name)[i, j]
                torch.testing.assert_close(got, getattr(one, name), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("backend", ["torch", "compiled"])
def test_batch_may_come_from_torques_or_steps_alone(backend):
    tau = torch.tensor([0.0, 0.01, 0.02], dtype=F64)[:, None, None].expand(3, 20, 2)
    out = run(smooth_model(), tau=tau, backend=backend)
    assert out.q.shape == (3, 21, 2)
    torch.testing.assert_close(out.q[1], run(smooth_model(), tau=tau[1]).q, rtol=1e-13, atol=1e-13)
    step = torch.tensor([[1e-3] * 5, [2e-3] * 5], dtype=F64)
    out = run(smooth_model(), sample_time=step, backend=backend)
    assert out.time.shape == (2, 6)
    torch.testing.assert_close(out.q[1], run(smooth_model(), sample_time=step[1]).q)


# Eager torch takes a second for some hundred steps, so the default run has one of each kind.
OFTEN = ("LFM", "ALFM", "NFLFM", "user")
NAMES = [
    n if n in OFTEN else pytest.param(n, marks=pytest.mark.slow) for n in (*model_names(), "user")
]


@pytest.mark.parametrize("name", NAMES)
def test_torch_and_compiled_code_agree(name):
    model = FrictionModel(DRAG, Constant(DRAG, 2), 1.0) if name == "user" else named_model(name)
    eager, compiled = (
        run(model, *MOVING, sample_time=1e-3, steps=400, backend=backend)
        for backend in ("torch", "compiled")
    )
    for field in ("q", "qd"):
        torch.testing.assert_close(
            getattr(compiled, field), getattr(eager, field), rtol=0, atol=1e-12
        )
    # An acceleration is a velocity difference over a step, and has its rounding error.
    torch.testing.assert_close(compiled.qdd, eager.qdd, rtol=1e-10, atol=1e-9)


def recorded(steps: int) -> dict:
    """All possible data of two runs: torques, irregular stamps, a measured motion."""
    generator = torch.Generator().manual_seed(5)

    def random(*shape: int, scale: float) -> Tensor:
        return scale * torch.randn(*shape, generator=generator, dtype=F64)

    return {
        "tau": random(2, steps, 2, scale=0.05),
        "sample_time": 3e-4 + 4e-4 * torch.rand(2, steps, generator=generator, dtype=F64),
        "drive": "measured",
        "measured": (random(2, steps, 2, scale=3.0), random(2, steps, 2, scale=60.0)),
    }


@pytest.mark.parametrize("name", NAMES)
def test_torque_drag_irregular_stamps_and_a_measured_drive_agree(name):
    model = FrictionModel(DRAG, Constant(DRAG, 2), 1.0) if name == "user" else named_model(name)
    plant = CHAIN.replace(drag_quadratic=torch.tensor([0.02, 0.01], dtype=F64))
    given = recorded(200 if name in OFTEN else 1000)
    eager, compiled = (
        run(model, *MOVING, plant, backend=b, **given) for b in ("torch", "compiled")
    )
    torch.testing.assert_close(compiled.q, eager.q, rtol=0, atol=1e-12)
    torch.testing.assert_close(compiled.qd, eager.qd, rtol=0, atol=1e-12)
    undriven = run(model, *MOVING, plant, backend="compiled", tau=given["tau"],
                   sample_time=given["sample_time"])  # fmt: skip
    assert torch.equal(undriven.q, compiled.q) == isinstance(model.schedule, Constant)


class Reads(TorchDispatchMode):
    """Counts how often a tensor's value is read, which makes a GPU wait."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        waits = ("aten::_local_scalar_dense", "aten::nonzero", "aten::equal", "aten::masked_select")
        self.count += operation.name().split(".")[0] in waits
        return operation(*args, **(kwargs or {}))


@pytest.mark.parametrize("name", model_names())
def test_no_tensor_value_is_read_within_the_loop(name):
    counts = []
    run(named_model(name), *MOVING, sample_time=5e-4, steps=2)  # bounds of the plant are cached
    for steps in (3, 9):
        with Reads() as reads:
            run(named_model(name), *MOVING, sample_time=5e-4, steps=steps, backend="torch")
        counts.append(reads.count)
    assert counts[0] == counts[1] > 0


@pytest.mark.parametrize("backend", ["torch", "compiled"])
@pytest.mark.parametrize("name", ["LFM", "NFLFM"])
def test_substeps_are_finer_steps(backend, name):
    """With coefficients evaluated at every substep, substeps are just shorter steps."""
    tau = 0.02 * torch.sin(torch.arange(40, dtype=F64))[:, None].expand(40, 2)
    fine = run(named_model(name), tau=tau.repeat_interleave(3, 0), sample_time=1e-3 / 3,
               backend=backend)  # fmt: skip
    out = run(named_model(name), tau=tau, sample_time=1e-3, substeps=3, backend=backend)
    for field in ("q", "qd", "qdd"):
        torch.testing.assert_close(
            getattr(out, field), getattr(fine, field)[::3], rtol=1e-11, atol=1e-11
        )


@pytest.mark.parametrize("backend", ["torch", "compiled"])
def test_irregular_time_stamps_give_the_same_end(backend):
    """The motion depends on time, not on samples: other stamps, same end."""
    generator = torch.Generator().manual_seed(1)
    step = 5e-4 + 1e-3 * torch.rand(150, generator=generator, dtype=F64)
    out = run(smooth_model(), sample_time=step, backend=backend)
    even = run(smooth_model(), sample_time=float(step.sum()) / 150, steps=150, backend=backend)
    torch.testing.assert_close(out.time[-1], even.time[-1])
    torch.testing.assert_close(out.q[-1], even.q[-1], rtol=0, atol=1e-9)


def test_simulated_motion_as_measured_drive_reproduces_itself():
    model = named_model("NFLFM")
    free = run(model, *MOVING, steps=60)
    measured = (free.qd[:-1], free.qdd[:-1])
    for backend in ("torch", "compiled"):
        driven = run(model, *MOVING, steps=60, drive="measured", measured=measured, backend=backend)
        torch.testing.assert_close(driven.q, free.q, rtol=0, atol=1e-13)
    slow = tuple(torch.zeros_like(m) for m in measured)
    other = run(model, *MOVING, steps=60, drive="measured", measured=slow)
    assert not torch.allclose(other.q, free.q, atol=1e-8)


@pytest.mark.parametrize("backend", [pytest.param("torch", marks=pytest.mark.slow), "compiled"])
def test_hidden_state_advances_once_per_sample(backend):
    """Substeps refine the integration; the class changes only at samples, as in a controller."""
    seen = []

    class Watched(Adaptive):
        def advance(self, qd, qdd, state):
            seen.append(1)
            return super().advance(qd, qdd, state)

    model = named_model("ALFM")
    fine = run(model, *MOVING, sample_time=5e-4, steps=300, substeps=2, backend=backend)
    model.schedule.__class__ = Watched
    watched = run(model, *MOVING, sample_time=5e-4, steps=300, substeps=2, backend="torch")
    assert len(seen) == 299
    torch.testing.assert_close(watched.q, fine.q, rtol=0, atol=1e-12)
    known = model.schedule.classes(fine.qd, fine.qdd)
    assert len(known.unique()) > 1


@pytest.mark.parametrize("backend", [pytest.param("torch", marks=pytest.mark.slow), "compiled"])
def test_motion_continues_with_its_hidden_state(backend):
    """A run in two parts with the hidden state handed over equals the uncut one."""
    model = named_model("ALFM")
    settings = {"sample_time": 5e-4, "backend": backend}
    whole = run(model, *MOVING, steps=400, **settings)
    # The acceleration at a restart differs at first, so its class must not count.
    states = model.schedule.states(whole.qd, whole.qdd)
    rest = run(model, whole.q[200], whole.qd[200], steps=200, hidden_state=states[200], **settings)
    torch.testing.assert_close(rest.q, whole.q[200:], rtol=0, atol=1e-12)
    other = states[200].clone()
    other[:, 0], other[:, 1] = 4 * model.schedule.thresholds[:, 1], 2.0
    lost = run(model, whole.q[200], whole.qd[200], steps=200, hidden_state=other, **settings)
    assert not torch.allclose(lost.q, whole.q[200:], rtol=0, atol=1e-9)
    two = torch.stack([states[200], other])
    both = run(model, whole.q[200], whole.qd[200], steps=200, hidden_state=two, **settings)
    torch.testing.assert_close(both.q, torch.stack([rest.q, lost.q]), rtol=0, atol=1e-13)


@pytest.mark.parametrize("backend", [pytest.param("torch", marks=pytest.mark.slow), "compiled"])
def test_measured_motion_drives_the_hidden_state_too(backend):
    model = named_model("ALFM")
    settings = {"sample_time": 5e-4, "steps": 300, "backend": backend}
    free = run(model, *MOVING, **settings)
    measured = (free.qd[:-1], free.qdd[:-1])
    same = run(model, *MOVING, drive="measured", measured=measured, **settings)
    torch.testing.assert_close(same.q, free.q, rtol=0, atol=1e-13)
    calm = tuple(torch.zeros_like(m) for m in measured)
    other = run(model, *MOVING, drive="measured", measured=calm, **settings)
    low = LFM(2, model.schedule.values[:, 0], v_smooth=0.05)
    torch.testing.assert_close(other.q, run(low, *MOVING, **settings).q, rtol=0, atol=1e-12)
    assert not torch.allclose(other.q, free.q, atol=1e-6)


def test_hidden_state_of_another_rate_decays_in_the_same_time():
    model = named_model("ALFM")
    made = model.schedule.sample_time
    other = at_sample_time(model.schedule, 2e-3)
    assert float(other.fading) == pytest.approx(math.exp(-2e-3 / other.time_constant))
    assert model.schedule.sample_time == made
    assert other.raw is model.schedule.raw
    assert at_sample_time(model.schedule, 1.0001 * made) is model.schedule


def test_different_rates_in_a_batch_need_memoryless_coefficients():
    steps = torch.tensor([[1e-3] * 5, [4e-3] * 5])
    with pytest.raises(ValueError, match=r"for a batch, got 0\.001 to 0\.004 s"):
        run(named_model("ALFM"), sample_time=steps)
    assert run(named_model("LFM"), sample_time=steps).q.shape == (2, 6, 2)


@pytest.mark.parametrize("name", ["ALFM", "NFLFM"])
def test_hidden_states_use_the_time_stamps(name):
    model = named_model("ALFM")
    if name == "NFLFM":
        model = NFLFM(2, network="rbf", derivatives=2)
    time = 5e-3 * torch.arange(200, dtype=F64)
    qd = torch.sin(9 * time)[:, None].expand(-1, 2).clone()
    qdd = 9 * torch.cos(9 * time)[:, None].expand(-1, 2).clone()
    expected = at_sample_time(model.schedule, 5e-3).states(qd, qdd)
    torch.testing.assert_close(model.schedule.states(qd, qdd, time), expected)
    assert not torch.allclose(model.schedule.states(qd, qdd), expected)


def test_hidden_state_must_match_the_model():
    with pytest.raises(ValueError, match="omit it"):
        run(smooth_model(), steps=2, hidden_state=torch.zeros(2, 2))
    for wrong in (torch.zeros(2, 3), torch.full((2, 2), torch.nan)):
        with pytest.raises(ValueError, match="hidden_state"):
            run(named_model("ALFM"), steps=2, hidden_state=wrong)


def test_gradients_reach_every_active_class():
    model = named_model("ALFM")
    out = rollout(CHAIN, model, *MOVING, sample_time=5e-4, steps=60)
    out.q.sum().backward()
    slope = model.schedule.raw.grad
    known = model.schedule.classes(out.qd.detach()[:-1], out.qdd.detach()[:-1])
    for joint in range(2):
        for c in range(3):
            assert bool(slope[joint, c].any()) == bool((known[:, joint] == c).any())


def test_threads_change_nothing():
    q0 = Q0 + torch.linspace(0, 1, 9, dtype=F64)[:, None]
    one, four = (run(smooth_model(), q0, steps=50, threads=n) for n in (1, 4))
    assert torch.equal(one.q, four.q)


# Divergence and stability


@pytest.mark.parametrize("backend", ["torch", "compiled"])
def test_divergence_is_reported_with_its_time(backend, caplog):
    """Negative viscosity b accelerates an axis: qd grows by exp(b/m t) and passes 1e6 at a known
    time."""
    explode = Law("explode", (Coefficient("b", "N s/m", positive=False),),
                  lambda qd, load, c, v_smooth: c[..., 0] * qd)  # fmt: skip
    model = FrictionModel(explode, Constant(explode, 1, [-100.0]), 1.0)
    qd0 = torch.tensor([[1.0], [0.0]], dtype=F64)
    with caplog.at_level(logging.WARNING, "nfriction"):
        out = run(model, torch.zeros(1, dtype=F64), qd0, LinearAxis(1.0), steps=300,
                  backend=backend)  # fmt: skip
    assert out.diverged.tolist() == [True, False]
    at = float(torch.log(torch.tensor(1e6))) / 100
    assert float(out.diverged_at[0]) == pytest.approx(at, abs=1.1e-3)
    lost = out.time >= out.diverged_at[0]
    for x in (out.q, out.qd, out.qdd):
        assert torch.isnan(x[0, lost]).all()
        assert torch.isfinite(x[0, ~lost]).all()
        assert torch.isfinite(x[1]).all()
    assert "diverged" in caplog.text


@pytest.mark.parametrize("substeps", [1, 2])
def test_too_steep_friction_is_refused_with_a_working_remedy(substeps):
    coefficients = [1e-3, 5e-2]
    model = LFM(2, coefficients, v_smooth=1e-3)
    with pytest.raises(ValueError, match="too steep") as caught:
        run(model, steps=5, substeps=substeps)
    suggestion = re.search(r"substeps=(\d+) or v_smooth >= (\S+)", str(caught.value))
    assert suggestion is not None
    assert int(suggestion[1]) == required_substeps(CHAIN, model, 1e-3) > substeps
    run(model, steps=5, substeps=int(suggestion[1]))
    with pytest.raises(ValueError, match="too steep"):
        run(model, steps=5, substeps=int(suggestion[1]) - 1)
    run(LFM(2, coefficients, v_smooth=float(suggestion[2])), steps=5, substeps=substeps)


def test_stability_limit_is_that_of_rk4():
    """Motion with viscous friction just below the limit decays, just above it grows."""
    axis = LinearAxis(0.5)
    limit = 0.5 * RK4_STABILITY / 1e-3
    assert required_substeps(axis, model_by_name("NCFM")(1, [limit]), 1e-3) == 1
    start = torch.zeros(1, dtype=F64), torch.ones(1, dtype=F64)
    ends = []
    for factor in (0.99, 1.0):
        model = model_by_name("NCFM")(1, [factor * limit])
        ends.append(float(run(model, *start, axis, steps=500).qd[-1].abs()))
    assert ends[0] < 0.1
    assert ends[1] == pytest.approx(1.0, abs=0.2)
    with pytest.raises(ValueError, match="too steep"):
        run(model_by_name("NCFM")(1, [1.01 * limit]), *start, axis, steps=5)


def test_coupled_joints_are_limited_by_their_fastest_mode():
    """Each joint alone allows twice these coefficients; together they need more steps."""
    plant, model = rigs.multiarm_triple(), model_by_name("NCFM")(3, [[0.97], [0.25], [0.18]])
    start = torch.tensor([3.6, 0.5, -0.4], dtype=F64), torch.zeros(3, dtype=F64)
    alone = plant.decay_rate(model.zero_velocity_damping().diag())
    assert float(alone.max()) * 0.01 < 0.6 * RK4_STABILITY
    with pytest.raises(ValueError, match="too steep"):
        run(model, *start, plant, sample_time=0.01, steps=100)
    needed = required_substeps(plant, model, 0.01)
    assert needed == 2
    out = run(model, *start, plant, sample_time=0.01, steps=100, substeps=needed)
    exact = run(model, *start, plant, sample_time=0.01, steps=100, substeps=50)
    assert float((out.q - exact.q).abs().max()) < 1e-3


# Gradients


def test_gradients_of_a_short_rollout_equal_finite_differences():
    model = smooth_model()

    def end(q0, qd0, raw):
        functional = torch.func.functional_call

        class Bound(torch.nn.Module):
            joints = 2

            def coefficients(self, qd, qdd):
                return functional(model.schedule, {"raw": raw}, (qd, qdd))

            def torque(self, qd, load, coefficients):
                return model.torque(qd, load, coefficients)

            def zero_velocity_damping(self):
                return model.zero_velocity_damping()

        out = rollout(CHAIN, Bound(), q0, qd0, sample_time=0.01, steps=5, gradients=True)
        return out.q, out.qd

    raw = model.schedule.raw.detach().clone().requires_grad_()
    inputs = (Q0.clone().requires_grad_(), QD0.clone().requires_grad_(), raw)
    assert torch.autograd.gradcheck(end, inputs)


def test_gradients_reach_the_parameters_of_model_and_plant():
    model = NFLFM(2, v_smooth=0.5)
    moment = CHAIN.gravity_moment.clone().requires_grad_()
    plant = CHAIN.replace(gravity_moment=moment)
    rollout(plant, model, Q0, QD0, steps=5).q.sum().backward()
    assert moment.grad is not None
    assert float(moment.grad.abs().sum()) > 0
    assert float(model.schedule.network.anfis.consequents.grad.abs().sum()) > 0


def test_gradients_are_recorded_if_required_and_affordable(monkeypatch):
    monkeypatch.setattr("nfriction.simulation.adjoint.MOST_STEPS", 20)
    model = smooth_model()
    assert rollout(CHAIN, model, Q0, QD0, steps=20).q.requires_grad
    assert not rollout(CHAIN, model, Q0, QD0, steps=21).q.requires_grad
    assert rollout(CHAIN, model, Q0, QD0, steps=21, gradients=True).q.requires_grad
    assert not rollout(CHAIN, model, Q0, QD0, steps=5, gradients=False).q.requires_grad
    with torch.no_grad():
        assert not rollout(CHAIN, model, Q0, QD0, steps=5).q.requires_grad
    assert not rollout(CHAIN, None, Q0, QD0, steps=5).q.requires_grad
    assert rollout(CHAIN, None, Q0.clone().requires_grad_(), QD0, steps=5).q.requires_grad
    with pytest.raises(ValueError, match="gradients"):
        rollout(CHAIN, model, Q0, QD0, steps=5, gradients=True, backend="compiled")


# Errors


def test_arrays_and_lists_are_tensors_in_double_precision():
    tau = 0.1 * torch.arange(10, dtype=F64).reshape(5, 2) + 1 / 3
    expected = run(smooth_model(), tau=tau, sample_time=1e-3, gradients=False)
    backwards = tau.numpy()[::-1].copy()[::-1]
    backwards.flags.writeable = False
    for given in (tau.numpy(), backwards, tau.tolist(), tuple(tau.tolist())):
        for times in (1e-3, [1e-3] * 5, np.full(5, 1e-3)):
            found = run(smooth_model(), Q0.tolist(), QD0.numpy(), tau=given,
                        sample_time=times, gradients=False)  # fmt: skip
            assert found.q.dtype == F64
            torch.testing.assert_close(found.q, expected.q, rtol=0, atol=0)


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_an_empty_batch_has_no_motion(backend):
    nothing = torch.zeros(0, 2, dtype=F64)
    for settings in ({"steps": 5}, {"tau": torch.zeros(0, 5, 2, dtype=F64)}):
        out = run(smooth_model(), nothing, nothing, backend=backend, gradients=False, **settings)
        assert out.q.shape == out.qd.shape == out.qdd.shape == (0, 6, 2)
        assert out.diverged.shape == (0,)


@pytest.mark.parametrize("scheme", ["rk4", "time_stepping"])
@pytest.mark.parametrize("backend", ["auto", "torch"])
def test_inference_mode_changes_nothing(backend, scheme):
    def motion():
        model = named_model("NFLFM") if scheme == "rk4" else smooth_model()
        q0 = 1.0 * Q0  # a tensor of the mode itself
        return run(model, q0, QD0, steps=20, backend=backend, scheme=scheme).q

    expected = motion().detach()
    with torch.inference_mode():
        torch.testing.assert_close(motion(), expected, rtol=0, atol=1e-12)


def test_tensors_on_two_devices_are_named() -> None:
    with pytest.raises(ValueError, match="one device, got cpu and meta"):
        run(smooth_model().to("meta"), steps=5)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "number of steps"),
        ({"steps": 5, "tau": torch.zeros(4, 2)}, "number of steps"),
        ({"steps": 5, "sample_time": torch.full((6,), 1e-3)}, "number of steps"),
        ({"steps": 0}, "at least 1"),
        ({"steps": 2.5}, "`steps` must be a whole number"),
        ({"steps": 5, "substeps": 1.5}, "`substeps` must be a whole number"),
        ({"steps": 5, "sample_time": 0}, "`sample_time` must be finite and positive"),
        ({"sample_time": [1e-3, 0.0, 1e-3]}, "`sample_time` must be finite and positive"),
        ({"sample_time": []}, "`sample_time` must be finite and positive"),
        ({"tau": torch.zeros(2)}, r"`tau` must be \(\*batch, steps, 2\), got \(2,\)"),
        ({"tau": torch.zeros(0, 2)}, "at least one step"),
        ({"tau": [[0.0, 0.0], [0.0]]}, "`tau` must be a tensor, an array or a list"),
        ({"tau": "none"}, "`tau` must be a tensor, an array or a list"),
        ({"steps": 5, "q0": torch.zeros(2) + 1j}, "`q0` must be real"),
        ({"steps": 5, "q0": torch.zeros(2).half()}, "`q0` must be .* float32 or float64, got .*16"),
        ({"tau": torch.zeros(3, 5, 2), "q0": torch.zeros(2, 2)}, r"`q0` \(2,\), `tau` \(3,\)"),
        ({"steps": 5, "drive": "measured", "measured": (torch.zeros(5, 2),) * 3}, "two"),
        ({"steps": 5, "sample_time": -1e-3}, "positive"),
        ({"steps": 5, "sample_time": float("nan")}, "finite"),
        ({"steps": 5, "substeps": 0}, "substeps"),
        ({"steps": 5, "q0": torch.tensor([torch.nan, 0.0])}, "`q0` must be finite"),
        ({"steps": 5, "qd0": torch.tensor([torch.inf, 0.0])}, "`qd0` must be finite"),
        ({"steps": 5, "q0": torch.zeros(3)}, "2 joints"),
        ({"steps": 5, "q0": torch.zeros(())}, "2 joints"),
        ({"tau": torch.zeros(5, 3)}, "`tau` must be"),
        ({"tau": torch.full((5, 2), torch.nan)}, "`tau` must be finite"),
        ({"steps": 5, "model": LFM(3)}, "3"),
        ({"steps": 5, "drive": "measured"}, "measured"),
        ({"steps": 5, "drive": "mesured"}, "measured"),
        ({"steps": 5, "measured": (torch.zeros(5, 2),) * 2}, "measured"),
        ({"steps": 5, "drive": "measured", "measured": (torch.zeros(6, 2),) * 2}, "one per step"),
        ({"steps": 5, "drive": "measured", "measured": (torch.full((5, 2), torch.nan),) * 2},
         "finite"),
        ({"steps": 5, "backend": "fortran"}, "backend"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_with_the_rule(settings, message):
    given = {"model": smooth_model()} | settings
    with pytest.raises(ValueError, match=message):
        run(**given)


def test_plant_and_friction_in_the_wrong_place_are_named() -> None:
    with pytest.raises(TypeError, match=r"`plant` must be a mechanism, got LFM\."):
        rollout(LFM(2), CHAIN, Q0, QD0, steps=1)
    with pytest.raises(TypeError, match=r"`friction` must be a friction model or None, got Pend"):
        rollout(CHAIN, CHAIN, Q0, QD0, steps=1)
