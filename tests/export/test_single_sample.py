"""The short way of one sample is the schedule, whatever its parameters and range."""

import pytest
import torch

from nfriction.export.controller import controller_of
from nfriction.export.neurofuzzy import SingleSample, with_single_sample
from nfriction.friction.laws import NONLINEAR
from nfriction.friction.models import LFM, FrictionModel
from nfriction.friction.neurofuzzy import NFLFM, NFNCFM, NFNLFM, NeuroFuzzy
from tests.friction.samples import randomise

JOINTS = 3


def trained(model: FrictionModel, spread: float = 0.2) -> FrictionModel:
    """A model off its start, with ranges that differ by joint and not around zero."""
    randomise(model, spread)
    model.schedule.set_range([8.0, 5.0, 20.0], [[-60.0, 50.0], [-10.0, 80.0], [5.0, 90.0]])
    return model


def samples(count: int = 400):
    random = torch.Generator().manual_seed(1)
    draw = [torch.randn(count, JOINTS, generator=random, dtype=torch.float64) for _ in range(2)]
    still = torch.zeros(1, JOINTS, dtype=torch.float64)
    return torch.cat([8.0 * draw[0], still]), torch.cat([60.0 * draw[1], still])


def assert_alike(schedule: NeuroFuzzy, single: torch.nn.Module) -> None:
    qd, qdd = samples()
    with torch.no_grad():
        expected = schedule(qd, qdd)
        found = torch.stack([single(*row) for row in zip(qd, qdd, strict=True)])
    # Some ten roundings of numbers of the size of the coefficients' scale.
    scale = torch.maximum(expected.abs().amax(0), schedule.scale)
    assert ((found - expected).abs().amax(0) <= 1e-14 * scale).all()


@pytest.mark.parametrize("kind", [NFNCFM, NFLFM, NFNLFM])
@pytest.mark.parametrize("interpretable", [False, True])
def test_it_gives_the_coefficients_of_the_schedule(kind, interpretable):
    model = trained(kind(JOINTS, interpretable=interpretable))
    assert_alike(model.schedule, SingleSample(model.schedule))


@pytest.mark.parametrize("acceleration", ["along_motion", "signed"])
def test_either_sense_of_acceleration_and_signs_of_coefficients(acceleration):
    model = trained(NFNLFM(JOINTS, acceleration=acceleration))
    # Exponents and slopes of the nonlinear law may be of any sign or must not: take both.
    schedule = model.schedule
    schedule.positive[:] = torch.tensor([i % 2 == 0 for i in range(len(NONLINEAR.names))])
    assert_alike(schedule, SingleSample(schedule))


def test_narrow_sets_do_not_underflow():
    """Between sets a tenth as wide every strength is below 1e-20: only their ratios count."""
    schedule = trained(NFLFM(JOINTS, interpretable=False), 0.05).schedule
    with torch.no_grad():
        schedule.network.anfis.partition.log_widths.sub_(2.7)
    single = SingleSample(schedule)
    assert_alike(schedule, single)


def test_one_input_may_have_fewer_sets_than_the_other():
    for terms in ((3, 5), (5, 3)):
        schedule = trained(NFLFM(JOINTS, terms=terms)).schedule
        assert_alike(schedule, SingleSample(schedule))


def test_another_schedule_stays_as_it_is():
    class Own(NeuroFuzzy):
        def forward(self, qd, qdd):
            return 2.0 * super().forward(qd, qdd)

    for schedule in (LFM(JOINTS).schedule, Own(LFM(1).law, JOINTS)):
        controller = controller_of(FrictionModel(LFM(1).law, schedule))
        assert with_single_sample(controller) is controller


def test_a_controller_stays_the_same_and_is_left_alone():
    model = trained(NFLFM(JOINTS))
    controller = controller_of(model)
    short = with_single_sample(controller)
    qd, qdd = samples(50)
    load = 1.0 + qd.abs()
    for row in zip(qd, qdd, load, strict=True):
        tau_f, coefficients, status = short(*row)
        expected = controller(*row)
        torch.testing.assert_close(tau_f, expected[0], rtol=1e-12, atol=1e-14)
        torch.testing.assert_close(coefficients, expected[1], rtol=1e-12, atol=1e-14)
        assert torch.equal(status, expected[2])
    assert isinstance(controller.model.schedule, NeuroFuzzy)
    # Batches go the long way, to the bit.
    assert torch.equal(short(qd, qdd, load)[0], controller(qd, qdd, load)[0])
