"""Air drag: closed form compared with quadrature, and dissipation."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nfriction.plant import PendulumChain, rigs
from nfriction.plant.dynamics import square_moments

SPEEDS = st.floats(-20, 20).filter(lambda v: v == 0 or abs(v) > 1e-9)


@given(start=SPEEDS, end=SPEEDS)
def test_moments_equal_the_integrals(start: float, end: float) -> None:
    zero = start / (start - end) if start * end < 0 else 0.5
    mean = first = 0.0
    nodes, weights = np.polynomial.legendre.leggauss(3)  # exact for cubics
    for low, high in ((0.0, zero), (zero, 1.0)):  # v |v| is a polynomial on either side of v = 0
        t = low + (high - low) * (nodes + 1) / 2
        v = start + t * (end - start)
        mean += (weights * v * np.abs(v)).sum() * (high - low) / 2
        first += (weights * t * v * np.abs(v)).sum() * (high - low) / 2
    got = square_moments(*torch.tensor([start, end], dtype=torch.float64))
    scale = max(start**2, end**2)
    assert got[0].item() == pytest.approx(mean, abs=1e-13 * scale)
    assert got[1].item() == pytest.approx(first, abs=1e-13 * scale)


def test_moments_have_finite_gradients_at_rest() -> None:
    for dtype in (torch.float64, torch.float32):
        ends = [torch.zeros((), dtype=dtype, requires_grad=True) for _ in range(2)]
        total = sum(square_moments(*ends))
        assert total.item() == 0
        assert all(g.item() == 0 for g in torch.autograd.grad(total, ends))


def dragged(linear: list[float], quadratic: list[float]) -> PendulumChain:
    return rigs.multiarm_triple().replace(
        drag_linear=torch.tensor(linear).double(), drag_quadratic=torch.tensor(quadratic).double()
    )


def by_quadrature(rig: PendulumChain, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Drag torque per joint by the midpoint rule, from the position of every point of the links."""
    phi, rate = np.cumsum(q), np.cumsum(qd)
    length, k1, k2 = (x.numpy() for x in (rig.length, rig.drag_linear, rig.drag_quadratic))
    torque = np.zeros(3)
    points = 4000
    for i in range(3):
        s = (np.arange(points) + 0.5) / points * length[i]
        normal = np.array([math.cos(phi[i]), -math.sin(phi[i])])  # along link i, for increasing phi
        jacobian = np.zeros((3, points))  # of the transverse speed, per absolute rate
        for j in range(i):
            tangent = np.array([math.cos(phi[j]), -math.sin(phi[j])])
            jacobian[j] = length[j] * (tangent @ normal)
        jacobian[i] = s
        v = rate @ jacobian
        force = k1[i] * v + k2[i] * v * np.abs(v)
        torque += jacobian @ force * length[i] / points
    return np.cumsum(torque[::-1])[::-1]  # absolute angles to joints


def test_drag_equals_an_independent_quadrature() -> None:
    rig = dragged([0.3, 0.1, 0.2], [0.05, 0.4, 0.3])
    plain = rigs.multiarm_triple()
    rng = np.random.default_rng(1)
    for _ in range(20):
        q, qd = rng.uniform(-3, 3, 3), rng.normal(0, 5, 3)
        state = torch.from_numpy(q), torch.from_numpy(qd)
        got = rig.bias(*state) - plain.bias(*state)
        # The midpoint rule's own error is (1/4000)^2 of the scale.
        np.testing.assert_allclose(got, by_quadrature(rig, q, qd), rtol=1e-6, atol=1e-6)


@given(k=st.lists(st.floats(0, 5), min_size=6, max_size=6), seed=st.integers(0, 10_000))
def test_drag_dissipates_energy(k: list[float], seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    q, qd = 5 * torch.randn(2, 30, 3, dtype=torch.float64, generator=generator)
    drag = dragged(k[:3], k[3:]).bias(q, qd) - rigs.multiarm_triple().bias(q, qd)
    # The difference of two bias vectors has their rounding errors, times a rate of about 10 rad/s.
    assert ((drag * qd).sum(-1) >= -1e-10).all()


def test_drag_of_a_single_link_equals_the_closed_form() -> None:
    rig = rigs.multiarm_single()
    k1, k2, qd = 0.2, 0.3, torch.tensor([-4.0]).double()
    pulled = rig.replace(drag_linear=torch.tensor([k1]), drag_quadratic=torch.tensor([k2]))
    size = rig.length.item()
    drag = pulled.bias(torch.zeros(1).double(), qd)
    expected = -(k1 * 4 * size**3 / 3 + k2 * 16 * size**4 / 4)
    assert drag.item() == pytest.approx(expected, rel=1e-7)  # k1, k2 came as float32
