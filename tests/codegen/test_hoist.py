"""Hoisting moves work to where it runs less often and changes no value."""

import numpy as np

from nfriction.codegen.scalar import Graph, UpdateRate, evaluate, reachable
from nfriction.codegen.transform import hoist


def example():
    g = Graph()
    p = [g.input("p", i, UpdateRate.PARAMETER) for i in range(3)]
    x, y = g.input("x", 0), g.input("x", 1)
    product = g.apply("mul", g.apply("mul", p[0], x), p[1])  # (p0 x) p1 = (p0 p1) x
    ratio = g.apply("div", g.apply("sin", x), p[2])
    mixed = g.apply("exp", g.apply("mul", y, p[2]))
    return g, g.total([product, ratio, g.apply("mul", mixed, x)])


def test_parameter_only_operations_leave_the_step():
    g, out = example()
    (step,), once = hoist(g, [[out]])
    for node in reachable(step, once):
        assert node.rate == UpdateRate.STEP or not node.args or node in once
        assert node.op != "div" or node in once
    assert {n.op for n in once} == {"mul", "div"}


def test_regrouping_preserves_the_value():
    g, out = example()
    rng = np.random.default_rng(1)
    inputs = {"p": rng.uniform(1, 2, (9, 3)), "x": rng.normal(size=(9, 2))}
    before, after = evaluate([out, *hoist(g, [[out]])[0][0]], inputs)
    np.testing.assert_allclose(after, before, rtol=1e-14)  # a few rounding errors


def test_outputs_of_every_update_rate_are_collected():
    g = Graph()
    p, x = g.input("p", 0, UpdateRate.PARAMETER), g.input("x", 0)
    outputs = [g.constant(2.0), p, g.apply("exp", p), g.apply("sin", x)]
    assert hoist(g, [outputs[:1], outputs[1:]]) == (
        [tuple(outputs[:1]), tuple(outputs[1:])],
        [outputs[2]],
    )
