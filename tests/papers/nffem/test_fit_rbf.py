"""The papers' network fitted to trajectories, with and without jerk and snap as inputs."""

import numpy as np
import pytest
import torch

from nfriction import NCFM, Recording, Stribeck, fit, rollout
from nfriction.friction.neurofuzzy import NFNCFM
from nfriction.papers.nffem.rbf_coefficients import RBFCoefficients
from nfriction.plant import PendulumChain


def swing() -> tuple[PendulumChain, Recording]:
    """A pendulum with Stribeck friction, whose C_p falls with speed."""
    plant = PendulumChain(mass=[0.5], length=[0.4], com=[0.2], inertia=[0.01])
    truth = Stribeck(1, [0.02, 0.04, 0.002, 1.0, 2.0])
    start, rest = torch.tensor([[2.2], [0.0]], dtype=torch.float64)
    run = rollout(plant, truth, start, rest, sample_time=2e-3, steps=2000)
    return plant, Recording(time=run.time.numpy(), q=run.q.detach().numpy())


def test_a_network_with_jerk_beats_the_law_that_it_starts_from() -> None:
    plant, recording = swing()
    start = fit(NCFM(1), plant, [recording], windows=(0.5,), fit_plant=False, drag=False)
    model = NFNCFM(1, network="rbf", head_units=5, derivatives=1)
    found = fit(model, plant, [recording], windows=(0.5,), fit_plant=False, drag=False,
                start=start, max_steps=4)  # fmt: skip
    assert "rejected" not in found.status
    assert found.residual < 0.8 * start.residual
    # Set to the recording's rate, at which the filters of jerk and snap run.
    schedule = model.schedule
    assert isinstance(schedule, RBFCoefficients)
    assert schedule.step == pytest.approx(2e-3)
    # The coefficient that it learnt falls with speed, as the true one does.
    slow, fast = model.coefficients(
        torch.tensor([[1.0], [6.0]], dtype=torch.float64), torch.zeros(2, 1, dtype=torch.float64)
    )
    assert float(slow) > float(fast)
    assert np.isfinite(found.residuals.numpy()).all()
