"""Online learning adapts to changed friction, stays bounded, and is equal in C."""

import ctypes
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from nfriction.export.c_file import find_compiler
from nfriction.friction.neurofuzzy import NFLFM, NFNLFM
from nfriction.fuzzy import RBFNetwork
from nfriction.papers.nffem.online import OnlineNetwork, OnlineOptions, write_online
from nfriction.papers.nffem.rbf_coefficients import RBFCoefficients

OPTIONS = OnlineOptions(noise=0.02, forgetting=2.0)


def model(kind: type = NFLFM, joints: int = 2, acceleration: str = "along_motion"):
    """Constant coefficients in a network whose units cover the motion."""
    made = kind(joints, network="rbf", head_units=6, acceleration=acceleration)
    made.requires_grad_(False)
    schedule = made.schedule
    assert isinstance(schedule, RBFCoefficients)
    values = torch.linspace(0.05, 0.1, len(made.law.names), dtype=torch.float64)
    values = values.repeat(joints, 1)
    network = RBFNetwork(joints, 2, 6, len(made.law.names)).requires_grad_(False)
    ends = torch.tensor([[0.0, -60.0], [6.0, 60.0]], dtype=torch.float64)
    network.init_range(*ends)
    network.output_weight.zero_()
    network.output_bias.copy_(values)
    schedule.set_network(
        network, ends[:, None].expand(2, joints, 2), torch.stack([0.8 * values, 1.2 * values])
    )
    return made


def motions(count: int, joints: int = 2) -> tuple[Tensor, Tensor, Tensor]:
    random = torch.Generator().manual_seed(0)
    qd, qdd, load = torch.randn(3, count, joints, generator=random, dtype=torch.float64)
    return 2 * qd, 20 * qdd, 1 + 0.1 * load


def test_halved_friction_is_recovered() -> None:
    made = model()
    online = OnlineNetwork(made, OPTIONS)
    qd, qdd, load = motions(800)
    true = 0.5 * made.torque(qd, load, made.coefficients(qd, qdd))
    for sample in zip(qd[:600], qdd, load, true, strict=False):
        online.learn(*sample)
    judged = slice(600, None)
    now, _ = online(qd[judged], qdd[judged], load[judged])
    error = (now - true[judged]).square().mean().sqrt()
    # Without learning the error would be as large as the torque itself.
    assert error < 0.05 * true[judged].square().mean().sqrt()


def test_zero_error_or_rest_changes_nothing() -> None:
    made = model()
    online = OnlineNetwork(made, OPTIONS)
    qd, qdd, load = motions(100)
    before = online.weight.clone()
    for sample in zip(qd, qdd, load, made(qd, qdd, load), strict=True):
        online.learn(*sample)
    torch.testing.assert_close(online.weight, before, rtol=0, atol=1e-12)
    rest = torch.full((2,), 0.01, dtype=torch.float64)
    spread = online.covariance.clone()
    online.learn(rest, rest, rest, 100 * rest)
    online.learn(100 * rest, rest, rest, torch.nan * rest)
    assert torch.equal(online.covariance, spread)


def test_outlying_torques_leave_everything_bounded() -> None:
    made = model()
    online = OnlineNetwork(made, OPTIONS)
    first = online.covariance.diagonal(dim1=1, dim2=2).sum(-1)
    qd, qdd, load = motions(400)
    for sample in zip(qd, qdd, load, 1e6 * torch.randn_like(qd), strict=True):
        online.learn(*sample)
        # A single speed for a long time: the others have no data.
        online.learn(qd[0] * 0 + 1.0, qdd[0] * 0, load[0], qd[0] * 0 + 5.0)
    assert (online.covariance.diagonal(dim1=1, dim2=2).sum(-1) <= first * (1 + 1e-9)).all()
    _, coefficients = online(qd, qdd, load)
    assert (coefficients <= online.most).all()
    assert (coefficients >= online.least).all()
    torch.testing.assert_close(online.most, 3 * made.schedule.network.output_bias.detach())


def test_one_outlier_or_overflow_changes_little() -> None:
    made = model()
    qd, qdd, load = motions(800)
    noise = 0.02 * torch.randn(qd.shape, generator=torch.Generator().manual_seed(1))
    measured = 0.6 * made.torque(qd, load, made.coefficients(qd, qdd)) + noise
    torques = []
    for spoilt in (False, True):
        online = OnlineNetwork(made, OPTIONS)
        for k, sample in enumerate(zip(qd, qdd, load, measured, strict=True)):
            if spoilt and k == 600:
                online.learn(*sample[:3], torch.full_like(sample[3], 1e3))
                online.learn(sample[0], sample[1], 0 * sample[2] + 1e200, sample[3])
            online.learn(*sample)
        torques.append(online(qd, qdd, load)[0])
    assert (torques[1] - torques[0]).square().mean().sqrt() < 0.02


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("kind", [NFLFM, NFNLFM])
@pytest.mark.parametrize("acceleration", ["signed", "along_motion"])
def test_c_code_learns_the_same(kind: type, acceleration: str, tmp_path: Path) -> None:
    made = model(kind, acceleration=acceleration)
    online = OnlineNetwork(made, OPTIONS)
    source, _ = write_online(made, tmp_path, OPTIONS, name="rig")
    library = tmp_path / "rig.so"
    compiler = find_compiler()
    assert compiler is not None
    flags = ["-std=c89", "-pedantic", "-Wall", "-Werror", "-O2", "-fPIC", "-shared"]
    subprocess.run([*compiler, *flags, "-o", library, source, "-lm"], check=True)
    code = ctypes.CDLL(str(library))
    size = online.weight.numel() + online.covariance.numel()
    learner = np.zeros(size)

    def pointer(x: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(x.ctypes.data)

    code.rig_start(pointer(learner))
    qd, qdd, load = motions(200)
    random = torch.Generator().manual_seed(1)
    noise = 0.05 * torch.randn(qd.shape, generator=random, dtype=torch.float64)
    # A model's torque is stored joint by joint; C uses sample by sample.
    measured = (0.6 * made(qd, qdd, load) + noise).contiguous()
    measured[7, 0], measured[90, 1] = torch.inf, 1e3
    loads = load.clone()
    loads[120, 0] = 1e200
    tau, coefficients = np.zeros(2), np.zeros((2, len(made.law.names)))
    for sample in zip(qd, qdd, loads, measured, strict=True):
        online.learn(*sample)
        code.rig_learn(pointer(learner), *(pointer(x.numpy()) for x in sample))
    for motion in zip(qd, qdd, load, strict=True):
        code.rig_step(
            pointer(learner), *(pointer(x.numpy()) for x in motion), pointer(tau),
            pointer(coefficients),
        )  # fmt: skip
        expected = online(*motion)
        # Sums taken in another order, over 200 updates.
        np.testing.assert_allclose(tau, expected[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(coefficients, expected[1], rtol=0, atol=1e-9)


def test_other_models_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="rbf"):
        OnlineNetwork(NFLFM(2), OPTIONS)
    with pytest.raises(ValueError, match="rbf"):
        OnlineNetwork(NFLFM(2, network="rbf", derivatives=1), OPTIONS)
    with pytest.raises(ValueError, match="margin"):
        OnlineOptions(noise=0.1, margin=0.5)
    with pytest.raises(ValueError, match="noise"):
        OnlineOptions(noise=0.0)
    with pytest.raises(ValueError, match="identifier"):
        write_online(model(), tmp_path, OPTIONS, name="1")
