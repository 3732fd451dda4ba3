"""Adjustable plant terms: identifiability, ratios and offsets within bounds."""

import numpy as np
import pytest
import torch

from nfriction import CVFM, LinearAxis, PendulumChain, Recording, Rotor, fit, rigs, rollout
from nfriction.fitting.adjusted_plant import adjusted_buffers
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.plant_parameters import plant_parameters
from nfriction.signals import quantise
from tests.fitting.recordings import F64, pendulum


def names(plant, **settings):
    return [p.name for p in plant_parameters(plant, **settings)]


def test_free_swing_keeps_one_gravity_term_as_the_scale():
    free = names(pendulum(), driven=())
    assert "gravity 1" not in free
    assert {"inertia 11", "inertia 22", "gravity 2", "length 1"} < set(free)
    driven = names(pendulum(), driven=(0, 1), largest_torque=1.0)
    assert set(driven) - set(free) == {
        "gravity 1", "torque gain 2", "gear loss 1", "gear loss 2", "torque offset 1 [N m]",
        "torque offset 2 [N m]",
    }  # fmt: skip


def test_wheel_has_no_angle_offset_and_coasting_keeps_its_inertia():
    driven = {"inertia 11", "gear loss 1", "torque offset 1 [N m]"}
    assert set(names(Rotor(0.02), driven=(0,), largest_torque=1.0)) == driven
    assert names(Rotor(0.02), driven=()) == []
    pendulum = {"gravity 1", "angle offset 1 [rad]"}
    assert set(names(Rotor(0.05, 0.5, 0.3), driven=(0,), largest_torque=1.0)) == driven | pendulum


def test_undriven_joint_has_no_torque_offset():
    terms = names(pendulum(), driven=(1,), largest_torque=1.0)
    assert "torque offset 2 [N m]" in terms
    assert "torque offset 1 [N m]" not in terms
    assert "gravity 1" in terms
    # A single drive has no gain either: it would only scale the masses.
    assert not [name for name in terms if "gain" in name]
    # Unless an arm with a fixed inertia sets the scale.
    armed = names(rigs.tlrip("free"), driven=(0,), largest_torque=1.0)
    assert "torque gain 1" in armed


def test_existing_drag_and_loss_may_vanish_completely():
    loss, drag = torch.tensor([0.1, 0.2], dtype=F64), torch.full((2,), 0.03, dtype=F64)
    plant = pendulum().replace(gear_loss=loss, drag_linear=drag)
    terms = plant_parameters(plant, driven=(0, 1), largest_torque=1.0, drag=True)
    least = adjusted_buffers(plant, terms, torch.tensor([t.lower for t in terms], dtype=F64))
    for name in ("gear_loss", "drag_linear"):
        torch.testing.assert_close(least[name], torch.zeros(2, dtype=F64))
    assert {t.name for t in terms if t.to_none} == {
        "gear loss 1", "gear loss 2", "drag linear", "drag quadratic"
    }  # fmt: skip


def test_absent_terms_are_not_adjusted():
    assert not [n for n in names(pendulum(), driven=()) if "armature" in n or "drag" in n]
    assert "armature 2" in names(pendulum(armature=[0.0, 1e-4]), driven=())
    assert "armature 1" not in names(pendulum(armature=[0.0, 1e-4]), driven=())
    drag = ["drag linear", "drag quadratic", "drag reach"]
    assert names(pendulum(), driven=(), drag=True)[-3:] == drag
    # A single link's reach only scales its drag, and its linear drag acts as viscous friction.
    single = names(rigs.multiarm_single(), driven=(), drag=True)
    assert [n for n in single if "drag" in n] == ["drag quadratic"]
    assert names(LinearAxis(2.0), driven=(0,), largest_torque=1.0) == [
        "mass 1", "force offset 1 [N]"
    ]  # fmt: skip
    assert names(LinearAxis(2.0), driven=()) == []
    moved = names(LinearAxis(2.0), driven=(0,), largest_torque=1.0, largest_rate=0.1)
    assert moved[-1] == "asymmetry [N s/m]"


def test_drive_of_an_axis_may_carry_its_weight():
    """A vertical axis needs a constant force far above the bias of a sensor."""
    time = np.arange(1500) * 2e-3
    drive = 20.0 + 4.0 * np.cos(9 * time) + 2.0 * np.cos(23 * time)
    vertical, zero = LinearAxis(2.0, torque_offset=-20.0), torch.zeros(1, dtype=F64)
    truth = CVFM(1, [[1.0, 3.0]]).requires_grad_(False)
    run = rollout(vertical, truth, zero, zero, torch.tensor(drive[:-1, None]), sample_time=2e-3)
    recording = Recording(time, quantise(run.q.numpy(), 2**18), tau=drive[:, None], unit="m")
    found = fit("CVFM", LinearAxis(2.0), recording, windows=(0.3,))
    assert not found.at_bounds
    known = {name: value for name, value, _ in found.plant_terms}
    assert known["force offset 1 [N]"] == pytest.approx(-20.0, rel=0.01)
    assert found.model.schedule.values[0].tolist() == pytest.approx([1.0, 3.0], rel=0.05)


def test_an_arm_has_no_hanging_position_and_no_encoder_terms():
    links = [n for n in names(rigs.tlrip("free"), driven=(), eccentricity="on") if "enc" in n]
    assert links == [f"encoder {part} {j} [rad]" for j in (2, 3, 4) for part in ("cosine", "sine")]


def test_ratios_scale_only_their_terms():
    plant = pendulum()
    terms = plant_parameters(plant, driven=())
    vector = torch.zeros(len(terms), dtype=F64)
    index = [t.name for t in terms].index("inertia 22")
    vector[index] = 0.1
    coupling = adjusted_buffers(plant, terms, vector)["inertia_coupling"]
    expected = plant.inertia_coupling.clone()
    expected[1, 1] *= 1.1
    torch.testing.assert_close(coupling, expected)
    assert all(t.upper == DEFAULTS.ratio_term[0] for t in terms if "inertia" in t.name)


@pytest.mark.parametrize(
    ("wrong", "ratios"),
    [
        # The last link's centre of mass, and the inertia about it.
        ({"com": [0.05, 0.07, 0.066]}, {"gravity 3", "inertia 33"}),
        # The first link's length moves the next link, and affects its own moment, too.
        ({"length": [0.105, 0.12, 0.1]}, {"length 1", "gravity 1", "inertia 11"}),
        ({"length": [0.1, 0.126, 0.1]}, {"length 2", "gravity 2", "inertia 22"}),
        ({"com": [0.05, 0.08, 0.066], "length": [0.105, 0.126, 0.1]},
         {"length 1", "length 2", *(f"gravity {j}" for j in (1, 2, 3)),
          *(f"inertia {j}{j}" for j in (1, 2, 3))}),
    ],
)  # fmt: skip
def test_error_of_a_link_changes_only_the_ratios_of_that_link(wrong, ratios):
    link = {
        "mass": [0.1, 0.2, 0.1], "com": [0.05, 0.07, 0.06], "length": [0.1, 0.12, 0.1],
        "inertia": [1e-4, 2e-4, 1e-4],
    }  # fmt: skip
    plant, true = PendulumChain(**link), PendulumChain(**link | wrong)
    terms = plant_parameters(plant, driven=(0, 1, 2), largest_torque=1.0)
    names = [t.name for t in terms]
    vector = torch.zeros(len(terms), dtype=F64)
    by = {
        "gravity": true.gravity_moment / plant.gravity_moment,
        "inertia": (true.inertia_coupling / plant.inertia_coupling).diagonal(),
    }
    for k, term in enumerate(names):
        kind, _, index = term.partition(" ")
        if kind in by:
            vector[k] = by[kind][int(index[0]) - 1] - 1.0
        if kind == "length":
            vector[k] = true.length[int(index) - 1] / plant.length[int(index) - 1] - 1.0
    assert {n for n, x in zip(names, vector, strict=True) if abs(x) > 1e-9} == ratios
    adjusted = adjusted_buffers(plant, terms, vector)
    for name, of in buffers(true):
        torch.testing.assert_close(adjusted[name], of)


def buffers(plant):
    return [(name, getattr(plant, name)) for name in ("inertia_coupling", "gravity_moment")]


def test_buffers_are_nominal_at_zero_and_ratios_multiply():
    plant = pendulum(armature=[1e-4, 1e-4])
    terms = plant_parameters(plant, driven=(0, 1), largest_torque=2.0, drag=True)
    own = dict(plant.named_buffers())
    zero = adjusted_buffers(plant, terms, torch.zeros(len(terms), dtype=F64))
    for name, value in zero.items():
        assert torch.equal(value, own[name])
    names = [t.name for t in terms]
    vector = torch.zeros(len(terms), dtype=F64)
    for name, x in (("gravity 2", 0.2), ("length 1", -0.1), ("torque offset 2 [N m]", 0.3)):
        vector[names.index(name)] = x
    changed = adjusted_buffers(plant, terms, vector)
    ratio = changed["inertia_coupling"] / own["inertia_coupling"]
    torch.testing.assert_close(ratio, torch.tensor([[1.0, 1.08], [1.08, 1.0]], dtype=F64))
    torch.testing.assert_close(changed["torque_offset"], torch.tensor([0.0, 0.3], dtype=F64))


def test_a_batch_of_vectors_gives_a_batch_of_plants():
    plant = pendulum()
    terms = plant_parameters(plant, driven=())
    vectors = 0.05 * torch.randn(
        3, len(terms), dtype=F64, generator=torch.Generator().manual_seed(1)
    )
    state = torch.tensor([[1.0, 0.5], [2.0, 4.0], [0.0, 0.0]], dtype=F64)
    plants = plant.replace(**adjusted_buffers(plant, terms, vectors))
    together = plants.forward_dynamics(*state)
    for vector, row in zip(vectors, together, strict=True):
        one = plant.replace(**adjusted_buffers(plant, terms, vector))
        torch.testing.assert_close(one.forward_dynamics(*state), row)


def test_bounds_contain_the_given_plant():
    terms = plant_parameters(pendulum(), driven=(0, 1), largest_torque=2.0, drag=True)
    assert all(t.lower <= 0.0 < t.upper and t.prior_sd > 0 for t in terms)
    offset = next(t for t in terms if "torque_offset" in t.change)
    assert offset.upper == pytest.approx(0.6)


def test_links_in_a_horizontal_plane_have_no_weight_to_fit():
    """Gravity of the first link, lengths and zeros of angles would have no effect."""
    plant = PendulumChain([0.3, 0.2], [0.2, 0.15], inertia=[1e-3, 4e-4], gravity=1e-6)
    names = [term.name for term in plant_parameters(plant, driven=[0, 1])]
    assert [n for n in names if n.startswith(("inertia", "gravity", "length", "angle"))] == [
        "inertia 11", "inertia 22", "gravity 2"]  # fmt: skip


@pytest.mark.parametrize("term", [{"drag": True}, {"eccentricity": "on"}])
def test_terms_of_a_plant_that_is_not_fitted_are_refused(term) -> None:
    with pytest.raises(ValueError, match="terms of the plant, so they need `fit_plant=True`"):
        FitOptions(fit_plant=False, **term)
