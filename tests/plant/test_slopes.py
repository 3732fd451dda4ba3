"""Closed derivatives of a chain are those that automatic differentiation finds."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from nfriction.plant import Arm, PendulumChain, rigs

F64 = torch.float64
CHAINS = {
    "one link": PendulumChain([0.3], [0.2]),
    "two with rotors": PendulumChain([0.3, 0.2], [0.2, 0.15], armature=[1e-3, 2e-3]),
    "three, offset": rigs.tlrip(arm="fixed").replace(
        angle_offset=torch.tensor([0.1, -0.2, 0.3], dtype=F64)
    ),
    "three, driven otherwise than told": rigs.tlrip(arm="fixed").replace(
        torque_gain=torch.tensor([1.2, 0.8, 1.1], dtype=F64)
    ),
    "three, of several gains": rigs.tlrip(arm="fixed").replace(
        torque_gain=torch.linspace(0.7, 1.3, 15, dtype=F64).reshape(5, 1, 3)
    ),
    "three, behind gears": rigs.tlrip(arm="fixed").replace(
        gear_loss=torch.tensor([0.3, 0.1, 0.0], dtype=F64)
    ),
}


def derivative(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """(*batch, joint) -> (*batch, joint), as (joint, joint, *batch)."""
    x = x.clone().requires_grad_()
    # What does not depend on the motion still has a derivative: zero.
    rows = (function(x) + 0.0 * x).unbind(-1)
    found = [torch.autograd.grad(y.sum(), x, retain_graph=True)[0] for y in rows]
    return torch.stack(found).movedim(-1, 1)


@pytest.mark.parametrize("name", CHAINS)
def test_slopes_are_the_automatic_ones(name):
    plant = CHAINS[name]
    random = torch.Generator().manual_seed(0)
    q, qd, qdd = torch.randn(3, 5, 4, plant.joints, generator=random, dtype=F64) * 5.0
    # As slow as a gear's loss turns.
    qd[0] *= 0.02
    found = plant.slopes(q, qd, qdd)
    load_by_qd = derivative(lambda x: plant.load(q, x), qd)
    tau = plant.inverse_dynamics(q, qd, qdd)
    by_tau = derivative(lambda x: plant.forward_dynamics(q, qd, x), tau)
    for a, b in (
        (found.by_q, derivative(lambda x: plant.inverse_dynamics(x, qd, qdd), q)),
        (found.by_qd, derivative(lambda x: plant.inverse_dynamics(q, x, qdd), qd)),
        (found.inverse_mass, by_tau),
        (found.load_by_q, derivative(lambda x: plant.load(x, qd), q)),
        (torch.diag_embed(found.load_by_qd.movedim(0, -1)), load_by_qd.movedim((0, 1), (-2, -1))),
    ):
        torch.testing.assert_close(a.expand(b.shape), b, rtol=1e-10, atol=1e-12)


def test_several_gears_share_a_state():
    gears = torch.tensor([[[0.1, 0.2, 0.3]], [[0.0, 0.1, 0.0]]], dtype=F64)
    q, qd, qdd = torch.randn(3, 4, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    plant = rigs.tlrip(arm="fixed")
    found = plant.replace(gear_loss=gears).slopes(q, qd, qdd)
    for p, loss in enumerate(gears):
        one = plant.replace(gear_loss=loss[0]).slopes(q, qd, qdd)
        for a, b in zip(found, one, strict=True):
            torch.testing.assert_close(a[..., p, :].expand(b.shape), b)


def test_a_chain_with_other_terms_has_none():
    fixed, free = rigs.tlrip(arm="fixed"), PendulumChain([0.3], [0.2], arm=Arm(0.1, 0.2))
    some = torch.full((3,), 1e-3, dtype=F64)
    assert fixed.has_slopes()
    for plant in (free, fixed.replace(drag_linear=some), fixed.replace(encoder_sine=some)):
        assert not plant.has_slopes()


class Sprung(PendulumChain):
    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        return super().forward_dynamics(q, qd, tau - 0.1 * q)


def test_a_chain_of_another_kind_has_none():
    assert not Sprung([0.3], [0.2]).has_slopes()
