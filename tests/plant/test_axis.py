"""The positioning axis has the same interface as the chain."""

import json

import pytest
import torch

from nfriction.plant import LinearAxis


def test_axis_follows_newtons_law() -> None:
    axis = LinearAxis(4.0, torque_offset=2.0)
    q, qd, tau = torch.randn(3, 5, 1, dtype=torch.float64)
    qdd = axis(q, qd, tau)
    torch.testing.assert_close(qdd, (tau + 2) / 4)
    torch.testing.assert_close(axis.inverse_dynamics(q, qd, qdd), tau)
    rhs = tau + axis.torque_offset - axis.bias(q, qd)
    torch.testing.assert_close((axis.mass_matrix(q) @ qdd[..., None])[..., 0], rhs)
    kinetic, potential = axis.energy(q, qd)
    torch.testing.assert_close(kinetic, 2 * qd[:, 0] ** 2)
    assert not potential.any()
    assert not axis.gravity(q).any()
    assert torch.equal(axis.load(q, qd), torch.ones(5, 1).double())
    assert axis.decay_rate(torch.tensor([2.0])).item() == 0.5
    assert (axis.unit, axis.joints, axis.has_drag) == ("m", 1, False)


def test_asymmetric_axis_has_direction_dependent_friction() -> None:
    axis = LinearAxis(4.0, torque_offset=2.0)
    crooked = axis.replace(asymmetry=torch.tensor([3.0], dtype=torch.float64))
    q, qd, tau = torch.randn(3, 5, 1, dtype=torch.float64)
    qdd = crooked(q, qd, tau)
    torch.testing.assert_close(crooked.inverse_dynamics(q, qd, qdd), tau)
    torch.testing.assert_close(qdd, axis(q, qd, tau) - 3 / 4 * qd.abs())
    torch.testing.assert_close(4.0 * qdd, tau + 2.0 - crooked.bias(q, qd))
    again = LinearAxis.from_dict(json.loads(json.dumps(crooked.to_dict())))
    assert torch.equal(again.asymmetry, crooked.asymmetry)


def test_replace_broadcasts_and_carries_gradients() -> None:
    mass = torch.tensor([[1.0], [2.0]], dtype=torch.float64, requires_grad=True)
    axis = LinearAxis(4.0).replace(mass=mass[:, None])
    x = torch.ones(2, 3, 1).double()
    qdd = axis(x, x, x)
    torch.testing.assert_close(qdd[..., 0], torch.tensor([[1.0] * 3, [0.5] * 3]).double())
    (gradient,) = torch.autograd.grad(qdd.sum(), mass)
    torch.testing.assert_close(gradient[:, 0], torch.tensor([-3.0, -0.75]).double())
    assert axis.mass_matrix(x).shape == (2, 3, 1, 1)


def test_axis_is_exported_and_restored_from_a_dictionary() -> None:
    axis = LinearAxis(95.0, torque_offset=3.0, name="axis").replace(mass=torch.tensor([90.0]))
    again = LinearAxis.from_dict(json.loads(json.dumps(axis.to_dict())))
    assert again.mass.item() == 90
    assert "axis" in repr(again)
    q, qd, tau = torch.randn(3, 1, dtype=torch.float64)
    program = torch.export.export(again, (q, qd, tau))
    assert torch.equal(program.module()(q, qd, tau), again(q, qd, tau))


@pytest.mark.parametrize("mass", [0.0, -1.0, float("nan"), "heavy"])
def test_bad_mass_is_refused(mass: float) -> None:
    with pytest.raises(ValueError, match="`mass` must be"):
        LinearAxis(mass)


def test_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"`q` must be \(\*batch, 1\)"):
        LinearAxis(1.0).gravity(torch.zeros(3))
