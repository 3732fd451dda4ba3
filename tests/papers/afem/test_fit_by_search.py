"""Direct searches of the position error recover the true friction, stop and resume."""

import json
from dataclasses import asdict

import pytest
import torch

from nfriction import LFM, NCFM, NFLFM
from nfriction.fitting.data.windows import cut_windows
from nfriction.papers.afem.fit_adaptive import PositionError
from nfriction.papers.afem.fit_by_search import (
    Box,
    SearchOptions,
    SearchState,
    fit_by_search,
    search,
)
from nfriction.signals import kalman_smoother
from nfriction.simulation.protocols import RolloutInputs
from nfriction.simulation.rollout import integrate
from tests.fitting.recordings import F64, pendulum, swing

V_SMOOTH = 0.05
TRUTH = [[1.5e-3, 2.5e-3], [8e-4, 1.2e-3]]


@pytest.fixture(scope="module")
def recorded():
    # An encoder so fine that the initial state of every window is known and not searched.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tests.fitting.recordings.COUNTS", 2**22)
        recording = swing(pendulum(), LFM(2, TRUTH, v_smooth=V_SMOOTH), seconds=3.0)
    return recording, (kalman_smoother(recording.time, recording.q),)


def fitted(recorded, model, **settings):
    recording, motions = recorded
    callback = settings.pop("callback", None)
    options = SearchOptions(**{"horizon": 1.0, "threads": 1} | settings)
    return fit_by_search(
        model, pendulum(), recording, options=options, motions=motions, callback=callback
    )


@pytest.mark.parametrize("method", ["pattern", "sqp"])
def test_known_friction_is_recovered(recorded, method):
    found = fitted(recorded, LFM(2, v_smooth=V_SMOOTH), method=method, max_evaluations=1500)
    torch.testing.assert_close(
        found.model.schedule.values, torch.tensor(TRUTH, dtype=F64), rtol=0.02, atol=0
    )
    assert found.residual < 1e-4
    assert found.residual_unit == "rad"
    assert found.motions is not None


def test_a_free_run_is_one_window(recorded):
    model = NCFM(2, v_smooth=V_SMOOTH)
    found = fitted(recorded, model, method="sqp", horizon=None, max_evaluations=30)
    assert found.residuals.shape[0] == 1
    assert found.status.startswith(("Converged", "Not converged"))


def test_resumed_search_equals_the_uninterrupted_one(recorded):
    whole = fitted(recorded, LFM(2, v_smooth=V_SMOOTH), max_evaluations=150, seed=3)
    kept = []

    def stop(state: SearchState) -> bool:
        kept.append(json.dumps(asdict(state)))
        return len(kept) == 4

    part = fitted(recorded, LFM(2, v_smooth=V_SMOOTH), max_evaluations=150, seed=3, callback=stop)
    assert not part.converged
    state = SearchState(**json.loads(kept[-1]))
    rest = fitted(recorded, LFM(2, v_smooth=V_SMOOTH), max_evaluations=150, seed=3, state=state)
    assert torch.equal(rest.model.schedule.values, whole.model.schedule.values)


def test_candidates_of_a_batch_equal_single_simulations(recorded):
    """Each candidate, in each window, equals `integrate` with its coefficients."""
    recording, motions = recorded
    model, plant = LFM(2, v_smooth=V_SMOOTH), pendulum()
    cut = cut_windows([recording], motions, 1.0)
    error = PositionError(plant, model, cut, torch.eye(2, dtype=F64), substeps=2, threads=2)
    vectors = torch.tensor([[1e-3, 2e-3, 3e-3, 4e-3], [4e-3, 1e-3, 0.0, 1e-3]], dtype=F64)
    before = model.schedule.parameter_vector()
    found = sum(part.square().sum((1, 2)) for part in error.parts(vectors)) / error.values
    assert torch.equal(model.schedule.parameter_vector(), before)
    for vector, square in zip(vectors, found, strict=True):
        model.schedule.set_parameter_vector(vector)
        q = integrate(plant, model, RolloutInputs(cut.q0, cut.qd0, cut.tau, cut.step, substeps=2)).q
        expected = ((q - cut.q) * cut.weight[..., None]).square().sum() / error.values
        torch.testing.assert_close(square, expected, rtol=1e-9, atol=0)
        torch.testing.assert_close(error.residuals(vector).square().sum() / error.values, expected)


def box(**changes):
    three = {"start": [2.0, 0.5, 1.0], "lower": [0.0, 0.0, 1.0], "upper": [torch.inf, 5.0, 1.0],
             "scale": [1.0, 1.0, 1.0]} | changes  # fmt: skip
    tensors = {name: torch.tensor(value, dtype=F64) for name, value in three.items()}
    return Box(**tensors, logarithmic=torch.tensor([False, True, False]))


@pytest.mark.parametrize("method", ["pattern", "sqp"])
def test_bounds_fixed_and_logarithmic_variables_are_handled(method):
    def cost(x):
        # NaN if the first is large, like a simulation that diverges.
        value = (x[:, 0] + 1).square() + (x[:, 1] / 0.02).log().square() + x[:, 2]
        return torch.where(x[:, 0] > 3, torch.nan, value)

    result = search(cost, box(lower=[0.0, 1e-4, 1.0]), SearchOptions(method, tolerance=1e-6))
    assert result.converged
    torch.testing.assert_close(
        result.vector, torch.tensor([0.0, 0.02, 1.0], dtype=F64), rtol=1e-3, atol=1e-6
    )
    assert result.value == pytest.approx(float(cost(result.vector[None])))


def test_unsupported_searches_are_refused(recorded):
    with pytest.raises(ValueError, match="constant or adaptive"):
        fitted(recorded, NFLFM(2))
    with pytest.raises(ValueError, match="method"):
        fitted(recorded, LFM(2), method="simplex")
    state = SearchState("sqp", [1.0], 0.0, 1)
    with pytest.raises(ValueError, match="state"):
        search(lambda x: x.sum(1), box(lower=[0.0, 1e-4, 1.0]), SearchOptions(state=state))
