"""The exponential and the hyperbolic tangent of exported C are accurate."""

import ctypes
import math
import shutil
import subprocess

import numpy as np
import pytest

from nfriction.export.c_dialect import ControllerC
from nfriction.export.c_model import exponential

GCC = shutil.which("gcc")
# Range of arguments. Below -87.3 the result is 0, and further down k would overflow its integer;
# above zero, which rounding can cause, it would be rounded in the wrong direction.
LEAST, LARGEST = -1e9, 0.1
TANH = 64


@pytest.fixture(scope="module", params=["-O0", "-O2", "-O3", "-O3 -ffast-math -march=native"])
def library(request, tmp_path_factory):
    """`double_exp` and `float_exp` as a host would compile them."""
    if not GCC:
        pytest.skip("needs gcc")
    folder = tmp_path_factory.mktemp("exp")
    texts = ["#include <limits.h>\n#include <math.h>\n#include <string.h>"]
    for real in ("double", "float"):
        dialect = ControllerC(real, real)
        body = dialect.text("numbers.c") + exponential(dialect, TANH, 1)
        texts += [f"#define {real.upper()}_JOINTS {TANH}", dialect.functions(body), body]
        for name, less in (("run", 0), ("less", 1)):
            texts.append(
                f"void {name}_{real}({real} *x, int n) {{ {real}_exp(x, n, ({real}){less}); }}"
            )
        texts.append(f"void tanh_{real}({real} *x, int n) {{ (void)n; {real}_tanh(x); }}")
    (folder / "e.c").write_text("\n".join(texts))
    # Linked separately: with -ffast-math it would disable subnormal numbers in this process.
    for command in (["-std=c99", *request.param.split(), "-fPIC", "-c", "e.c"],
                    ["-shared", "e.o", "-o", "e.so"]):  # fmt: skip
        subprocess.run([GCC, *command], cwd=folder, check=True, capture_output=True)
    loaded = ctypes.CDLL(str(folder / "e.so"))
    loaded.joins_terms = "-ffast-math" in request.param
    return loaded


def run(library, real: str, x: np.ndarray, name: str = "run") -> np.ndarray:
    found = np.ascontiguousarray(x, dtype={"double": np.float64, "float": np.float32}[real]).copy()
    getattr(library, f"{name}_{real}")(ctypes.c_void_p(found.ctypes.data), ctypes.c_int(len(found)))
    return found


@pytest.mark.parametrize("real", ["double", "float"])
def test_exp_is_accurate_to_one_and_a_half_ulp(library, real):
    kind = np.float64 if real == "double" else np.float32
    random = np.random.default_rng(0)
    x = np.concatenate([-(10.0 ** random.uniform(-20, 1.9, 100_001)), [0.0, LARGEST]]).astype(kind)
    exact = np.exp(x.astype(np.longdouble))
    # -ffast-math may merge both parts of ln 2: an error of half an ulp of it k times, k = |x| / ln
    # 2.
    allowed = 1.5 + 0.75 * np.abs(x.astype(np.float64)) * library.joins_terms
    error = np.abs(run(library, real, x) - exact) / np.spacing(exact.astype(kind))
    assert (error <= allowed).all()


@pytest.mark.parametrize("real", ["double", "float"])
def test_expm1_is_accurate_for_small_arguments(library, real):
    kind = np.float64 if real == "double" else np.float32
    random = np.random.default_rng(0)
    x = np.concatenate([-(10.0 ** random.uniform(-20, 1.6, 100_001)), [0.0]]).astype(kind)
    exact = np.expm1(x.astype(np.longdouble))
    error = np.abs(run(library, real, x, "less") - exact)
    # -ffast-math may merge both parts of ln 2, which shifts the argument by |x| / ln 2 half ulps.
    joined = 0.75 * np.abs(x.astype(np.float64)) * np.exp(x) * library.joins_terms
    allowed = 2.5 * np.spacing(np.abs(exact).astype(kind)) + joined * np.spacing(kind(1.0))
    assert (error <= allowed).all()


@pytest.mark.parametrize("real", ["double", "float"])
def test_exp_underflows_to_zero_and_keeps_nan(library, real):
    x = np.array([-88.1, -1e3, -1e6, LEAST])
    assert (run(library, real, x) == 0.0).all()
    assert np.isnan(run(library, real, np.array([math.nan] * 5))).all()


@pytest.mark.parametrize("real", ["double", "float"])
def test_tanh_is_accurate_at_every_magnitude(library, real):
    random = np.random.default_rng(1)
    x = np.concatenate([10.0 ** random.uniform(-20, 3, TANH - 4), [0.0, 20.0, 1e6, 1e-300]])
    x = (x * random.choice([-1.0, 1.0], TANH)).astype(
        np.float64 if real == "double" else np.float32
    )
    found = run(library, real, x, "tanh")
    exact = np.tanh(x.astype(np.longdouble))
    # Relative to the result: there is no cancellation around zero.
    assert (np.abs(found - exact) <= 6 * np.spacing(np.abs(exact).astype(x.dtype))).all()
