"""The functions that numba computes four at a time are the library's, as those in C are."""

import numpy as np
import pytest

from nfriction.codegen import build
from nfriction.codegen.emit import COMPILED, PYTHON_PRELUDE
from nfriction.codegen.kernels import ARRAY, of_arrays
from nfriction.codegen.lanes_python import function, prelude
from nfriction.codegen.scalar import Graph, evaluate

pytest.importorskip("numba")


ENTRY = f"""
@njit(void(REALS, REALS), {COMPILED})
def entry(x, y):
    f(x, y)
"""


def build_f(outputs, bound):
    """A function of two arrays, `x` and what becomes of it."""
    into = [f"y[{i}]" for i in range(len(outputs))]
    text = PYTHON_PRELUDE + prelude() + function("f", ["x", "y"], outputs, bound, into) + ENTRY
    return of_arrays(build.build_numba(text, "entry", [ARRAY, ARRAY]))


@pytest.fixture(scope="module")
def four(tmp_path_factory):
    """What emitted code computes of four numbers: sines, cosines, exponentials, tangents."""
    g = Graph()
    x = [g.input("x", i) for i in range(4)]
    bound = {a.number: f"x[{i}]" for i, a in enumerate(x)}
    nodes = [g.apply(op, a) for op in ("sin", "cos", "exp", "tanh") for a in x]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NFRICTION_CACHE", str(tmp_path_factory.mktemp("vectors")))
        f = build_f(nodes, bound)

    def run(op, x):
        rows, out = np.asarray(x, dtype=float).reshape(-1, 4), np.empty(16)
        place = ("sin", "cos", "exp", "tanh").index(op)
        found = []
        for row in rows:
            f(row, out)
            found.append(out[4 * place : 4 * place + 4].copy())
        return np.concatenate(found)

    return run


@pytest.mark.parametrize(
    ("op", "exact", "scales"),
    [
        ("exp", np.exp, (1e-9, 1.0, 30.0, 700.0)),
        ("tanh", np.tanh, (1e-9, 0.3, 2.0, 30.0)),
        ("sin", np.sin, (1e-9, 0.8, 4.0, 100.0, 9e4, 1e7)),
        ("cos", np.cos, (1e-9, 0.8, 4.0, 100.0, 9e4, 1e7)),
    ],
)
def test_errors_stay_below_three_units_in_the_last_place(four, op, exact, scales):
    for scale in scales:
        x = np.random.default_rng(0).uniform(-scale, scale, 4000)
        expected = exact(x.astype(np.longdouble))
        units = np.abs(four(op, x) - expected) / np.spacing(np.abs(expected.astype(float)))
        assert units.max() < 3


def test_special_values_are_the_librarys(four):
    x = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 1e300, -1e300, 800.0])
    with np.errstate(all="ignore"):
        for op, exact in (("tanh", np.tanh), ("sin", np.sin), ("cos", np.cos)):
            np.testing.assert_array_equal(four(op, x), exact(x))
        assert np.signbit(four("tanh", x)[4])
        # Below -708, where the library still counts down to 1e-324, the result stops at 1e-308.
        np.testing.assert_allclose(four("exp", x), np.exp(x), atol=1e-307)


def test_phases_that_wait_for_each_other_keep_every_value():
    """Values read by a later phase, names and all, against the same graph in NumPy."""
    g = Graph()
    x = [g.input("x", i) for i in range(5)]
    bound = {a.number: f"x[{i}]" for i, a in enumerate(x)}
    waves = [g.apply(op, a) for a in x for op in ("sin", "cos", "exp", "tanh")]
    products = [g.apply("mul", a, b) for a, b in zip(waves[1:], waves[:-1], strict=True)]
    inner = g.apply("tanh", g.total(products))
    # A sum of both phases, and an argument that is itself kept.
    outer = g.apply("exp", g.apply("sub", inner, products[0]))
    outputs = [outer, g.apply("add", g.total(products), outer), inner, waves[3]]
    values, got = np.linspace(-1, 1, 5), np.empty(len(outputs))
    build_f(outputs, bound)(values, got)
    expected = evaluate(outputs, {"x": values})
    np.testing.assert_allclose(got, [float(e) for e in expected], rtol=1e-14)
