"""The ANFIS layer: a partition of unity, linear in its consequents, equal in every executor."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nfriction.fuzzy import Anfis

FLOAT64 = torch.float64
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")
VARIANTS = [
    {"order": order, "kind": kind, "interpretable": interpretable}
    for order in (0, 1)
    for kind in ("gaussian", "bell")
    for interpretable in (False, True)
]


def random_layer(groups: int = 3, terms: tuple[int, ...] = (4, 3), **options: object) -> Anfis:
    layer = Anfis(groups, len(terms), terms, 2, **options)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for p in layer.parameters():
            p.add_(0.3 * torch.randn(p.shape, generator=generator, dtype=p.dtype))
    return layer


def samples(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(shape, generator=generator, dtype=FLOAT64) - 1


def naive(layer: Anfis, x: np.ndarray) -> np.ndarray:
    """Takagi-Sugeno inference of one sample as in textbooks: products, sums, loops."""
    centres, widths = (v.detach().numpy() for v in layer.sets())
    consequents = layer.consequents.detach().numpy()
    y = np.zeros((layer.groups, layer.outputs))
    for g in range(layer.groups):
        held, start = [], 0
        for i, count in enumerate(layer.terms):
            z = (x[g, i] - centres[g, start : start + count]) / widths[g, start : start + count]
            if layer.kind == "bell":
                b = layer.log_slopes.detach().exp().numpy()[g, start : start + count]
                held.append(1 / (1 + np.abs(z) ** (2 * b)))
            else:
                held.append(np.exp(-0.5 * z**2))
            start += count
        firing = [np.prod(one) for one in np.ndindex(*layer.terms) for one in [_pick(held, one)]]
        for o in range(layer.outputs):
            slopes, constant = consequents[g, o, :, :-1], consequents[g, o, :, -1]
            consequent = constant + (slopes @ x[g] if layer.order == 1 else 0)
            y[g, o] = np.dot(firing, consequent) / np.sum(firing)
    return y


def _pick(held: list[np.ndarray], indices: tuple[int, ...]) -> list[float]:
    return [one[index] for one, index in zip(held, indices, strict=True)]


@pytest.mark.parametrize("options", VARIANTS)
def test_output_equals_textbook_inference(options: dict) -> None:
    layer = random_layer(terms=(4, 3, 2), **options)
    x = samples(5, 3, 3)
    expected = np.stack([naive(layer, one) for one in x.numpy()])
    np.testing.assert_allclose(layer(x).detach().numpy(), expected, rtol=1e-11, atol=1e-12)


@settings(max_examples=25)
@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.sampled_from(["gaussian", "bell"]))
def test_strengths_sum_to_one_even_where_all_underflow(a: float, b: float, kind: str) -> None:
    layer = random_layer(kind=kind)
    x = torch.tensor([a, b], dtype=FLOAT64).expand(3, 2)
    strength = layer.strength_columns(x.unsqueeze(-1))
    assert (strength >= 0).all()
    torch.testing.assert_close(strength.sum(1), torch.ones(3, 1, dtype=FLOAT64), rtol=1e-12, atol=0)


@pytest.mark.parametrize("options", VARIANTS)
def test_output_is_linear_in_the_consequents(options: dict) -> None:
    layer, x = random_layer(**options), samples(7, 2, 3, 2)
    rows, flat = layer.regressors(x), layer.consequents.flatten(2)
    linear = torch.einsum("...gp,gop->...go", rows, flat)
    torch.testing.assert_close(layer(x), linear, rtol=1e-12, atol=1e-13)


def test_a_constant_layer_is_constant() -> None:
    layer, x = random_layer(), 10 * samples(20, 3, 2)
    with torch.no_grad():
        layer.consequents.zero_()
        layer.consequents[..., -1] = torch.tensor([[2.0], [-3.0]], dtype=FLOAT64)
    torch.testing.assert_close(layer(x), layer(x)[:1].expand(20, 3, 2), rtol=1e-12, atol=0)
    assert layer(x)[0, 0].tolist() == pytest.approx([2.0, -3.0], rel=1e-12)


def test_affine_functions_are_reproduced_everywhere() -> None:
    layer, x = random_layer(), samples(200, 3, 2)
    y = torch.stack([x[..., 0] - 2 * x[..., 1] + 3, -x[..., 0]], -1)
    layer.solve_consequents(x, y, prior_precision=0.0)
    for name in ("slopes", "far"):
        z = x if name == "slopes" else 5 * x
        expected = torch.stack([z[..., 0] - 2 * z[..., 1] + 3, -z[..., 0]], -1)
        # Far from the samples the rules extrapolate what they learnt, limited by the conditioning.
        torch.testing.assert_close(layer(z), expected, rtol=1e-6, atol=1e-6)


def test_inputs_far_from_the_grid_are_handled() -> None:
    layer, moved = random_layer(order=0), random_layer(order=0)
    shift, scale = 1e4, 1e-2
    centres, widths = layer.sets()
    pieces = centres.detach().split(layer.terms, 1), widths.detach().split(layer.terms, 1)
    moved.init_from_sets([shift + scale * c for c in pieces[0]], [scale * w for w in pieces[1]])
    x = samples(50, 3, 2)
    # Rounding of the shifted inputs: 1e4 * 1e-16 / 1e-2.
    torch.testing.assert_close(moved(shift + scale * x), layer(x), rtol=1e-9, atol=1e-9)


def test_groups_are_independent_and_batches_of_any_shape() -> None:
    layer, x = random_layer(), samples(4, 5, 3, 2)
    changed = x.clone()
    changed[..., 1, :] += 0.3
    difference = (layer(changed) - layer(x)).abs()
    assert (difference[..., [0, 2], :] == 0).all()
    assert (difference[..., 1, :] > 0).all()
    torch.testing.assert_close(layer(x[2, 3]), layer(x)[2, 3], rtol=1e-13, atol=1e-14)


def test_output_is_invariant_to_relabelling_the_terms() -> None:
    layer, other = random_layer(), random_layer()
    order = torch.tensor([2, 0, 3, 1])
    with torch.no_grad():
        centres = layer.partition.centres
        for name in ("centres", "log_widths"):
            source = getattr(layer.partition, name)
            getattr(other.partition, name)[:, :4] = source[:, order]
        grid = layer.consequents.unflatten(2, (4, 3))
        other.consequents.copy_(grid[:, :, order].flatten(2, 3))
    assert centres.shape == (3, 7)
    x = samples(20, 3, 2)
    torch.testing.assert_close(other(x), layer(x), rtol=1e-12, atol=1e-13)


def test_even_grid_crosses_at_one_half() -> None:
    for kind in ("gaussian", "bell"):
        layer = Anfis(1, 1, [5], 1, kind=kind)
        layer.init_grid(-2.0, 6.0)
        middles = torch.tensor([-1.0, 1.0, 3.0, 5.0], dtype=FLOAT64)[:, None, None]
        held = layer.memberships(middles)[0].squeeze(1).sort(-1, descending=True).values
        torch.testing.assert_close(held[:, :2], torch.full((4, 2), 0.5, dtype=FLOAT64))


@pytest.mark.parametrize("prior_precision", [0.0, 1e-3, 10.0])
def test_least_squares_is_stationary(prior_precision: float) -> None:
    layer, x = random_layer(), samples(300, 3, 2)
    y = torch.stack([torch.sin(3 * x[..., 0]) * x[..., 1], x[..., 0] ** 2], -1)
    layer.solve_consequents(x, y, prior_precision)
    shrinkage = prior_precision * layer.consequents.square().sum()
    loss = (layer(x) - y).square().sum() + shrinkage
    (gradient,) = torch.autograd.grad(loss, layer.consequents)
    assert gradient.abs().max() < 1e-9 * y.square().sum()


def test_rules_without_nearby_samples_are_zero() -> None:
    layer = Anfis(1, 1, [5], 1)
    layer.init_grid(0.0, 1000.0)
    x = samples(50, 1, 1) * 20
    layer.solve_consequents(x, torch.full((50, 1, 1), 7.0, dtype=FLOAT64))
    far = layer.consequents[..., -1, :]
    torch.testing.assert_close(far, torch.zeros_like(far))


@pytest.mark.parametrize("options", VARIANTS[4:])  # zero order is the same code without a product
def test_gradients_forward_and_reverse(options: dict) -> None:
    layer = random_layer(groups=1, terms=(3, 2), **options)
    names = [name for name, _ in layer.named_parameters()]
    values = [p.detach().clone().requires_grad_() for p in layer.parameters()]

    def evaluate(x: torch.Tensor, *parameters: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(layer, dict(zip(names, parameters, strict=True)), (x,))

    inputs = (samples(2, 1, 2).requires_grad_(), *values)
    assert torch.autograd.gradcheck(evaluate, inputs, check_forward_ad=True)


def test_per_sample_jacobians_by_vmap() -> None:
    layer, x = random_layer(), samples(6, 3, 2)
    parameters = {name: p.detach() for name, p in layer.named_parameters()}

    def one(values: dict, sample: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(layer, values, (sample,))

    jacobian: Callable = torch.func.vmap(torch.func.jacrev(one), (None, 0))
    rows = jacobian(parameters, x)["consequents"]
    expected = layer.regressors(x)[:, 0].detach()
    torch.testing.assert_close(rows[:, 0, 0, 0, 0].flatten(1), expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("options", [VARIANTS[0], *VARIANTS[4:]])
def test_scripted_and_exported_layers_agree(options: dict) -> None:
    layer, x = random_layer(**options), samples(9, 3, 2)
    scripted = torch.jit.script(layer)
    torch.testing.assert_close(scripted(x), layer(x), rtol=1e-14, atol=1e-15)
    shapes = ({0: torch.export.Dim("samples")},)
    program = torch.export.export(layer, (x,), dynamic_shapes=shapes, strict=True)
    z = samples(5, 3, 2, seed=3)
    torch.testing.assert_close(program.module()(z), layer(z), rtol=1e-14, atol=1e-15)


def test_float32_agrees_with_float64() -> None:
    layer = Anfis(2, 2, [3, 3], 1).float()
    x = samples(10, 2, 2).float()
    layer.solve_consequents(x, x[..., :1] ** 2)
    assert layer(x).dtype == torch.float32
    assert (layer(x) - x[..., :1] ** 2).abs().max() < 0.1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 1, [2], 1), "at least 1"),
        ((1, 2, [2], 1), "terms"),
        ((1, 1, [0], 1), "terms"),
        ((1, 8, [9] * 8, 1), "rules"),
    ],
)
def test_unsound_sizes_are_refused(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Anfis(*arguments)


def test_unsound_options_and_samples_are_refused() -> None:
    with pytest.raises(ValueError, match="order"):
        Anfis(1, 1, [2], 1, order=2)
    with pytest.raises(ValueError, match="kind"):
        Anfis(1, 1, [2], 1, kind="cone")
    layer, x = Anfis(1, 1, [2], 1), samples(10, 1, 1)
    with pytest.raises(ValueError, match="lower"):
        layer.init_grid(1.0, 1.0)
    with pytest.raises(ValueError, match="finite"):
        layer.solve_consequents(x, x * torch.nan)
    with pytest.raises(ValueError, match="negative"):
        layer.solve_consequents(x, x, prior_precision=-1.0)
    with pytest.raises(ValueError, match="sample"):
        layer.solve_consequents(x[:0], x[:0])
    with pytest.raises(ValueError, match="centres"):
        layer.init_from_sets([x[:, 0, 0]], [x[:, 0, 0]])


@pytest.mark.parametrize("options", VARIANTS)
@pytest.mark.parametrize("terms", [(5,), (4, 3), (2, 3, 2)])
def test_input_jacobian_has_one_block_per_output(options: dict, terms: tuple[int, ...]) -> None:
    layer = random_layer(terms=terms, **options)
    x = samples(20, 3, len(terms)).requires_grad_()
    y = layer(x)
    found = layer.input_jacobian(x)
    assert found.shape == (3, 2, len(terms), 20)
    for k in range(2):
        (expected,) = torch.autograd.grad(y[..., k].sum(), x, retain_graph=True)
        # Sums of the same numbers in another order.
        torch.testing.assert_close(
            found[:, k].permute(2, 0, 1), expected, rtol=1e-10, atol=1e-12 * float(expected.std())
        )
