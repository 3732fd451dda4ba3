"""Named rigs, their published numbers, and rig files."""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from nfriction.plant import Arm, LinearAxis, Motor, PendulumChain, rigs


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", rigs.names())
def test_every_rig_moves_and_keeps_its_name(name: str) -> None:
    rig = rigs.by_name(name)
    assert rig.name == name
    assert len(rig.joint_names) == rig.joints
    assert rig.position_quantum is not None
    assert "buffers" not in rig.to_dict()  # its parameters are complete
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(3, 4, rig.joints, dtype=torch.float64, generator=generator).unbind(0)
    assert rig(*state).isfinite().all()
    assert (torch.linalg.eigvalsh(rig.mass_matrix(state[0])) > 0).all()
    assert rig.unit == ("m" if isinstance(rig, LinearAxis) else "rad")


@pytest.mark.filterwarnings("ignore:the inertia of link")
@pytest.mark.parametrize("name", rigs.names())
def test_rig_file_round_trip_is_exact(name: str, tmp_path: Path) -> None:
    rig = rigs.by_name(name)
    fitted = rig.replace(torque_offset=rig.torque_offset + 0.125)
    rigs.write(fitted, tmp_path / "rig.json")
    again = rigs.read(tmp_path / "rig.json")
    assert again.to_dict() == fitted.to_dict()
    for (_, value), (_, other) in zip(fitted.named_buffers(), again.named_buffers(), strict=True):
        assert torch.equal(value, other)


def test_unknown_names_list_the_valid_ones() -> None:
    with pytest.raises(ValueError, match="tlrip, rtip, multiarm-single"):
        rigs.by_name("tlrp")
    with pytest.raises(ValueError, match="A0"):
        rigs.dfki("B7")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="`arm` must be"):
        rigs.tlrip("loose")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="`inertia` must be"):
        rigs.tlrip(inertia="some")  # type: ignore[arg-type]


def test_conventions_and_encoder_resolutions_of_named_rigs() -> None:
    assert rigs.tlrip().convention == ("relative", "upright")
    assert rigs.rtip().convention == ("relative", "hanging")
    assert rigs.multiarm_double().convention == ("absolute", "hanging")
    assert rigs.tlrip().position_quantum == 2 * math.pi / 8192
    assert rigs.tlrip("free").joint_names == ("joint1", "joint2", "joint3", "joint4")
    assert rigs.xl330().gravity_moment.item() == pytest.approx(0.4807, abs=1e-4)


@pytest.mark.parametrize(
    ("build", "m", "r", "length", "inertia", "rotor"),
    [
        ("A0", (0.608, 0.630), (0.275, 0.166), 0.3, (0.05472, 0.02522), 6.07e-5),
        ("C0", (0.6417, 0.5639), (0.2, 0.3213), 0.2, (0.02671, 0.05388), 9.94e-5),
        ("C1", (0.5235, 0.6256), (0.2, 0.2557), 0.2, (0.03189, 0.05087), 6.29e-5),
    ],
)
def test_dfki_has_the_mass_matrix_of_its_source(
    build: str,
    m: tuple[float, float],
    r: tuple[float, float],
    length: float,
    inertia: tuple[float, float],
    rotor: float,
) -> None:
    rig = rigs.dfki(build)  # type: ignore[arg-type]
    for bend in np.linspace(-3, 3, 7):
        swing, gear = m[1] * length * r[1] * math.cos(bend), 6
        m11 = sum(inertia) + m[1] * length**2 + 2 * swing + (gear**2 + 1) * rotor
        m12 = inertia[1] + swing - gear * rotor
        m22 = inertia[1] + gear**2 * rotor
        q = torch.tensor([0.4, bend], dtype=torch.float64)
        expected = torch.tensor([[m11, m12], [m12, m22]], dtype=torch.float64)
        torch.testing.assert_close(rig.mass_matrix(q), expected, rtol=1e-12, atol=1e-14)


def test_emps_offset_has_the_sign_of_the_recording(data_dir: Path) -> None:
    """Regression tau = M qdd + Fv qd + Fc sgn(qd) - torque_offset on the real recording."""
    signal = pytest.importorskip("scipy.signal")
    rows = np.loadtxt(data_dir / "emps" / "emps_first.csv", delimiter=",", skiprows=1)
    q, tau = rows[:, 1], rows[:, 3]
    qd, qdd = (signal.savgol_filter(q, 41, 3, order, 1e-3) for order in (1, 2))
    moving = np.abs(qd) > 5e-3
    design = np.stack([qdd, qd, np.sign(qd), -np.ones_like(qd)], 1)[moving]
    mass, _, _, offset = np.linalg.lstsq(design, tau[moving], rcond=None)[0]
    rig = rigs.emps()
    # The published values come from all recordings and another filter.
    assert offset == pytest.approx(rig.torque_offset.item(), rel=0.1)
    assert mass == pytest.approx(rig.mass.item(), rel=0.1)


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"mass": [1]}', r"missing keys \['length'\]"),
        ('{"mass": [1], "length": [1], "masss": 2}', r"unknown keys \['masss'\]"),
        ('{"mass": [1], "length": [1], "type": "chain"}', r"unknown keys \['type'\]"),
        ('{"mass": [1], "length": [1], "arm": {"inertia": 1}}', r"arm: missing keys \['length'\]"),
        ('{"mass": [1], "length": ["long"]}', "`length` must be"),
        ('{"mass": 1, "length": [1]}', "`mass` must be one or more numbers"),
        ('{"mass": [1], "length": [1], "gravity": "earth"}', "`gravity` must be"),
        ('{"kind": "cart", "mass": [1]}', "no kind 'cart'"),
        ('{"kind": "axis"}', r"missing keys \['mass'\]"),
        ('{"mass": [1], "length": [1], "buffers": {"friction": [1]}}', "no buffer `friction`"),
        ("[1, 2]", "one table"),
        ('{"mass": ', "rig.json: not valid JSON: Expecting value at line 1, column 1"),
    ],
)
def test_bad_rig_files_raise_clear_errors(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        rigs.read(write(tmp_path / "rig.json", text))


def test_toml_is_read_and_other_suffixes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\.json or \.toml"):
        rigs.read(write(tmp_path / "rig.yaml", "mass: 1"))
    with pytest.raises(ValueError, match=r"written as \.json"):
        rigs.write(rigs.tlrip(), tmp_path / "rig.toml")
    path = write(tmp_path / "rig.toml", 'name = "bench"\nmass = [1.0]\nlength = [0.5]\n')
    if sys.version_info < (3, 11):
        with pytest.raises(ValueError, match=r"Python 3\.11"):
            rigs.read(path)
        return
    rig = rigs.read(path)
    assert isinstance(rig, PendulumChain)
    assert rig.name == "bench"


def test_rig_file_may_contain_drag(tmp_path: Path) -> None:
    data = {"mass": [1.0], "length": [1.0], "buffers": {"drag_quadratic": [0.1]}}
    rig = rigs.read(write(tmp_path / "rig.json", json.dumps(data)))
    assert rig.has_drag


def test_mistyped_rig_or_key_suggests_the_nearest_one(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Did you mean multiarm-double"):
        rigs.by_name("multiarm_double")
    text = '{"mass": [1], "lenght": [1]}'
    with pytest.raises(ValueError, match=r"unknown keys \['lenght'\], did you mean length\?"):
        rigs.read(write(tmp_path / "rig.json", text))
    with pytest.raises(ValueError, match=r"rig: missing keys \['mass'\]; required"):
        rigs.read(write(tmp_path / "rig.json", '{"length": [1]}'))


HUGE = "1" + "0" * 400  # an integer in JSON, beyond the range of float


@pytest.mark.parametrize(
    "text",
    [
        f'{{"mass": [{HUGE}], "length": [1]}}',
        f'{{"mass": [1], "length": [1], "gravity": {HUGE}}}',
        f'{{"mass": [1], "length": [1], "inertia": [[{HUGE}, 0, 0, 0, 0, 0]]}}',
        f'{{"mass": [1], "length": [1], "arm": {{"inertia": {HUGE}, "length": 1}}}}',
        f'{{"mass": [1], "length": [1], "buffers": {{"armature": [{HUGE}]}}}}',
        f'{{"kind": "axis", "mass": {HUGE}}}',
    ],
)
def test_numbers_beyond_float_range_are_refused_in_a_short_message(
    text: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=r"rig\.json: .* must be") as refusal:
        rigs.read(write(tmp_path / "rig.json", text))
    assert len(str(refusal.value)) < 400


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"mass": [10**400]}, "`mass` must be one or more numbers"),
        ({"inertia": [10**400]}, "`inertia` must be numbers"),
        ({"gravity": math.nan}, "`gravity` must be finite"),
        ({"joint_names": "a"}, "`joint_names` must be a list of texts"),
        ({"joint_names": [1]}, "`joint_names` must be a list of texts"),
        ({"convention": "ab"}, "`convention` must be a list of texts"),
        ({"convention": None}, "`convention` must be a list of texts"),
        ({"name": 3}, "`name` must be text"),
        ({"position_quantum": [1e-4, 1e-4]}, "`position_quantum` must be"),
    ],
)
def test_python_arguments_are_checked_like_those_of_files(changed: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PendulumChain(**({"mass": [1.0], "length": [1.0]} | changed))


def test_arm_length_that_is_no_number_is_refused() -> None:
    for value in (math.inf, math.nan, -1.0, 10**400, "1"):
        with pytest.raises(ValueError, match="`arm's length` must be"):
            Arm(1.0, value)  # type: ignore[arg-type]


def test_states_that_are_no_tensors_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"`q` must be \(\*batch, 1\), a tensor .*got \[0\.1\]"):
        rigs.xl330().load([0.1], [0.0])  # type: ignore[arg-type]


def test_arm_must_be_an_arm_and_is_stored_as_plain_numbers() -> None:
    with pytest.raises(TypeError, match="`arm` must be an Arm"):
        PendulumChain([1.0], [1.0], arm={"inertia": 1.0, "length": 1.0})  # type: ignore[arg-type]
    arm = Arm(torch.tensor(1.0), np.float64(0.5))  # type: ignore[arg-type]
    data = PendulumChain([1.0], [1.0], arm=arm).to_dict()
    assert json.loads(json.dumps(data)) == data
    for wrong in (None, [1.0], "rig"):
        with pytest.raises(ValueError, match="a rig is one table"):
            rigs.from_dict(wrong)  # type: ignore[arg-type]


def test_geared_motor_adds_its_reflected_inertia_only_to_the_arm() -> None:
    """As in `datasets/rtip_twin`: the RTIP paper's gearbox of 10:1, a hundred times the rotor."""
    plain = rigs.rtip("free")
    free = plain.to_dict()
    links = {key: free[key] for key in ("mass", "length", "com", "inertia", "gravity")}
    motor = Motor(gear_ratio=[10, 1, 1, 1], rotor_inertia=[1e-5, 0, 0, 0])
    geared = PendulumChain(**links, arm=Arm(**free["arm"]), motor=motor)
    q, qd = torch.randn(2, 5, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = torch.zeros(5, 4, 4, dtype=torch.float64)
    expected[:, 0, 0] = 1e-3
    added = geared.mass_matrix(q) - plain.mass_matrix(q)
    torch.testing.assert_close(added, expected, rtol=0, atol=1e-14)
    assert torch.equal(geared.bias(q, qd), plain.bias(q, qd))
