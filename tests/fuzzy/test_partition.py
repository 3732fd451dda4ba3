"""Ordered partitions stay ordered and overlapping for any parameters."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nfriction.fuzzy import Anfis
from nfriction.fuzzy.membership import HALF_WIDTH_OF_GAUSSIAN

FLOAT64 = torch.float64


@given(
    st.integers(0, 10_000),
    st.lists(st.integers(1, 6), min_size=1, max_size=3),
    st.floats(0.1, 10),
    st.sampled_from(["gaussian", "bell"]),
)
def test_sets_are_ordered_in_range_and_overlapping(
    seed: int, terms: list[int], spread: float, kind: str
) -> None:
    layer = Anfis(2, len(terms), terms, 1, kind=kind, interpretable=True)
    lower, upper = -3.0, 5.0
    layer.init_grid(lower, upper)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in layer.partition.parameters():
            p.copy_(spread * torch.randn(p.shape, generator=generator, dtype=FLOAT64))
    centres, widths = layer.sets()
    half = widths * (HALF_WIDTH_OF_GAUSSIAN if kind == "gaussian" else 1.0)
    slack = 1e-12 * (upper - lower)
    start = 0
    for count in terms:
        c, h = centres[:, start : start + count], half[:, start : start + count]
        assert (c >= lower - slack).all()
        assert (c <= upper + slack).all()
        assert (c.diff(dim=1) > 0).all()
        # Neighbours' intervals of membership at least one half touch, and reach the ends.
        assert (h[:, :-1] + h[:, 1:] >= c.diff(dim=1) - slack).all()
        assert (c[:, 0] - h[:, 0] <= lower + slack).all()
        assert (c[:, -1] + h[:, -1] >= upper - slack).all()
        start += count
    universe = torch.linspace(lower, upper, 501, dtype=FLOAT64)
    x = universe[:, None, None].expand(-1, 2, len(terms))
    for held in layer.memberships(x):
        assert held.amax(-1).min() >= 0.5 - 1e-9


def test_assigned_partition_within_bounds_is_kept() -> None:
    layer = Anfis(1, 1, [3], 1, interpretable=True)
    centres = torch.tensor([0.1, 0.45, 0.9], dtype=FLOAT64)
    widths = torch.tensor([0.2, 0.25, 0.3], dtype=FLOAT64)
    layer.init_from_sets([centres], [widths], lower=0.0, upper=1.0)
    found_centres, found_widths = layer.sets()
    torch.testing.assert_close(found_centres[0], centres, rtol=1e-12, atol=0)
    torch.testing.assert_close(found_widths[0], widths, rtol=1e-12, atol=0)


def test_interpretable_grid_is_near_the_even_grid() -> None:
    layer, free = Anfis(1, 2, [5, 4], 1, interpretable=True), Anfis(1, 2, [5, 4], 1)
    for name in (0, 1):
        torch.testing.assert_close(layer.sets()[name], free.sets()[name], rtol=0.1, atol=0.1)


def test_gradients_reach_every_parameter() -> None:
    layer = Anfis(1, 2, [4, 3], 1, interpretable=True)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        layer.consequents.copy_(
            torch.randn(layer.consequents.shape, generator=generator, dtype=FLOAT64)
        )
    x = torch.rand(50, 1, 2, generator=generator, dtype=FLOAT64) * 2 - 1
    layer(x).square().sum().backward()
    for name, p in layer.named_parameters():
        assert p.grad is not None, name
        assert torch.isfinite(p.grad).all(), name
        assert (p.grad != 0).all(), name


def test_widths_must_be_positive() -> None:
    layer = Anfis(1, 1, [2], 1)
    ends = torch.tensor([0.0, 1.0], dtype=FLOAT64)
    with pytest.raises(ValueError, match="positive"):
        layer.init_from_sets([ends], [ends])
