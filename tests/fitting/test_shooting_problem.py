"""The quadratic model of a shooting problem matches the derivatives of its cost."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nfriction import LFM, NFLFM
from nfriction.fitting.data.windows import Windows
from nfriction.fitting.plant_parameters import plant_parameters
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian, _carry
from nfriction.signals import Motion
from nfriction.simulation.protocols import RolloutInputs
from nfriction.simulation.rollout import integrate
from tests.fitting.recordings import F64, pendulum, solve

ABSOLUTE = torch.tensor([[1.0, 0.0], [1.0, 1.0]], dtype=F64)


def windows(steps=20, step=2e-3) -> Windows:
    """Two windows with torque, the second of them shorter."""
    g = torch.Generator().manual_seed(5)
    q0 = torch.tensor([[1.6, 0.5], [2.5, -0.4]], dtype=F64)
    qd0 = torch.tensor([[2.0, -3.0], [-1.0, 4.0]], dtype=F64)
    tau = 0.05 * torch.randn(2, steps, 2, generator=g, dtype=F64)
    steps_ = torch.full((2, steps), step, dtype=F64)
    weight = torch.ones(2, steps + 1, dtype=F64)
    steps_[1, -4:], weight[1, -4:] = 0.0, 0.0
    truth = LFM(2, [[4e-3, 3e-3], [2e-3, 1e-3]], v_smooth=0.1)
    q = integrate(pendulum(), truth, RolloutInputs(q0, qd0, tau, steps_)).q
    spans = ((0, 0, steps), (1, 0, steps - 4))
    return Windows(q, tau, steps_, weight, q0, qd0, spans)


def problem(model, substeps=2, stride=1, **settings) -> ShootingProblem:
    plant = pendulum()
    terms = plant_parameters(plant, driven=(0, 1), largest_torque=0.1)
    jacobian = StepJacobian(plant, model, terms)
    return ShootingProblem(
        jacobian, model, windows(), 1e-3, ABSOLUTE, substeps, stride=stride, **settings
    )


def bent(name):
    """A model with coefficients different from the true ones, and a nonzero network."""
    if name == "LFM":
        return LFM(2, [5e-3, 2e-3], v_smooth=0.1)
    model = NFLFM(2, [5e-3, 2e-3], v_smooth=0.1, terms=(2, 2), head_units=2)
    model.schedule.set_range(5.0, [-300.0, 300.0])
    g = torch.Generator().manual_seed(1)
    vector = model.schedule.parameter_vector()
    model.schedule.set_parameter_vector(0.3 * torch.randn(vector.shape, generator=g, dtype=F64))
    return model


def point(p: ShootingProblem) -> torch.Tensor:
    """Unknowns away from the prior's means, and inside every bound."""
    g = torch.Generator().manual_seed(2)
    x = p.variables.start(torch.full((len(p.variables.terms),), 0.02, dtype=F64))
    x[p.variables.shared_count :] += 0.01 * torch.randn(
        x.numel() - p.variables.shared_count, generator=g, dtype=F64
    )
    return x


def residuals(p: ShootingProblem, x: torch.Tensor) -> torch.Tensor:
    """Weighted errors of the used samples, (window, step + 1, joint)."""
    return p.deviation(x, p.simulate(x)) * p.scale


def misfit(p: ShootingProblem, x: torch.Tensor) -> torch.Tensor:
    return residuals(p, x).flatten()


OFFSETS = torch.full((2, 2), 0.05, dtype=F64)


# Some cases have both, so that columns of a network and of offsets cannot be confused.
@pytest.mark.parametrize(
    ("name", "offset_sd"), [("LFM", None), ("LFM", OFFSETS), ("NFLFM", OFFSETS)]
)
@pytest.mark.parametrize(
    ("substeps", "stride"),
    [
        (1, 1),
        (2, 3),
        *(pytest.param(*x, marks=pytest.mark.slow) for x in ((1, 20), (2, 1), (1, 12))),
    ],
)
def test_gradient_and_hessian_equal_finite_differences(name, substeps, stride, offset_sd):
    """Also with decimation: 3 and 12 leave steps after the last sample that counts."""
    p = problem(bent(name), substeps, stride, offset_sd=offset_sd)
    x = point(p)
    found = p.linearise(x)
    torch.testing.assert_close(found.cost, p.cost(x))
    precision, mean = p.variables.prior()
    columns = []
    for i in range(x.numel()):
        unit = torch.zeros_like(x)
        # Fourth order: truncation and rounding are both far below the tolerance.
        unit[i] = 1e-4 * max(
            0.1 if i < p.variables.friction_count and name == "NFLFM" else 1e-3, float(x[i].abs())
        )
        ends = [misfit(p, x + s * unit) for s in (-2, -1, 1, 2)]
        columns.append((ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * unit[i]))
    jacobian, r = torch.stack(columns, -1), misfit(p, x)
    gradient = jacobian.T @ r + precision * (x - mean)
    hessian = jacobian.T @ jacobian + torch.diag(precision)
    # Entries differ by orders of magnitude: compared in units of the diagonal.
    scale = hessian.diagonal().clamp_min(1e-12).rsqrt()
    size = float((scale * gradient).abs().max())
    torch.testing.assert_close(scale * found.gradient, scale * gradient, rtol=0, atol=1e-6 * size)
    torch.testing.assert_close(
        scale[:, None] * found.hessian * scale, scale[:, None] * hessian * scale, rtol=0, atol=1e-6
    )


def test_decimated_samples_are_weighted_for_the_skipped_ones():
    """Every third sample counts, with the square root of three, or all of them with one."""
    every, third = problem(bent("LFM")), problem(bent("LFM"), stride=3)
    x = point(every)
    torch.testing.assert_close(residuals(every, x), every.errors(x) / every.noise_sd)
    expected = torch.zeros_like(residuals(every, x))
    expected[:, ::3] = 3**0.5 * residuals(every, x)[:, ::3]
    torch.testing.assert_close(residuals(third, x), expected)
    assert torch.equal(third.errors(x), every.errors(x))


@pytest.mark.parametrize("piece", [1, 7])
def test_result_does_not_depend_on_the_chunks(piece, monkeypatch):
    """However many samples are accumulated at a time, the model of the cost is the same."""
    p = problem(bent("NFLFM"), stride=3)
    whole = p.linearise(point(p))
    monkeypatch.setattr("nfriction.fitting.shooting.sensitivity.PIECE", piece)
    parts = p.linearise(point(p))
    torch.testing.assert_close(parts.gradient, whole.gradient, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(parts.hessian, whole.hessian, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", ["LFM", "NFLFM"])
def test_state_derivatives_alone_are_the_same(name):
    p = problem(bent(name), stride=3, offset_sd=OFFSETS)
    x, count = point(p), p.variables.shared_count
    whole, alone = p.linearise(x), p.linearise(x, states=True)
    assert float(alone.cost) == float(whole.cost)
    torch.testing.assert_close(alone.gradient, whole.gradient[count:], rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(alone.hessian, whole.hessian[count:, count:], rtol=1e-11, atol=1e-9)


def test_padding_has_no_effect():
    p = problem(bent("LFM"))
    x = point(p)
    before = p.linearise(x)
    p.windows.q[1, -4:] += 100.0
    after = p.linearise(x)
    assert torch.equal(before.gradient, after.gradient)
    assert float(before.cost) == float(after.cost)


def test_residuals_are_in_the_coordinates_of_the_recording():
    p = problem(bent("LFM"))
    x = p.variables.start()
    joint = replace(p, measurement=torch.eye(2, dtype=F64))
    r, own = residuals(p, x), residuals(joint, x)
    torch.testing.assert_close(r[..., 0], own[..., 0])
    torch.testing.assert_close(r[..., 1], own[..., 0] + own[..., 1])


def test_noise_free_problem_is_solved_exactly():
    """With noise-free positions the true coefficients result, and the given model is unchanged."""
    model = LFM(2, [2e-3, 2e-3], v_smooth=0.1)
    before, plant = model.schedule.values, pendulum()
    w = windows(steps=60, step=5e-3)
    p = ShootingProblem(StepJacobian(plant, model, []), model, w, 1e-7, ABSOLUTE)
    result = solve(p, p.variables.start(), cost_tolerance=1e-14)
    assert result.converged
    truth = torch.tensor([[4e-3, 3e-3], [2e-3, 1e-3]], dtype=F64)
    found = p.variables.split(result.x).friction.reshape(2, 2)
    torch.testing.assert_close(found, truth, rtol=1e-4, atol=0)
    assert torch.equal(model.schedule.values, before)


def test_prior_mean_of_the_plant_may_be_set():
    p = problem(bent("LFM"))
    mean = torch.full((len(p.variables.terms),), 0.03, dtype=F64)
    sd = torch.tensor([t.prior_sd for t in p.variables.terms], dtype=F64)
    moved = replace(p, plant_prior=(mean, sd))
    x = p.variables.start(mean)
    prior = 0.5 * float(((mean / sd) ** 2).sum())
    assert float(p.cost(x) - moved.cost(x)) == pytest.approx(prior)


def test_initial_states_at_rest_are_fixed_and_others_free():
    p = problem(bent("LFM"))
    free, mean = p.variables.prior()
    p = replace(p, windows=replace(p.windows, at_rest=(1,)))
    held, same = p.variables.prior()
    first = p.variables.shared_count
    torch.testing.assert_close(
        held[first + 4 :].rsqrt(), torch.tensor([1e-4, 1e-4, 1e-3, 1e-3], dtype=F64)
    )
    assert torch.equal(held[: first + 4], free[: first + 4])
    assert torch.equal(same, mean)


def test_simulated_motions_replace_smoothed_ones_inside_windows():
    """Longer windows start from it; samples outside every window keep the smoother's state."""
    w = windows()
    w = replace(w, spans=((0, 0, 20), (0, 20, 36)))
    model, plant = bent("LFM"), pendulum()
    p = ShootingProblem(StepJacobian(plant, model, []), model, w, 1e-3, ABSOLUTE, substeps=2)
    x, zero = point(p), np.zeros((40, 2))
    before = Motion(np.arange(40.0), zero, zero, zero)
    (after,) = p.simulated_motions(x, [before])
    state = p.variables.split(x).states.numpy()
    for window, sample in ((0, 0), (1, 20)):
        np.testing.assert_allclose(after.q[sample], state[window, :2], rtol=0, atol=1e-12)
        np.testing.assert_allclose(after.qd[sample], state[window, 2:], rtol=0, atol=1e-12)
    error = (residuals(p, x)[1, 16] * p.noise_sd).numpy() @ np.linalg.inv(ABSOLUTE.numpy()).T
    np.testing.assert_allclose(after.q[36], w.q[1, 16].numpy() + error, rtol=0, atol=1e-12)
    assert not after.q[37:].any()
    assert not before.q.any()


@pytest.mark.parametrize("offset_sd", [None, torch.full((2, 2), 0.05, dtype=torch.float64)])
def test_states_are_declared_blocks_only_if_independent(offset_sd):
    p = problem(bent("LFM"), offset_sd=offset_sd)
    found = p.linearise(point(p))
    first, count = p.variables.shared_count, 2 * p.windows.q0.shape[-1]
    across = found.hessian[first : first + count, first + count :]
    assert (found.blocks is None) == bool(across.any() or offset_sd is not None)
    if found.blocks is not None:
        assert found.blocks == (first, count)


@pytest.mark.filterwarnings("error")
def test_overflow_of_derivatives_is_passed_to_the_search():
    maps = [torch.full((4, 1, 3, n), 1e200, dtype=F64) for n in (3, 1)]
    _, after = _carry(*maps, torch.ones(1, 3, 2, dtype=F64), 2)
    assert not torch.isfinite(after).any()
