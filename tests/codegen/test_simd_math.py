"""Vectorised exp, tanh, sin and cos equal the maths library's to a few ulp."""

import numpy as np
import pytest

from nfriction.codegen import jit
from nfriction.codegen.emit import write_function
from nfriction.codegen.ir import Body
from nfriction.codegen.scalar import Graph, evaluate

OPERATIONS = ("sin", "cos", "exp", "tanh")


def built(outputs, places, width=0):
    """Emitted code as a function of arrays, (input, width) and (output, width)."""
    body = Body()
    write_function(body, "f", {"y": outputs}, places, [], ["x"], width)
    with body.function("define void @entry(i64 %a, i64 %b, ptr %x, ptr %y, ptr %z)"):
        body.run("call void @f(ptr %x, ptr %y)")
        body.run("ret void")
    function = jit.build(body.text(), "entry")

    def run(x):
        y = np.empty((len(outputs), max(1, width)))
        function(0, 0, np.ascontiguousarray(x).ctypes.data, y.ctypes.data, 0)
        return y

    return run


@pytest.fixture(scope="module", params=[0, 4, 8])
def functions(request):
    """Each function of 8 numbers: as calls that share vectors, and as vectors throughout."""
    g, width = Graph(), request.param
    x = [g.input("x", i) for i in range(8 // max(1, width))]
    places = {a.number: ("x", i) for i, a in enumerate(x)}
    run = built([g.apply(op, a) for op in OPERATIONS for a in x], places, width)

    def evaluated(op, x):
        rows = np.asarray(x, dtype=float).reshape(-1, 8)
        return np.concatenate([run(r).reshape(4, 8)[OPERATIONS.index(op)] for r in rows])

    return evaluated


@pytest.mark.parametrize(
    ("op", "exact", "scales"),
    [
        ("exp", np.exp, (1e-9, 1.0, 30.0, 700.0)),
        ("tanh", np.tanh, (1e-9, 0.3, 2.0, 30.0)),
        ("sin", np.sin, (1e-9, 0.8, 4.0, 100.0, 9e4, 1e7)),
        ("cos", np.cos, (1e-9, 0.8, 4.0, 100.0, 9e4, 1e7)),
    ],
)
def test_errors_stay_below_three_units_in_the_last_place(functions, op, exact, scales):
    for scale in scales:
        x = np.random.default_rng(0).uniform(-scale, scale, 4000)
        expected = exact(x.astype(np.longdouble))
        units = np.abs(functions(op, x) - expected) / np.spacing(np.abs(expected.astype(float)))
        assert units.max() < 3


def test_special_values_equal_the_librarys(functions):
    x = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 1e300, -1e300, 800.0])
    with np.errstate(all="ignore"):
        for op, exact in (("tanh", np.tanh), ("sin", np.sin), ("cos", np.cos)):
            np.testing.assert_array_equal(functions(op, x), exact(x))
        assert np.signbit(functions("tanh", x)[4])
        # Below -708, where the library still returns denormals down to 1e-324, the result stops at
        # 1e-308.
        np.testing.assert_allclose(functions("exp", x), np.exp(x), atol=1e-307)


def test_relative_accuracy_is_kept_near_multiples_of_pi_over_two(functions):
    x = np.arange(1, 4001) * (np.pi / 2)
    np.testing.assert_allclose(functions("sin", x), np.sin(x), rtol=1e-15)
    np.testing.assert_allclose(functions("cos", x), np.cos(x), rtol=1e-15)


def test_vector_and_scalar_calls_agree_and_respect_dependencies():
    """Calls that depend on other results, and values that are used long after both."""
    g = Graph()
    x = [g.input("x", i) for i in range(5)]
    places = {a.number: ("x", i) for i, a in enumerate(x)}
    waves = [g.apply(op, a) for a in x for op in OPERATIONS]
    products = [g.apply("mul", a, b) for a, b in zip(waves[1:], waves[:-1], strict=True)]
    inner = g.apply("tanh", g.total(products))
    outer = g.apply("exp", g.apply("sub", inner, products[0]))
    outputs = [outer, g.apply("add", g.total(products), outer), inner, waves[3], *products]
    values = np.random.default_rng(1).uniform(-1, 1, (5, 8))
    single = built(outputs, places)
    alone = np.concatenate([single(column) for column in values.T], axis=1)
    np.testing.assert_array_equal(built(outputs, places, 8)(values), alone)
    np.testing.assert_array_equal(built(outputs, places, 4)(values[:, :4]), alone[:, :4])
    np.testing.assert_allclose(alone, evaluate(outputs, {"x": values.T}), rtol=1e-13)
