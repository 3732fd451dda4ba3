"""Joint models of simulators: exact where possible, otherwise with their error stated."""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from nfriction import LinearAxis, rollout
from nfriction.export import fit_damping_frictionloss, mjcf, urdf
from nfriction.friction import model_by_name
from nfriction.friction.memory import Dahl
from nfriction.friction.models import LFM, NCFM, NLFM
from nfriction.friction.neurofuzzy import NFLFM
from nfriction.io.model_file import ModelInfo
from nfriction.papers.afem.adaptive import ALFM
from nfriction.signals import Motion
from tests.friction.samples import randomise

TIME = 1e-3 * np.arange(3000)


def swing(joints: int = 2, amplitude: float = 1.0) -> Motion:
    phase = 7 * TIME[:, None] + np.arange(joints)
    q = amplitude * np.sin(phase)
    return Motion(TIME, q, 7 * amplitude * np.cos(phase), -49 * q)


@pytest.mark.parametrize(
    ("model", "frictionloss"), [(NCFM(2, [0.3]), 0.0), (LFM(2, [0.3, 0.7]), 0.7)]
)
def test_viscous_and_coulomb_friction_are_converted_exactly(
    model: NCFM | LFM, frictionloss: float
) -> None:
    found = fit_damping_frictionloss(model, swing())
    assert found.damping == pytest.approx([0.3, 0.3], rel=1e-9)
    assert found.frictionloss == pytest.approx([frictionloss] * 2, abs=1e-9)
    assert max(found.relative_error) < 1e-9


def test_conversion_error_is_minimal() -> None:
    model = NFLFM(2, [0.1, 0.2])
    randomise(model, 0.3)
    motion = swing()
    found = fit_damping_frictionloss(model, motion)
    qd, qdd = torch.as_tensor(motion.qd), torch.as_tensor(motion.qdd)
    tau = model(qd, qdd, torch.ones_like(qd)).detach().numpy()

    def rms(damping: np.ndarray, frictionloss: np.ndarray) -> np.ndarray:
        nearest = damping * motion.qd + frictionloss * np.tanh(motion.qd / model.v_smooth)
        return np.sqrt(((tau - nearest) ** 2).mean(0))

    d, f = np.array(found.damping), np.array(found.frictionloss)
    best = rms(d, f)
    np.testing.assert_allclose(best, found.rms_error, rtol=1e-9)
    np.testing.assert_allclose(np.sqrt((tau**2).mean(0)), found.rms_torque)
    for factor in (0.99, 1.01):
        assert (rms(factor * d, f) > best).all()
        assert (rms(d, factor * f) > best).all()


def test_converted_values_are_never_negative() -> None:
    # Friction that falls with speed would require negative damping.
    falling = NLFM(1, [0.0, 1.0, 0.0, 0.0, 1.0])
    found = fit_damping_frictionloss(falling, swing(1))
    assert min(*found.damping, *found.frictionloss) >= 0
    offset = fit_damping_frictionloss(NLFM(1, [-1.0, 0.01, 0.0, 0.0, 1.0]), swing(1))
    assert min(*offset.damping, *offset.frictionloss) >= 0
    assert (
        offset.relative_error[0] > 0.9
    )  # a constant offset is lost completely, and the stated error shows it


def test_load_and_memory_are_included() -> None:
    heavy = fit_damping_frictionloss(
        LFM(2, [0.3, 0.7]), swing(), load=lambda q, qd: torch.full_like(q, 2.0)
    )
    assert heavy.frictionloss == pytest.approx([1.4, 1.4])
    adaptive = ALFM(2, torch.tensor([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]).repeat(2, 1, 1))
    # Slow motion with low acceleration has the coefficients of the lowest class, fast the highest.
    slow, fast = swing(amplitude=0.01), swing(amplitude=5.0)
    assert fit_damping_frictionloss(adaptive, slow).damping == pytest.approx([0.1, 0.1], rel=1e-6)
    # The first joint starts without acceleration, in the lowest class.
    assert fit_damping_frictionloss(adaptive, fast).damping[1] == pytest.approx(0.5, rel=1e-6)
    both = fit_damping_frictionloss(adaptive, [slow, fast])
    assert max(both.relative_error) > 1e-6


def test_uninformative_motion_is_refused() -> None:
    still = Motion(TIME, *(np.zeros((len(TIME), 2)) for _ in range(3)))
    with pytest.raises(ValueError, match="does not move"):
        fit_damping_frictionloss(LFM(2), still)
    with pytest.raises(ValueError, match="the law 'dahl' has: export a model without"):
        fit_damping_frictionloss(Dahl(2), still)
    with pytest.raises(ValueError, match="with 2 joints"):
        fit_damping_frictionloss(LFM(2), swing(3))


ROBOT = """<mujoco><!-- kept -->
  <worldbody>
    <body><joint name="shoulder" type="hinge" axis="0 1 0"/><geom size="0.1" mass="1"/>
      <body pos="0 0 1"><joint name="elbow" axis="0 1 0" damping="9"/>
        <geom size="0.1" mass="1"/></body></body>
  </worldbody>
  <equality><joint joint1="elbow" active="false"/></equality>
</mujoco>"""


def test_mujoco_applies_the_damping_values(tmp_path: Path) -> None:
    mujoco: Any = pytest.importorskip("mujoco")
    (tmp_path / "robot.xml").write_text(ROBOT)
    info = ModelInfo(joint_names=["elbow", "shoulder"])
    model = LFM(2, [[0.3, 0.7], [0.5, 0.9]])
    found = mjcf(model, tmp_path / "out.xml", swing(), info, patch=tmp_path / "robot.xml")
    loaded = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    state = mujoco.MjData(loaded)
    state.qvel[:] = [2.0, -3.0]  # of shoulder and elbow, in the robot's own order
    mujoco.mj_forward(loaded, state)
    np.testing.assert_allclose(state.qfrc_passive, [-0.5 * 2.0, 0.3 * 3.0], rtol=1e-9)
    np.testing.assert_allclose(loaded.dof_frictionloss, [0.9, 0.7], rtol=1e-9)
    assert found.damping == pytest.approx([0.3, 0.5])
    assert "kept" in (tmp_path / "out.xml").read_text()


@pytest.mark.parametrize("name", ["lugre", "dahl"])
def test_bristles_in_mujoco_agree_with_a_rollout(name: str, tmp_path: Path) -> None:
    mujoco: Any = pytest.importorskip("mujoco", minversion="4.0")
    body = '<body><joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="0.5"/></body>'
    option = '<option timestep="1e-4" gravity="0 0 0" integrator="implicitfast"/>'
    robot = f"<mujoco>{option}<worldbody>{body}</worldbody></mujoco>"
    (tmp_path / "robot.xml").write_text(robot)
    values = {"lugre": [1.0, 0.5, 0.05, 300.0, 5.0, 0.4], "dahl": [1.0, 0.4, 300.0]}[name]
    model = model_by_name(name)(1, values).requires_grad_(False)
    info = ModelInfo(joint_names=["x"], unit="m")
    found = mjcf(model, tmp_path / "out.xml", swing(1), info, patch=tmp_path / "robot.xml")
    assert "exact" in str(found)
    loaded = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    state = mujoco.MjData(loaded)
    time = 1e-4 * np.arange(10_000)
    force = 1.3 * (1.2 + 0.8 * np.sin(3.0 * time)) * np.sin(5.0 * time)
    positions = []
    for f in force:
        state.qfrc_applied[0] = f
        mujoco.mj_step(loaded, state)
        positions.append(float(state.qpos[0]))
    zero = torch.zeros(1, dtype=torch.float64)
    tau = torch.tensor(force)[:, None]
    run = rollout(LinearAxis(0.5), model, zero, zero, tau, sample_time=1e-4)
    # MuJoCo's steps are first-order accurate.
    assert np.ptp(positions) > 0.05
    np.testing.assert_allclose(positions, run.q[1:, 0].numpy(), atol=1e-3 * np.ptp(positions))
    mjcf(model, tmp_path / "part.xml", swing(1), info)
    assert 'lugre="300 ' in (tmp_path / "part.xml").read_text()
    with pytest.raises(ValueError, match="have no memory"):
        urdf(model, tmp_path / "out.urdf", swing(1), info)


def test_existing_friction_in_a_file_is_replaced(tmp_path: Path) -> None:
    others = '<dcmotor joint="shoulder" input="none" lugre="1 0 1 1 1"/><motor joint="elbow"/>'
    path, info = tmp_path / "robot.xml", ModelInfo(joint_names=["elbow"])
    path.write_text(ROBOT.replace("</mujoco>", f"<actuator>{others}</actuator></mujoco>"))

    def motors() -> list[tuple[str | None, ...]]:
        found = ElementTree.parse(path).iter("dcmotor")
        return [(motor.get("joint"), motor.get("lugre")) for motor in found]

    for stiffness in (100, 300):
        model = Dahl(1, [1.0, 0.4, stiffness]).requires_grad_(False)
        mjcf(model, path, swing(1), info, patch=path)
        assert motors() == [("shoulder", "1 0 1 1 1"), ("elbow", f"{stiffness} 0 1 1 1")]
    mjcf(LFM(1, [0.3, 0.7]), path, swing(1), info, patch=path)
    assert motors() == [("shoulder", "1 0 1 1 1")]
    assert "<motor " in path.read_text()


def test_snippets_load_and_state_their_error(tmp_path: Path) -> None:
    mujoco: Any = pytest.importorskip("mujoco")
    info = ModelInfo(joint_names=['a "b" --', "c"])  # awkward names
    found = mjcf(LFM(2, [0.3, 0.7]), tmp_path / "friction.xml", swing(), info)
    mujoco.MjModel.from_xml_path(str(tmp_path / "friction.xml"))
    assert "RMS" in (tmp_path / "friction.xml").read_text()
    assert "damping 0.3 N m s/rad, friction loss 0.7 N m" in str(found)
    urdf(LFM(2, [0.3, 0.7]), tmp_path / "friction.urdf", swing(), info)
    tree = ElementTree.parse(tmp_path / "friction.urdf")
    assert [joint.get("name") for joint in tree.iter("joint")] == list(info.joint_names)
    assert [float(x.attrib["friction"]) for x in tree.iter("dynamics")] == pytest.approx([0.7, 0.7])
