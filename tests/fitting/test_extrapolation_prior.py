"""Outside the recorded range, a network stays close to its constant law."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nfriction import NFLFM
from nfriction.fitting.data.windows import Windows
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.result.identifiability import CoefficientUncertainty, covariance_root
from nfriction.fitting.result.of_search import result_from_shooting
from nfriction.fitting.shooting.autocorrelation import bandwidth, hac_sd
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.shooting.uncertainty import gathered_information
from nfriction.fitting.strategy.extrapolation_prior import (
    ExtrapolationPrior,
    prior_on_unvisited_cells,
    visit_histogram,
)
from nfriction.signals import Motion
from nfriction.simulation.protocols import RolloutInputs
from nfriction.simulation.rollout import integrate
from tests.fitting.recordings import F64, pendulum, solve

FASTEST, STRONGEST = 5.0, 100.0
ANCHOR_SD = DEFAULTS.unvisited_sd


def network(size: float = 0.0) -> NFLFM:
    """A small network over known ranges, with random parameters from a fixed seed."""
    model = NFLFM(2, [4e-3, 2e-3], v_smooth=0.1, terms=(3, 3), head_units=2)
    model.schedule.set_range(FASTEST, [-STRONGEST, STRONGEST])
    vector = model.schedule.parameter_vector()
    g = torch.Generator().manual_seed(3)
    model.schedule.set_parameter_vector(size * torch.randn(vector.shape, generator=g, dtype=F64))
    return model


def swings(*sizes: float) -> Motion:
    """Harmonic swings with one amplitude per joint, as shares of the ranges; one arc of each."""
    phase = np.linspace(0.0, 2 * np.pi, 4000)
    qd = np.stack([FASTEST * size * np.sin(phase) for size in sizes], -1)
    qdd = np.stack([STRONGEST * size * np.cos(phase) for size in sizes], -1)
    return Motion(phase, qd, qd, qdd)


def test_coverage_by_small_swings_is_judged_for_each_joint():
    schedule = network().schedule
    motions = [swings(1.0, 0.1), swings(1.0, 0.5)]
    found = prior_on_unvisited_cells(schedule, motions)
    size = torch.hypot(found.qd / FASTEST, found.qdd / STRONGEST)
    assert found.weight[size[:, 0] < 0.75, 0].all()
    assert not found.weight[(size[:, 0] - 1).abs() < 0.05, 0].any()
    assert not found.weight[size[:, 1] < 0.15, 1].any()
    assert found.weight[size[:, 1] > 0.7, 1].all()
    assert (found.qd > 0).all()
    assert (found.qd < FASTEST).all()


def test_samples_outside_the_range_are_counted_at_its_edge():
    counts = visit_histogram(network().schedule, [swings(2.0, 0.5)], 10)
    assert counts.shape == (2, 10, 10)
    assert (counts.sum((1, 2)) == 4000).all()
    assert counts[0, -1].sum() > 2000
    assert not counts[1, 6:].any()


def test_normal_equations_match_the_derivatives_of_the_residuals():
    schedule = network(0.2).schedule
    prior = prior_on_unvisited_cells(schedule, [swings(1.0, 0.5)])
    at, columns = schedule.parameter_vector(), []
    r, (gradient, hessian) = prior.residuals(schedule), prior.normal_equations(schedule)
    for k in range(len(at)):
        unit = torch.zeros_like(at)
        unit[k] = 1e-5
        ends = []
        for sign in (-1, 1):
            schedule.set_parameter_vector(at + sign * unit)
            ends.append(prior.residuals(schedule))
        columns.append((ends[1] - ends[0]) / 2e-5)
    slope = torch.stack(columns, -1)
    torch.testing.assert_close(gradient, slope.T @ r, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(hessian, slope.T @ slope, rtol=1e-5, atol=1e-5)


def test_deviations_are_relative_to_the_scale():
    schedule = network().schedule
    prior = prior_on_unvisited_cells(schedule, [swings(1.0, 1.0)])
    torch.testing.assert_close(
        prior.residuals(schedule), torch.zeros_like(prior.residuals(schedule))
    )
    (bias,) = [p for n, p in schedule.named_parameters() if n.endswith("output_bias")]
    with torch.no_grad():
        bias.add_(ANCHOR_SD)
    found = prior.residuals(schedule).unflatten(0, (-1, 2, 2))
    # The coefficients' positive map rounds near zero; otherwise one deviation of ANCHOR_SD.
    torch.testing.assert_close(found[prior.weight > 0], torch.ones(1, dtype=F64).expand_as(
        found[prior.weight > 0]), rtol=0, atol=1e-3)  # fmt: skip
    assert not found[prior.weight == 0].any()


def problem(model: NFLFM, prior: ExtrapolationPrior | None) -> ShootingProblem:
    """Windows of large swings, simulated with another network."""
    g = torch.Generator().manual_seed(5)
    q0 = torch.tensor([[1.6, 0.5], [2.5, -0.4]], dtype=F64)
    qd0 = torch.tensor([[2.0, -3.0], [-1.0, 4.0]], dtype=F64)
    tau = 0.05 * torch.randn(2, 60, 2, generator=g, dtype=F64)
    step = torch.full((2, 60), 5e-3, dtype=F64)
    q = integrate(pendulum(), network(0.3), RolloutInputs(q0, qd0, tau, step)).q
    w = Windows(q, tau, step, torch.ones(2, 61, dtype=F64), q0, qd0)
    jacobian = StepJacobian(pendulum(), model, [])
    return ShootingProblem(jacobian, model, w, 1e-4, torch.eye(2, dtype=F64), extrapolation=prior)


@pytest.mark.parametrize("size", [0.0, 0.2])
def test_extrapolation_prior_is_part_of_the_cost_and_its_derivatives(size):
    model = network(size)
    prior = prior_on_unvisited_cells(model.schedule, [swings(1.0, 0.5)])
    free, tied = problem(model, None), problem(model, prior)
    x = free.variables.start()
    r, n = prior.residuals(model.schedule), tied.variables.friction_count
    slope, curvature = prior.normal_equations(model.schedule)
    torch.testing.assert_close(tied.cost(x) - free.cost(x), 0.5 * r.square().sum())
    a, b = free.linearise(x), tied.linearise(x)
    torch.testing.assert_close(b.gradient[:n] - a.gradient[:n], slope, rtol=1e-7, atol=1e-6)
    difference = b.hessian - a.hessian
    torch.testing.assert_close(difference[:n, :n], curvature, rtol=1e-7, atol=1e-4)
    assert not difference[n:].any()


def test_prior_reduces_deviations_outside_the_data():
    deviation = []
    for tied in (False, True):
        model = network()
        prior = prior_on_unvisited_cells(model.schedule, [swings(1.0, 1.0)])
        p = problem(model, prior if tied else None)
        result = solve(p, p.variables.start())
        model.schedule.set_parameter_vector(p.variables.split(result.x).friction)
        deviation.append(float(prior.residuals(model.schedule).square().mean().sqrt()))
        assert float(p.errors(result.x).abs().max()) < 1e-3
    assert deviation[1] < 0.5 * deviation[0]


def test_extrapolation_prior_is_not_counted_as_information():
    model = network()
    prior = prior_on_unvisited_cells(model.schedule, [swings(1.0, 1.0)])
    p = problem(model, prior)
    result = solve(p, p.variables.start(), max_steps=5)
    errors, n = p.errors(result.x), p.variables.friction_count
    where = (prior.weight > 0)[..., None].expand(-1, -1, 2)

    def openness(uncertainty: CoefficientUncertainty) -> torch.Tensor:
        return (uncertainty.sd(prior.qd, prior.qdd) / model.schedule.scale)[where]

    openness_of_fit = openness(result_from_shooting(model, p, result, ()).uncertainty)
    alone = result_from_shooting(model, problem(model, None), result, ())
    torch.testing.assert_close(openness_of_fit, openness(alone.uncertainty))
    # As if the prior were data.
    known = gathered_information(p, result.x, hac_sd(errors, bandwidth(p.windows.q)))
    known.data[:n, :n] += prior.normal_equations(model.schedule)[1]
    mistaken = openness(CoefficientUncertainty(model.schedule, covariance_root(known)[:n]))
    assert (openness_of_fit >= (1 - 1e-6) * mistaken).all()
    assert openness_of_fit.median() > 1.3 * mistaken.median()


@pytest.mark.parametrize(("prior_sd", "steps"), [(0.03, 20), (0.3, 1)])
def test_error_bars_include_a_tight_prior_and_an_early_stop(prior_sd, steps):
    model, truth = network(), network(0.3)
    start = torch.zeros_like(model.schedule.parameter_vector())
    tight = (start, torch.full_like(start, prior_sd))
    p = replace(problem(model, None), friction_prior=tight)
    run = p.simulate(p.variables.start()).motion
    found = result_from_shooting(model, p, solve(p, p.variables.start(), max_steps=steps), ())
    off = (model.schedule(run.qd, run.qdd) - truth.schedule(run.qd, run.qdd)).abs()
    bars = 1.96 * found.uncertainty.sd(run.qd, run.qdd)
    assert (off < bars).double().mean() > 0.9
