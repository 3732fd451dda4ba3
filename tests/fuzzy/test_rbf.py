"""Radial basis functions: their formula, placing of centres, and a head initialised at zero."""

import math
from copy import deepcopy

import pytest
import torch
from torch import nn

from nfriction.fuzzy import AnfisRBF, RBFNetwork

FLOAT64 = torch.float64
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")


def samples(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(shape, generator=generator, dtype=FLOAT64) - 1


def surface(x: torch.Tensor) -> torch.Tensor:
    return torch.stack([torch.sin(2 * x[..., 0]) * x[..., 1], x[..., 0] ** 2 + x[..., 1]], -1)


def shaken(module: nn.Module) -> nn.Module:
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for p in module.parameters():
            p.add_(0.3 * torch.randn(p.shape, generator=generator, dtype=p.dtype))
    return module


def naive(network: RBFNetwork, x: torch.Tensor) -> torch.Tensor:
    z = (x.unsqueeze(-2) - network.centres) / network.log_widths.exp()
    units = torch.exp(-0.5 * z.square().sum(-1))
    return torch.einsum("...gu,gou->...go", units, network.output_weight) + network.output_bias


@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_expanded_exponent_equals_the_plain_one_for_any_inputs(offset: float) -> None:
    network, x = shaken(RBFNetwork(3)), samples(6, 5, 3, 2)
    with torch.no_grad():
        network.centres += offset
    # Inputs at 1e4 are themselves rounded to 1e-12.
    torch.testing.assert_close(
        network(x + offset), naive(network, x + offset), rtol=1e-11, atol=1e-11
    )


def test_rounding_error_of_the_expansion_is_within_its_bound() -> None:
    network, x = shaken(RBFNetwork(2)), samples(500, 2, 2)
    with torch.no_grad():
        network.log_widths.fill_(-7.0)  # a thousandth of the range
        x[0] = network.centres[:, 0]
    # 1e-16 (range/width)^2
    torch.testing.assert_close(network(x), naive(network, x), rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["network", "combined"])
def test_script_export_and_vmap_agree(kind: str) -> None:
    module = shaken(RBFNetwork(3) if kind == "network" else AnfisRBF(3, 2, [4, 3], 2, units=6))
    x, z = samples(9, 3, 2), samples(5, 3, 2, seed=3)
    scripted = torch.jit.script(module)
    torch.testing.assert_close(scripted(x), module(x), rtol=1e-14, atol=1e-15)
    shapes = ({0: torch.export.Dim("samples")},)
    program = torch.export.export(module, (x,), dynamic_shapes=shapes, strict=True)
    torch.testing.assert_close(program.module()(z), module(z), rtol=1e-13, atol=1e-14)
    torch.testing.assert_close(torch.func.vmap(module)(x), module(x), rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("kind", ["network", "combined"])
def test_gradients_forward_and_reverse(kind: str) -> None:
    module = shaken(RBFNetwork(1, units=3) if kind == "network" else AnfisRBF(1, 2, [2, 2], 1))
    names = [name for name, _ in module.named_parameters()]
    values = [p.detach().clone().requires_grad_() for p in module.parameters()]

    def evaluate(x: torch.Tensor, *parameters: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(module, dict(zip(names, parameters, strict=True)), (x,))

    inputs = (samples(2, 1, 2).requires_grad_(), *values)
    assert torch.autograd.gradcheck(evaluate, inputs, check_forward_ad=True)


@pytest.mark.parametrize("prior_precision", [0.0, 1e-2])
def test_output_layer_is_stationary(prior_precision: float) -> None:
    network, x = RBFNetwork(2), samples(200, 2, 2)
    y = surface(x)
    network.solve_output(x, y, prior_precision)
    layer = torch.cat([network.output_weight, network.output_bias.unsqueeze(-1)], -1)
    loss = (network(x) - y).square().sum() + prior_precision * layer.square().sum()
    gradients = torch.autograd.grad(loss, [network.output_weight, network.output_bias])
    for gradient in gradients:
        assert gradient.abs().max() < 1e-9 * y.square().sum()


def test_input_jacobian_has_one_block_per_output() -> None:
    network = shaken(RBFNetwork(3))
    x = samples(20, 3, 2).requires_grad_()
    y = network(x)
    found = network.input_jacobian(x)
    for k in range(2):
        (expected,) = torch.autograd.grad(y[..., k].sum(), x, retain_graph=True)
        # Sums of the same numbers in another order.
        torch.testing.assert_close(found[:, k].permute(2, 0, 1), expected, rtol=1e-10, atol=1e-12)


def test_kmeans_is_repeatable_and_finds_clusters() -> None:
    middles = torch.tensor([[0.0, 0.0], [5.0, 0.0], [0.0, 5.0]], dtype=FLOAT64)
    x = (middles.repeat(50, 1) + 0.05 * samples(150, 2)).unsqueeze(1)
    network = RBFNetwork(1, units=3)
    network.init_kmeans(x, seed=4)
    found = network.centres[0].detach()
    distance = torch.cdist(found, middles).amin(1)
    assert distance.max() < 0.05
    assert torch.cdist(middles, found).amin(1).max() < 0.05
    network.init_kmeans(x, seed=4)
    assert torch.equal(network.centres[0].detach(), found)


def test_orthogonal_least_squares_finds_the_true_units() -> None:
    # Interior samples as centres: each true unit is a candidate.
    x = samples(400, 1, 2)
    truth = RBFNetwork(1, units=3)
    width = 0.5 * x[:, 0].std(0)
    with torch.no_grad():
        truth.centres[0] = x[[10, 200, 333], 0]
        truth.log_widths[0] = width.log()
        truth.output_weight[0] = torch.tensor([[3.0, -4.0, 2.0], [1.0, 2.0, -5.0]])
        y = truth(x)
    network = RBFNetwork(1, units=6)
    network.init_ols(x, y, width=0.5)
    network.solve_output(x, y, 1e-10)
    guess = RBFNetwork(1, units=6)
    guess.init_kmeans(x)
    guess.solve_output(x, y, 1e-10)

    def error(model: RBFNetwork) -> float:
        return (model(x) - y).square().mean().sqrt().item()

    assert error(network) < 0.05 * y.std().item()
    assert error(network) < 0.5 * error(guess)


@pytest.mark.parametrize("place", ["kmeans", "ols"])
def test_more_units_fit_better(place: str) -> None:
    x = samples(800, 1, 2)
    y = surface(x)
    errors = []
    for units in (3, 10, 30):
        network = RBFNetwork(1, units=units)
        if place == "kmeans":
            network.init_kmeans(x)
        else:
            network.init_ols(x, y)
        network.solve_output(x, y)
        errors.append((network(x) - y).square().mean().sqrt().item())
    assert errors[2] < 0.3 * errors[1] < 0.3 * errors[0]


@pytest.mark.parametrize("width", [0, -1.0, float("nan")])
def test_a_width_that_is_not_positive_is_refused(width: float) -> None:
    x = samples(20, 1, 2)
    with pytest.raises(ValueError, match="`width` must be positive and finite"):
        RBFNetwork(1, units=3).init_ols(x, surface(x), width=width)


def test_head_is_zero_at_the_start_and_improves_when_solved() -> None:
    x = samples(500, 2, 2)
    y = surface(x)
    assert (AnfisRBF(2, 1, (3,), 3).head(samples(5, 2, 4)) == 0).all()
    model = AnfisRBF(2, 2, [3, 3], 2, units=15)
    model.init_grid(-1.0, 1.0)
    model.anfis.solve_consequents(x, y)
    before = model(x)
    assert torch.equal(before, model.anfis(x))
    model.init_head(x)
    assert torch.equal(model(x), before)
    model.solve_head(x, y)
    # Least squares of a layer that may stay zero cannot increase the error.
    assert (model(x) - y).square().sum() < (before - y).square().sum()


def test_initial_centres_lie_in_the_range_of_the_grid() -> None:
    model = AnfisRBF(2, 2, [3, 3], 1, units=40)
    model.init_grid(torch.tensor([0.0, 10.0]), torch.tensor([1.0, 30.0]))
    low = torch.tensor([0.0, 10.0, -1.0], dtype=FLOAT64)
    high = torch.tensor([1.0, 30.0, 1.0], dtype=FLOAT64)
    centres = model.head.centres
    assert (centres >= low).all()
    assert (centres <= high).all()
    assert ((centres.amax((0, 1)) - centres.amin((0, 1))) > 0.8 * (high - low)).all()


def test_unsound_sizes_and_samples_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        RBFNetwork(1, units=0)
    network, x = RBFNetwork(1), samples(50, 1, 2)
    with pytest.raises(ValueError, match="samples"):
        network.init_kmeans(x[:5])
    with pytest.raises(ValueError, match="vary"):
        network.init_kmeans(x * torch.tensor([1.0, 0.0]))
    with pytest.raises(ValueError, match="range"):
        network.init_range(1.0, 0.0)
    targets = surface(x)
    for y, fault in (
        (targets.squeeze(1).T, "must be of shape"),
        (targets[:40], "must be of shape"),
        (torch.full_like(targets, torch.nan), "must be finite, got NaN"),
    ):
        for place in (network.solve_output, network.init_ols, AnfisRBF(1, 2, [2, 2], 2).solve_head):
            with pytest.raises(ValueError, match=fault):
                place(x, y)


@pytest.mark.parametrize("width", [1e-1, 1e-3, 1e-5])
def test_narrow_units_are_accurate_in_single_precision(width: float) -> None:
    """Units one apart; the expanded square would lose the digits of their distances."""
    network = RBFNetwork(1, inputs=1, units=2, outputs=1).requires_grad_(False)
    network.centres.copy_(torch.tensor([[[0.0], [1.0]]]))
    network.log_widths.fill_(math.log(width))
    x = torch.tensor([[[0.1 * width]], [[-2.0 * width]]], dtype=FLOAT64)
    single = deepcopy(network).float()
    for form in ("forward", "activations", "regressors"):
        found = getattr(single, form)(x.float())
        assert found.dtype == torch.float32
        torch.testing.assert_close(found.double(), getattr(network, form)(x), rtol=1e-4, atol=1e-6)
    slopes = single.input_jacobian(x.float()).double()
    torch.testing.assert_close(slopes, network.input_jacobian(x), rtol=1e-3, atol=0.0)
