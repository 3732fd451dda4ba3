"""The chain compared with exact states of the paper's rig, and with MuJoCo."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nfriction.plant import PendulumChain, rigs

CASES = ["none", "izz", "izz_strict", "full"]
TENSOR = [
    [0.002, 0.0388, 0.04, 0.0004, 0.00032, -0.00024],
    [0.0025, 0.0485, 0.05, 0.0005, 0.0004, -0.0003],
    [0.0025, 0.0485, 0.05, 0.0005, 0.0004, -0.0003],
]


def paper_rig(case: str, arm: Any, tensor: Any = TENSOR) -> PendulumChain:
    if case == "izz_strict":
        with pytest.warns(UserWarning, match="no rigid body"):
            return rigs.tlrip(arm, [[0, 0, izz, 0, 0, 0] for izz in (0.04, 0.05, 0.05)])
    return rigs.tlrip(arm, tensor if case == "full" else case)


def assert_rounding(got: Tensor, expected: Tensor) -> None:
    # 1e-12 of the largest entry of each state: entries of one vector share their rounding.
    scale = expected.abs().flatten(1).amax(1).clamp(min=1.0)
    error = (got - expected).abs().flatten(1).amax(1)
    assert (error <= 1e-12 * scale).all(), (error / scale).max()


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("arm", ["fixed", "free"])
def test_dynamics_match_the_exact_states(case: str, arm: str, reference_dir: Path) -> None:
    data = json.loads((reference_dir / "plant_states.json").read_text())
    states = data["states"][case]
    rig = paper_rig(case, arm, data["meta"]["full_tensor"])
    joints = slice(None) if arm == "free" else slice(1, None)

    def column(name: str) -> Tensor:
        return torch.tensor([state[name] for state in states], dtype=torch.float64)

    q, qd, tau = (column(name)[:, joints] for name in ("q", "qd", "tau"))
    assert_rounding(rig.mass_matrix(q), column("M")[:, joints, joints])
    assert_rounding(rig.gravity(q), column("G")[:, joints])
    assert_rounding(rig.energy(q, qd)[1][:, None], column("V")[:, None])
    if arm == "fixed":
        assert_rounding(rig(q, qd, tau), column("qdd_armfixed"))
        return
    assert_rounding(rig.bias(q, qd), column("bias"))
    assert_rounding(rig.energy(q, qd)[0][:, None], column("T")[:, None])
    assert_rounding(rig(q, qd, tau), column("qdd"))
    assert_rounding(rig.inverse_dynamics(q, qd, column("qdd")), tau)


def mjcf(rig: PendulumChain, tensor: list[list[float]], armature: list[float]) -> str:
    """The rig as a MuJoCo model: link frame x along the link, z the joint axis, first link up."""
    given = rig.to_dict()
    inner = ""
    for i in reversed(range(rig.links)):
        place = f"{given['length'][i - 1]!r} 0 0"
        frame = ""
        if i == 0:
            place = f"{given['arm']['length']!r} 0 0" if rig.first_link else "0 0 0"
            frame = 'xyaxes="0 0 1 0 -1 0"'
        inner = f"""<body pos="{place}" {frame}>
          <joint type="hinge" axis="0 0 1" armature="{armature[rig.first_link + i]!r}"/>
          <inertial pos="{given["com"][i]!r} 0 0" mass="{given["mass"][i]!r}"
            fullinertia="{" ".join(map(repr, tensor[i]))}"/>{inner}</body>"""
    if rig.first_link:
        spin = given["arm"]["inertia"]
        inner = f"""<body><joint type="hinge" axis="0 0 1" armature="{armature[0]!r}"/>
          <inertial pos="0 0 0" mass="1" diaginertia="{spin!r} {spin!r} {spin!r}"/>{inner}</body>"""
    gravity = given["gravity"]
    return (
        f"""<mujoco><option gravity="0 0 {-gravity!r}"/><worldbody>{inner}</worldbody></mujoco>"""
    )


@pytest.mark.parametrize("arm", ["fixed", "free"])
def test_dynamics_agree_with_mujoco(arm: Any) -> None:
    mujoco = pytest.importorskip("mujoco")
    rig = paper_rig("full", arm)
    armature = [0.01, 0.02, 0.003, 0.0004][-rig.joints :]
    rig = rig.replace(armature=torch.tensor(armature, dtype=torch.float64))
    model = mujoco.MjModel.from_xml_string(mjcf(rig, TENSOR, armature))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(50):
        q = rng.uniform(-math.pi, math.pi, rig.joints)
        qd = rng.normal(0, 5, rig.joints)
        data.qpos[:], data.qvel[:] = q, qd
        mujoco.mj_forward(model, data)
        mass = np.zeros((rig.joints, rig.joints))
        for column, unit in zip(mass, np.eye(rig.joints), strict=True):
            mujoco.mj_mulM(model, data, column, unit)
        state = torch.from_numpy(q), torch.from_numpy(qd)
        np.testing.assert_allclose(rig.mass_matrix(state[0]), mass, atol=1e-12)
        # |bias| reaches 1e2 N m; MuJoCo sums spatial forces in another order.
        np.testing.assert_allclose(rig.bias(*state), data.qfrc_bias, atol=1e-11, rtol=1e-11)
