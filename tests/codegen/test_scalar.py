"""Simplification changes the graph, never the value."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nfriction.codegen.scalar import EVALUATE, Graph, UpdateRate, evaluate, reachable

UNARY = ("neg", "abs", "sin", "cos", "tanh", "exp", "sqrt", "atan", "floor")
BINARY = ("add", "sub", "mul", "div", "max", "min", "atan2", "pow")
VALUES = (0.0, 1.0, -1.0, 2.0, 0.5, -0.5, 3.0)


@st.composite
def recipes(draw):
    """Straight-line programs: each line names an operation and earlier lines as its operands."""
    size = draw(st.integers(1, 25))
    lines = []
    for i in range(size):
        earlier = st.integers(0, i + 3)
        kind = draw(st.sampled_from(("unary", "binary", "binary", "where", "constant")))
        if kind == "unary":
            lines.append((draw(st.sampled_from(UNARY)), draw(earlier)))
        elif kind == "binary":
            lines.append((draw(st.sampled_from(BINARY)), draw(earlier), draw(earlier)))
        elif kind == "where":
            lines.append(("where", draw(earlier), draw(earlier), draw(earlier)))
        else:
            lines.append(("constant", draw(st.sampled_from(VALUES))))
    return lines


def build(lines):
    """The same recipe as a graph and as plain NumPy."""
    g = Graph()
    nodes = [g.input("x", i) for i in range(4)]
    x = np.random.default_rng(0).normal(size=(5, 4))
    values = [x[:, i] for i in range(4)]
    with np.errstate(all="ignore"):
        for op, *args in lines:
            if op == "constant":
                nodes.append(g.constant(args[0]))
                values.append(np.full(5, args[0]))
            elif op == "where":
                a, b, c = args
                nodes.append(
                    g.apply("where", g.apply("lt", nodes[a], nodes[b]), nodes[b], nodes[c])
                )
                values.append(np.where(values[a] < values[b], values[b], values[c]))
            else:
                nodes.append(g.apply(op, *(nodes[a] for a in args)))
                values.append(EVALUATE[op](*(values[a] for a in args)))
    return nodes[-1], values[-1], x


@given(recipes())
@settings(max_examples=150, deadline=None)
def test_simplification_preserves_the_value(lines):
    node, expected, x = build(lines)
    got = np.broadcast_to(evaluate([node], {"x": x})[0], expected.shape)
    finite = np.isfinite(expected)  # 0 * inf may become 0, as a written zero means "no coupling"
    # Integer powers are expanded into products; their rounding errors are then amplified.
    np.testing.assert_allclose(got[finite], expected[finite], rtol=1e-9, atol=1e-9)


def test_equal_operations_share_a_node():
    g = Graph()
    x, y = g.input("x", 0), g.input("x", 1)
    assert g.apply("add", x, y) is g.apply("add", y, x)
    assert g.apply("neg", g.apply("sub", x, y)) is g.apply("sub", y, x)
    assert g.apply("cos", g.apply("neg", x)) is g.apply("cos", x)
    difference = g.apply("sub", x, x)
    assert g.apply("sub", x, x) is difference


@pytest.mark.parametrize(
    ("op", "value"), [("mul", 1.0), ("add", 0.0), ("sub", 0.0), ("div", 1.0), ("pow", 1.0)]
)
def test_neutral_elements_are_removed(op, value):
    g = Graph()
    x = g.input("x", 0)
    assert g.apply(op, x, g.constant(value)) is x


def test_constants_fold_like_numpy_even_where_python_would_raise():
    g = Graph()
    zero = g.constant(0.0)
    assert g.apply("div", g.constant(1.0), zero).value == math.inf
    assert math.isnan(g.apply("div", zero, zero).value)
    assert g.apply("exp", g.constant(1e4)).value == math.inf


def test_signed_zeros_and_nan_are_distinguished():
    g = Graph()
    assert g.constant(-0.0) is not g.constant(0.0)
    assert g.constant(math.nan) is g.constant(math.nan)
    assert g.constant(True) is not g.constant(1.0)


def test_update_rate_is_that_of_the_most_volatile_argument():
    g = Graph()
    p, x = g.input("p", 0, UpdateRate.PARAMETER), g.input("x", 0)
    assert g.apply("mul", p, g.constant(2.0)).rate == UpdateRate.PARAMETER
    assert g.apply("mul", g.apply("exp", p), x).rate == UpdateRate.STEP


def test_reachable_lists_arguments_first_and_omits_dead_code():
    g = Graph()
    x = g.input("x", 0)
    dead = g.apply("exp", x)
    out = g.apply("add", g.apply("sin", x), g.apply("cos", x))
    nodes = reachable([out])
    assert dead not in nodes
    assert all(nodes.index(a) < i for i, node in enumerate(nodes) for a in node.args)
