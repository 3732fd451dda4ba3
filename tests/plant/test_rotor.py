"""One rotating axis: the chain's equation in a motor's parameters, and rigs with motors."""

import json
import math

import numpy as np
import pandas as pd
import pytest
import torch

from nfriction.plant import LinearAxis, Motor, PendulumChain, Rotor, rigs
from nfriction.recording import Recording

GEARED = Motor(gear_ratio=50, rotor_inertia=1.2e-5, torque_constant=0.03)


def states() -> tuple[torch.Tensor, ...]:
    return torch.randn(3, 5, 1, dtype=torch.float64).unbind(0)


def test_pendulum_on_a_geared_motor_follows_newtons_law() -> None:
    rotor = Rotor(0.05, mass=0.5, com=0.3, motor=GEARED)
    q, qd, tau = states()
    qdd = (tau + 0.5 * 9.81 * 0.3 * torch.sin(q)) / (0.05 + 50**2 * 1.2e-5)
    torch.testing.assert_close(rotor(q, qd, tau), qdd)
    torch.testing.assert_close(rotor.inverse_dynamics(q, qd, qdd), tau)
    assert rotor.motor_factors == {"motor": [0.02], "current": [pytest.approx(1.5)]}


def test_rotor_equals_a_chain_of_one_link() -> None:
    rotor = Rotor(0.05, mass=0.5, com=0.3)
    chain = PendulumChain([0.5], [1.0], [0.3], [0.05 - 0.5 * 0.09])
    for given in (states(), states()):
        torch.testing.assert_close(rotor(*given), chain(*given))


@pytest.mark.parametrize("rotor", [Rotor(0.02), Rotor(motor=GEARED), Rotor(0.02, motor=GEARED)])
def test_balanced_rotor_has_no_gravity_and_a_constant_load(rotor: Rotor) -> None:
    q, qd, tau = states()
    assert not rotor.gravity(q).any()
    assert torch.equal(rotor.load(q, qd), torch.ones_like(q))
    torch.testing.assert_close(rotor(q, qd, tau), rotor(q + 1, 2 * qd, tau))
    assert (rotor.unit, rotor.joints) == ("rad", 1)


def test_rig_files_of_every_kind_keep_their_motors(tmp_path) -> None:
    for plant in (
        Rotor(0.02, motor=GEARED, name="wheel", position_quantum=1e-5),
        Rotor(0.05, 0.5, 0.3, convention=("relative", "hanging")),
        LinearAxis(20.0, motor=Motor(2 * math.pi / 0.005, 1e-5, 0.1)),
        PendulumChain([1.0, 0.5], [0.3, 0.2], motor=Motor([6, 50], [1e-5, 1e-6], [0.1, 0.03])),
    ):
        rigs.write(plant, tmp_path / "rig.json")
        again = rigs.read(tmp_path / "rig.json")
        assert type(again) is type(plant)
        assert again.to_dict() == plant.to_dict()
        assert again.motor_factors == plant.motor_factors
        assert "buffers" not in again.to_dict()
        for (_, value), (_, other) in zip(
            plant.named_buffers(), again.named_buffers(), strict=True
        ):
            assert torch.equal(value, other)


def test_rotor_inertia_is_reflected_to_the_joint() -> None:
    motor = Motor([6, 50], [1e-5, 1e-6])
    chain = PendulumChain([1.0, 0.5], [0.3, 0.2], motor=motor)
    same = PendulumChain([1.0, 0.5], [0.3, 0.2], armature=[36e-5, 2500e-6])
    torch.testing.assert_close(chain.armature, same.armature)
    assert chain.has_armature
    axis = LinearAxis(20.0, motor=Motor(1000.0, 1e-5))
    assert axis.mass.item() == pytest.approx(30.0)


@pytest.mark.parametrize(
    ("rig", "message"),
    [
        ({"kind": "rotor"}, "a rotor needs `inertia`"),
        ({"kind": "rotor", "inertia": 0.01, "mass": 1, "com": 0.2}, "at least mass com"),
        ({"kind": "rotor", "inertia": -1}, "must not be negative"),
        ({"kind": "rotor", "inertia": 1, "mass": 0.5}, "belong together, got 0.5 and 0.0"),
        ({"kind": "rotor", "inertia": 1, "gear": 50}, "unknown keys"),
        ({"kind": "rotor", "inertia": 1, "motor": {"ratio": 5}}, "did you mean gear_ratio"),
        ({"kind": "rotor", "inertia": 1, "motor": {"gear_ratio": 0}}, "must not be zero"),
        ({"kind": "rotor", "inertia": 1, "motor": {"rotor_inertia": -1}}, "not be negative"),
        ({"kind": "rotor", "inertia": 1, "motor": {"gear_ratio": [5, 6]}}, "a list of 1"),
        ({"kind": "rotor", "inertia": 1, "motor": 50}, "motor must be a table"),
        (
            {"mass": [1], "length": [1], "armature": [1], "motor": {"rotor_inertia": 1}},
            "not both",
        ),
    ],
)
def test_impossible_rigs_are_refused(rig: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rigs.from_dict(json.loads(json.dumps(rig)))


def test_rig_may_be_given_by_name_file_or_object(tmp_path) -> None:
    rotor = Rotor(0.02)
    rigs.write(rotor, tmp_path / "rig.json")
    assert rigs.of(rotor) is rotor
    assert rigs.of("emps").name == "emps"
    assert rigs.of(tmp_path / "rig.json").to_dict() == rotor.to_dict()
    with pytest.raises(TypeError, match="`plant` must be a mechanism"):
        rigs.of([rotor])  # type: ignore[arg-type]


def test_motors_of_several_links_refuse_absolute_angles() -> None:
    time = np.arange(200) * 1e-3
    table = pd.DataFrame({"time": time, "motor1": 10 * np.sin(time), "motor2": 20 * np.sin(time)})

    def arm(*convention: str) -> PendulumChain:
        return PendulumChain([1.0, 0.5], [0.3, 0.2], motor=Motor(10.0), convention=convention)

    with pytest.raises(ValueError, match="relative to the previous link"):
        Recording.from_pandas(table, plant=arm("absolute", "hanging"))
    plant = arm("relative", "hanging")
    with pytest.raises(ValueError, match="relative to the previous link"):
        Recording.from_pandas(table, plant=plant, convention="absolute,hanging")
    q = Recording.from_pandas(table, plant=plant).q
    np.testing.assert_allclose(q, np.stack([np.sin(time), 2 * np.sin(time)], 1))


def test_motor_of_a_rotor_must_be_a_motor() -> None:
    with pytest.raises(TypeError, match="must be a Motor"):
        Rotor(0.02, motor={"gear_ratio": 5})  # type: ignore[arg-type]
