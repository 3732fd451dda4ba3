"""The papers' network fitted to trajectories, with and without jerk and snap as inputs."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from nfriction import NCFM, PendulumChain, Recording, Stribeck, fit, rollout
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.shooting.uncertainty import integration_error
from nfriction.friction.neurofuzzy import NFLFM, NFNCFM
from nfriction.papers.nffem.fit_rbf import place_units
from nfriction.papers.nffem.rbf_coefficients import RBFCoefficients
from nfriction.signals import Motion
from tests.fitting.recordings import F64, pendulum
from tests.fitting.test_shooting_problem import ABSOLUTE, windows

Case = tuple[PendulumChain, Recording, FitResult]


@pytest.fixture(scope="module")
def case() -> Case:
    """A pendulum with Stribeck friction, whose C_p falls with speed, and the fit of its C_p."""
    plant = PendulumChain(mass=[0.5], length=[0.4], com=[0.2], inertia=[0.01])
    truth = Stribeck(1, [0.02, 0.04, 0.002, 1.0, 2.0])
    start, rest = torch.tensor([[2.2], [0.0]], dtype=torch.float64)
    run = rollout(plant, truth, start, rest, sample_time=2e-3, steps=2000)
    swing = Recording(time=run.time.numpy(), q=run.q.detach().numpy())
    law = fit(NCFM(1), plant, [swing], windows=(0.5,), fit_plant=False, drag=False)
    return plant, swing, law


def network(case: Case, max_steps: int) -> FitResult:
    """A network of velocity, acceleration and jerk, from the fit of its law."""
    plant, swing, law = case
    model = NFNCFM(1, network="rbf", head_units=5, derivatives=1)
    return fit(model, plant, [swing], windows=(0.5,), fit_plant=False, drag=False, start=law,
               max_steps=max_steps)  # fmt: skip


def test_network_with_jerk_beats_its_initial_law(case: Case) -> None:
    found = network(case, 4)
    assert "rejected" not in found.status
    assert found.residual < 0.8 * case[2].residual
    # Set to the recording's sample rate, at which the filters of jerk and snap run.
    schedule = found.model.schedule
    assert isinstance(schedule, RBFCoefficients)
    assert schedule.step == pytest.approx(2e-3)
    # The learnt coefficient falls with speed, as the true one does.
    slow, fast = found.model.coefficients(
        torch.tensor([[1.0], [6.0]], dtype=torch.float64), torch.zeros(2, 1, dtype=torch.float64)
    )
    assert float(slow) > float(fast)
    assert np.isfinite(found.residuals.numpy()).all()


@pytest.mark.parametrize("lost", ["hold-out", "long windows"])
def test_network_without_improvement_is_replaced_by_its_law(
    case: Case, lost: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nfriction.papers.nffem.fit_rbf.improves", lambda *_: lost != "hold-out")
    monkeypatch.setattr(
        "nfriction.papers.nffem.fit_rbf.Validation.lost_over_long_windows",
        lambda *_: "Network rejected: kept.",
    )
    found = network(case, 1)
    assert "Network rejected" in found.status
    qd = torch.tensor([[1.0], [6.0]], dtype=torch.float64)
    torch.testing.assert_close(
        found.model.coefficients(qd, 0 * qd), case[2].model.coefficients(qd, 0 * qd).expand(2, 1, 1)
    )
    assert found.model.schedule.step == pytest.approx(2e-3)


def test_gradient_with_hidden_state_equals_the_cost_derivative() -> None:
    w = windows()
    model = NFLFM(2, v_smooth=0.1, network="rbf", head_units=4, derivatives=1, sample_time=2e-3)
    schedule = model.requires_grad_(False).schedule
    assert isinstance(schedule, RBFCoefficients)
    g = torch.Generator().manual_seed(0)
    qd, qdd = torch.randn(2, 300, 2, generator=g, dtype=F64)
    qd, qdd = 6.0 * qd, 60.0 * qdd
    values = torch.tensor([[4e-3, 3e-3], [2e-3, 1.5e-3]], dtype=F64)
    motion = Motion(1e-3 * np.arange(len(qd)), qd.numpy(), qd.numpy(), qdd.numpy())
    place_units(schedule, values, values, [motion])
    p = ShootingProblem(StepJacobian(pendulum(), model, []), model, w, 1e-3, ABSOLUTE, stride=4)
    x, count = p.variables.start(), p.variables.friction_count
    x[:count] += 3e-4 * torch.randn(count, generator=g, dtype=F64)
    local = p.linearise(x)
    assert float(local.cost) == pytest.approx(float(p.cost(x)))
    along = torch.zeros_like(x)
    along[:count] = torch.randn(count, generator=g, dtype=F64)
    slope = float(p.cost(x + 1e-7 * along) - p.cost(x - 1e-7 * along)) / 2e-7
    # Derivatives treat the hidden state as fixed, although it depends on the motion.
    assert float(local.gradient @ along) == pytest.approx(slope, rel=0.01)
    # Finer steps would advance it sooner, which is no error of the integration.
    assert not integration_error(p, SimpleNamespace(x=x, hessian=local.hessian)).any()  # type: ignore[arg-type]
