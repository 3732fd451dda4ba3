"""The Gauss-Laplace posterior against closed forms of linear regression."""

import math

import torch
from torch import Tensor

from nfriction.papers.nffem.evidence import Posterior, posterior, reestimate
from nfriction.papers.nffem.jacobian import NormalEquations
from tests.papers.nffem.networks import F64, noise

N, GROUPS = 30, torch.tensor([0, 0, 1, 1, 1])


def problem() -> tuple[Tensor, Tensor, Tensor]:
    return noise(0, N, 5), noise(1, N), noise(2, 5)


def equations(X: Tensor, y: Tensor, w: Tensor) -> NormalEquations:
    e = X @ w - y
    return NormalEquations(X.T @ X, X.T @ e, e @ e)


def known_at(local: NormalEquations, offset: Tensor, alpha: Tensor, beta: float) -> Posterior:
    return posterior(local, offset, GROUPS, N, alpha, beta)


def closed_form(X: Tensor, y: Tensor, w0: Tensor, alpha: Tensor, beta: float) -> float:
    """log N(y; X w0, X diag(1 / 2 alpha) X^T + 1 / (2 beta))."""
    spread = X @ (0.5 / alpha[GROUPS]).diag() @ X.T + torch.eye(N, dtype=F64) / (2 * beta)
    return float(torch.distributions.MultivariateNormal(X @ w0, spread).log_prob(y))


def mode(X: Tensor, y: Tensor, w0: Tensor, alpha: Tensor, beta: float) -> Tensor:
    system = beta * X.T @ X + alpha[GROUPS].diag()
    return w0 + torch.linalg.solve(system, beta * X.T @ (y - X @ w0))


def test_log_evidence_of_linear_regression_is_exact() -> None:
    X, y, w0 = problem()
    for alpha, beta in (([0.3, 2.0], 1.7), ([1e-4, 50.0], 0.01), ([1e3, 1e-3], 300.0)):
        precision = torch.tensor(alpha, dtype=F64)
        w = mode(X, y, w0, precision, beta)
        known = known_at(equations(X, y, w), w - w0, precision, beta)
        exact = closed_form(X, y, w0, precision, beta)
        assert abs(known.log_evidence - exact) < 1e-10 * max(1, abs(exact))
        assert known.newton_decrement < 1e-20 * N


def test_gamma_and_covariance_equal_their_definitions() -> None:
    X, y, w0 = problem()
    alpha, beta = torch.tensor([0.3, 2.0], dtype=F64), 1.7
    w = mode(X, y, w0, alpha, beta)
    known = known_at(equations(X, y, w), w - w0, alpha, beta)
    inverse = torch.linalg.inv(beta * X.T @ X + alpha[GROUPS].diag())
    torch.testing.assert_close(known.covariance, inverse / 2, rtol=1e-11, atol=1e-15)
    for group, size in ((0, 2), (1, 3)):
        shrunk = alpha[group] * inverse.diagonal()[group == GROUPS].sum()
        torch.testing.assert_close(known.gamma[group], size - shrunk, rtol=1e-11, atol=0)


def test_identities_hold_at_the_stationary_point_of_the_evidence() -> None:
    X, _, w0 = problem()
    y = X @ (w0 + torch.tensor([1.0, -1.0, 0.2, 0.1, -0.3])) + 0.2 * noise(3, N)
    alpha, beta = torch.ones(2, dtype=F64), 1.0
    for _ in range(300):
        w = mode(X, y, w0, alpha, beta)
        local = equations(X, y, w)
        known = known_at(local, w - w0, alpha, beta)
        alpha, beta = reestimate(known, local, GROUPS, N, alpha)
    best = closed_form(X, y, w0, alpha, beta)
    for factor in (0.9, 1.1):
        assert closed_form(X, y, w0, alpha * torch.tensor([factor, 1]), beta) < best
        assert closed_form(X, y, w0, alpha * torch.tensor([1, factor]), beta) < best
        assert closed_form(X, y, w0, alpha, beta * factor) < best


def test_newton_decrement_is_the_gain_of_a_full_step() -> None:
    X, y, w0 = problem()
    alpha, beta = torch.tensor([0.3, 2.0], dtype=F64), 1.7
    w = w0 + 0.3

    def objective(v: Tensor) -> float:
        return float(beta * (X @ v - y).square().sum() + alpha[GROUPS] @ (v - w0).square())

    gain = objective(w) - objective(mode(X, y, w0, alpha, beta))
    known = known_at(equations(X, y, w), w - w0, alpha, beta)
    assert math.isclose(known.newton_decrement, gain, rel_tol=1e-11)


def test_effective_parameters_range_from_none_to_all() -> None:
    X, y, w0 = problem()
    local = equations(X, y, w0)
    strong = known_at(local, 0.0 * w0, torch.full((2,), 1e30, dtype=F64), 1.0)
    weak = known_at(local, 0.0 * w0, torch.full((2,), 1e-12, dtype=F64), 1.0)
    assert 0 <= float(strong.gamma.sum()) < 1e-25  # no rounding of 5 - 5 in it
    torch.testing.assert_close(weak.gamma, torch.tensor([2, 3], dtype=F64), rtol=1e-10, atol=0)


def test_singular_data_are_regularised_by_the_prior() -> None:
    X, y, w0 = problem()
    X[:, 4] = X[:, 3]
    local = equations(X, y, w0)
    known = known_at(local, 0.0 * w0, torch.full((2,), 1e-6, dtype=F64), 1.0)
    assert math.isclose(float(known.gamma.sum()), 4, rel_tol=1e-5)
    assert math.isfinite(known.log_evidence)
