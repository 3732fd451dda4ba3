"""Forward-mode derivatives of traced programs: every rule against torch and finite differences."""

import numpy as np
import pytest
import torch

from nfriction.codegen import CompiledFunction, UnsupportedOperation
from nfriction.codegen.graph import trace
from nfriction.codegen.scalar import Graph, evaluate, reachable
from nfriction.codegen.transform import _RULES, tangents, with_jacobian

RULES = {
    "add": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": lambda x, y: x / y,
    "pow": lambda x, y: (x * x) ** y,
    "where": lambda x, y: torch.where(x < y, x * y, x - y),
    "max": torch.maximum,
    "min": torch.minimum,
    "neg": lambda x, y: -(x * y),
    "abs": lambda x, y: (x - y).abs(),
    "sqrt": lambda x, y: (x * x + y * y).sqrt(),
    "exp": lambda x, y: torch.exp(x * y),
    "log": lambda x, y: torch.log(x * x + y * y),
    "sin": lambda x, y: torch.sin(x * y),
    "cos": lambda x, y: torch.cos(x * y),
    "tanh": lambda x, y: torch.tanh(x * y),
    "atan": lambda x, y: torch.atan(x * y),
}
# Away from the kinks of max, min, abs and where; both orders and signs occur.
X = torch.tensor([0.7, -1.3, 0.4, -0.2], dtype=torch.float64)
Y = torch.tensor([1.9, -0.6, -0.8, 0.5], dtype=torch.float64)


def program(function, *inputs):
    named = {f"x{i}": x for i, x in enumerate(inputs)}

    def call(**given):
        return function(*given.values())

    return trace(call, named)


def jacobian(function, *inputs, wrt=None):
    """Jacobian by the differentiation rules, evaluated in NumPy."""
    names = [f"x{i}" for i in (range(len(inputs)) if wrt is None else wrt)]
    port = with_jacobian(program(function, *inputs), names).outputs[-1]
    given = {f"x{i}": x.reshape(-1).numpy() for i, x in enumerate(inputs)}
    return torch.tensor(np.array(evaluate(port.nodes, given))).reshape(port.shape)


def test_every_rule_has_a_case():
    assert set(RULES) == set(_RULES)


@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize("frozen", [None, 0, 1])
def test_rules_agree_with_torch_and_finite_differences(name, frozen):
    """Both operands vary, then each alone: rules treat a constant operand separately."""
    function = RULES[name]
    wrt = [i for i in (0, 1) if i != frozen]
    found = jacobian(function, X, Y, wrt=wrt)
    exact = torch.cat(torch.func.jacfwd(function, tuple(wrt))(X, Y), -1)
    torch.testing.assert_close(found, exact, rtol=1e-14, atol=1e-14)
    step = 1e-6  # truncation and rounding both about 1e-10
    columns = []
    for i in wrt:
        for unit in torch.eye(4, dtype=torch.float64):
            up, down = [X, Y], [X, Y]
            up[i], down[i] = up[i] + step * unit, down[i] - step * unit
            columns.append((function(*up) - function(*down)) / (2 * step))
    torch.testing.assert_close(found, torch.stack(columns, -1), rtol=1e-7, atol=1e-8)


def test_repeated_variables_and_compositions_are_differentiated():
    def function(x, y):
        z = x * x / (1 + y.exp()) - (x / y)
        return torch.atan(z * z).sum() * z.cos()

    exact = torch.cat(torch.func.jacfwd(function, (0, 1))(X, Y), -1)
    torch.testing.assert_close(jacobian(function, X, Y), exact, rtol=1e-13, atol=1e-13)


def test_identity_and_constant_outputs_have_correct_jacobians():
    found = jacobian(lambda x, y: (x, y.sin(), torch.ones_like(x)), X, Y, wrt=[0])
    eye, zero = torch.eye(4, dtype=torch.float64), torch.zeros(4, 4, dtype=torch.float64)
    assert torch.equal(found, torch.cat([eye, zero, zero]))


def test_directions_without_effect_add_no_operations():
    traced = program(lambda x, y: x.sin() * x.exp(), X, Y)
    outputs = traced.outputs[0].nodes
    size = len(traced.graph)
    unused = traced.inputs[1].nodes[0]
    one = traced.graph.constant(1.0)
    found = tangents(traced.graph, reachable(outputs), {unused.number: one})
    assert not any(node.number in found for node in reachable(outputs))
    assert len(traced.graph) <= size + 1  # the one constant
    jacobian = with_jacobian(traced, ["x1"]).outputs[-1]
    assert all(node.op == "constant" and node.value == 0.0 for node in jacobian.nodes)


def test_missing_rule_raises_only_if_its_operation_is_differentiated():
    with pytest.raises(UnsupportedOperation, match=r"`atan2`.*derivative"):
        jacobian(torch.atan2, X, Y)

    def function(x, y):
        return x * torch.sinh(y)

    with pytest.raises(UnsupportedOperation, match="sinh"):
        jacobian(function, X, Y)
    torch.testing.assert_close(jacobian(function, X, Y, wrt=[0]), torch.diag(torch.sinh(Y)))


def test_conditions_have_no_derivative():
    graph = Graph()
    a, b = graph.input("x", 0), graph.input("x", 1)
    chosen = graph.apply("where", graph.apply("lt", a, b), a, b)
    found = tangents(graph, reachable([chosen]), {a.number: graph.constant(1.0)})
    for x, slope in ((0.0, 1.0), (2.0, 0.0)):
        value = evaluate([found[chosen.number]], {"x": np.array([x, 1.0])})[0]
        assert value == slope


def test_compiled_jacobian_is_batched_and_is_the_last_output():
    def function(x, y):
        return x.tanh() * y.sum(), (x * x).sum()[None]

    compiled = CompiledFunction(function, (X, Y), jacobian=(0, 1))
    rows = torch.linspace(0.5, 2.0, 3, dtype=torch.float64)[:, None]
    *values, found = compiled(rows * X, rows * Y)
    assert [v.shape for v in values] == [(3, 4), (3, 1)]
    assert found.shape == (3, 5, 8)
    for k, row in enumerate(rows):
        blocks = torch.func.jacfwd(lambda *xy: torch.cat(function(*xy)), (0, 1))(row * X, row * Y)
        np.testing.assert_allclose(found[k], torch.cat(blocks, -1), rtol=1e-13, atol=1e-13)
