"""Placement of fuzzy sets by variable projection of the output layer."""

import pytest
import torch
from torch import Tensor, nn

from nfriction.fuzzy import Anfis, RBFNetwork
from nfriction.papers.nffem.projection import Projection, project

FLOAT64 = torch.float64
LAYERS = {
    "anfis": lambda: Anfis(1, 2, [3, 2], 2),
    "zero order": lambda: Anfis(1, 2, [3, 3], 2, order=0),
    "bells": lambda: Anfis(1, 2, [2, 3], 2, kind="bell"),
    "interpretable": lambda: Anfis(1, 2, [3, 3], 2, interpretable=True),
    "interpretable bells": lambda: Anfis(1, 2, [3, 2], 2, kind="bell", interpretable=True),
    "network": lambda: RBFNetwork(1, units=4),
}


def samples(count: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return 2 * torch.rand(count, 1, 2, generator=generator, dtype=FLOAT64) - 1


def surface(x: Tensor) -> Tensor:
    return torch.stack([torch.sin(2 * x[..., 0]) * x[..., 1], x[..., 0] ** 2 + x[..., 1]], -1)


def shaken(module: nn.Module, size: float) -> nn.Module:
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for p in module.parameters():
            p.add_(size * torch.randn(p.shape, generator=generator, dtype=p.dtype))
    return module


def squares(layer: nn.Module, x: Tensor, y: Tensor) -> float:
    with torch.no_grad():
        return float((layer(x) - y).square().sum())


@pytest.mark.parametrize("kind", LAYERS)
def test_cost_is_the_residual_of_the_best_output_layer(kind: str) -> None:
    layer, x = shaken(LAYERS[kind](), 0.1), samples(300)
    y = surface(x)
    problem = Projection(layer, x, y, ridge=1e-9)
    left = float(problem.cost(problem.theta))
    assert squares(layer, x, y) == pytest.approx(2 * left, rel=1e-5)
    # No other output layer is better.
    for p in (p for n, p in layer.named_parameters() if "consequents" in n or "output" in n):
        with torch.no_grad():
            p.mul_(1.001)
            assert squares(layer, x, y) > 2 * left
            p.div_(1.001)


@pytest.mark.parametrize("kind", LAYERS)
def test_gradient_equals_that_of_the_cost(kind: str) -> None:
    layer, x = shaken(LAYERS[kind](), 0.1), samples(400)
    problem = Projection(layer, x, surface(x), ridge=1e-3)
    theta = problem.theta
    local = problem.quadratic(theta)
    step, slopes = 1e-5, []
    for i in range(len(theta)):
        ahead, behind = theta.clone(), theta.clone()
        ahead[i] += step
        behind[i] -= step
        rise = problem.cost(ahead) - problem.cost(behind)
        slopes.append(float(rise) / (2 * step))
    # Central differences: error of order step^2, and rounding over step.
    torch.testing.assert_close(local.gradient.tolist(), slopes, rtol=1e-4, atol=1e-6)
    eigenvalues = torch.linalg.eigvalsh(local.hessian)
    assert eigenvalues.min() > -1e-9 * eigenvalues.max()


def test_sets_are_improved_and_frozen_ones_unchanged() -> None:
    x = samples(300)
    layer = Anfis(1, 2, [3, 3], 2)
    layer.solve_consequents(x, surface(x))
    before = squares(layer, x, surface(x))
    project(layer, x, surface(x), 20)
    assert squares(layer, x, surface(x)) < 0.5 * before
    layer.partition.requires_grad_(False)
    kept = {name: value.clone() for name, value in layer.state_dict().items()}
    project(layer, x, surface(x), 20)
    assert all(torch.equal(kept[name], value) for name, value in layer.state_dict().items())


def test_an_interrupt_is_passed_on_with_the_best_so_far() -> None:
    x = samples(300)
    calls = 0

    class Interrupted(RBFNetwork):
        def jacobian_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor:
            nonlocal calls
            calls += 1
            if calls == 5:
                raise KeyboardInterrupt
            return super().jacobian_columns(x, out)

    network = Interrupted(1, units=5)
    network.solve_output(x, surface(x))
    before = squares(network, x, surface(x))
    with pytest.raises(KeyboardInterrupt):
        project(network, x, surface(x), 50)
    assert squares(network, x, surface(x)) < before


def test_several_groups_are_refused() -> None:
    with pytest.raises(ValueError, match="one group"):
        Projection(RBFNetwork(2), samples(5).expand(5, 2, 2), samples(5).expand(5, 2, 2))
