"""Hoisting moves work to where it is done less often and changes nothing else."""

import numpy as np

from nfriction.codegen.partition import partition
from nfriction.codegen.scalar import Graph, Level, evaluate, reachable


def example():
    g = Graph()
    p = [g.input("p", i, Level.PARAMETER) for i in range(3)]
    s = g.input("s", 0, Level.STEP)
    x = g.input("x", 0)
    product = g.apply("mul", g.apply("mul", p[0], x), p[1])  # (p0 x) p1 = (p0 p1) x
    ratio = g.apply("div", g.apply("sin", x), p[2])
    held = g.apply("exp", g.apply("mul", s, p[2]))
    return g, g.total([product, ratio, g.apply("mul", held, x)])


def test_no_stage_operation_is_left_that_only_needs_longer_lived_values():
    g, out = example()
    split = partition(g, [out])
    hoisted = {n for nodes in split.hoisted.values() for n in nodes}
    for node in reachable(split.outputs, hoisted):
        assert node.level == Level.STAGE or not node.args or node in hoisted
        assert node.op != "div" or node in hoisted
    operations = {n.op for n in split.hoisted[Level.PARAMETER]}
    assert operations == {"mul", "div"}
    assert [n.op for n in split.hoisted[Level.STEP]] == ["exp"]


def test_regrouping_keeps_the_value():
    g, out = example()
    rng = np.random.default_rng(1)
    inputs = {"p": rng.uniform(1, 2, (9, 3)), "s": rng.normal(size=(9, 1)),
              "x": rng.normal(size=(9, 1))}  # fmt: skip
    before, after = evaluate([out, *partition(g, [out]).outputs], inputs)
    np.testing.assert_allclose(after, before, rtol=1e-14)  # a few roundings


def test_outputs_of_any_level_are_served():
    g = Graph()
    p, s = g.input("p", 0, Level.PARAMETER), g.input("s", 0, Level.STEP)
    outputs = [g.constant(2.0), p, g.apply("exp", p), g.apply("sin", s)]
    split = partition(g, outputs)
    assert list(split.outputs) == outputs
    assert split.hoisted == {Level.PARAMETER: (outputs[2],), Level.STEP: (outputs[3],)}
