"""Training of fuzzy networks by Bayesian regularisation, on samples and on controllers."""

import math
from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from nfriction.fuzzy import Anfis, AnfisRBF, RBFNetwork
from nfriction.papers.controller.mamdani import paper_controller
from nfriction.papers.nffem.evidence import EvidenceState
from nfriction.papers.nffem.jacobian import flatten, trainable
from nfriction.papers.nffem.projection import Scaling, one_group, to_own_units
from nfriction.papers.nffem.train_network import (
    TrainingOptions,
    controller_targets,
    recorded_losses,
    train_network,
    train_on_controller,
)

FLOAT64 = torch.float64


def samples(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(shape, generator=generator, dtype=FLOAT64) - 1


def surface(x: Tensor) -> Tensor:
    return torch.stack([torch.sin(2 * x[..., 0]) * x[..., 1], x[..., 0] ** 2 + x[..., 1]], -1)


def shaken(module: nn.Module, size: float = 0.3) -> nn.Module:
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for p in module.parameters():
            p.add_(size * torch.randn(p.shape, generator=generator, dtype=p.dtype))
    return module


NETWORKS = {
    "anfis": lambda g: Anfis(g, 2, [3, 2], 2),
    "zero order": lambda g: Anfis(g, 2, [3, 3], 2, order=0),
    "bells": lambda g: Anfis(g, 2, [2, 3], 2, kind="bell"),
    "interpretable": lambda g: Anfis(g, 2, [3, 3], 2, interpretable=True),
    "interpretable bells": lambda g: Anfis(g, 2, [3, 2], 2, kind="bell", interpretable=True),
    "network": lambda g: RBFNetwork(g, units=4),
    "head": lambda g: AnfisRBF(g, 2, [3, 2], 2, units=3),
}


@pytest.mark.parametrize("kind", NETWORKS)
def test_change_of_units_is_exact_and_reversible(kind: str) -> None:
    network, x = shaken(NETWORKS[kind](2)), samples(50, 2, 2)
    random = [samples(2, 2, seed=seed) for seed in range(4)]
    scaling = Scaling(random[0], random[1].abs() + 0.1, random[2], random[3].abs() + 0.1)
    with torch.no_grad():
        before, start = network(x), deepcopy(network.state_dict())
        to_own_units(network, scaling)
        own = x * scaling.x_half + scaling.x_middle
        torch.testing.assert_close(scaling.outputs(network(own)), before, rtol=1e-10, atol=1e-11)
        to_own_units(network, scaling.inverse())
    for name, value in network.state_dict().items():
        torch.testing.assert_close(value, start[name], rtol=1e-11, atol=1e-11)


def rmse(network: nn.Module, x: Tensor, y: Tensor) -> float:
    with torch.no_grad():
        return float(((network(x) - y) / (y.amax(0) - y.amin(0))).square().mean().sqrt())


def test_targets_are_the_controller_outputs_over_its_universes() -> None:
    controller = paper_controller(2)
    x, y = controller_targets(controller, 3000, seed=3)
    torch.testing.assert_close(controller(x[:, 0], x[:, 1]), y, rtol=1e-12, atol=0)
    lower, upper = (end * controller.si_factor for end in (controller.lower, controller.upper))
    assert (x >= lower).all()
    assert (x <= upper).all()
    # The mean of n uniform draws lies within five of its standard deviations.
    middle = (x.mean(0) - 0.5 * (lower + upper)).abs() / (upper - lower)
    assert middle.max() < 5 * math.sqrt(1 / 12 / 3000)
    again, _ = controller_targets(controller, 3000, seed=3)
    assert torch.equal(x, again)
    assert not torch.equal(x, controller_targets(controller, 3000, seed=4)[0])


@pytest.mark.parametrize("kind", ["anfis", "interpretable", "network", "head"])
def test_training_beats_the_least_squares_start(kind: str) -> None:
    controller = paper_controller(2)
    network = NETWORKS[kind](1)
    x, y = controller_targets(controller, 1500)
    start = NETWORKS[kind](1)
    train_on_controller(
        start, controller, samples=1500, options=TrainingOptions(search_steps=0, max_steps=0)
    )
    fits = train_on_controller(
        network, controller, samples=1500, options=TrainingOptions(search_steps=20, max_steps=10)
    )
    assert len(fits) == 1
    assert rmse(network, x[:, None], y[:, None]) < 0.95 * rmse(start, x[:, None], y[:, None])
    # It learns the function, not the samples.
    x, y = controller_targets(controller, 1500, seed=9)
    assert rmse(network, x[:, None], y[:, None]) < 0.95 * rmse(start, x[:, None], y[:, None])


def test_training_starts_from_the_controller_sets_or_an_even_grid() -> None:
    controllers = [paper_controller(joint) for joint in (2, 4)]
    frozen = {"samples": 300, "options": TrainingOptions(search_steps=0, max_steps=0)}
    network = Anfis(2, 2, [len(v.sets) for v in controllers[0].rule_base.inputs], 2)
    train_on_controller(network, controllers, **frozen)
    centres, widths = network.sets()
    for g, controller in enumerate(controllers):
        terms = [
            [float(factor) * number for number in term.parameters[:2]]
            for variable, factor in zip(
                controller.rule_base.inputs, controller.si_factor, strict=True
            )
            for term in variable.sets
        ]
        assert torch.stack([centres[g], widths[g]], 1).tolist() == [
            pytest.approx(term, rel=1e-9, abs=1e-9) for term in terms
        ]
    other = Anfis(2, 2, [4, 3], 2)
    train_on_controller(other, controllers, **frozen)
    grid = deepcopy(other)
    ends = [torch.stack([getattr(c, e) * c.si_factor for c in controllers])
            for e in ("lower", "upper")]  # fmt: skip
    grid.init_grid(*ends)
    for ours, wanted in zip(other.sets(), grid.sets(), strict=True):
        torch.testing.assert_close(ours, wanted, rtol=1e-9, atol=1e-9)


def test_identities_hold_at_convergence() -> None:
    x = samples(400, 1, 2)
    y = surface(x) + 0.05 * torch.randn(
        400, 1, 2, generator=torch.Generator().manual_seed(2), dtype=FLOAT64
    )
    network = Anfis(1, 2, [2, 2], 2)
    fit = train_network(network, x, y, TrainingOptions(max_steps=500, tolerance=1e-6))[0]
    assert fit.converged
    for group, gamma in fit.gamma.items():
        shrinkage = 2 * fit.alpha[group] * fit.parameter_squares[group]
        assert abs(gamma - shrinkage) <= 1e-5 * max(1, gamma)
    unexplained = fit.samples - sum(fit.gamma.values())
    assert math.isclose(fit.beta, unexplained / (2 * fit.error_squares), rel_tol=1e-5)
    assert set(fit.alpha) == {"centres", "widths", "consequents"}


def test_seed_is_reproducible_and_more_starts_raise_the_evidence() -> None:
    controller = paper_controller(2)
    options = TrainingOptions(search_steps=15, max_steps=10)
    three = replace(options, starts=3)
    twins = [RBFNetwork(1, units=5) for _ in range(2)]
    fits = [train_on_controller(n, controller, samples=400, options=three)[0] for n in twins]
    assert torch.equal(flatten(trainable(twins[0])), flatten(trainable(twins[1])))
    assert fits[0].log_evidence == fits[1].log_evidence
    alone = train_on_controller(RBFNetwork(1, units=5), controller, samples=400, options=options)[0]
    assert fits[0].log_evidence >= alone.log_evidence - 1e-6


def test_groups_train_independently() -> None:
    controllers = [paper_controller(joint) for joint in (2, 4)]
    both, alone = Anfis(2, 2, [3, 3], 2), Anfis(1, 2, [3, 3], 2)
    options = TrainingOptions(search_steps=10, max_steps=5, seed=5)
    pair = train_on_controller(both, controllers, samples=800, options=options)
    # Group g draws its samples with seed + g.
    single = train_on_controller(
        alone, controllers[1], samples=800, options=replace(options, seed=6)
    )
    assert pair[1].log_evidence == pytest.approx(single[0].log_evidence, rel=1e-9)
    x = controller_targets(controllers[1], 100)[0].unsqueeze(1)
    with torch.no_grad():
        torch.testing.assert_close(one_group(both, 1)(x), alone(x), rtol=1e-7, atol=1e-12)


def test_interrupt_leaves_a_usable_network() -> None:
    controllers = [paper_controller(joint) for joint in (2, 3)]
    network = Anfis(2, 2, [3, 3], 2)

    def interrupt(state: EvidenceState) -> None:
        if state.step == 2:
            raise KeyboardInterrupt

    fits = train_on_controller(
        network, controllers, samples=1000, options=TrainingOptions(callback=interrupt)
    )
    assert [fit.status for fit in fits] == ["stopped"]
    # The first group keeps its best result, the second its least-squares start.
    for g, (controller, worst) in enumerate(zip(controllers, (0.05, 0.1), strict=True)):
        x, y = controller_targets(controller, 1000, seed=7)
        assert rmse(one_group(network, g), x[:, None], y[:, None]) < worst


def test_frozen_parameters_are_unchanged() -> None:
    x = 3.0 + samples(300, 1, 2)
    network = Anfis(1, 2, [3, 3], 2)
    network.init_grid(2.0, 4.0)
    network.partition.requires_grad_(False)
    before = flatten(dict(network.partition.named_parameters())).clone()
    fit = train_network(network, x, surface(x), TrainingOptions(max_steps=20))[0]
    assert set(fit.alpha) == {"consequents"}
    after = flatten(dict(network.partition.named_parameters()))
    torch.testing.assert_close(after, before, rtol=1e-12, atol=1e-13)


def test_inconsistent_sizes_are_refused_on_entry() -> None:
    network, x = RBFNetwork(1, units=3), samples(50, 1, 2)
    with pytest.raises(ValueError, match="must be"):
        train_network(network, x[:, 0], surface(x))
    with pytest.raises(ValueError, match="finite"):
        train_network(network, x * math.nan, surface(x))
    with pytest.raises(ValueError, match="vary"):
        train_network(network, x * torch.tensor([1.0, 0.0]), surface(x))
    with pytest.raises(ValueError, match="starts"):
        TrainingOptions(starts=0)
    with pytest.raises(ValueError, match="not negative"):
        TrainingOptions(max_steps=-1)
    with pytest.raises(TypeError, match="double precision"):
        train_network(Anfis(1, 2, [2, 2], 2).float(), x.float(), surface(x).float())
    for made in (Anfis(1, 2, [2, 2], 2), RBFNetwork(1)):
        with pytest.raises(ValueError, match="cover less than a tenth of the range of an input"):
            train_network(made, 1000 * x + 500, surface(x))
        with pytest.raises(ValueError, match="vary"):
            train_network(made, x * torch.tensor([1.0, 0.0]) + 500.0, surface(x))
    with pytest.raises(TypeError, match="Linear"):
        train_network(nn.Linear(2, 2), x, surface(x))
    with pytest.raises(ValueError, match="controllers"):
        train_on_controller(network, [paper_controller(2)] * 2)
    with pytest.raises(ValueError, match="at least 1"):
        controller_targets(paper_controller(2), 0)


def test_losses_are_those_of_their_own_joint() -> None:
    """Also if a joint takes no step, such as one with constant outputs."""
    random = torch.Generator().manual_seed(0)
    x = torch.rand(400, 2, 2, dtype=torch.float64, generator=random)
    y = torch.stack([torch.full_like(x[:, 0], 3.0), x[:, 1].square()], 1)
    network = RBFNetwork(2, 2, 6, 2)
    network.init_kmeans(x)
    losses, keep = recorded_losses(["joint1", "joint2"])
    fits = train_network(network, x, y, TrainingOptions(callback=keep, max_steps=3))
    assert fits[0].steps == 0
    assert {name: len(of) for name, of in losses.items()} == {"joint2": fits[1].steps}
