"""Gradients of rollouts: the adjoint pass equals differentiation of recorded steps."""

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from nfriction import NFLFM, PendulumChain, rollout
from nfriction.friction import model_by_name, model_names
from nfriction.simulation import adjoint

F64 = torch.float64
CHAIN = PendulumChain([0.3, 0.2], [0.2, 0.15], inertia=[1e-3, 4e-4])
Q0 = torch.tensor([[2.2, 0.6], [1.0, -0.4], [3.0, 0.1]], dtype=F64)
QD0 = torch.tensor([[0.5, -0.3], [-2.0, 1.0], [0.0, 0.7]], dtype=F64)
STEPS = 12


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def neurofuzzy() -> NFLFM:
    """A network with motion-dependent coefficients, away from the kinks of its inputs' range."""
    model = NFLFM(2, [2e-3, 1e-3], v_smooth=0.5, terms=(3, 2), head_units=3)
    for seed, p in enumerate(model.parameters()):
        p.data.add_(0.1 * random(*p.shape, seed=seed))
    return model


class Coupled(nn.Module):
    """User-defined friction whose coefficients depend on the motion of every joint."""

    joints = 2

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(1e-3 * random(2, 4))

    def coefficients(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return 1e-3 + torch.tanh(torch.cat([qd, 0.1 * qdd], -1) @ self.weight.T)[..., None] ** 2

    def torque(self, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
        return coefficients[..., 0] * qd * (1.0 + 0.1 * load)

    def zero_velocity_damping(self) -> Tensor:
        return torch.full((2,), 1e-3, dtype=F64)


def gradients(plant, model, backend, q0=Q0, qd0=QD0, wanted=(), **settings) -> list[Tensor]:
    """Gradients of a sum over the whole motion with different weights for all numbers."""
    q0, qd0 = (x.detach().clone().requires_grad_() for x in (q0, qd0))
    out = rollout(
        plant, model, q0, qd0, **({"steps": STEPS} | settings), gradients=True, backend=backend
    )
    scales = {"q": 1.0, "qd": 0.1, "qdd": 1e-3}
    loss = sum(
        scale * (getattr(out, name) * random(*out.q.shape, seed=seed)).sum()
        for seed, (name, scale) in enumerate(scales.items())
    )
    inputs = [q0, qd0, *wanted, *(() if model is None else model.parameters())]
    found = torch.autograd.grad(loss, inputs, allow_unused=True, materialize_grads=True)
    return [out.q.detach(), *found]


def assert_equal_gradients(plant, model, **settings) -> None:
    found = gradients(plant, model, "auto", **settings)
    expected = gradients(plant, model, "torch", **settings)
    for a, b in zip(found, expected, strict=True):
        # Both are exact; they add in another order.
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11 * float(b.abs().max() + 1e-3))


@pytest.mark.parametrize(
    "name", [*(n for n in model_names() if not n.startswith("A")), "user", None]
)
def test_gradients_of_every_model_agree(name):
    model = Coupled() if name == "user" else name and model_by_name(name)(2, v_smooth=0.5)
    assert_equal_gradients(CHAIN, model)


def test_gradients_of_a_single_link_agree():
    model = NFLFM(1, [2e-3, 1e-3], v_smooth=0.5, terms=(3, 2), head_units=3)
    plant = PendulumChain([0.3], [0.2])
    assert_equal_gradients(plant, model, q0=Q0[:, :1], qd0=QD0[:, :1])


@pytest.mark.parametrize("chunk", [1, 15, 10_000])
def test_gradients_do_not_depend_on_the_chunks(chunk, monkeypatch):
    monkeypatch.setitem(adjoint.CHUNK, "cpu", chunk)
    assert_equal_gradients(CHAIN, neurofuzzy())


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("substeps", [1, 3])
def test_gradients_agree_with_batches_substeps_and_irregular_stamps(batch, substeps):
    tau = (0.02 * random(STEPS, 2, seed=9)).requires_grad_()
    q0 = Q0[0] if not batch else Q0.expand(*batch, 2)
    qd0 = QD0[0] if not batch else QD0.expand(*batch, 2)
    stamps = 1e-3 * (1.0 + torch.arange(STEPS, dtype=F64) % 3)
    assert_equal_gradients(
        CHAIN, neurofuzzy(), q0=q0, qd0=qd0, tau=tau, sample_time=stamps, substeps=substeps,
        wanted=(tau,),
    )  # fmt: skip


@pytest.mark.parametrize("model", [neurofuzzy(), Coupled()])
def test_gradients_with_a_measured_drive_agree(model):
    measured = (random(STEPS, 2, seed=4), 10.0 * random(3, STEPS, 2, seed=5))
    assert_equal_gradients(CHAIN, model, drive="measured", measured=(
        measured[0].expand(3, -1, -1), measured[1]))  # fmt: skip


def test_gradients_of_plant_terms_agree():
    moment = CHAIN.gravity_moment.clone().requires_grad_()
    drag = torch.full((2,), 1e-3, dtype=F64, requires_grad=True)
    found, expected = (
        # A buffer that is itself computed passes its gradient on.
        gradients(
            CHAIN.replace(gravity_moment=1.1 * moment, drag_linear=drag), neurofuzzy(), backend,
            wanted=(moment, drag),
        )
        for backend in ("auto", "torch")
    )  # fmt: skip
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)


def test_models_with_external_tensors_are_recorded():
    """A tensor that no module owns is invisible to the adjoint pass, and must not be lost."""
    viscous = torch.tensor(2e-3, dtype=F64, requires_grad=True)

    class Reading(Coupled):
        def coefficients(self, qd: Tensor, qdd: Tensor) -> Tensor:
            return super().coefficients(qd, qdd) + viscous

    assert float(gradients(CHAIN, Reading(), "auto", wanted=(viscous,))[3].abs()) > 0
    assert_equal_gradients(CHAIN, Reading(), wanted=(viscous,))


def test_models_with_hidden_state_are_recorded():
    model = model_by_name("ALFM")(2, v_smooth=0.5)
    assert_equal_gradients(CHAIN, model)


def test_parameters_changed_after_the_forward_pass_are_refused():
    """Parameters that an optimiser has changed since are refused, not differentiated."""
    model = neurofuzzy()
    out = rollout(CHAIN, model, Q0, QD0, steps=3)
    with torch.no_grad():
        next(model.parameters()).add_(1.0)
    with pytest.raises(RuntimeError, match="inplace"):
        out.q.sum().backward()


@pytest.mark.parametrize("power", [1, 2])
def test_second_derivatives_are_refused(power):
    """Otherwise a linear loss would give a Hessian of zero, as its gradient has no graph."""
    q0 = Q0.clone().requires_grad_()
    out = rollout(CHAIN, neurofuzzy(), q0, QD0, steps=3)
    with pytest.raises(RuntimeError, match="first order only"):
        torch.autograd.grad((out.q**power).sum(), q0, create_graph=True)


def test_diverging_candidate_does_not_affect_other_gradients():
    q0, qd0 = Q0[:1].repeat(2, 1), QD0[:1].repeat(2, 1)
    tau = torch.zeros(2, STEPS, 2, dtype=F64)
    tau[1, 5:] = 1e12
    model = neurofuzzy()
    out = rollout(CHAIN, model, q0, qd0, tau, gradients=True)
    assert out.diverged.tolist() == [False, True]
    out.q[0].sum().backward()
    lone = neurofuzzy()
    rollout(CHAIN, lone, q0[:1], qd0[:1], steps=STEPS).q.sum().backward()
    for a, b in zip(model.parameters(), lone.parameters(), strict=True):
        torch.testing.assert_close(a.grad, b.grad, rtol=1e-9, atol=1e-15)


def test_each_step_costs_few_operations():
    """The reason for the adjoint pass: on small tensors the calls cost more than the arithmetic."""

    class Counter(TorchDispatchMode):
        count = 0

        def __torch_dispatch__(self, function, types, args=(), kwargs=None):
            Counter.count += 1
            return function(*args, **(kwargs or {}))

    def operations(backend: str, steps: int) -> int:
        Counter.count = 0
        with Counter():
            rollout(
                CHAIN, neurofuzzy(), Q0, QD0, steps=steps, gradients=True, backend=backend
            ).q.sum().backward()
        return Counter.count

    def growth(backend: str) -> int:
        return operations(backend, 12) - operations(backend, 6)

    assert growth("auto") < growth("torch") / 6
