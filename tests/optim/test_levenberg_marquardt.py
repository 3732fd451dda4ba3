"""Properties of the Levenberg-Marquardt solver."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from scipy.optimize import lsq_linear
from torch import Tensor

from nfriction.optim.least_squares import Quadratic, Status
from nfriction.optim.levenberg_marquardt import LevenbergMarquardt

F64 = torch.float64


@dataclass(frozen=True)
class FromResiduals:
    """Quadratic model of residuals r(x), its Jacobian in forward mode unless given."""

    residual: Callable[[Tensor], Tensor]
    jacobian: Callable[[Tensor], Tensor] | None = None

    def __call__(self, x: Tensor) -> Quadratic:
        r = self.residual(x)
        J = (self.jacobian or torch.func.jacfwd(self.residual))(x).reshape(r.numel(), x.numel())
        return Quadratic(0.5 * r @ r, J.T @ r, J.T @ J)

    def cost(self, x: Tensor) -> Tensor:
        r = self.residual(x)
        return 0.5 * r @ r


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=F64)


def rosenbrock(x: Tensor) -> Tensor:
    return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def powell_singular(x: Tensor) -> Tensor:
    a, b, c, d = x.unbind()
    terms = [a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2]
    return torch.stack(terms)


def line(n: int = 40, noise: float = 0.1) -> tuple[Tensor, Tensor]:
    t = torch.linspace(0, 1, n, dtype=F64)
    generator = torch.Generator().manual_seed(0)
    y = 1 + 2 * t + noise * torch.randn(n, generator=generator, dtype=F64)
    return torch.stack([torch.ones_like(t), t], 1), y


def test_empty_problem_converges_at_once() -> None:
    solver = LevenbergMarquardt()
    result = solver.minimise(lambda x: Quadratic(2.0, x, x[:, None] * x), vector())
    assert result.converged
    assert result.cost == 2.0
    assert result.steps == 0


@pytest.mark.parametrize("start", [(-1.2, 1.0), (6.0, -9.0), (0.0, 0.0)])
def test_rosenbrock_reaches_its_minimum_from_anywhere(start: tuple) -> None:
    solver = LevenbergMarquardt()
    result = solver.minimise(FromResiduals(rosenbrock), vector(*start))
    assert result.converged
    torch.testing.assert_close(result.x, vector(1, 1), rtol=1e-10, atol=1e-10)
    costs = [step.cost for step in result.history]
    assert costs == sorted(costs, reverse=True)  # every accepted step lowers the cost
    assert result.steps == len(costs) <= result.evaluations


def test_powell_singular_converges_despite_its_singular_hessian() -> None:
    result = LevenbergMarquardt().minimise(FromResiduals(powell_singular), vector(3, -1, 0, 1))
    assert result.converged
    assert result.x.abs().max() < 1e-6  # the cost is of fourth order in x


def test_exponential_is_recovered_from_noisy_data_within_its_error() -> None:
    t = torch.linspace(0, 4, 200, dtype=F64)
    truth, sigma = vector(2.0, 1.3, 0.5), 0.01
    inside = torch.zeros(3)
    for seed in range(20):
        noise = torch.randn(200, generator=torch.Generator().manual_seed(seed), dtype=F64)
        y = truth[0] * torch.exp(-truth[1] * t) + truth[2] + sigma * noise
        model = FromResiduals(lambda x, y=y: x[0] * torch.exp(-x[1] * t) + x[2] - y)
        result = LevenbergMarquardt().minimise(model, vector(0.5, 0.2, 0.0), cost=model.cost)
        assert result.converged
        error = (result.x - truth).abs()
        inside += error < 2 * sigma * torch.linalg.inv(result.hessian).diagonal().sqrt()
    # 95 % of 60 trials: fewer than 50 inside has probability below 1e-3.
    assert inside.sum() >= 50


def test_quadratic_is_solved_in_one_undamped_step() -> None:
    X, y = line()
    result = LevenbergMarquardt(initial_damping=0.0).minimise(
        FromResiduals(lambda w: X @ w - y), vector(-30, 400)
    )
    assert result.converged
    assert result.steps == 1
    torch.testing.assert_close(result.x, torch.linalg.lstsq(X, y).solution, rtol=1e-12, atol=0)


def test_active_bound_gives_the_constrained_minimum() -> None:
    X, y = line()
    model = FromResiduals(lambda w: X @ w - y)
    result = LevenbergMarquardt().minimise(
        model, vector(0, 0), upper=vector(math.inf, 1.5), lower=-10.0
    )
    assert result.converged
    assert result.at_upper.tolist() == [False, True]
    # With the slope fixed at 1.5 the intercept is the mean of the remainder.
    assert float(result.x[0]) == pytest.approx(float((y - 1.5 * X[:, 1]).mean()), rel=1e-10)
    assert result.gradient[1] < 0  # Kuhn-Tucker: the gradient pushes outward


def test_strongly_coupled_bounds_satisfy_kuhn_tucker() -> None:
    generator = torch.Generator().manual_seed(3)
    for _ in range(30):
        J = torch.randn(12, 6, generator=generator, dtype=F64)
        J[:, 1] = J[:, 0] + 0.01 * J[:, 1]
        y = torch.randn(12, generator=generator, dtype=F64)
        result = LevenbergMarquardt().minimise(
            FromResiduals(lambda w, J=J, y=y: J @ w - y),
            torch.zeros(6, dtype=F64),
            lower=-0.1,
            upper=0.2,
        )
        assert result.converged
        assert ((result.x >= -0.1) & (result.x <= 0.2)).all()
        slope, free = result.gradient, ~(result.at_lower | result.at_upper)
        # A slope s along one parameter predicts a decrease of s^2 / (2 H); a search may end if that
        # is below the cost tolerance.
        least = (2e-14 * result.cost * result.hessian.diagonal()).sqrt()
        assert (slope.abs() < least)[free].all()
        assert (slope > -least)[result.at_lower].all()
        assert (slope < least)[result.at_upper].all()


def test_search_on_coupled_bounds_reaches_the_minimum() -> None:
    """From corners of the box, compared with an exact solver of bounded linear least squares."""
    generator = torch.Generator().manual_seed(5)
    for _ in range(100):
        weak, common, loads = (
            torch.randn(*shape, generator=generator, dtype=F64)
            for shape in ((12, 6), (12, 2), (2, 6))
        )
        # Six columns that differ little from two directions are nearly collinear.
        J = common @ loads + 10 ** -float(3 * torch.rand(1, generator=generator)) * weak
        y = torch.randn(12, generator=generator, dtype=F64)
        start = 0.05 + 0.15 * torch.randint(-1, 2, (6,), generator=generator).double()
        result = LevenbergMarquardt().minimise(
            FromResiduals(lambda w, J=J, y=y: J @ w - y), start, lower=-0.1, upper=0.2
        )
        exact = lsq_linear(J.numpy(), y.numpy(), (-0.1, 0.2), method="bvls", tol=1e-14)
        assert result.converged
        # If ours is lower, the exact solver has reached its iteration limit.
        assert result.cost <= exact.cost * (1 + 1e-9)


@pytest.mark.parametrize("lower", [-0.1, 0.0, 1e-12])
def test_parameter_within_round_off_of_its_bound_is_active(lower: float) -> None:
    """A step in scaled units never ends exactly on a bound, but the result must report it as
    active."""
    generator = torch.Generator().manual_seed(2)
    pinned = 0
    for _ in range(70):
        J = torch.randn(12, 5, generator=generator, dtype=F64)
        J = J * 10 ** torch.randn(5, generator=generator, dtype=F64)
        y = torch.randn(12, generator=generator, dtype=F64)
        result = LevenbergMarquardt().minimise(
            FromResiduals(lambda w, J=J, y=y: J @ w - y),
            torch.full((5,), 0.05, dtype=F64),
            lower=lower,
            upper=0.2,
        )
        near = torch.minimum(result.x - lower, 0.2 - result.x) < 1e-15
        assert torch.equal(near, result.at_lower | result.at_upper)
        pinned += int(near.sum())
    assert pinned > 35


def test_start_on_a_bound_leaves_it_when_the_minimum_is_inside() -> None:
    result = LevenbergMarquardt().minimise(
        FromResiduals(rosenbrock), vector(-5, -5), lower=-5.0, upper=5.0
    )
    assert result.converged
    torch.testing.assert_close(result.x, vector(1, 1), rtol=1e-10, atol=0)
    assert not (result.at_lower | result.at_upper).any()


def test_rank_deficient_problem_is_solved() -> None:
    X, y = line()
    model = FromResiduals(lambda w: X[:, 0] * w[0] + X[:, 1] * (w[1] + 2 * w[2]) - y)
    result = LevenbergMarquardt().minimise(model, torch.zeros(4, dtype=F64))
    assert result.converged
    fit = torch.linalg.lstsq(X, y).solution
    torch.testing.assert_close(
        torch.stack([result.x[0], result.x[1] + 2 * result.x[2]]), fit, rtol=1e-8, atol=0
    )


def test_not_a_number_is_a_rejected_step() -> None:
    # sqrt is NaN for negative values, which the first full step reaches.
    def residual(x: Tensor) -> Tensor:
        return torch.stack([x[0].sqrt() - 0.1])

    model = FromResiduals(residual)
    for cost in (None, model.cost):
        result = LevenbergMarquardt(initial_damping=0.0).minimise(model, vector(4.0), cost=cost)
        assert result.converged
        assert result.evaluations > result.steps + 1
        assert float(result.x[0]) == pytest.approx(0.01, rel=1e-9)


def test_problem_without_finite_values_reports_not_finite() -> None:
    at_start = LevenbergMarquardt().minimise(FromResiduals(lambda x: x.log()), vector(-1.0))
    assert (at_start.status, at_start.converged) == ("not_finite", False)

    def island(x: Tensor) -> Quadratic:
        cost = 1.0 if float(x[0]) == 1.0 else math.nan
        return Quadratic(cost, vector(1.0), torch.eye(1, dtype=F64))

    around = LevenbergMarquardt().minimise(island, vector(1.0))
    assert (around.status, float(around.x[0])) == ("not_finite", 1.0)


def test_wrong_derivative_is_reported_as_a_stall() -> None:
    model = FromResiduals(rosenbrock, lambda x: -torch.func.jacfwd(rosenbrock)(x))
    result = LevenbergMarquardt().minimise(model, vector(-1.2, 1.0))
    assert (result.status, result.converged) == ("stalled", False)
    assert "derivative" in result.message


@pytest.mark.parametrize("powers", [(3, -4), (20, -30)])
def test_result_is_invariant_to_parameter_units(powers: tuple[int, int]) -> None:
    # Powers of two scale without rounding, so the two runs agree bit for bit.
    scale = vector(*(2.0**power for power in powers))
    model, start = FromResiduals(rosenbrock), vector(-1.2, 1.0)
    plain = LevenbergMarquardt().minimise(model, start)
    scaled = LevenbergMarquardt().minimise(
        FromResiduals(lambda x: rosenbrock(x / scale)), start * scale
    )
    assert torch.equal(scaled.x / scale, plain.x)
    assert scaled.history == plain.history
    assert scaled.status == plain.status


def test_given_jacobian_and_cost_do_not_change_the_result() -> None:
    def jacobian(x: Tensor) -> Tensor:
        return torch.stack(
            [torch.stack([-20 * x[0], x.new_tensor(10.0)]), x.new_tensor([-1.0, 0.0])]
        )

    plain = LevenbergMarquardt().minimise(FromResiduals(rosenbrock), vector(-1.2, 1))
    model = FromResiduals(rosenbrock, jacobian)
    cheap = LevenbergMarquardt().minimise(model, vector(-1.2, 1), cost=model.cost)
    torch.testing.assert_close(cheap.x, plain.x, rtol=1e-12, atol=0)


def test_interrupt_returns_the_best_so_far() -> None:
    calls = 0

    def interrupted(x: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        if calls == 12:
            raise KeyboardInterrupt
        return rosenbrock(x)

    start = vector(-1.2, 1)
    result = LevenbergMarquardt().minimise(FromResiduals(interrupted), start)
    assert (result.status, result.converged) == ("stopped", False)
    assert result.steps > 0
    assert result.cost == result.history[-1].cost < float(FromResiduals(rosenbrock).cost(start))


def test_callback_sees_every_step_and_can_stop() -> None:
    seen = []

    def callback(x: Tensor, local: Quadratic, step: object) -> Status | None:
        seen.append((x, step))
        return "stopped" if len(seen) == 3 else None

    result = LevenbergMarquardt().minimise(
        FromResiduals(rosenbrock), vector(-1.2, 1), callback=callback
    )
    assert result.status == "stopped"
    assert [step for _, step in seen] == result.history
    assert torch.equal(seen[-1][0], result.x)


def test_step_limit_is_not_convergence() -> None:
    result = LevenbergMarquardt(max_steps=2).minimise(FromResiduals(rosenbrock), vector(-1.2, 1))
    assert (result.status, result.converged, result.steps) == ("max_steps", False, 2)


def test_bad_input_is_refused_on_entry() -> None:
    model, start = FromResiduals(rosenbrock), vector(0, 0)
    solver = LevenbergMarquardt()
    with pytest.raises(ValueError, match="vector"):
        solver.minimise(model, start[None])
    with pytest.raises(ValueError, match="lower"):
        solver.minimise(model, start, lower=1.0, upper=0.0)
    with pytest.raises(ValueError, match="upper"):
        solver.minimise(model, start, upper=vector(1.0))
    with pytest.raises(ValueError, match="half the sum"):
        solver.minimise(model, start, cost=lambda x: 2 * model.cost(x))
    with pytest.raises(ValueError, match="Hessian"):
        solver.minimise(lambda x: Quadratic(1.0, x, x), start)
    with pytest.raises(ValueError, match="max_steps"):
        LevenbergMarquardt(max_steps=-1)
