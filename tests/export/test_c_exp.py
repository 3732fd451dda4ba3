"""The exponential of exported C is accurate, and is taken only where it may be."""

import ctypes
import math
import shutil
import subprocess

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nfriction.codegen.function import specialise
from nfriction.codegen.joints import template
from nfriction.codegen.scalar import evaluate, reachable
from nfriction.export.c_bounds import bounds_of
from nfriction.export.c_dialect import bits
from nfriction.export.c_exp import LARGEST, LEAST, by_exponentials, exponential

GCC = shutil.which("gcc")
F64 = torch.float64


@pytest.fixture(scope="module", params=["-O0", "-O2", "-O3", "-O3 -ffast-math -march=native"])
def library(request, tmp_path_factory):
    """`double_exp` and `float_exp` as a host would compile them."""
    if not GCC:
        pytest.skip("needs gcc")
    folder = tmp_path_factory.mktemp("exp")
    texts = ["#include <limits.h>\n#include <string.h>"]
    for real in ("double", "float"):
        texts += [bits(real, real), exponential(real, real)]
        for name, less in (("run", 0), ("less", 1)):
            texts.append(
                f"void {name}_{real}({real} *x, int n) {{ {real}_exp(x, n, ({real}){less}); }}"
            )
    (folder / "e.c").write_text("\n".join(texts))
    # Linked apart: with -ffast-math that would take subnormal numbers from this very process.
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
def test_it_is_accurate_to_one_and_a_half_units_in_the_last_place(library, real):
    kind = np.float64 if real == "double" else np.float32
    random = np.random.default_rng(0)
    x = np.concatenate([-(10.0 ** random.uniform(-20, 1.9, 100_001)), [0.0, LARGEST]]).astype(kind)
    exact = np.exp(x.astype(np.longdouble))
    # -ffast-math may join both parts of ln 2: half a unit of it k times, k = |x| / ln 2.
    allowed = 1.5 + 0.75 * np.abs(x.astype(np.float64)) * library.joins_terms
    error = np.abs(run(library, real, x) - exact) / np.spacing(exact.astype(kind))
    assert (error <= allowed).all()


@pytest.mark.parametrize("real", ["double", "float"])
def test_less_one_small_numbers_keep_their_digits(library, real):
    kind = np.float64 if real == "double" else np.float32
    random = np.random.default_rng(0)
    x = np.concatenate([-(10.0 ** random.uniform(-20, 1.6, 100_001)), [0.0]]).astype(kind)
    exact = np.expm1(x.astype(np.longdouble))
    error = np.abs(run(library, real, x, "less") - exact)
    # -ffast-math may join both parts of ln 2, which moves the argument by |x| / ln 2 half units.
    joined = 0.75 * np.abs(x.astype(np.float64)) * np.exp(x) * library.joins_terms
    allowed = 2.5 * np.spacing(np.abs(exact).astype(kind)) + joined * np.spacing(kind(1.0))
    assert (error <= allowed).all()


@pytest.mark.parametrize("real", ["double", "float"])
def test_it_vanishes_far_below_and_keeps_nan(library, real):
    x = np.array([-88.1, -1e3, -1e6, LEAST])
    assert (run(library, real, x) == 0.0).all()
    assert np.isnan(run(library, real, np.array([math.nan] * 5))).all()


def traced(function, joints: int = 2, size: int = 3):
    inputs = {"x0": torch.rand(joints, size, dtype=F64) + 0.5}
    folded = specialise(function, inputs)
    return template(folded.outputs, {"x0": joints * size}, folded.known, joints)


class Layered(torch.nn.Module):
    """Whatever exported models put into an exponential, and some more."""

    def __init__(self):
        super().__init__()
        self.centres = torch.nn.Parameter(
            torch.tensor([[0.1, 0.5, 0.9], [-1.0, 0.0, 2.0]]).double()
        )

    def forward(self, x):
        held = x.clamp(-1.0, 2.0)
        z = (held - self.centres) * 3.0
        logs = -(z * z)
        shifted = logs - logs.amax(1, keepdim=True)
        shares = torch.softmax(logs, 1)
        root = torch.sqrt(shares + 1.0) + torch.tanh(x) * torch.exp(shifted) - x.abs()
        return torch.cat([shifted, shares, root, torch.minimum(logs, held)], 1)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=6))
def test_no_value_leaves_its_bounds(values):
    one = traced(Layered())
    nodes = one.outputs[0]
    limits = bounds_of(one, nodes)
    for row, columns in zip(np.array(values).reshape(2, 3), one.table, strict=True):
        found = evaluate(nodes, {"x0": row, "p": columns})
        for node, value in zip(nodes, found, strict=True):
            low, high = limits[node.number]
            slack = 1e-12 * max(1.0, abs(float(value)))
            assert low - slack <= float(value) <= high + slack


def test_distances_to_a_maximum_are_known_to_have_a_sign():
    one = traced(Layered())
    limits = bounds_of(one, one.outputs[0])
    for node in one.outputs[0][:3]:
        low, high = limits[node.number]
        assert LEAST < low <= high <= LARGEST


@given(st.lists(st.floats(-1e3, 1e3), min_size=6, max_size=6))
@settings(max_examples=60, deadline=None)
def test_tanh_by_exponentials_is_tanh_and_in_their_range(values):
    one = traced(lambda x: torch.tanh(3.0 * x))
    nodes = by_exponentials(one.graph, one.outputs[0])
    calls = [n for n in reachable(nodes) if n.op in ("tanh", "expm1")]
    assert {n.op for n in calls} == {"expm1"}
    limits = bounds_of(one, nodes)
    assert all(limits[n.args[0].number][0] >= LEAST for n in calls)
    assert all(limits[n.args[0].number][1] <= LARGEST for n in calls)
    x = np.array(values).reshape(2, 3)
    for row in x:
        found = np.array(evaluate(nodes, {"x0": row}))
        # Relative to the result: around zero nothing cancels.
        np.testing.assert_allclose(found, np.tanh(3.0 * row), rtol=1e-15, atol=0.0)
