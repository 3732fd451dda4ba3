"""Packed code computes what the scalars say: joints in step, loops, and tests by the bits."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nfriction.codegen import finite
from nfriction.codegen.elements import Names
from nfriction.codegen.emit import C_PRELUDE, C
from nfriction.codegen.function import specialise
from nfriction.codegen.joints import TABLE, Template, template
from nfriction.codegen.loops import body
from nfriction.codegen.packing import pack
from nfriction.codegen.places import at, place
from nfriction.codegen.scalar import Graph, evaluate, reachable
from nfriction.codegen.squares import completed

F64 = torch.float64
CC = shutil.which("cc") or shutil.which("gcc")
JOINTS = 3


def templated(function, *shapes, joints=JOINTS):
    inputs = {f"x{i}": torch.rand(joints, *s, dtype=F64) + 0.5 for i, s in enumerate(shapes)}
    folded = specialise(function, inputs)
    sizes = {name: x.numel() for name, x in inputs.items()}
    return template(folded.outputs, sizes, folded.known, joints)


def evaluated(one, x: np.ndarray) -> np.ndarray:
    """The first output of every row of a template of one input, in NumPy."""
    rows = x.reshape(one.joints, -1)
    values = [
        evaluate(one.outputs[0], {"x0": row, TABLE: columns})
        for row, columns in zip(rows, one.table, strict=True)
    ]
    return np.array(values).reshape(-1)


class Network(torch.nn.Module):
    """Distances to centres, a softmax, a product of shares and a linear layer for every joint."""

    def __init__(self, units: int = 6):
        super().__init__()
        random = torch.Generator().manual_seed(0)
        shape = (JOINTS, units, 4)
        self.centres = torch.nn.Parameter(torch.randn(shape, generator=random, dtype=F64))
        self.widths = torch.nn.Parameter(torch.rand(shape, generator=random, dtype=F64) + 0.5)
        self.weights = torch.nn.Parameter(
            torch.randn(JOINTS, 2, units, generator=random, dtype=F64)
        )

    def forward(self, x):
        distance = ((x.unsqueeze(1) - self.centres) / self.widths).square().sum(-1)
        shares = torch.softmax(-distance, -1) * (1.0 + torch.exp(-distance))
        return (self.weights * shares.unsqueeze(1)).sum(-1)


def expanded(x):
    """A quadratic form as products of matrices would compute it."""
    q = -torch.arange(1.0, 13.0, dtype=F64).reshape(JOINTS, 4)
    m = torch.linspace(-1.0, 1.0, 12, dtype=F64).reshape(JOINTS, 4)
    return torch.exp((q * (x * x)).sum(-1) + (-2.0 * q * m * x).sum(-1) + (q * m * m).sum(-1))


def compiled(one, tmp_path, calls=()):
    """One row of a template of one input and one output, as C."""
    packing = pack(one.outputs[0], calls)
    names = Names("c")

    def bound(node):
        name, index = node.value
        return f"{name}[{packing.place(node) if name == TABLE else index}]"

    made = body(one.outputs[0], packing, C(), bound, (), names)
    stores = [f"out[{i}] = {text};" for i, text in enumerate(made.texts)]
    constants = [
        f"static const {kind} {name}[] = {{{', '.join(values)}}};"
        for name, (kind, values) in names.arrays.items()
    ]
    inside = "\n".join([*made.declarations, *made.statements, *stores])
    source = "\n".join(
        [
            C_PRELUDE,
            *constants,
            f"void f(const double *{TABLE}, const double *x0, double *out) {{\n{inside}\n}}",
        ]
    )
    (tmp_path / "f.c").write_text(source)
    command = [CC, "-std=c99", "-O1", "-shared", "-fPIC", "-o", str(tmp_path / "f.so")]
    subprocess.run([*command, str(tmp_path / "f.c"), "-lm"], check=True)
    function = ctypes.CDLL(str(tmp_path / "f.so")).f
    columns = [
        np.full(one.joints, n.value) if n.op == "constant" else one.table[:, n.value[1]]
        for n in packing.columns
    ]
    table = np.ascontiguousarray(np.stack(columns, -1)) if columns else np.zeros((one.joints, 1))

    def run(x):
        rows = np.ascontiguousarray(x, dtype=np.float64).reshape(one.joints, -1)
        out = np.empty((one.joints, len(one.outputs[0])))
        for j in range(one.joints):
            arrays = (table[j], rows[j], out[j])
            function(*(ctypes.c_void_p(a.ctypes.data) for a in arrays))
        return out.reshape(-1)

    return run, source


@pytest.mark.skipif(CC is None, reason="needs a C compiler")
@pytest.mark.parametrize("units", [4, 6, 25])
def test_loops_equal_the_module(tmp_path, units):
    network = Network(units)
    one = templated(network, (4,))
    assert one.joints == JOINTS
    run, source = compiled(one, tmp_path)
    x = torch.randn(JOINTS, 4, dtype=F64)
    np.testing.assert_allclose(run(x.numpy()), network(x).detach().reshape(-1), rtol=1e-13)
    # As much code for 25 units as for 6.
    assert source.count("exp(") <= 2
    assert len(source) < 4000


@pytest.mark.skipif(CC is None, reason="needs a C compiler")
@pytest.mark.parametrize("units", [4, 6, 25])
def test_lanes_give_every_joint_what_its_row_gives(tmp_path, units):
    """The same body over arrays with the joints side by side, all of them in one call."""
    network = Network(units)
    one = templated(network, (4,))
    packing, names = pack(one.outputs[0]), Names("c")

    def bound(node):
        name, index = node.value
        return f"{name}[{at(packing.place(node) if name == TABLE else index, JOINTS)}]"

    made = body(one.outputs[0], packing, C(), bound, (), names, lanes=JOINTS)
    count = len(made.texts)
    stores = "".join(f"out[{count} * j + {i}] = {text};" for i, text in enumerate(made.texts))
    stores = f"for (j = 0; j < {JOINTS}; ++j) {{ {stores} }}"
    constants = [
        f"static const {kind} {name}[] = {{{', '.join(values)}}};"
        for name, (kind, values) in names.arrays.items()
    ]
    inside = "\n".join([*made.declarations, *made.statements, stores])
    head = f"void f(const double *{TABLE}, const double *x0, double *out)"
    (tmp_path / "f.c").write_text("\n".join([C_PRELUDE, *constants, f"{head} {{\n{inside}\n}}"]))
    command = [CC, "-std=c89", "-O3", "-shared", "-fPIC", "-o", str(tmp_path / "f.so")]
    subprocess.run([*command, str(tmp_path / "f.c"), "-lm"], check=True)
    x = torch.randn(JOINTS, 4, dtype=F64)
    columns = [one.table[:, n.value[1]] for n in packing.columns]
    out = np.empty(JOINTS * count)
    arrays = np.concatenate(columns), np.ascontiguousarray(x.mT.numpy()), out
    function = ctypes.CDLL(str(tmp_path / "f.so")).f
    function(*(ctypes.c_void_p(a.ctypes.data) for a in arrays))
    np.testing.assert_allclose(out, network(x).detach().reshape(-1), rtol=1e-13)


@pytest.mark.skipif(CC is None, reason="needs a C compiler")
def test_calls_are_packed_however_few(tmp_path):
    """Those that wait for another come in a pack of their own."""

    def nested(x):
        first = torch.expm1(x[:, 0]) + torch.expm1(2.0 * x[:, 1])
        return torch.expm1(first) * x[:, 0]

    one = templated(nested, (2,))
    packs = {id(made): made for made, _ in pack(one.outputs[0], ("expm1",)).home.values()}
    assert sorted(len(made.nodes) for made in packs.values() if made.op == "expm1") == [1, 2]
    run, _ = compiled(one, tmp_path, ("expm1",))
    x = 0.3 * torch.randn(JOINTS, 2, dtype=F64)
    np.testing.assert_allclose(run(x.numpy()), nested(x), rtol=1e-13)


def test_joints_that_look_at_each_other_are_one_row():
    def coupled(x):
        return x * x.sum()

    one = templated(coupled, ())
    assert one.joints == 1
    x = np.array([1.0, 2.0, 4.0])
    np.testing.assert_array_equal(evaluated(one, x), 7.0 * x)


def test_joints_alike_share_one_row_of_code():
    scale = torch.tensor([1.5, 2.5, 3.5], dtype=F64)
    one = templated(lambda x: scale * torch.tanh(x) + 1.0, ())
    assert one.joints == JOINTS
    assert len(one.outputs[0]) == 1
    x = np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(evaluated(one, x), scale.numpy() * np.tanh(x) + 1.0, rtol=1e-15)


def test_squares_are_completed():
    one = templated(expanded, (4,))
    squared = completed(one)
    x = np.random.default_rng(0).normal(size=(JOINTS, 4))
    np.testing.assert_allclose(evaluated(squared, x), evaluated(one, x), rtol=1e-12)
    count = [sum(n.op == "mul" for n in reachable(t.outputs[0])) for t in (one, squared)]
    assert count[1] < count[0]


def test_a_test_for_infinity_asks_every_input():
    def guarded(x):
        return torch.where(x.abs().sum(-1) < torch.inf, torch.exp(x.sum(-1)), torch.nan)

    one = templated(guarded, (2,))
    nodes = finite.by_bits(one.graph, one.outputs[0])
    tested = [n.args[0].value for n in reachable(nodes) if n.op == "finite"]
    assert sorted(tested) == [("x0", 0), ("x0", 1)]
    test = finite.border(nodes)
    (usual,) = finite.decided(one.graph, nodes, test, True)
    (rare,) = finite.decided(one.graph, nodes, test, False)
    assert usual.op == "exp"
    assert np.isnan(rare.value)
    values = {"x0": np.array([[1.0, 2.0], [np.nan, 1.0], [1.0, -np.inf]])}
    np.testing.assert_array_equal(evaluate(nodes, values)[0], [np.exp(3.0), np.nan, np.nan])


@given(st.integers(1, 30), st.integers(0, 40), st.integers(-3, 3), st.integers(1, 6), st.integers())
@settings(max_examples=200)
def test_an_index_says_where_each_round_reads(count, start, step, divisor, turn):
    index = [start + step * (i // divisor) + turn % 3 * (i % divisor) for i in range(count)]
    text = place(index, [("i", count)])
    if count % divisor == 0:
        assert text is not None
    if text is not None and count > 1:
        lanes = place(index, [("i", count)], 3)
        found = [eval(lanes.replace("/", "//"), {"i": i, "j": 2}) for i in range(count)]
        assert found == [3 * n + 2 for n in index]
    if text is not None:
        assert [eval(text.replace("/", "//"), {"i": i}) for i in range(count)] == index


@given(st.lists(st.tuples(*[st.integers(0, 60)] * 3), min_size=4, max_size=60))
@settings(max_examples=25, deadline=None)
@pytest.mark.skipif(CC is None, reason="needs a C compiler")
def test_random_graphs_survive_packing(tmp_path_factory, lines):
    """Whatever is packed comes in an order in which no loop waits for itself."""
    graph = Graph()
    nodes = [graph.input("x0", i) for i in range(6)]
    for op, i, j in lines:
        name = ("add", "mul", "max", "sub", "tanh")[op % 5]
        args = [nodes[i % len(nodes)], nodes[j % len(nodes)]][: 1 if name == "tanh" else 2]
        nodes.append(graph.apply(name, *args))
    squashed = [graph.apply("tanh", node) for node in nodes[-20:]]
    wanted = tuple(dict.fromkeys([*squashed[-5:], graph.total(squashed)]))
    x = np.linspace(-1.0, 1.0, 6)
    expected = [np.broadcast_to(v, ()) for v in evaluate(wanted, {"x0": x})]
    one = Template(graph, (wanted,), {"x0": 6}, np.empty((1, 0)))
    run, _ = compiled(one, tmp_path_factory.mktemp("random"))
    np.testing.assert_allclose(run(x), expected, rtol=1e-9, atol=1e-9)
