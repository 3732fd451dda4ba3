"""Compiled single functions equal eager ones."""

import re

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from nfriction.codegen import CompiledFunction, jit
from tests.codegen.mechanisms import F64, NeuroFuzzy


class Network(nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.layers = nn.Sequential(nn.Linear(2, 6), nn.Tanh(), nn.Linear(6, 3)).double()

    def forward(self, x, y):
        return self.layers(x), torch.maximum(x, y).sum()


def everything(x, y):
    """One of each scalar operation."""
    p = x.abs() + 0.1
    return torch.stack([
        x + y, x - y, x * y, x / p, -x, p, p**1.7, torch.fmod(x, p), torch.remainder(x, p),
        torch.atan2(x, y), torch.maximum(x, y), torch.minimum(x, y), p.sqrt(), x.exp(), x.expm1(),
        p.log(), p.log1p(), x.sin(), x.cos(), x.tan(), x.tanh().asin(), x.tanh().acos(), x.atan(),
        x.sinh(), x.cosh(), x.tanh(), (3 * x).floor(), (3 * x).ceil(), (3 * x).trunc(),
        torch.where((x < y) & (x <= 1) | ~(x == y), x, y), (x != y).to(F64), -(-x - y) * -(x - 9.0),
        torch.where(torch.logical_xor(x > 0, y > 0), x * 1e-320, torch.inf), x - (y - (x - y)),
        x / (y / p), (x < 0).to(F64) - ((x > y) == (y > 0)).to(F64),
    ])  # fmt: skip


def test_every_operation_agrees():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 50, 3))
    compiled = CompiledFunction(everything, torch.randn(2, 3, dtype=F64).unbind())
    expected = torch.stack([everything(a, b) for a, b in zip(*map(torch.tensor, (x, y)))])  # noqa: B905
    np.testing.assert_allclose(compiled(x, y), expected.numpy(), rtol=1e-13, atol=1e-15)


def test_booleans_act_as_numbers_in_arithmetic():
    def f(x):
        above = x > 0
        counted = above.to(F64) * (x < 2)
        return torch.where(torch.isfinite(x), counted, above + 1.0), ~above, torch.maximum(above, x)

    x = np.array([[np.nan, np.inf, -1.0, 0.0, 1.0, 3.0]])
    compiled = CompiledFunction(f, [torch.ones(6, dtype=F64)])
    for ours, expected in zip(compiled(x), f(torch.tensor(x[0])), strict=True):
        np.testing.assert_array_equal(ours[0], expected.numpy().astype(float))


def test_nan_and_infinity_propagate_as_in_torch():
    def f(x, y):
        return torch.stack([torch.maximum(x, y), torch.minimum(x, y), x.clamp(-1.0, 1.0), 1 / x])

    special = np.array([np.nan, np.inf, -np.inf, 0.0, 1.0])
    x, y = (a.reshape(-1, 1) for a in np.meshgrid(special, special))
    compiled = CompiledFunction(f, torch.ones(2, 1, dtype=F64).unbind())
    expected = torch.stack([f(a, b) for a, b in zip(*map(torch.tensor, (x, y)))])  # noqa: B905
    np.testing.assert_array_equal(compiled(x, y), expected.numpy())


def test_parameters_of_a_module_stay_inputs():
    network = Network()
    compiled = CompiledFunction(network, torch.ones(2, 2, dtype=F64).unbind())
    with torch.no_grad():
        network.layers[0].weight *= 2.0
    x = torch.randn(7, 2, dtype=F64)
    out, total = compiled(x, -x)
    np.testing.assert_allclose(out, network(x, -x)[0].detach(), rtol=1e-13)
    assert total.shape == (7,)
    with pytest.raises(ValueError, match="batch"):
        compiled(np.ones((7, 3)), np.ones((7, 3)))


def test_a_bound_method_lifts_its_module():
    friction = NeuroFuzzy(2)
    compiled = CompiledFunction(friction.coefficients, torch.ones(2, 2, dtype=F64).unbind())
    with torch.no_grad():
        friction.rule *= 0.5
    qd, qdd = torch.randn(2, 9, 2, dtype=F64)
    expected = friction.coefficients(qd, qdd).detach()
    np.testing.assert_allclose(compiled(qd, qdd), expected, rtol=1e-12)


OPERATORS = [
    lambda a, b: a + b, lambda a, b: a - b, lambda a, b: a * b, lambda a, b: a / (b.abs() + 1),
    torch.maximum, torch.atan2, lambda a, b: torch.where(a < b, a.sin(), b.tanh()),
    lambda a, b: (a - b).clamp(-1, 1), lambda a, b: -a, lambda a, b: torch.exp(-a.abs()) * b,
]  # fmt: skip


@given(st.lists(st.tuples(*[st.integers(0, 50)] * 3), min_size=1, max_size=20))
@settings(max_examples=15)
def test_random_graphs_agree(lines):
    def f(x, y):
        values = [x, y]
        for op, i, j in lines:
            a, b = values[i % len(values)], values[j % len(values)]
            values.append(OPERATORS[op % len(OPERATORS)](a, b))
        return values[-1]

    x = torch.linspace(-2, 2, 6, dtype=F64).reshape(3, 2)
    compiled = CompiledFunction(f, (x[0], x[1]))
    got, expected = compiled(x, x.flip(0)), f(x, x.flip(0)).numpy()
    np.testing.assert_allclose(got, expected, rtol=1e-10, atol=1e-10)  # chains of 20 products


def test_emitted_code_is_deterministic():
    inputs = [torch.ones(2, dtype=F64), torch.ones(2, dtype=F64)]
    a, b = (CompiledFunction(NeuroFuzzy(2).coefficients, inputs) for _ in range(2))
    assert a.kernel.source() == b.kernel.source()
    assert a.kernel.source(8) == b.kernel.source(8) != a.kernel.source()


@pytest.mark.parametrize("rows", [2, 3, 8, 21])
def test_batched_rows_equal_single_rows_bit_for_bit(rows):
    compiled = CompiledFunction(everything, torch.randn(2, 3, dtype=F64).unbind())
    x, y = np.random.default_rng(2).normal(size=(2, rows, 3))
    together = compiled(x, y)
    for i in range(rows):
        np.testing.assert_array_equal(compiled(x[i : i + 1], y[i : i + 1])[0], together[i])


def test_loader_resolves_all_maths_functions():
    """LLVM on Windows resolves none of them by itself."""
    compiled = CompiledFunction(everything, torch.randn(2, 3, dtype=F64).unbind())
    called = set(re.findall(r"declare double @([a-z0-9]+)\(", compiled.kernel.source()))
    assert called <= set(jit.LIBRARY)
    assert {"fmod", "pow", "log1p"} - called == {"fmod"}  # a remainder is LLVM's own instruction


def test_jacobian_self_check_uses_inputs_with_the_signs_of_the_example(monkeypatch):
    """Negative stiffness or time steps may diverge, and the check would compare noise."""
    checked = []
    eager = CompiledFunction._eager

    def recorded(self, inputs):
        checked.extend(inputs)
        return eager(self, inputs)

    monkeypatch.setattr(CompiledFunction, "_eager", recorded)
    small, size = torch.full((50,), 1e-3, dtype=F64), torch.full((50,), -3.0, dtype=F64)
    CompiledFunction(lambda x, y: (x * y).sum()[None], (small, size), jacobian=(0, 1))
    assert (checked[0] > 0).all()
    assert (checked[1] < 0).all()
    assert not torch.equal(checked[0], small)
