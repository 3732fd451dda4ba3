"""Normal equations from columns shared by outputs, for the layers that offer them."""

import pytest
import torch
from torch import Tensor, nn

from nfriction.fuzzy import Anfis, RBFNetwork
from nfriction.papers.nffem import jacobian
from nfriction.papers.nffem.evidence import EvidenceOptions, bayesian_regularisation
from nfriction.papers.nffem.jacobian import (
    CHUNK_ENTRIES,
    NormalEquations,
    assign,
    flatten,
    normal_equations,
    trainable,
)
from tests.papers.nffem.networks import F64, noise

LAYERS = {
    "anfis": lambda g: Anfis(g, 2, [3, 2], 2),
    "zero order": lambda g: Anfis(g, 2, [3, 3], 2, order=0),
    "bells": lambda g: Anfis(g, 2, [2, 3], 2, kind="bell"),
    "interpretable": lambda g: Anfis(g, 2, [3, 3], 2, interpretable=True),
    "interpretable bells": lambda g: Anfis(g, 2, [3, 2], 2, kind="bell", interpretable=True),
    "network": lambda g: RBFNetwork(g, units=4),
}


def shaken(module: nn.Module) -> nn.Module:
    with torch.no_grad():
        for seed, p in enumerate(module.parameters()):
            p.add_(0.3 * noise(seed, *p.shape))
    return module


def frozen_first(module: nn.Module) -> nn.Module:
    next(module.parameters()).requires_grad_(False)
    return module


class Plain(nn.Module):
    """A network that hides everything except its outputs."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: Tensor) -> Tensor:
        return self.network(x)


def assert_same(got: NormalEquations, wanted: NormalEquations) -> None:
    for ours, theirs in zip(got, wanted, strict=True):
        size = float(theirs.abs().max())
        torch.testing.assert_close(ours, theirs, rtol=1e-11, atol=1e-11 * size)


@pytest.mark.parametrize("groups", [1, 2])
@pytest.mark.parametrize("kind", LAYERS)
def test_columns_and_maps_equal_the_reverse_mode_jacobian(kind: str, groups: int) -> None:
    network, x = shaken(LAYERS[kind](groups)), noise(0, 20, groups, 2)
    wanted = torch.func.jacrev(lambda values: torch.func.functional_call(network, values, (x,)))(
        trainable(network)
    )
    columns, maps = network.jacobian_columns(x), network.jacobian_maps()
    assert list(maps) == list(wanted)
    for name, block in wanted.items():
        found = torch.einsum("gcs,gkce->sgke", columns, maps[name])
        for group in range(groups):
            own = block[:, group, :, group].flatten(2)
            torch.testing.assert_close(found[:, group], own, rtol=1e-12, atol=1e-12)
    first = network.readout() @ columns[:, : network.readout().shape[2]]
    torch.testing.assert_close(first.movedim(-1, 0), network(x), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("groups", [1, 3])
@pytest.mark.parametrize("kind", LAYERS)
def test_columns_give_the_normal_equations_of_the_full_jacobian(
    kind: str, groups: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    layer = shaken(LAYERS[kind](groups))
    x, y = noise(0, 101, groups, 2), noise(1, 101, groups, 2)
    for module in (layer, frozen_first(layer)):
        assign(module, flatten(trainable(module)) + 0.1)
        wanted = normal_equations(Plain(module), x, y)
        rows = module.jacobian_columns(x[:1]).shape[1] + 2
        # Chunks that do not divide the samples, and all at once.
        for entries in (33 * groups * rows, CHUNK_ENTRIES):
            monkeypatch.setattr(jacobian, "CHUNK_ENTRIES", entries)
            assert_same(normal_equations(module, x, y), wanted)


def test_regularisation_uses_the_columns_if_offered() -> None:
    calls = 0

    class Watched(RBFNetwork):
        def jacobian_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor:
            nonlocal calls
            calls += 1
            return super().jacobian_columns(x, out)

    x = noise(0, 200, 1, 2)
    y = torch.stack([x[..., 0] ** 2, x.prod(-1)], -1) + 0.1 * noise(1, 200, 1, 2)
    ours, plain = Watched(1, units=3), RBFNetwork(1, units=3)
    fit = bayesian_regularisation(ours, x, y, options=EvidenceOptions(max_steps=15))
    assert calls >= 16

    same = bayesian_regularisation(Plain(plain), x, y, options=EvidenceOptions(max_steps=15))
    # Rounding, amplified over 15 steps of a nonlinear search.
    assert fit.log_evidence == pytest.approx(same.log_evidence, rel=1e-6)
    torch.testing.assert_close(fit.w, same.w, rtol=1e-5, atol=1e-6)


def test_columns_of_a_long_recording_use_bounded_memory() -> None:
    sizes: list[int] = []

    class Watched(RBFNetwork):
        def jacobian_columns(self, x: Tensor, out: Tensor | None = None) -> Tensor:
            sizes.append(len(x))
            return super().jacobian_columns(x, out)

    network = Watched(1)
    normal_equations(network, noise(0, 50_000, 1, 2), noise(1, 50_000, 1, 2))
    assert sum(sizes) == 50_000
    assert max(sizes) * (10 + 1 + 40 + 2) <= CHUNK_ENTRIES


def test_inconsistent_sizes_are_refused() -> None:
    network, x = RBFNetwork(1, units=3), noise(0, 9, 1, 2)
    with pytest.raises(ValueError, match="must agree"):
        normal_equations(network, x, noise(1, 9, 1, 3))


def test_units_far_from_every_sample_are_not_slower() -> None:
    # Denormal numbers are fifty times as slow; a unit 24 widths away has no effect.
    network, x = RBFNetwork(1, units=5), noise(0, 200, 1, 2)
    with torch.no_grad():
        network.log_widths.fill_(-9.0)
        activations = network.activations(x)
    tiny = torch.finfo(F64).tiny
    assert (activations.square() >= tiny).all()
    assert activations.min() < 1e-100
