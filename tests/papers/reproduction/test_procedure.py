"""The papers' procedure: controllers keep their rules and span, the network their outputs."""

import numpy as np
import pytest
import torch

from nfriction.friction import model_by_name
from nfriction.friction.models import LFM
from nfriction.papers.controller.mamdani import paper_controller
from nfriction.papers.nffem.rbf_coefficients import RBFCoefficients
from nfriction.papers.nffem.train_network import TrainingOptions
from nfriction.papers.reproduction.procedure import controllers_from_classes, papers_neuro_fuzzy
from nfriction.signals import Motion


def swing(seconds: float = 4.0) -> Motion:
    t = np.arange(0.0, seconds, 1e-3)
    q = np.stack([a * np.sin(3.0 * t) * np.exp(-t / 4.0) for a in (1.0, 2.0, 3.0)], -1)
    qd = np.gradient(q, t, axis=0)
    return Motion(t, q, qd, np.gradient(qd, t, axis=0))


def classes(*rows: list[float]) -> torch.Tensor:
    """Low, medium, high of every coefficient, the same for three joints."""
    return torch.tensor([list(rows)] * 3, dtype=torch.float64)


RISING = classes([0.01, 0.002], [0.02, 0.003], [0.03, 0.006])


def test_controller_is_table_4_with_rescaled_universes() -> None:
    # With Table 4's own universes, ours is the paper's controller of joint 2.
    paper = paper_controller(2)
    lower, upper = (end * paper.si_factor for end in (paper.lower, paper.upper))
    qd = np.array([[0.0], [float(upper[0])]])
    qdd = np.array([[float(lower[1])], [float(upper[1])]])
    table = torch.tensor([[[0.0, 0.0], [5e-4, 5e-4], [1e-3, 1e-3]]], dtype=torch.float64)
    ours = controllers_from_classes(LFM.definition, table, qd, qdd)[0]
    random = torch.Generator().manual_seed(0)
    x = lower + (upper - lower) * torch.rand(200, 2, generator=random, dtype=torch.float64)
    torch.testing.assert_close(ours(x[:, 0], x[:, 1]), paper(x[:, 0], x[:, 1]))


def test_falling_coefficients_mirror_rising_ones() -> None:
    motion = swing()
    rising = controllers_from_classes(LFM.definition, RISING, motion.qd, motion.qdd)
    falling = controllers_from_classes(LFM.definition, RISING.flip(1), motion.qd, motion.qdd)
    qd, qdd = torch.as_tensor(motion.qd[::50, 0]).abs(), torch.as_tensor(motion.qdd[::50, 0])
    ends = RISING[0].amin(0) + RISING[0].amax(0)
    torch.testing.assert_close(falling[0](qd, qdd), ends - rising[0](qd, qdd))


@pytest.mark.parametrize("name", ["ANCFM", "ALFM", "ANLFM"])
def test_outputs_are_within_the_span_of_the_classes(name: str) -> None:
    model = model_by_name(name)(3)
    count = len(model.law.coefficients)
    steps = torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)
    table = 1e-3 * steps[:, None] * torch.arange(1, count + 1)
    motion = swing()
    for controller in controllers_from_classes(
        model.law, table.expand(3, 3, count), motion.qd, motion.qdd
    ):
        y = controller(torch.as_tensor(motion.qd[:, 0]).abs(), torch.as_tensor(motion.qdd[:, 0]))
        assert (y >= table.amin(0) - 1e-12).all()
        assert (y <= table.amax(0) + 1e-12).all()


@pytest.mark.slow
def test_network_agrees_with_the_controller() -> None:
    adaptive = model_by_name("ALFM")(3, RISING)
    motion = swing()
    model, fits = papers_neuro_fuzzy(adaptive, [motion], samples=1000)
    assert len(fits) == 3
    assert isinstance(model.schedule, RBFCoefficients)
    assert type(model).__name__ == "NFLFM"
    controllers = controllers_from_classes(model.law, RISING, motion.qd, motion.qdd)
    # Samples of the motion between the network's training samples; it knows no others.
    qd, qdd = torch.as_tensor(motion.qd[2::4]), torch.as_tensor(motion.qdd[2::4])
    wanted = torch.stack([c(qd[:, j].abs(), qdd[:, j]) for j, c in enumerate(controllers)], 1)
    error = (model.schedule(qd, qdd) - wanted).square().mean(0).sqrt()
    # The error of the papers' 2-10-2 network is 2.5 to 3.1 % of the output range on 40,000 samples.
    assert (error < 0.06 * (wanted.amax(0) - wanted.amin(0))).all()


@pytest.mark.slow
def test_equal_seeds_give_equal_networks() -> None:
    adaptive = model_by_name("ANCFM")(3, RISING[..., :1])
    first, second = (papers_neuro_fuzzy(adaptive, [swing(1.0)], samples=300)[0] for _ in range(2))
    for a, b in zip(first.state_dict().values(), second.state_dict().values(), strict=True):
        assert torch.equal(a, b)


def test_equal_classes_still_span_a_universe() -> None:
    motion, brief = swing(1.0), TrainingOptions(search_steps=5, max_steps=5)
    model, _ = papers_neuro_fuzzy(
        model_by_name("ANCFM")(3, [0.02]), [motion], samples=300, options=brief
    )
    qd = torch.as_tensor(motion.qd)
    # Within the one percent width of such a universe.
    torch.testing.assert_close(
        model.coefficients(qd, qd), torch.full((*qd.shape, 1), 0.02, dtype=torch.float64),
        rtol=0.006, atol=0.0,
    )  # fmt: skip


def test_only_an_adaptive_model_starts_the_procedure() -> None:
    with pytest.raises(ValueError, match="adaptive"):
        papers_neuro_fuzzy(LFM(3), [swing(1.0)])
    still = Motion(*(np.zeros((10, 3)) for _ in range(4)))
    with pytest.raises(ValueError, match="both sides of zero"):
        controllers_from_classes(LFM.definition, RISING, still.qd, still.qdd)
