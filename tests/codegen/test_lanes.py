"""The functions computed four at a time are the library's, to a few units in the last place."""

import ctypes

import numpy as np
import pytest

from nfriction.codegen import build, lanes
from nfriction.codegen.emit import C, c_function, statements
from nfriction.codegen.scalar import Graph

SOURCE = (
    "#include <math.h>\n"
    + lanes.PRELUDE
    + """
void run_exp(double *x) { nf_exp4(x); }
void run_tanh(double *x) { nf_tanh4(x); }
void run_sincos(double *x, double *c) { nf_sincos4(x, c); }
"""
)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NFRICTION_CACHE", str(tmp_path_factory.mktemp("lanes")))
        return build.build_c(SOURCE)


def run(library, name, x):
    out = [np.array(x, dtype=float) for _ in range(2 if name == "sincos" else 1)]
    for i in range(0, len(x), 4):
        pointers = [ctypes.c_void_p(a[i:].ctypes.data) for a in out]
        getattr(library, f"run_{name}")(*pointers)
    return out


@pytest.mark.parametrize(
    ("name", "exact", "scales"),
    [
        ("exp", [np.exp], (1e-9, 1.0, 30.0, 700.0)),
        ("tanh", [np.tanh], (1e-9, 0.3, 2.0, 30.0)),
        ("sincos", [np.sin, np.cos], (1e-9, 0.8, 4.0, 100.0, 9e4, 1e7)),
    ],
)
def test_errors_stay_below_three_units_in_the_last_place(library, name, exact, scales):
    for scale in scales:
        x = np.random.default_rng(0).uniform(-scale, scale, 4000)
        for got, f in zip(run(library, name, x), exact, strict=True):
            expected = f(x.astype(np.longdouble))
            units = np.abs(got - expected) / np.spacing(np.abs(expected.astype(float)))
            assert units.max() < 3


def test_special_values_are_the_librarys(library):
    x = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 1e300, -1e300, 800.0])
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(run(library, "tanh", x)[0], np.tanh(x))
        # Below -708, where the library still counts down to 1e-324, the result stops at 1e-308.
        np.testing.assert_allclose(run(library, "exp", x)[0], np.exp(x), atol=1e-307)
        sine, cosine = run(library, "sincos", x)
        np.testing.assert_array_equal(sine, np.sin(x))
        np.testing.assert_array_equal(cosine, np.cos(x))


def test_quarter_turns_keep_their_relative_accuracy(library):
    x = np.arange(1, 4001) * (np.pi / 2)
    sine, cosine = run(library, "sincos", x)
    np.testing.assert_allclose(sine, np.sin(x), rtol=1e-15)
    np.testing.assert_allclose(cosine, np.cos(x), rtol=1e-15)


def test_calls_that_depend_on_each_other_are_never_collected_together():
    g = Graph()
    x = [g.input("x", i) for i in range(3)]
    inner = [g.apply("sin", a) for a in x]
    outer = g.apply("cos", g.total(inner))
    lines, (result,) = statements(
        [g.apply("add", outer, inner[0])], {a.number: f"x[{i}]" for i, a in enumerate(x)}, C(), True
    )
    calls = [i for i, line in enumerate(lines) if line.startswith("nf_sincos4")]
    assert len(calls) == 2
    first = lines[calls[0]].split("(")[1].split(" ")[0]
    assert any(first in line for line in lines[calls[0] + 1 : calls[1]])
    assert result


def test_collecting_changes_no_value():
    g = Graph()
    x = [g.input("x", i) for i in range(5)]
    waves = [g.apply(op, a) for a in x for op in ("sin", "cos", "exp", "tanh")]
    total = g.apply("tanh", g.total([g.apply("mul", a, b) for a, b in zip(waves, waves[1:])]))  # noqa: B905, RUF007
    bound = {a.number: f"x[{i}]" for i, a in enumerate(x)}
    values = np.linspace(-1, 1, 5)
    results = []
    for collect in (False, True):
        body = c_function("f", ["x"], {"y": [total, *waves]}, bound, qualifier="", collect=collect)
        library = build.build_c("#include <math.h>\n" + lanes.PRELUDE + body)
        y = np.empty(1 + len(waves))
        library.f(ctypes.c_void_p(values.ctypes.data), ctypes.c_void_p(y.ctypes.data))
        results.append(y)
    np.testing.assert_allclose(results[1], results[0], rtol=1e-14)
