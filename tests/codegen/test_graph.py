"""A traced function has torch's values, operation by operation."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from nfriction.codegen import UnsupportedOperation, supported_operations
from nfriction.codegen.graph import LIMIT, trace
from nfriction.codegen.scalar import evaluate

F64 = torch.float64


def traced(function, *examples):
    """Values of the traced function at inputs other than its trace inputs."""
    names = [f"x{i}" for i in range(len(examples))]
    program = trace(
        lambda **inputs: function(*(inputs[n] for n in names)),
        {n: torch.ones_like(x) * 0.3 for n, x in zip(names, examples, strict=True)},
    )
    values = {n: x.numpy().reshape(-1) for n, x in zip(names, examples, strict=True)}
    return [
        np.array(evaluate(port.nodes, values), dtype=float).reshape(port.shape)
        for port in program.outputs
    ]


X = torch.tensor([0.7, -1.3, 0.2, -0.1], dtype=F64)
Y = torch.tensor([-0.4, 0.9, 2.5, -3.0], dtype=F64)
M = torch.linspace(-1, 1, 12, dtype=F64).reshape(3, 4) ** 3 + 0.1
INDEX = torch.tensor([2, 0, 2])


def in_place(x, y):
    out = torch.zeros(3, 2, dtype=F64)
    out[0] = x[:2]
    out[:, 1] += y[1:]
    out.view(-1)[4] = x[3] * y[0]
    row = out[1]
    row.mul_(3.0).clamp_(max=2.0)
    return out


CASES = {
    "arithmetic": lambda x, y, m: (
        x + y,
        x - 2 * y,
        x * y,
        x / y,
        -x,
        1 - x,
        2 / y,
        x.sub(y, alpha=3),
    ),
    "rounding": lambda x, y, m: (
        x.floor(),
        x.ceil(),
        x.trunc(),
        torch.div(x, y, rounding_mode="floor"),
        torch.remainder(x, y),
        torch.fmod(x, y),
        torch.remainder(x, 0.6),
    ),
    "trigonometry": lambda x, y, m: (
        x.sin(),
        x.cos(),
        x.tan(),
        x.atan(),
        torch.atan2(x, y),
        x.tanh().asin(),
        x.tanh().acos(),
        x.sinh(),
        x.cosh(),
    ),
    "exponentials": lambda x, y, m: (
        x.exp(),
        x.expm1(),
        x.abs().log(),
        x.square().log1p(),
        x.abs().sqrt(),
        x.abs().rsqrt(),
        x.reciprocal(),
        x.sigmoid(),
        x.tanh(),
    ),
    "powers": lambda x, y, m: (
        x**2,
        x**3,
        x**-2,
        x.abs() ** 0.5,
        x.abs() ** 1.7,
        2.0**x,
        x.abs() ** y,
    ),
    "activations": lambda x, y, m: (
        functional.softplus(40 * x),
        functional.softplus(x, beta=2.0),
        x.relu(),
        functional.silu(x),
        functional.elu(x),
        functional.leaky_relu(x),
        functional.hardtanh(x),
        functional.logsigmoid(x),
    ),
    "sign": lambda x, y, m: (x.sign(), (0 * x).sign(), x.abs(), x.sgn(), torch.hypot(x, y)),
    "choice": lambda x, y, m: (
        torch.maximum(x, y),
        torch.minimum(x, y),
        x.clamp(-0.5, 0.5),
        x.clamp(min=0.0),
        torch.where(x > y, x, y),
        torch.where(x > 0, 1.0, -1.0),
        x.masked_fill(x < 0, 5.0),
        x.clamp_min(0.1),
        x.clamp_max(0.1),
        torch.clamp(x, y.abs() * 0.1, y.abs()),
    ),
    "comparison": lambda x, y, m: (
        x > y,
        x >= y,
        x < y,
        x <= y,
        x == x,
        x != y,
        (x > 0) & (y > 0),
        (x > 0) | (y > 0),
        ~(x > 0),
        torch.logical_xor(x > 0, y > 0),
        x.isnan(),
        (x > 0).to(F64) * y,
        (x > 0) * y,
    ),
    "views": lambda x, y, m: (
        m.reshape(2, 6),
        m.T,
        m.permute(1, 0),
        m[1],
        m[:, 1:3],
        m[::2],
        m[..., -1],
        m.flatten(),
        m[None].squeeze(0),
        m.unsqueeze(-1),
        x.expand(3, 4),
        m.transpose(0, 1).reshape(-1),
        m.diagonal(),
        m.unflatten(1, (2, 2)),
        m.movedim(0, 1),
        m.view(4, 3),
        m.squeeze(),
    ),
    "assembly": lambda x, y, m: (
        torch.cat([x, y]),
        torch.stack([x, y], -1),
        torch.stack(m.unbind(0), 1),
        torch.cat(m.split(2, 1), 0),
        torch.cat(m.chunk(2, 1), 0),
        m.flip(0),
        m.roll(1, 1),
        x.repeat(2, 2),
        torch.cat(m.split([1, 3], 1), 1),
        x.roll(1),
        functional.pad(x, (1, 2)),
        torch.hstack([x, y]),
    ),
    "indexing": lambda x, y, m: (
        m[INDEX],
        m.index_select(1, INDEX),
        m[[0, 1], [2, 3]],
        m[:, INDEX],
        torch.gather(x, 0, INDEX),
        m[torch.tensor([True, False, True])],
    ),
    "reductions": lambda x, y, m: (
        m.sum(),
        m.sum(0),
        m.sum(-1, keepdim=True),
        m.mean(1),
        m.mean(),
        m.prod(1),
        m.amax(1),
        m.amin(0),
        m.max(),
        m.min(),
        m.cumsum(1),
        x.cumsum(0),
        m.norm(),
        torch.linalg.vector_norm(m, dim=1),
        (x > 0).sum(),
        torch.linalg.vector_norm(x, ord=1),
        m.sum((0, 1)),
    ),
    "softmax": lambda x, y, m: (
        m.softmax(1),
        m.log_softmax(0),
        m.logsumexp(1),
        (800 * m).softmax(1),
        m.exp().sum(1).log(),
    ),
    "products": lambda x, y, m: (
        m @ x,
        x @ y,
        m @ m.T,
        torch.einsum("ij,j,j->i", m, x, y),
        torch.outer(x, y),
        torch.einsum("ij,kj->ik", m, m),
        torch.addmv(m[:, 0], m, x),
        torch.bmm(m[None], m.T[None]),
        functional.linear(x, m, m[:, 0]),
        functional.linear(m, m),
        torch.addmm(m[:, :3], m, m.T, beta=0.5, alpha=2.0),
        torch.dot(x, y),
    ),
    "creation": lambda x, y, m: (
        x + torch.zeros_like(x),
        x * torch.ones(4, dtype=F64),
        x + torch.full((4,), 0.5),
        x.new_tensor([1.0, 2, 3, 4]) * x,
        x * torch.arange(4),
        torch.eye(4, dtype=F64) @ x,
        x.new_zeros(4) + x,
        torch.full_like(x, 2),
    ),
    "copies": lambda x, y, m: (
        x.clone(),
        x.detach(),
        x.contiguous(),
        x.to(F64),
        m.T.contiguous(),
        x.double(),
    ),
    "in place": lambda x, y, m: in_place(x, y),
}


@pytest.mark.parametrize("name", CASES)
def test_traced_values_are_eager_values(name):
    expected = CASES[name](X, Y, M)
    expected = expected if isinstance(expected, tuple) else (expected,)
    got = traced(CASES[name], X, Y, M)
    for i, (a, b) in enumerate(zip(got, expected, strict=True)):
        assert a.shape == tuple(b.shape), (name, i)
        np.testing.assert_allclose(a, b.double().numpy(), rtol=1e-13, atol=1e-15, err_msg=f"{i}")


def test_nan_propagates_as_in_torch():
    x = torch.tensor([float("nan"), 1.0], dtype=F64)
    y = torch.tensor([1.0, float("nan")], dtype=F64)
    for f in (
        torch.maximum,
        torch.minimum,
        lambda a, b: a.clamp(-1, 1) + b,
        lambda a, b: a.softmax(0),
    ):
        np.testing.assert_array_equal(traced(f, x, y)[0], f(x, y).numpy())


def test_same_tensor_passed_twice_is_two_inputs():
    x = torch.tensor([1.0, 2.0], dtype=F64)
    program = trace(lambda a, b: a - 2 * b, {"a": x, "b": x})
    a, b = np.array([5.0, 7.0]), np.array([1.0, 10.0])
    got = evaluate(program.outputs[0].nodes, {"a": a, "b": b})
    np.testing.assert_array_equal(got, a - 2 * b)


def test_tracing_does_not_modify_example_inputs():
    x = torch.ones(3, dtype=F64)
    trace(lambda a: a.mul_(2.0).add_(1.0), {"a": x})
    assert torch.equal(x, torch.ones(3, dtype=F64))


@pytest.mark.parametrize(
    ("function", "named"),
    [
        (lambda x: torch.linalg.svdvals(x.reshape(2, 2)), "svd"),
        (lambda x: x + torch.randn(4, dtype=F64), "randn"),
        (lambda x: x if x.sum() > 0 else -x, "_local_scalar_dense"),
        (lambda x: x * x[0].item(), "_local_scalar_dense"),
        (lambda x: x[(x[:1] > 0).long()], "index"),
        (lambda x: x.sort()[0], "sort"),
        (lambda x: torch.fft.fft(x).real, "fft"),
        (lambda x: x.float() * 2, "float32"),
    ],
)
def test_unsupported_code_raises_error_with_remedy(function, named):
    with pytest.raises(UnsupportedOperation, match=r'backend="torch"') as error:
        trace(function, {"x": X})
    assert named in str(error.value)


def test_a_model_too_large_to_unroll_is_refused():
    with pytest.raises(UnsupportedOperation, match=str(LIMIT)):
        trace(lambda x: torch.outer(x, x), {"x": torch.ones(int(LIMIT**0.5) + 2, dtype=F64)})


def test_single_precision_is_refused_with_remedy():
    with pytest.raises(ValueError, match=r"double\(\)"):
        trace(lambda x: x, {"x": torch.ones(2)})


def test_constant_outputs_are_supported():
    program = trace(lambda x: x * (2.0 if torch.ones(()).item() > 0 else 3.0), {"x": X})
    np.testing.assert_array_equal(
        evaluate(program.outputs[0].nodes, {"x": X.numpy()}), 2 * X.numpy()
    )


def test_the_supported_operations_can_be_listed():
    assert {"sin", "mm", "softplus", "unbind"} <= set(supported_operations())
