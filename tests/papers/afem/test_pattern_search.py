"""Laws of the pattern search."""

import json
import math

import pytest
import torch
from torch import Tensor

from nfriction.papers.afem.pattern_search import PatternSearch, PatternState, VariableScaling

F64 = torch.float64


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=F64)


def bowl(x: Tensor) -> Tensor:
    return (x - vector(0.3, -0.7, 0.1)).square() @ vector(1.0, 5.0, 2.0)


def rosenbrock(x: Tensor) -> Tensor:
    return 100 * (x[:, 1] - x[:, 0].square()).square() + (1 - x[:, 0]).square()


@pytest.mark.parametrize("rotate", [False, True])
@pytest.mark.parametrize("speculate", [False, True])
def test_every_variant_finds_the_bottom_of_a_bowl(rotate: bool, speculate: bool) -> None:
    search = PatternSearch(rotate=rotate, speculate=speculate)
    result = search.minimise(bowl, vector(2, 2, 2), lower=-3.0, upper=3.0)
    assert result.converged
    # The value is flat to 1e-12 within the mesh tolerance, 6e-6 of these bounds.
    torch.testing.assert_close(result.x, vector(0.3, -0.7, 0.1), rtol=0, atol=3e-5)
    values = [value for _, value, _ in result.state.history]
    assert values == sorted(values, reverse=True)


def test_rosenbrock_is_followed_along_its_valley() -> None:
    search = PatternSearch(rotate=True, speculate=True, max_evaluations=50_000)
    result = search.minimise(rosenbrock, vector(-1.2, 1), lower=-5.0, upper=5.0)
    assert result.converged
    torch.testing.assert_close(result.x, vector(1, 1), rtol=0, atol=5e-3)


def test_kink_askew_to_the_axes_needs_rotation() -> None:
    def ridge(x: Tensor) -> Tensor:
        return 3 * (x[:, 0] - x[:, 1]).abs() + (x[:, 0] + x[:, 1] - 2).abs()

    start = vector(-3.1, -3.1)
    fixed = PatternSearch().minimise(ridge, start, lower=-5.0, upper=5.0)
    turned = PatternSearch(rotate=True, contraction=0.8, seed=1).minimise(
        ridge, start, lower=-5.0, upper=5.0
    )
    assert fixed.state.value > 1  # along the axes every way is up: the known limit of a fixed basis
    assert turned.state.value < 1e-2


def test_absolute_value_is_no_obstacle() -> None:
    target = vector(0.37, -1.21, 2.0)
    result = PatternSearch().minimise(
        lambda x: (x - target).abs().sum(1), vector(0, 0, 0), lower=-4.0, upper=4.0
    )
    assert result.converged
    torch.testing.assert_close(result.x, target, rtol=0, atol=2e-5)


def test_minimum_outside_is_found_on_the_bounds() -> None:
    seen = []

    def objective(x: Tensor) -> Tensor:
        seen.append(x)
        return bowl(x)

    result = PatternSearch().minimise(
        objective, vector(2, 2, 2), lower=vector(0.5, -3, -3), upper=vector(3, -1, 3)
    )
    assert result.converged
    torch.testing.assert_close(result.x, vector(0.5, -1, 0.1), rtol=0, atol=3e-5)
    assert result.x[:2].tolist() == [0.5, -1.0]  # to the last bit
    every = torch.cat(seen)
    assert (every >= vector(0.5, -3, -3)).all()
    assert (every <= vector(3, -1, 3)).all()


def test_noisy_plateau_ends_without_pretending() -> None:
    def plateau(x: Tensor) -> Tensor:
        ripple = 1e-3 * torch.sin(1e4 * x).sum(1)
        return (x.abs().sum(1) - 1).clamp(min=0) + ripple

    result = PatternSearch(max_evaluations=5000).minimise(
        plateau, vector(3, -2), lower=-4.0, upper=4.0
    )
    assert result.converged
    assert result.state.value < 3e-3  # somewhere on the plateau, within its ripple
    assert result.state.evaluations <= 5000


def test_values_that_are_not_finite_are_rejected() -> None:
    def holed(x: Tensor) -> Tensor:
        value = bowl(x)
        return torch.where(x[:, 0] < 0.25, math.nan, torch.where(x[:, 1] > 1.9, -math.inf, value))

    result = PatternSearch().minimise(holed, vector(2, 1.5, 2), lower=-3.0, upper=3.0)
    assert result.converged
    torch.testing.assert_close(result.x, vector(0.3, -0.7, 0.1), rtol=0, atol=3e-5)
    nowhere = PatternSearch().minimise(lambda x: x[:, 0] * math.nan, vector(1.0))
    assert (nowhere.status, nowhere.converged) == ("not_finite", False)
    assert nowhere.state.value == math.inf


def test_start_that_is_not_finite_can_be_left() -> None:
    result = PatternSearch().minimise(
        lambda x: torch.where(x[:, 0] > 1, math.nan, x[:, 0].square()), vector(1.2)
    )
    assert result.converged
    assert abs(float(result.x)) < 1e-4


def test_logarithmic_variables_span_decades() -> None:
    target = vector(3e-6, 4e4)

    def objective(x: Tensor) -> Tensor:
        return (x / target).log().square().sum(1)

    result = PatternSearch().minimise(
        objective, vector(1.0, 1.0), lower=1e-9, upper=1e9, logarithmic=True
    )
    assert result.converged
    torch.testing.assert_close(result.x, target, rtol=1e-4, atol=0)
    assert result.state.evaluations < 400
    mixed = PatternSearch().minimise(
        lambda x: objective(x[:, :1]) + x[:, 1].square(),
        vector(1.0, 5.0),
        lower=vector(0, -10),
        logarithmic=[True, False],
    )
    assert mixed.converged
    assert float(mixed.x[1]) == pytest.approx(0, abs=1e-4)


def test_units_of_the_variables_do_not_matter() -> None:
    # Powers of two scale without rounding, so the two searches agree bit for bit.
    unit = vector(2.0**20, 2.0**-30, 1)
    low, high = vector(-3, -3, -3), vector(3, 3, 3)
    plain = PatternSearch().minimise(bowl, vector(2, 2, 2), lower=low, upper=high)
    scaled = PatternSearch().minimise(
        lambda x: bowl(x / unit), vector(2, 2, 2) * unit, lower=low * unit, upper=high * unit
    )
    assert torch.equal(scaled.x / unit, plain.x)
    assert scaled.state.history == plain.state.history


@pytest.mark.parametrize(("speculate", "size"), [(False, 6), (True, 7)])
def test_every_poll_is_one_call_of_known_size(speculate: bool, size: int) -> None:
    sizes = []

    def objective(x: Tensor) -> Tensor:
        sizes.append(len(x))
        return bowl(x)

    search = PatternSearch(speculate=speculate)
    result = search.minimise(objective, vector(2, 2, 2), lower=-3.0, upper=3.0)
    assert sizes[0] == 1
    assert set(sizes[1:]) == {size} == {search.poll_size(3)}
    assert sum(sizes) == result.state.evaluations


def test_resumed_search_is_the_uninterrupted_one_bit_for_bit() -> None:
    search = PatternSearch(rotate=True, speculate=True, seed=7, max_evaluations=600)
    whole = search.minimise(rosenbrock, vector(-1.2, 1), lower=-5.0, upper=5.0)
    stopped = search.minimise(
        rosenbrock, vector(-1.2, 1), lower=-5.0, upper=5.0, callback=lambda s: s.iterations == 17
    )
    assert (stopped.status, stopped.state.iterations) == ("stopped", 17)
    text = json.dumps(stopped.state.to_dict())
    state = PatternState.from_dict(json.loads(text))
    resumed = search.minimise(rosenbrock, vector(0, 0), lower=-5.0, upper=5.0, state=state)
    assert torch.equal(resumed.x, whole.x)
    assert resumed.state == whole.state
    assert json.dumps(stopped.state.to_dict()) == text  # the given state is not touched


def test_seed_decides_the_rotation() -> None:
    def run(seed: int) -> list:
        search = PatternSearch(rotate=True, seed=seed, max_evaluations=200)
        return search.minimise(rosenbrock, vector(-1.2, 1), lower=-5.0, upper=5.0).state.history

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_limit_of_evaluations_is_kept_and_said() -> None:
    result = PatternSearch(max_evaluations=50).minimise(rosenbrock, vector(-1.2, 1))
    assert (result.status, result.converged) == ("max_evaluations", False)
    assert result.state.evaluations <= 50


def test_interrupt_returns_the_best_so_far() -> None:
    calls = 0

    def objective(x: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        if calls == 20:
            raise KeyboardInterrupt
        return bowl(x)

    result = PatternSearch().minimise(objective, vector(2, 2, 2), lower=-3.0, upper=3.0)
    assert (result.status, result.state.iterations) == ("stopped", 18)
    assert (
        result.state.value == float(bowl(result.x[None])[0]) < float(bowl(vector(2, 2, 2)[None])[0])
    )


def test_bad_input_is_refused_at_the_border() -> None:
    search, start = PatternSearch(), vector(1, 1)
    with pytest.raises(ValueError, match="one value per candidate"):
        search.minimise(lambda x: x, start)
    with pytest.raises(ValueError, match="lower"):
        search.minimise(rosenbrock, start, lower=2.0, upper=1.0)
    with pytest.raises(ValueError, match="upper"):
        search.minimise(rosenbrock, start, upper=vector(1, 2, 3))
    with pytest.raises(ValueError, match="positive where logarithmic"):
        search.minimise(rosenbrock, -start, logarithmic=True)
    with pytest.raises(ValueError, match="scale"):
        search.minimise(rosenbrock, start, scale=0.0)
    with pytest.raises(ValueError, match="vector"):
        search.minimise(rosenbrock, start[None])
    with pytest.raises(ValueError, match="contraction"):
        PatternSearch(contraction=2.0)


def test_a_logarithmic_variable_at_its_bound_is_exactly_there():
    """exp(log(x)) may miss x in its last digits, and a fit reports which bounds were reached."""
    g = torch.Generator().manual_seed(0)
    upper = 10 ** (6 * torch.rand(100, generator=g, dtype=torch.float64) - 3)
    scaling = VariableScaling.build(0.5 * upper, 1e-3 * upper, upper, logarithmic=True)
    assert torch.equal(scaling.from_unit(scaling.to_unit(scaling.upper)), scaling.upper)
    assert torch.equal(scaling.from_unit(scaling.to_unit(scaling.lower)), scaling.lower)
