"""Properties of the pattern search."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import pytest
import torch
from torch import Tensor

from nfriction.papers.afem.fit_by_search import (
    Box,
    SearchOptions,
    SearchResult,
    SearchState,
    local_quadratic,
    search,
)

F64 = torch.float64


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=F64)


def box(
    start: Tensor, lower: Any = -5.0, upper: Any = 5.0, scale: Any = None, log: Any = False
) -> Box:
    """A box with one value or one for each variable; its scale is the range by default."""
    low, high = (torch.as_tensor(end, dtype=F64).expand_as(start) for end in (lower, upper))
    scale = high - low if scale is None else torch.as_tensor(scale, dtype=F64).expand_as(start)
    return Box(start, low, high, scale, torch.as_tensor(log).expand(len(start)))


def minimise(
    objective: Callable[[Tensor], Tensor], variables: Box, callback: Any = None, **options: Any
) -> SearchResult:
    settings = {"tolerance": 1e-6, "max_evaluations": 10_000} | options
    return search(objective, variables, SearchOptions(**settings), callback)


def bowl(x: Tensor) -> Tensor:
    return (x - vector(0.3, -0.7, 0.1)).square() @ vector(1.0, 5.0, 2.0)


def rosenbrock(x: Tensor) -> Tensor:
    return 100 * (x[:, 1] - x[:, 0].square()).square() + (1 - x[:, 0]).square()


START = vector(2, 2, 2)


def test_minimum_of_a_quadratic_is_found() -> None:
    values: list[float] = []
    result = minimise(bowl, box(START, -3.0, 3.0), lambda at: values.append(at.value))
    assert result.converged
    # The value is flat to 1e-12 within the mesh tolerance, 6e-6 of these bounds.
    torch.testing.assert_close(result.vector, vector(0.3, -0.7, 0.1), rtol=0, atol=3e-5)
    assert values == sorted(values, reverse=True)


def test_rosenbrock_is_minimised() -> None:
    result = minimise(rosenbrock, box(vector(-1.2, 1)), max_evaluations=50_000)
    assert result.converged
    torch.testing.assert_close(result.vector, vector(1, 1), rtol=0, atol=5e-3)


def test_nonsmooth_function_is_minimised() -> None:
    target = vector(0.37, -1.21, 2.0)
    result = minimise(lambda x: (x - target).abs().sum(1), box(vector(0, 0, 0), -4.0, 4.0))
    assert result.converged
    # Rotated axes descend along a kink in smaller and smaller steps.
    torch.testing.assert_close(result.vector, target, rtol=0, atol=2e-4)


def test_minimum_outside_is_found_on_the_bounds() -> None:
    seen = []

    def objective(x: Tensor) -> Tensor:
        seen.append(x)
        return bowl(x)

    result = minimise(objective, box(START, vector(0.5, -3, -3), vector(3, -1, 3)))
    assert result.converged
    torch.testing.assert_close(result.vector, vector(0.5, -1, 0.1), rtol=0, atol=3e-5)
    assert result.vector[:2].tolist() == [0.5, -1.0]  # to the last bit
    every = torch.cat(seen)
    assert (every >= vector(0.5, -3, -3)).all()
    assert (every <= vector(3, -1, 3)).all()


def test_noisy_plateau_does_not_report_convergence() -> None:
    def plateau(x: Tensor) -> Tensor:
        ripple = 1e-3 * torch.sin(1e4 * x).sum(1)
        return (x.abs().sum(1) - 1).clamp(min=0) + ripple

    result = minimise(plateau, box(vector(3, -2), -4.0, 4.0), max_evaluations=5000)
    assert result.converged
    assert result.value < 3e-3  # somewhere on the plateau, within its ripple


def test_values_that_are_not_finite_are_rejected() -> None:
    def holed(x: Tensor) -> Tensor:
        value = bowl(x)
        return torch.where(x[:, 0] < 0.25, math.nan, torch.where(x[:, 1] > 1.9, -math.inf, value))

    result = minimise(holed, box(vector(2, 1.5, 2), -3.0, 3.0))
    assert result.converged
    torch.testing.assert_close(result.vector, vector(0.3, -0.7, 0.1), rtol=0, atol=3e-5)
    nowhere = minimise(lambda x: x[:, 0] * math.nan, box(vector(1.0)))
    assert not nowhere.converged
    assert "finite nowhere" in nowhere.message
    assert nowhere.value == math.inf


def test_search_can_leave_a_start_that_is_not_finite() -> None:
    result = minimise(
        lambda x: torch.where(x[:, 0] > 1, math.nan, x[:, 0].square()),
        box(vector(1.2), -math.inf, math.inf, scale=1.2),
    )
    assert result.converged
    assert abs(float(result.vector)) < 1e-4


def test_logarithmic_variables_span_decades() -> None:
    target = vector(3e-6, 4e4)
    evaluations = 0

    def objective(x: Tensor) -> Tensor:
        nonlocal evaluations
        evaluations += len(x)
        return (x / target).log().square().sum(1)

    decades = box(vector(1.0, 1.0), 1e-9, 1e9, scale=18.0, log=True)
    result = minimise(objective, decades)
    assert result.converged
    torch.testing.assert_close(result.vector, target, rtol=1e-4, atol=0)
    assert evaluations < 600
    mixed = minimise(
        lambda x: objective(x[:, :1]) + x[:, 1].square(),
        box(vector(1.0, 5.0), vector(0, -10), math.inf, scale=1.0, log=[True, False]),
    )
    assert mixed.converged
    assert float(mixed.vector[1]) == pytest.approx(0, abs=1e-4)


def test_result_is_invariant_to_variable_units() -> None:
    # Powers of two scale without rounding, so the two searches agree bit for bit.
    unit = vector(2.0**20, 2.0**-30, 1)
    low, high = vector(-3, -3, -3), vector(3, 3, 3)
    plain = minimise(bowl, box(START, low, high))
    scaled = minimise(lambda x: bowl(x / unit), box(START * unit, low * unit, high * unit))
    assert torch.equal(scaled.vector / unit, plain.vector)
    assert (scaled.value, scaled.iterations) == (plain.value, plain.iterations)


def test_every_poll_is_one_call_of_fixed_size() -> None:
    sizes = []

    def objective(x: Tensor) -> Tensor:
        sizes.append(len(x))
        return bowl(x)

    kept: list[SearchState] = []
    minimise(objective, box(START, -3.0, 3.0), kept.append)
    assert sizes[0] == 1
    assert set(sizes[1:]) == {7}
    assert sum(sizes) == kept[-1].evaluations


def test_resumed_search_equals_the_uninterrupted_one_bit_for_bit() -> None:
    options = {"seed": 7, "max_evaluations": 600}
    variables = box(vector(-1.2, 1))
    kept: list[str] = []
    whole = minimise(
        rosenbrock, variables, lambda at: kept.append(json.dumps(asdict(at))), **options
    )
    stopped = minimise(rosenbrock, variables, lambda at: at.iterations == 17, **options)
    assert (stopped.converged, stopped.iterations) == (False, 17)
    rest: list[str] = []
    state = SearchState(**json.loads(kept[16]))
    resumed = minimise(
        rosenbrock, box(vector(0, 0)), lambda at: rest.append(json.dumps(asdict(at))),
        state=state, **options,
    )  # fmt: skip
    assert torch.equal(resumed.vector, whole.vector)
    assert rest == kept[17:]


def test_rotation_depends_on_the_seed() -> None:
    def run(seed: int) -> list[float]:
        values: list[float] = []
        minimise(rosenbrock, box(vector(-1.2, 1)), lambda at: values.append(at.value),
                 seed=seed, max_evaluations=200)  # fmt: skip
        return values

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_evaluation_limit_is_respected_and_reported() -> None:
    counts: list[int] = []
    result = minimise(
        rosenbrock, box(vector(-1.2, 1)), lambda at: counts.append(at.evaluations),
        max_evaluations=50,
    )  # fmt: skip
    assert not result.converged
    assert "limit of evaluations" in result.message
    assert counts[-1] <= 50


def test_interrupt_returns_the_best_so_far() -> None:
    calls = 0

    def objective(x: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        if calls == 20:
            raise KeyboardInterrupt
        return bowl(x)

    result = minimise(objective, box(START, -3.0, 3.0))
    assert (result.converged, result.iterations) == (False, 18)
    assert "interrupt" in result.message
    assert result.value == float(bowl(result.vector[None])[0]) < float(bowl(START[None])[0])


def test_bad_input_is_refused_on_entry() -> None:
    with pytest.raises(ValueError, match="tolerance"):
        SearchOptions(tolerance=0.0)


def test_logarithmic_variable_reaches_its_bound_exactly() -> None:
    """exp(log(x)) may miss x in its last digits, and a fit reports active bounds."""
    g = torch.Generator().manual_seed(0)
    upper = 10 ** (6 * torch.rand(100, generator=g, dtype=F64) - 3)
    decades = box(0.5 * upper, 1e-3 * upper, upper, scale=1.0, log=True)
    low, high = decades.ends
    assert torch.equal(decades.from_unit(high), decades.upper)
    assert torch.equal(decades.from_unit(low), decades.lower)


def valley(seed: int = 0) -> tuple[Tensor, Tensor]:
    """Slopes of four residuals, rotated and of very different size, and their common zero."""
    random = torch.Generator().manual_seed(seed)
    turned = torch.linalg.qr(torch.randn(4, 4, generator=random, dtype=F64))[0]
    stiffness = vector(1.0, 30.0, 300.0, 1000.0)
    return torch.diag(stiffness) @ turned, turned.mT @ (0.3 / stiffness)


def test_quadratic_model_of_residuals_follows_a_narrow_valley() -> None:
    slopes, least = valley()

    def residuals(x: Tensor) -> list[Tensor]:
        return [(x - least) @ slopes[:1].mT, (x - least) @ slopes[1:].mT]

    def cost(x: Tensor) -> Tensor:
        return 0.5 * torch.cat(residuals(x), 1).square().sum(-1)

    variables = box(
        torch.zeros(4, dtype=F64), upper=vector(5, 5, 5, float(least[3]) - 0.01), scale=1.0
    )
    local = local_quadratic(residuals, variables, torch.zeros(4, dtype=F64))
    assert local is not None
    torch.testing.assert_close(local.hessian, slopes.mT @ slopes, rtol=1e-5, atol=1e-3)
    torch.testing.assert_close(local.gradient, -slopes.mT @ slopes @ least, rtol=1e-5, atol=1e-3)
    options = SearchOptions(tolerance=1e-3, max_evaluations=400)
    by_quadratic, by_polls = (search(cost, variables, options, None, r) for r in (residuals, None))
    assert by_quadratic.converged
    assert by_polls.value > 10 * by_quadratic.value
    # On the last bound, the optimum of the other three.
    others = torch.linalg.lstsq(slopes[:, :3], slopes @ least - slopes[:, 3] * variables.upper[3])
    expected = torch.cat([others.solution, variables.upper[3:]])
    torch.testing.assert_close(by_quadratic.vector, expected, rtol=0, atol=1e-5)


def test_negligible_decrease_ends_the_search() -> None:
    def residuals(x: Tensor) -> list[Tensor]:
        # An endless slope that gets ever flatter.
        return [1.0 + torch.exp(-x)]

    def cost(x: Tensor) -> Tensor:
        return 0.5 * residuals(x)[0].square().sum(-1)

    variables = box(vector(0.0), upper=1e4, scale=1.0)
    options = SearchOptions(tolerance=1e-6, max_evaluations=10_000)
    whole, part = (search(cost, variables, options, None, residuals, n) for n in (0.0, 1e-3))
    assert part.converged
    assert part.iterations < whole.iterations
    assert part.value == pytest.approx(0.5, rel=0.02)


def test_search_with_a_quadratic_model_resumes_bit_for_bit() -> None:
    def residuals(x: Tensor) -> list[Tensor]:
        return [torch.stack([10 * (x[:, 1] - x[:, 0].square()), 1 - x[:, 0]], -1)]

    def run(state: SearchState | None, stop: int) -> tuple[SearchResult, list[SearchState]]:
        kept: list[SearchState] = []

        def keep(at: SearchState) -> bool:
            kept.append(at)
            return len(kept) == stop

        options = SearchOptions(tolerance=1e-4, state=state)
        return search(
            lambda x: 0.5 * rosenbrock(x), box(vector(-1.2, 1)), options, keep, residuals
        ), kept

    whole, steps = run(None, 0)
    _, begun = run(None, 5)
    rest, _ = run(begun[-1], 0)
    assert whole.converged
    assert torch.equal(rest.vector, whole.vector)
    torch.testing.assert_close(whole.vector, vector(1, 1), rtol=0, atol=1e-4)
    assert steps[-1].evaluations < 1000
