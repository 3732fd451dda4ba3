"""Joint torque from the drive's torque through a gear."""

import torch

from nfriction.plant.dynamics import SIGN_WIDTH, joint_torque, motor_torque

F64 = torch.float64
GAIN, LOSS = torch.tensor([1.1, 0.9], dtype=F64), torch.tensor([0.1, 0.4], dtype=F64)


def test_drive_torque_inverts_joint_torque():
    random = torch.Generator().manual_seed(0)
    tau, qd = torch.randn(2, 200, 2, dtype=F64, generator=random)
    qd = qd * torch.logspace(-3, 1, 200, dtype=F64).unsqueeze(-1)
    there = joint_torque(tau, qd, GAIN, LOSS)
    torch.testing.assert_close(motor_torque(there, qd, GAIN, LOSS), tau, rtol=1e-13, atol=1e-15)


def test_gear_dissipates_power_in_both_directions_and_none_at_rest():
    fast = torch.tensor([[5.0, 5.0], [-5.0, -5.0]], dtype=F64)
    for sign in (1.0, -1.0):
        tau = torch.full((2, 2), 2.0 * sign, dtype=F64)
        lost = (GAIN * tau - joint_torque(tau, fast, GAIN, LOSS)) * fast
        torch.testing.assert_close(lost, (GAIN * LOSS * 10.0).expand(2, 2))
    still = torch.zeros(2, dtype=F64)
    torch.testing.assert_close(joint_torque(GAIN, still, GAIN, LOSS), GAIN * GAIN)
    slow = torch.full((2,), 1e-3 * SIGN_WIDTH, dtype=F64)
    torch.testing.assert_close(
        joint_torque(GAIN, slow, GAIN, LOSS), GAIN * GAIN * (1 - 1e-3 * LOSS), rtol=1e-8, atol=0
    )
