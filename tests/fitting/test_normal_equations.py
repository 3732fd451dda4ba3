"""Information in windows survives any growth of their states, and round-off adds none."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import torch

from nfriction import LFM
from nfriction.fitting.data.inputs import adjustable_terms, measurement_matrix
from nfriction.fitting.data.windows import cut_windows
from nfriction.fitting.options import FitOptions
from nfriction.fitting.result.identifiability import (
    Information,
    information,
    null_directions,
    standard_deviations,
)
from nfriction.fitting.result.of_search import result_from_shooting
from nfriction.fitting.shooting.normal_equations import (
    Kept,
    drawn_score,
    marginalize_states,
    normal_equations,
    score_covariance,
)
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.shooting.uncertainty import gathered_information
from nfriction.fitting.strategy.continuation import ShootingFitter
from nfriction.signals import kalman_smoother
from tests.fitting.recordings import F64, pendulum, solve, swing

NAMES = tuple("abcdefghij")
# Unknowns of two joints' states, and some that windows share.
STATE, SHARED = 4, 6


def swings(seconds, length, friction, start, recordings=1, **settings):
    """Estimation of the law and the plant that generated the swings, and windows of these."""
    law = LFM(2, friction, v_smooth=0.05)
    plant = pendulum()
    made = [
        swing(plant, law, seconds=seconds, start=(q + 0.1 * k, qd))
        for k, (q, qd) in enumerate([start] * recordings)
    ]
    motions = [kalman_smoother(r.time, r.q) for r in made]
    each = settings.get("offset_sd") is not None
    options = FitOptions(drag=False)
    terms = adjustable_terms(plant, LFM(2).law, made, options, per_recording=each)
    measurement = measurement_matrix(plant, made[0].resolve_convention(plant))
    jacobian = StepJacobian(plant, law, terms)
    search = ShootingFitter(jacobian, law, made, measurement, options, **settings)
    return search, cut_windows(made, motions, length)


def regular_problem(stride=1, **settings) -> ShootingProblem:
    friction = [[2e-3, 3e-3], [1e-3, 2e-3]]
    search, windows = swings(0.6, 0.2, friction, (1.6, 0.8), recordings=2, **settings)
    start = search.friction.schedule.parameter_vector()
    return search.problem(windows, 2e-4, start, stride=stride)


def error_sizes(p: ShootingProblem) -> torch.Tensor:
    g = torch.Generator().manual_seed(4)
    return 2e-4 * (0.5 + torch.rand(p.windows.q.shape, generator=g, dtype=F64))


def information_from_squares(p: ShootingProblem, x: torch.Tensor, sd: torch.Tensor) -> Information:
    """Normal equations of all unknowns, and those with the states marginalised."""
    rows = p.rows(p.simulate(x), p.scale * sd / p.noise_sd)
    covariance = normal_equations(rows, torch.zeros_like(sd), p.variables.indices(), len(x))[1]
    hessian = p.linearise(x).hessian
    return information(hessian, p.variables.prior()[0], p.variables.shared_count, covariance)


@pytest.mark.parametrize("offset_sd", [None, torch.full((2, 2), 0.05, dtype=F64)])
@pytest.mark.parametrize("stride", [1, 3])
def test_rows_and_squares_agree_in_regular_motion(stride, offset_sd):
    p = regular_problem(stride, offset_sd=offset_sd)
    assert len(p.windows) == 6
    x, sd = p.variables.start(), error_sizes(p)
    found, expected = gathered_information(p, x, sd), information_from_squares(p, x, sd)
    torch.testing.assert_close(found.prior, expected.prior)
    for name in ("data", "score"):
        one, other = getattr(found, name), getattr(expected, name)
        # Entries differ by orders of magnitude: compared in units of the diagonal.
        scale = other.diagonal().clamp_min(1e-12).rsqrt()
        one, other = (scale[:, None] * matrix * scale for matrix in (one, other))
        torch.testing.assert_close(one, other, rtol=0, atol=1e-6)


@pytest.mark.parametrize("piece", [1, 50])
def test_result_does_not_depend_on_the_chunks(piece, monkeypatch):
    p = regular_problem(offset_sd=torch.full((2, 2), 0.05, dtype=F64))
    x, sd = p.variables.start(), error_sizes(p)
    whole = gathered_information(p, x, sd)
    monkeypatch.setattr("nfriction.fitting.shooting.sensitivity.PIECE", piece)
    parts = gathered_information(p, x, sd)
    torch.testing.assert_close(parts.data, whole.data, rtol=1e-8, atol=1e-3)
    torch.testing.assert_close(parts.score, whole.score, rtol=1e-8, atol=1e-3)


def window_with_growing_states(growth, factor, seed=0):
    """A window whose rows, without its state, have the triangular `factor`; both grow together.

    Returns:
        Information about shared unknowns from its rows, and from their squares.
    """
    g = torch.Generator().manual_seed(seed)
    shared, size = len(factor), len(factor) + STATE
    turn = torch.linalg.qr(torch.randn(300, size, generator=g, dtype=F64)).Q
    states, others = growth * torch.randn(2, STATE, size, generator=g, dtype=F64)
    own, free = turn[:, :STATE], turn[:, STATE:]
    common = own @ others[:, :shared] + free @ factor
    jacobian = torch.cat([common, own @ states[:, :STATE]], 1)
    # Prior of the states so weak that it adds no information about shared unknowns.
    precision = torch.full((size,), 1e-12, dtype=F64)
    precision[:shared] = 0.0
    kept = Kept(torch.arange(shared, size)[None], STATE, size)
    pieces = [(slice(None), part[None]) for part in jacobian.split(60)]
    data, _ = marginalize_states(pieces, kept, precision[None, shared:])
    hessian = jacobian.T @ jacobian + torch.diag(precision)
    return Information(data, precision[:shared]), information(hessian, precision, shared)


def triangle(seed):
    g = torch.Generator().manual_seed(100 + seed)
    return 1e3 * torch.randn(SHARED, SHARED, generator=g, dtype=F64)


@pytest.mark.parametrize("seed", range(4))
def test_information_survives_growing_states(seed):
    factor = triangle(seed)
    rows, squares = window_with_growing_states(1e12, factor, seed)
    assert null_directions(NAMES, rows) == ()
    # In units of the diagonal; rows are rounded to 1e-4 relative to information of 1e3.
    scale = (factor.T @ factor).diagonal().rsqrt()
    difference = scale[:, None] * (rows.data - factor.T @ factor) * scale
    assert float(difference.abs().max()) < 1e-3
    # Their squares are rounded to 1e8 relative to information of 1e6.
    assert null_directions(NAMES, squares) != ()


def test_growing_states_add_no_spurious_information():
    wrong = 0
    for seed in range(10):
        factor = triangle(seed)
        factor[:, 1] = 2 * factor[:, 0]
        rows, squares = window_with_growing_states(1e12, factor, seed)
        (direction,) = null_directions(NAMES, rows)
        assert set(direction.split(" with ")) == {"a", "b"}
        blind = 0 * factor
        blind[:, 1:] = triangle(seed)[:, 1:]
        rows, squares = window_with_growing_states(1e12, blind, seed)
        assert null_directions(NAMES, rows) == ("a",)
        wrong += float(squares.data[0, 0]) > 1e6
    # Of the round-off of large squares about half is positive.
    assert wrong


@pytest.mark.parametrize("growth", [1e20, 1e25])
def test_round_off_of_rows_adds_no_information(growth):
    """Beyond the precision of rows, all information is lost, and round-off is not taken for any."""
    rows, _ = window_with_growing_states(growth, triangle(0))
    directions = " with ".join(null_directions(NAMES, rows))
    assert set(directions.split(" with ")) == set(NAMES[:SHARED])


@pytest.mark.parametrize("growth", [1e16, 4e16, 1e17])
def test_lost_directions_do_not_make_others_overconfident(growth):
    """At the limit of precision some directions are lost; the others are estimated with these
    open."""
    kept = too_sure = 0
    for seed in range(60):
        factor = triangle(seed)
        rows, _ = window_with_growing_states(growth, factor, seed)
        exact = standard_deviations(Information(factor.T @ factor, torch.zeros(SHARED, dtype=F64)))
        share = standard_deviations(rows) / exact
        kept += int(share.isfinite().sum())
        too_sure += int((share < 0.9).sum())
    assert kept
    assert too_sure <= 0.1 * kept  # two in three, if what is lost were taken as known


def in_whole_numbers(rows: np.ndarray, shared: int, precision: list[float]) -> np.ndarray:
    """Curvature with the last columns marginalised, in exact integer arithmetic."""
    digits = 200
    whole = np.vectorize(lambda v: int(Fraction(v) * 2**digits), otypes=[object])(rows)
    square = np.vectorize(Fraction, otypes=[object])(whole.T @ whole)
    for i, p in enumerate(precision):
        square[shared + i, shared + i] += Fraction(p) * 4**digits
    for k in range(len(square) - 1, shared - 1, -1):
        square = square[:k, :k] - np.outer(square[:k, k], square[k, :k]) / square[k, k]
    return np.vectorize(lambda v: float(v / 4**digits))(square)


@pytest.mark.filterwarnings("ignore:.*looks like degrees")
def test_chaotic_window_keeps_its_information():
    """A free swing from upright, whose end moves 1e12 times as far as its start."""
    search, windows = swings(4.0, 4.0, [[3e-4, 6e-4], [3e-4, 3e-4]], (0.02, 0.01))
    start = search.friction.schedule.parameter_vector()
    p = search.problem(windows, 2e-4, start)
    x, count = p.variables.start(), p.variables.shared_count
    g = torch.Generator().manual_seed(0)
    noise = 2e-4 * torch.randn(windows.q.shape, generator=g, dtype=F64)
    # As if measured from exactly the start that its smoother estimated.
    p = search.problem(
        replace(windows, q=windows.q + p.errors(x) @ search.measurement.inverse().T + noise),
        2e-4, start,
    )  # fmt: skip
    result, errors = solve(p, x, max_steps=0), p.errors(x)
    assert float(result.hessian.max()) > 1e24
    moved = tuple(kalman_smoother(r.time, r.q) for r in search.recordings)
    assert result_from_shooting(p.friction, p, result, moved).unidentifiable == ()
    rows = torch.cat([scaled for _, scaled in p.rows(p.simulate(x), p.scale)], 1)[0]
    exact = in_whole_numbers(rows.numpy(), count, p.variables.prior()[0][count:].tolist())
    lower, upper = p.variables.bounds()
    fitted = (lower < upper)[:count]
    index = fitted.nonzero().flatten()
    sd = torch.full_like(errors, p.noise_sd)
    gathered = gathered_information(p, x, sd).subset(index)
    squares = information_from_squares(p, x, sd).subset(index)
    expected = torch.as_tensor(exact)[fitted][:, fitted]
    scale = expected.diagonal().rsqrt()

    def error(known: Information) -> float:
        return float((scale[:, None] * (known.data - expected) * scale).abs().max())

    assert error(gathered) < 1e-3
    assert error(squares) > 0.1


def test_sampled_errors_give_the_covariance_of_the_gradient() -> None:
    """That of independent errors, and twice that if those of two windows are the same."""
    generator = torch.Generator().manual_seed(0)
    one = torch.randn(1, 60, 5, generator=generator, dtype=F64)
    rows = one.expand(2, -1, -1)
    kept = Kept(torch.tensor([[3, 4], [5, 6]]), 2, 7)
    precision = torch.full((2, 2), 1e-9, dtype=F64)
    _, response = marginalize_states([(slice(None), rows)], kept, precision)

    def drawn(errors: torch.Tensor) -> torch.Tensor:
        return drawn_score([(slice(None), rows)], kept, response, errors[..., None, :])

    expected = score_covariance([(slice(None), rows)], kept, response, precision)
    errors = torch.randn(2, 60, 4000, generator=generator, dtype=F64)
    scale = expected.diagonal().sqrt()
    apart = (drawn(errors) - expected) / (scale[:, None] * scale)
    assert float(apart.abs().max()) < 0.1
    torch.testing.assert_close(drawn(errors[:1].expand(2, -1, -1)).diagonal() / scale.square(),
                               torch.full((3,), 2.0, dtype=F64), rtol=0.1, atol=0)  # fmt: skip
