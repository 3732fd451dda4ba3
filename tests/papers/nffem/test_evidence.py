"""Properties of Bayesian regularisation."""

import copy
import math

import pytest
import torch
from torch import Tensor, nn

from nfriction.papers.nffem.evidence import (
    EvidenceOptions,
    EvidenceResult,
    bayesian_regularisation,
)
from nfriction.papers.nffem.jacobian import flatten, jacobian_pieces, trainable
from tests.papers.nffem.networks import F64, Linear, RadialBasis, Tanh, noise, triangle_wave


def one(_name: str) -> str:
    return "all"


def regression(seed: int, n: int = 60) -> tuple[Tensor, Tensor]:
    """Three strong and eight weak coefficients."""
    X = noise(seed, n, 11)
    truth = torch.cat([3 * noise(seed + 1, 3), 0.03 * noise(seed + 2, 8)])
    return X, X @ truth + 0.3 * noise(seed + 3, n)


def predictive_std(fit: EvidenceResult, model: nn.Module, x: Tensor, noise: bool = True) -> Tensor:
    """Standard deviation of a model's output by the covariance and, optionally, the noise."""
    rows = torch.cat([J for _, _, (J,) in jacobian_pieces(model, x)])
    return (((rows @ fit.covariance) * rows).sum(1) + noise * 0.5 / fit.beta).sqrt()


def test_identities_hold_at_convergence() -> None:
    x, y = triangle_wave(0)
    fit = bayesian_regularisation(
        Tanh(3, seed=1), x, y, options=EvidenceOptions(tolerance=1e-7, max_steps=2000)
    )
    assert fit.converged
    for group, alpha in fit.alpha.items():
        shrinkage = 2 * alpha * fit.parameter_squares[group]
        assert abs(fit.gamma[group] - shrinkage) <= 1e-7 * max(1, fit.gamma[group])
    # A group that the data do not need is switched off; the identity is relative in the others.
    needed = [group for group, gamma in fit.gamma.items() if gamma > 0.1]
    assert len(needed) >= 3
    for group in needed:
        alpha = fit.gamma[group] / (2 * fit.parameter_squares[group])
        assert math.isclose(fit.alpha[group], alpha, rel_tol=1e-6)
    unexplained = fit.samples - sum(fit.gamma.values())
    assert math.isclose(fit.beta, unexplained / (2 * fit.error_squares), rel_tol=2e-7)


@pytest.mark.slow
def test_effective_parameters_saturate_as_units_are_added() -> None:
    # Foresee and Hagan's first example: gamma stays near 8.7 from four units on, while the
    # parameters grow from 13 to 31. The noise of a data set changes it by about one.
    x, y = triangle_wave(0)
    gamma, evidence = {}, {}
    for units in (1, 2, 3, 4, 6, 10):
        fits = [
            bayesian_regularisation(
                Tanh(units, seed), x, y, kind=one, options=EvidenceOptions(max_steps=150)
            )
            for seed in range(3)
        ]
        best = max(fits, key=lambda fit: fit.log_evidence)
        gamma[units], evidence[units] = sum(best.gamma.values()), best.log_evidence
    assert gamma[1] < 4.1
    assert gamma[2] < 7
    for units in (4, 6, 10):
        assert abs(gamma[units] - 8.7) < 1.2
    # The evidence shows that one and two units are too few, and stays high for more.
    assert evidence[1] < evidence[2] - 20 < evidence[3] - 20
    assert max(evidence[n] for n in (4, 6, 10)) - min(evidence[n] for n in (4, 6, 10)) < 6


def test_linear_regression_reaches_the_closed_form_maximum() -> None:
    X, y = regression(0)
    prior = {"a": 0.2, "b": 0.01 * noise(8, 8)}
    fit = bayesian_regularisation(
        Linear(3, 8), X, y, prior=prior, options=EvidenceOptions(tolerance=1e-9)
    )
    assert fit.converged
    centre = torch.cat([torch.full((3,), 0.2, dtype=F64), prior["b"]])

    def closed(alpha: dict[str, float], beta: float) -> float:
        variance = torch.tensor([0.5 / alpha["a"]] * 3 + [0.5 / alpha["b"]] * 8, dtype=F64)
        spread = X @ variance.diag() @ X.T + 0.5 / beta * torch.eye(60, dtype=F64)
        return float(torch.distributions.MultivariateNormal(X @ centre, spread).log_prob(y))

    best = closed(fit.alpha, fit.beta)
    assert abs(fit.log_evidence - best) < 1e-10 * abs(best)
    for factor in (0.95, 1.05):
        assert closed(fit.alpha, fit.beta * factor) < best
        for group in fit.alpha:
            assert closed({**fit.alpha, group: fit.alpha[group] * factor}, fit.beta) < best


@pytest.mark.slow
def test_separate_alpha_for_strong_weights_beats_a_single_alpha() -> None:
    gain, error = 0.0, {"one": 0.0, "two": 0.0}
    for seed in range(0, 100, 10):
        X, y = regression(seed, n=20)
        truth = torch.cat([3 * noise(seed + 1, 3), 0.03 * noise(seed + 2, 8)])
        single = bayesian_regularisation(Linear(3, 8), X, y, kind=one)
        two = bayesian_regularisation(Linear(3, 8), X, y)
        assert single.converged
        assert two.converged
        gain += two.log_evidence - single.log_evidence
        error["one"] += float((single.w - truth).square().sum())
        error["two"] += float((two.w - truth).square().sum())
    assert gain > 10 * 3  # three nats per data set: strong evidence by any standard
    assert error["two"] < 0.7 * error["one"]


def coverage(seed: int, x: Tensor, clean: Tensor) -> tuple[Tensor, Tensor]:
    """Shares of the function and of new measurements within their 95 % error bars."""
    y = clean + 0.1 * noise(seed, len(x))
    model = Tanh(4, seed)
    fit = bayesian_regularisation(model, x, y, options=EvidenceOptions(max_steps=200))
    with torch.no_grad():
        error = model(x) - clean
    fresh = error + 0.1 * noise(seed + 100_000, len(x))
    inside = error.abs() < 1.96 * predictive_std(fit, model, x, noise=False)
    predicted = fresh.abs() < 1.96 * predictive_std(fit, model, x)
    return inside.double().mean(), predicted.double().mean()


@pytest.mark.slow
def test_error_bars_have_their_stated_coverage() -> None:
    x = torch.linspace(-1, 1, 80, dtype=F64)
    clean = torch.tanh(2 * x) - 0.8 * torch.tanh(5 * x - 2)
    shares = torch.stack([torch.stack(coverage(seed, x, clean)) for seed in range(100)]).mean(0)
    assert 0.90 <= float(shares[0]) <= 0.98
    assert 0.90 <= float(shares[1]) <= 0.98


@pytest.mark.slow
def test_error_bars_of_a_linear_model_have_their_stated_coverage() -> None:
    inside = []
    for seed in range(100):
        X = noise(seed, 40, 6)
        truth = noise(seed + 1000, 6)
        model = Linear(6)
        fit = bayesian_regularisation(model, X, X @ truth + 0.5 * noise(seed + 2000, 40))
        x = noise(seed + 3000, 50, 6)
        deviation = predictive_std(fit, model, x, noise=False)
        inside.append((x @ (fit.w - truth)).abs() < 1.96 * deviation)
    assert 0.90 <= float(torch.stack(inside).double().mean()) <= 0.98


def test_interrupt_keeps_the_best_result() -> None:
    x, y = triangle_wave(0)
    calls = 0

    class Interrupted(Tanh):
        def forward(self, inputs: Tensor) -> Tensor:
            nonlocal calls
            calls += 1
            if calls == 9:
                raise KeyboardInterrupt
            return super().forward(inputs)

    model = Interrupted(4, 0)
    before = float((model(x).detach() - y).square().sum())
    fit = bayesian_regularisation(model, x, y)
    assert fit.status == "stopped"
    assert 0 < fit.steps < 9
    assert torch.equal(flatten(trainable(model)), fit.w)
    assert float((model(x) - y).detach().square().sum()) < before


def test_error_of_the_model_leaves_it_unchanged() -> None:
    x, y = triangle_wave(0)
    calls = 0

    class Broken(Tanh):
        def forward(self, inputs: Tensor) -> Tensor:
            nonlocal calls
            calls += 1
            if calls == 5:
                raise RuntimeError("broken")
            return super().forward(inputs)

    model = Broken(4, 0)
    before = copy.deepcopy(model.state_dict())
    with pytest.raises(RuntimeError, match="broken"):
        bayesian_regularisation(model, x, y)
    assert all(torch.equal(before[name], value) for name, value in model.state_dict().items())


class Root(nn.Module):
    """sqrt(w) x, which is NaN for negative w."""

    def __init__(self, w: float) -> None:
        super().__init__()
        self.w = nn.Parameter(torch.tensor([w], dtype=F64))

    def forward(self, x: Tensor) -> Tensor:
        return self.w.sqrt() * x


def test_step_to_nan_is_rejected() -> None:
    x = torch.linspace(0, 1, 50, dtype=F64)
    y = 0.1 * x + 1e-3 * noise(0, 50)
    model = Root(4.0)  # the first full step from w = 4 ends at about -3.6
    fit = bayesian_regularisation(model, x, y)
    assert fit.converged
    assert abs(float(model.w) - 0.01) < 5 * float(fit.covariance.sqrt())


def test_nan_at_the_start_is_reported_and_changes_nothing() -> None:
    model = Root(-1.0)
    x = torch.linspace(0, 1, 50, dtype=F64)
    fit = bayesian_regularisation(model, x, x)
    assert (fit.status, fit.converged, fit.steps) == ("not_finite", False, 0)
    assert "not finite" in fit.message
    assert math.isnan(fit.log_evidence)
    assert float(model.w) == -1.0


def test_noise_floor_ends_the_fit() -> None:
    x = noise(0, 200, 2)
    truth = RadialBasis(4, seed=1)
    with torch.no_grad():
        y = truth(x)
        model = RadialBasis(4, seed=1)
        for parameter in model.parameters():
            parameter.add_(0.05)
    fit = bayesian_regularisation(model, x, y, options=EvidenceOptions(noise_floor=1e-3))
    assert (fit.status, fit.converged) == ("noise_floor", True)
    rms = math.sqrt(fit.error_squares / fit.samples)
    assert 0 < rms <= 1e-3
    assert math.sqrt(0.5 / fit.beta) >= 1e-3
    # Without a floor it continues, down to the rounding of the targets if necessary.
    exact = bayesian_regularisation(copy.deepcopy(model), x, y)
    assert exact.error_squares < 1e-6 * fit.error_squares


def test_prior_determines_weights_without_data() -> None:
    X, y = regression(0)
    X = X.clone()
    X[:, 3:] = 0
    model = Linear(3, 8)
    with torch.no_grad():
        model.b.copy_(noise(5, 8))
    before = model.b.detach().clone()
    fit = bayesian_regularisation(model, X, y, prior={"b": before})
    assert fit.converged
    assert torch.equal(model.b, before)
    assert fit.gamma["b"] == 0
    assert 2.5 < fit.gamma["a"] <= 3


def test_units_of_the_targets_shift_the_evidence_by_their_jacobian() -> None:
    X, y = regression(1)
    plain = bayesian_regularisation(Linear(3, 8), X, y, options=EvidenceOptions(tolerance=1e-9))
    scaled = bayesian_regularisation(
        Linear(3, 8), X, 1000 * y, options=EvidenceOptions(tolerance=1e-9)
    )
    assert plain.converged
    assert scaled.converged
    torch.testing.assert_close(scaled.w, 1000 * plain.w, rtol=1e-6, atol=0)
    shift = len(y) * math.log(1000)
    assert math.isclose(scaled.log_evidence, plain.log_evidence - shift, rel_tol=1e-9)
    for group, gamma in plain.gamma.items():
        assert math.isclose(scaled.gamma[group], gamma, rel_tol=1e-6)


def test_bad_input_is_refused_on_entry() -> None:
    X, y = regression(0)

    def fit(**options: object) -> EvidenceResult:
        return bayesian_regularisation(Linear(3, 8), X, y, **options)

    with pytest.raises(ValueError, match=r"\['c'\]"):
        fit(prior={"c": 0.0})
    with pytest.raises(ValueError, match="positive"):
        EvidenceOptions(tolerance=0.0)
    with pytest.raises(ValueError, match="finite"):
        bayesian_regularisation(Linear(3, 8), X, y * math.nan)
    with pytest.raises(ValueError, match="same number"):
        bayesian_regularisation(Linear(3, 8), X, y[1:])
