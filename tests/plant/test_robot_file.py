"""Robot descriptions: dynamics equal MuJoCo's for the same file; unsupported files are refused."""

import math
import re
import sys
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nfriction.export.simulators import DampingFit, patched
from nfriction.plant import PendulumChain, rigs

mujoco = pytest.importorskip("mujoco")

IN_A_FOLDER = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@dataclass
class Body:
    """A body in the world at zero: its frame, mass, mass centre and inertia in world axes."""

    frame: np.ndarray
    place: np.ndarray
    mass: float
    com: np.ndarray
    inertia: np.ndarray


def numbers(values: object) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))


def rpy(matrix: np.ndarray) -> str:
    with np.errstate(all="ignore"):
        return numbers(Rotation.from_matrix(matrix).as_euler("xyz"))


def urdf_of(bodies: list[Body], axes: list[np.ndarray], spin: np.ndarray) -> str:
    """A URDF of bodies in a row, each with a massless frame and half its mass fixed to it."""
    lines = ['<robot name="row"><link name="ground"/>']
    before = Body(np.eye(3), np.zeros(3), 0.0, np.zeros(3), np.eye(3))
    for k, (body, axis) in enumerate(zip(bodies, axes, strict=True)):
        to = before.frame.T
        i = spin.T @ body.frame.T @ (body.inertia / 2) @ body.frame @ spin
        inertial = (
            f'<inertial><origin xyz="{numbers(body.frame.T @ (body.com - body.place))}" '
            f'rpy="{rpy(spin)}"/><mass value="{body.mass / 2!r}"/>'
            f'<inertia ixx="{i[0, 0]!r}" iyy="{i[1, 1]!r}" izz="{i[2, 2]!r}" '
            f'ixy="{i[0, 1]!r}" ixz="{i[0, 2]!r}" iyz="{i[1, 2]!r}"/></inertial>'
        )
        parent = f"link{k}" if k else "ground"
        lines.append(
            f'<link name="link{k + 1}">{inertial}</link>'
            f'<link name="shell{k + 1}">{inertial}</link><link name="frame{k + 1}"/>'
            f'<joint name="hinge{k + 1}" type="continuous"><parent link="{parent}"/>'
            f'<child link="link{k + 1}"/><axis xyz="{numbers(2.0 * body.frame.T @ axis)}"/>'
            f'<origin xyz="{numbers(to @ (body.place - before.place))}" '
            f'rpy="{rpy(to @ body.frame)}"/></joint>'
            f'<joint name="glue{k + 1}" type="fixed"><parent link="link{k + 1}"/>'
            f'<child link="shell{k + 1}"/></joint>'
            f'<joint name="tip{k + 1}" type="fixed"><parent link="link{k + 1}"/>'
            f'<child link="frame{k + 1}"/><origin xyz="1 2 3"/></joint>'
        )
        before = body
    return "".join([*lines, "</robot>"]).replace("np.float64(", "").replace(")", "")


def random_row(seed: int, joints: int, arm: bool) -> str:
    """A random chain that a `PendulumChain` can represent, with arbitrarily rotated frames, as
    URDF."""
    random = np.random.default_rng(seed)
    turn = Rotation.from_euler("z", random.uniform(-3, 3)).as_matrix()
    axis = turn @ np.array([1.0, 0.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    side = np.cross(axis, up)

    def inertia() -> np.ndarray:
        cloud = random.normal(size=(5, 3)) * random.uniform(0.02, 0.1)
        return sum(0.1 * (p @ p * np.eye(3) - np.outer(p, p)) for p in cloud)

    bodies, axes = [], []
    anchor, sign = random.normal(size=3), random.choice([-1.0, 1.0])
    if arm:
        com = anchor + random.normal(size=3)
        bodies.append(Body(Rotation.random(random_state=seed).as_matrix(), anchor, 1.3, com,
                           inertia()))  # fmt: skip
        axes.append(sign * up)
        anchor = anchor + 0.7 * axis + random.normal() * up
    for k in range(joints):
        length, angle = random.uniform(0.1, 0.5), random.uniform(-math.pi, math.pi)
        along = math.cos(angle) * up + math.sin(angle) * side
        # The mass may lie anywhere along the axis; on the last link also off the line.
        com = anchor + random.uniform(-0.3, 1.2) * length * along + 0.05 * random.normal() * axis
        if k == joints - 1:
            com = com + 0.1 * random.normal() * side
        frame = Rotation.random(random_state=seed + 10 + k).as_matrix()
        place = anchor + 0.1 * random.normal() * axis
        bodies.append(Body(frame, place, random.uniform(0.1, 1.0), com, inertia()))
        axes.append(sign * axis)
        anchor = anchor + length * along
    return urdf_of(bodies, axes, Rotation.random(random_state=seed + 5).as_matrix())


def zero_of(plant: PendulumChain) -> np.ndarray:
    """Joint coordinates of the plant at the file's zero."""
    zero = np.zeros(plant.joints)
    zero[plant.first_link] = math.pi if plant.convention[1] == "hanging" else 0.0
    return zero


def assert_moves_alike(
    plant: PendulumChain, model: object, seed: int = 0, tolerance: float = 1e-9
) -> None:
    data = mujoco.MjData(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    states = np.random.default_rng(seed).normal(size=(10, 3, plant.joints)) * [[3], [2], [1]]
    for q, qd, tau in states:
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, qd, tau
        mujoco.mj_forward(model, data)
        found = plant(*(torch.tensor(x) for x in (q + zero_of(plant), qd, tau))).numpy()
        # Both solve with the mass matrix, whose condition number is below 1e5.
        assert np.abs(found - data.qacc).max() <= tolerance * max(1.0, np.abs(data.qacc).max())


@IN_A_FOLDER
@given(st.integers(0, 10_000), st.integers(1, 4), st.booleans())
@example(0, 2, True)
def test_dynamics_of_any_chain_equal_those_of_mujoco(tmp_path, seed, joints, arm):
    path = tmp_path / "row.urdf"
    path.write_text(random_row(seed, joints, arm))
    plant = rigs.read(path)
    assert plant.joint_names == tuple(f"hinge{k + 1}" for k in range(joints + arm))
    assert (plant.name, plant.first_link) == ("row", int(arm))
    model = mujoco.MjModel.from_xml_path(str(path))
    assert_moves_alike(plant, model, seed)
    # MuJoCo writes six digits, so axes that hardly differ are taken as parallel.
    mujoco.mj_saveLastXML(str(tmp_path / "row.xml"), model)
    saved = mujoco.MjModel.from_xml_path(str(tmp_path / "row.xml"))
    assert_moves_alike(rigs.read(tmp_path / "row.xml"), saved, seed, tolerance=1e-4)


MJCF = """<mujoco model="bench"><option gravity="0 0 -9.7"/>
<default><joint type="hinge" armature="0.002" damping="0.1"/><geom density="2700"/>
<default class="light"><geom density="300" type="capsule" size="0.01"/></default></default>
<worldbody><geom type="plane" size="1 1 1"/>
<body name="arm" pos="0 0 1"><joint name="j1" axis="0 0 {sign}"/>
<geom type="box" size=".2 .02 .03" pos="0.2 0.01 0"/>
<body name="a" pos=".42 0 -0.1"><joint name="j2" axis="{sign} 0 0" ref="20"/>
<geom class="light" fromto="0.02 0 0 0.02 0 -.3"/>
<body name="b" pos="0.05 0 -.3"><joint name="j3" axis="{sign} 0 0" ref="-100"/>
<geom type="box" size=".01 .03 .2" pos="0.03 0 .15" euler="0 0 30"/>
<body pos="0 0 0.05" euler="20 0 0"><geom type="sphere" size=".03" pos="0 0.01 0.1"/></body>
</body></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("sign", [1, -1])
def test_mjcf_is_read_as_compiled_by_mujoco(tmp_path, sign):
    path = tmp_path / "bench.xml"
    path.write_text(MJCF.format(sign=sign))
    plant = rigs.read(path)
    assert plant.joint_names == ("j1", "j2", "j3")
    assert plant.armature.tolist() == [0.002] * 3
    model = mujoco.MjModel.from_xml_path(str(path))
    model.dof_damping[:] = 0.0  # friction is no part of a plant
    assert_moves_alike(plant, model)


def test_warnings_of_mujoco_are_passed_on_without_a_log_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "bench.xml"
    path.write_text(MJCF.format(sign=1).replace('pos="0.2 0.01 0"', 'pos="NaN 0.01 0"'))
    with pytest.warns(UserWarning, match=r"bench\.xml: MuJoCo says: .*NaN"):
        rigs.read(path)
    assert mujoco.get_mju_user_warning() is None
    assert [entry.name for entry in tmp_path.iterdir()] == ["bench.xml"]


def test_file_of_a_known_rig_gives_that_rig(tmp_path):
    rig = rigs.multiarm_triple()
    given, place, bodies = rig.to_dict(), np.zeros(3), []
    down, axis = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
    for m, length, com, izz in zip(
        given["mass"], given["length"], given["com"], given["inertia"], strict=True
    ):
        inertia = izz * np.diag([1.0, 1.0, 0.0])
        bodies.append(Body(np.eye(3), place, m, place + com * down, inertia))
        place = place + length * down
    path = tmp_path / "triple.urdf"
    path.write_text(urdf_of(bodies, [axis] * 3, np.eye(3)))
    found = rigs.read(path)
    assert found.convention == ("relative", "hanging")
    assert "buffers" not in found.to_dict()  # hanging at zero, so no offset remains
    ratio = 9.81 / given["gravity"]
    for name, factor in (("inertia_coupling", 1.0), ("gravity_moment", ratio)):
        expected = factor * getattr(rig, name)
        torch.testing.assert_close(getattr(found, name), expected, rtol=1e-12, atol=1e-15)


def test_exported_friction_does_not_change_the_rig(tmp_path):
    for name, root, text in (
        ("a.urdf", "robot", random_row(3, 2, False)), ("b.xml", "mujoco", MJCF.format(sign=1))
    ):  # fmt: skip
        path = tmp_path / name
        path.write_text(text)
        plant = rigs.read(path)
        halves = (0.5,) * plant.joints
        found = DampingFit(plant.joint_names, halves, halves, (), ())
        path.write_bytes(patched(path, root, found))
        assert "0.5" in path.read_text()
        assert rigs.read(path).to_dict() == plant.to_dict()


PENDULUM = """<robot name="p"><link name="base"/><link name="rod"><inertial>
<origin xyz="0 0 -0.2"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="bob"><inertial><origin xyz="0 0 -0.1"/><mass value="0.5"/>
<inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="top" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
</joint>
<joint name="elbow" type="continuous"><parent link="rod"/><child link="bob"/>
<axis xyz="0 1 0"/><origin xyz="0 0 -0.4"/></joint></robot>"""


@pytest.mark.parametrize("suffix", ["urdf", "xml"])
def test_very_long_names_are_refused_in_a_short_message(tmp_path, suffix):
    path = tmp_path / f"bench.{suffix}"
    written = PENDULUM if suffix == "urdf" else MJCF.format(sign=1)
    path.write_text(re.sub(r'(<joint name=)"[^"]*"', r'\1"' + "j" * 1000 + '"', written, count=1))
    with pytest.raises(ValueError, match="name of 1000 characters") as raised:
        rigs.read(path)
    assert len(str(raised.value)) < 300


ELBOW = '<axis xyz="0 1 0"/><origin xyz="0 0 -0.4"/>'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"continuous"', '"prismatic"', "joint 'elbow' is 'prismatic'"),
        ('"continuous"', '"floating"', "joint 'elbow' is 'floating'"),
        ('<parent link="rod"/>', '<parent link="base"/>', r"the ground carries several joints"),
        (ELBOW, ELBOW.replace("0 1 0", "1 1 0"), "'elbow' has an axis 45 degrees off that of"),
        (ELBOW, ELBOW.replace("0 1 0", "0 0 1"), "'elbow' has an axis 90 degrees off the horiz"),
        (ELBOW, ELBOW.replace("0 1 0", "0 -1 0"), "'elbow' turns against 'top'"),
        (ELBOW, ELBOW.replace("0 1 0", "0 0 0"), "axis without direction"),
        (ELBOW, ELBOW.replace("0 0 -0.4", "0 0.1 0"), "'elbow' turns about the very axis of"),
        (ELBOW, ELBOW + '<mimic joint="top"/>', "'elbow' mimics"),
        ('xyz="0 0 -0.2"', 'xyz="0.01 0 -0.2"', "'top' carries a mass centre 10 mm off the line"),
        ('<mass value="0.5"/>', '<mass value="0"/>', "'elbow' carries no mass"),
        ('<mass value="0.5"/>', '<mass value="-1"/>', "link 'bob': mass and moments"),
        ('<mass value="0.5"/>', "", "link 'bob': an inertial needs"),
        ('<mass value="0.5"/>', '<mass value="heavy"/>', "mass of link 'bob'.*'heavy'"),
        ('<mass value="0.5"/>', '<mass value="nan"/>', r"1 finite numbers up to 1e\+09, got 'nan'"),
        ('xyz="0 0 -0.1"', 'xyz="0 0"', r"3 finite numbers up to 1e\+09, got '0 0'"),
        ('<child link="bob"/>', '<child link="rod"/>', "'rod' is the child of two joints"),
        ('<child link="bob"/>', '<child link="base"/>', "links form a loop"),
        ('<link name="base"/>', '<link name="base"/><link name="b2"/>', "one link that no joint"),
        ('<child link="bob"/>', '<child link="gone"/>', "a child that is not a link: 'gone'"),
        ('name="elbow"', 'name="top"', "every joint needs a unique name"),
        ("robot", "rover", "root element is <rover>"),
        ("</robot>", "", "not XML, or cut short"),
        ("<robot", '<!DOCTYPE r [<!ENTITY a "b">]><robot', "declares a document type"),
        ("<robot", '<robot xmlns:xacro="http://ros.org/xacro"><xacro:a/></robot><robot',
         "cut short"),
        ('<link name="base"/>', '<link name="base"/><xacro:a xmlns:xacro="http://ros.org/xacro"/>',
         "contains macros"),
    ],
)  # fmt: skip
def test_mechanisms_that_are_no_chain_are_refused_by_name(tmp_path, old, new, message):
    path = tmp_path / "p.urdf"
    path.write_text(PENDULUM)
    rigs.read(path)
    assert old in PENDULUM
    path.write_text(PENDULUM.replace(old, new))
    with pytest.raises(ValueError, match=message) as caught:
        rigs.read(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name="j3" axis', 'name="j3" type="slide" axis', "joint 'j3' is 'slide'"),
        ('<joint name="j1"', '<freejoint name="f"/><joint name="j1"', "bench.xml"),
        ('name="j3"', 'name="j3" stiffness="1"', "joint 'j3' has a spring"),
        ('gravity="0 0 -9.7"', 'gravity="0 0 0"', "no gravity"),
        ('gravity="0 0 -9.7"', 'gravity="0 1 -9.7"', "(off the horizontal|off that).*fit-torque"),
        ('gravity="0 0 -9.7"', 'density="1.2"', "its medium causes drag"),
        ('<body name="b"', '<body name="b" gravcomp="1"', "compensates gravity"),
        ("</worldbody>", '</worldbody><equality><joint joint1="j2" joint2="j3"/></equality>',
         "equality"),
        ('<body name="arm"', '<replicate count="2"><body/></replicate><body name="arm"',
         "<replicate> is not read"),
        ("</mujoco>", '<include file="/etc/passwd"/></mujoco>', "<include> is not read"),
        ('pos=".42 0 -0.1"', 'pos=".42 0.1 -0.1"', "'j2' passes the axis of 'j1' at 100 mm"),
        ('pos=".42 0 -0.1"', 'pos="-.8 0 -0.1"', "'j1' turns so that 'j2' points inward"),
        ('class="light" from', 'nonsense="1" from', "bench.xml"),
    ],
)  # fmt: skip
def test_elements_other_than_hinges_are_refused(tmp_path, old, new, message):
    path = tmp_path / "bench.xml"
    text = MJCF.format(sign=1)
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message):
        rigs.read(path)


def test_without_mujoco_the_error_names_the_package(tmp_path, monkeypatch):
    path = tmp_path / "bench.xml"
    path.write_text(MJCF.format(sign=1))
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match="pip install mujoco"):
        rigs.read(path)
    path.write_text(PENDULUM)  # a URDF needs none, whatever its suffix
    assert rigs.read(path).joint_names == ("top", "elbow")


@settings(IN_A_FOLDER, max_examples=60)
@given(st.data())
def test_damaged_file_gives_a_plant_or_an_error(tmp_path, data):
    start = data.draw(st.integers(0, len(PENDULUM) - 1))
    end = data.draw(st.integers(start, min(start + 30, len(PENDULUM))))
    put = data.draw(st.text('0123456789-.e<>/=" abXYZ\u00e9', max_size=12))
    path = tmp_path / "p.urdf"
    path.write_text(PENDULUM[:start] + put + PENDULUM[end:], encoding="utf-8")
    try:
        plant = rigs.read(path)
    except ValueError:
        return
    state = torch.ones(plant.joints, dtype=torch.float64)
    assert plant(state, state, state).isfinite().all()
