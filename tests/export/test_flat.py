"""The short way of one sample is the schedule, whatever its parameters and range."""

import pytest
import torch

from nfriction.export.controller import controller_of
from nfriction.export.flat import flattened, shortened
from nfriction.export.flat_numbers import NumberByNumber, _deepest
from nfriction.export.flat_tensors import TensorByTensor
from nfriction.friction.laws import NONLINEAR
from nfriction.friction.models import NFLFM, NFNCFM, NFNLFM, FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from tests.friction.samples import randomise

JOINTS = 3
ways = pytest.mark.parametrize("way", [TensorByTensor, NumberByNumber])


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


@ways
@pytest.mark.parametrize("kind", [NFNCFM, NFLFM, NFNLFM])
@pytest.mark.parametrize("interpretable", [False, True])
def test_it_gives_the_coefficients_of_the_schedule(kind, interpretable, way):
    model = trained(kind(JOINTS, interpretable=interpretable))
    assert_alike(model.schedule, way(model.schedule))


@ways
@pytest.mark.parametrize("acceleration", ["along_motion", "signed"])
def test_either_sense_of_acceleration_and_signs_of_coefficients(acceleration, way):
    model = trained(NFNLFM(JOINTS, acceleration=acceleration))
    # Exponents and slopes of the nonlinear law may be of any sign or must not: take both.
    schedule = model.schedule
    schedule.positive[:] = torch.tensor([i % 2 == 0 for i in range(len(NONLINEAR.names))])
    assert_alike(schedule, way(schedule))


@ways
def test_narrow_sets_do_not_underflow(way):
    """Between sets a tenth as wide every strength is below 1e-20: only their ratios count."""
    schedule = trained(NFLFM(JOINTS), 0.05).schedule
    with torch.no_grad():
        schedule.network.anfis.partition.log_widths.sub_(2.7)
    single = way(schedule)
    assert not getattr(single, "shallow", False)
    assert_alike(schedule, single)


def test_sets_of_usual_width_need_no_maximum():
    assert NumberByNumber(trained(NFLFM(JOINTS)).schedule).shallow


def test_depth_is_the_largest_over_the_range():
    """`shallow` judges by the ends and the crossings; a fine grid finds nothing deeper."""
    random = torch.Generator().manual_seed(2)
    slope = torch.rand(1, 1, 5, generator=random, dtype=torch.float64) * 3.0 + 0.5
    centres = torch.rand(1, 1, 5, generator=random, dtype=torch.float64)
    lower, upper = torch.tensor([[[-2.0]], [[3.0]]], dtype=torch.float64)
    found = _deepest(slope, -slope * centres, lower, upper)
    x = torch.linspace(-2.0, 3.0, 20_001, dtype=torch.float64)[:, None]
    grid = float((slope[0] * (x - centres[0])).square().amin(-1).max())
    assert grid <= found * (1 + 1e-12)
    assert found == pytest.approx(grid, rel=1e-3)


def test_what_has_no_short_way_stays_as_it_is():
    uneven = NFLFM(JOINTS, terms=(3, 5))
    assert flattened(uneven) is uneven


def test_a_controller_stays_the_same_and_is_left_alone():
    model = trained(NFLFM(JOINTS))
    controller = controller_of(model)
    short = shortened(controller)
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
