"""Eccentric encoders are a change of coordinates of the same motion."""

import math

import pytest
import torch
from torch import Tensor

from nfriction import PendulumChain, rigs, rollout
from nfriction.plant.dynamics import correct_encoder

F64 = torch.float64
COSINE, SINE = torch.tensor([2e-3, -1e-3, 3e-3], dtype=F64), torch.tensor([1e-3] * 3, dtype=F64)


def eccentric(rig: PendulumChain) -> PendulumChain:
    return rig.replace(encoder_cosine=COSINE, encoder_sine=SINE)


def readings(rig: PendulumChain, q: Tensor) -> Tensor:
    """Readings of true angles, by Newton's method."""
    read = q.clone()
    for _ in range(6):
        turned = correct_encoder(read, rig.encoder_zero, COSINE, SINE)
        read = read - (turned.angle - q) / turned.slope
    return read


def test_reading_error_is_a_sine_of_the_angle() -> None:
    """q + e sin(q + delta), less its value at hanging, to first order in e."""
    rig = rigs.tlrip()
    q = torch.linspace(-3, 3, 50, dtype=F64)[:, None] + torch.tensor([math.pi, 0, 0], dtype=F64)
    size, phase = torch.hypot(COSINE, SINE), torch.atan2(COSINE, SINE)
    own = q - torch.tensor([math.pi, 0, 0], dtype=F64)
    off = size * ((own + phase).sin() - phase.sin())
    assert float((readings(rig, q) - q - off).abs().max()) < 2 * float(size.max()) ** 2


def test_encoder_reads_zero_when_hanging() -> None:
    for rig in (rigs.tlrip(), rigs.multiarm_triple()):
        hanging = torch.tensor([math.pi, 0.0, 0.0], dtype=F64)
        still = torch.zeros(3, dtype=F64)
        torch.testing.assert_close(
            eccentric(rig)(hanging, still, still), rig(hanging, still, still)
        )


def test_eccentric_encoders_do_not_change_the_motion() -> None:
    rig = rigs.tlrip()
    q0, qd0 = torch.tensor([[2.0, 0.6, -0.4], [0.5, -0.2, 0.9]], dtype=F64)
    true = rollout(rig, None, q0, qd0, steps=500, gradients=False)
    read = readings(rig, true.q)
    slope = correct_encoder(read, rig.encoder_zero, COSINE, SINE).slope
    found = rollout(
        eccentric(rig), None, read[0], qd0 / slope[0], steps=500, gradients=False
    )  # fmt: skip
    # Runge-Kutta steps in other coordinates differ by their integration error.
    torch.testing.assert_close(found.q, read, rtol=0, atol=1e-7)


@pytest.mark.parametrize("arm", ["fixed", "free"])
def test_dynamics_are_inverse_and_conserve_energy(arm: str) -> None:
    rig = rigs.tlrip(arm)  # type: ignore[arg-type]
    joints = torch.linspace(1e-3, 3e-3, rig.joints, dtype=F64)
    rig = rig.replace(encoder_cosine=joints, encoder_sine=-joints)
    q, qd, tau = torch.randn(3, 20, rig.joints, dtype=F64, generator=torch.Generator())
    torch.testing.assert_close(rig.inverse_dynamics(q, qd, rig(q, qd, tau)), tau)
    run = rollout(rig, None, q[0], qd[0], steps=300, gradients=False)
    energy = sum(rig.energy(run.q, run.qd))
    assert float((energy - energy[0]).abs().max()) < 1e-6 * float(energy.abs().max())


def test_rig_file_round_trip_is_exact() -> None:
    rig = eccentric(rigs.tlrip())
    again = PendulumChain.from_dict(rig.to_dict())
    assert again.has_eccentricity
    assert torch.equal(again.encoder_cosine, COSINE)
    assert not PendulumChain.from_dict(rigs.tlrip().to_dict()).has_eccentricity
