"""Friction inputs other than speed are chosen by evidence and must improve hold-out errors."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from nfriction import (
    CVFM,
    LFM,
    NFCVFM,
    LinearAxis,
    PendulumChain,
    Recording,
    Rotor,
    Stribeck,
    fit,
    load,
    rollout,
    save,
)
from nfriction.export import c, mjcf, onnx, torchscript
from nfriction.fitting.data.inputs import apply_encoder_offsets
from nfriction.fitting.options import FitOptions
from nfriction.fitting.result.fit_result import InputGain
from nfriction.fitting.result.identifiability import Interval
from nfriction.fitting.strategy import neurofuzzy
from nfriction.fitting.strategy.inputs import (
    _Choice,
    _of_shared,
    _recurring,
    candidates,
    chosen_inputs,
    friction_drives,
    realigned,
    significant,
    widened_start,
    with_position_load,
)
from nfriction.fitting.task import prepare_task
from nfriction.friction.coefficients import Constant
from nfriction.friction.heat import HeatedConstant
from nfriction.friction.inputs import with_inputs
from nfriction.friction.laws import COULOMB_VISCOUS, LINEAR
from nfriction.friction.models import FrictionModel
from nfriction.io.model_file import ModelInfo
from nfriction.optim.least_squares import Quadratic
from nfriction.signals import Motion, quantise
from tests.fitting.recordings import pendulum, swing

V_SMOOTH = 0.05
BRIEF = {"windows": (0.5,), "fit_plant": False, "drag": False}
TRUTHS = {
    "nothing": ([], [[5e-3, 1e-3], [2e-3, 5e-4]]),
    "direction": (["direction"], [[5e-3, 1e-3, 0.4], [2e-3, 5e-4, -0.5]]),
    "load": (["load"], [[1e-3, 1e-3, 4e-3], [5e-4, 5e-4, 2e-3]]),
    "position": (["position"], [[4e-3, 1e-3, 3e-3], [1e-3, 5e-4, 2e-3]]),
    "heat": (["heat"], [[5e-3, 1e-3, 1.5, 0.0], [2e-3, 5e-4, 1.0, 0.0]]),
}
WAVES, PHASES = torch.tensor([1.0, 3.0]).double(), torch.tensor([0.5, -2.0]).double()
CAPACITY, COOLING = [0.1, 0.05], 2.0


def truth(name: str) -> FrictionModel:
    inputs, values = TRUTHS[name]
    law = with_inputs(COULOMB_VISCOUS, inputs)
    schedule = Constant(law, 2, values)
    if name == "heat":
        schedule = HeatedConstant(law, 2, values)
        schedule.set_heat(CAPACITY, COOLING, 2e-3)
    return FrictionModel(law, schedule, V_SMOOTH).requires_grad_(False)


def rig(name: str) -> PendulumChain:
    plant = pendulum(normal_load="bearing")
    return plant.replace(load_waves=WAVES, load_phase=PHASES) if name == "position" else plant


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(name, marks=[pytest.mark.slow] * (name in ("direction", "position", "heat")))
        for name in TRUTHS
    ],
)
def recorded(request):
    # Both links move over half a wave.
    start = (1.2, 0.8) if request.param == "position" else None
    recording = swing(rig(request.param), truth(request.param), seconds=3.0, start=start)
    return request.param, recording, fit(CVFM(2, v_smooth=V_SMOOTH), pendulum(), recording, **BRIEF)


def test_input_is_chosen_if_friction_depends_on_it(recorded) -> None:
    name, recording, law = recorded
    model = NFCVFM(2, v_smooth=V_SMOOTH)
    task = prepare_task(model, pendulum(), [recording], FitOptions(**BRIEF))
    found, refitted, seeing = chosen_inputs(task, law)
    assert (refitted is law) == (not found)
    assert seeing.plant.has_position_load == any(gain.name == "position" for gain in found)
    if name == "nothing":
        assert all(gain.share < 0.2 for gain in found)
    else:
        assert found[0].name == name
        assert found[0].share > 0.5
        if len(found) == 1:
            assert found[0].share == pytest.approx(1 - (refitted.residual / law.residual) ** 2)
    if name == "position":
        torch.testing.assert_close(refitted.plant.load_waves, WAVES)
        off = (refitted.plant.load_phase - PHASES + math.pi) % (2 * math.pi) - math.pi
        assert off.abs().max() < 0.1


def test_an_input_is_described_by_its_share_of_the_squared_error() -> None:
    said = "Input load reduces the squared error by 90 %"
    assert InputGain("load", 0.9, (0.8,)).words(["a"]) == f"{said}."
    both = InputGain("load", 0.9, (0.8, 0.1)).words(["a", "b"])
    assert both == f"{said} (with one joint alone: a 80 %, b 10 %)."


def test_law_with_inputs_starts_from_the_fitted_law() -> None:
    """Smoothed states may lead to another minimum, in which every input seems to help."""
    plant, brief = pendulum(), {**BRIEF, "windows": (0.5, 1.5)}
    recording = swing(plant, truth("direction"), seconds=3.0)
    law = fit(CVFM(2, v_smooth=V_SMOOTH), plant, recording, **brief)
    model = NFCVFM(2, v_smooth=V_SMOOTH)
    task = prepare_task(model, plant, [recording], FitOptions(**brief))
    turned = tuple(replace(motion, q=motion.q + np.array([3.0, -3.0])) for motion in task.motions)
    found = widened_start(replace(task, motions=turned), law, ["direction"])
    assert found.residual < law.residual


@pytest.mark.slow
def test_dry_and_viscous_friction_have_separate_direction_ratios() -> None:
    """The constant torque of a drive explains only the dry part."""
    time, step, inertia = 2e-3 * np.arange(2001), 2e-4, 0.08
    tau, q, v, turned = 3.0 * np.sin(4 * time) + 1.5 * np.sin(11 * time), 0.0, 0.0, []
    for torque in tau:
        turned.append(q)
        for _ in range(10):
            free = v + step / inertia * torque
            dry, viscous = (1.0, 0.5) if free > 0 else (0.7, 0.3)
            slowed = max(0.0, abs(free) - step / inertia * dry) / (1 + step / inertia * viscous)
            v = math.copysign(slowed, free)
            q += step * v
    recording = Recording(time, quantise(np.array(turned)[:, None], 65536), tau=tau[:, None])
    brief, plant = {"windows": (0.5,)}, Rotor(inertia)
    law = fit("coulomb-viscous", plant, recording, **brief)
    task = prepare_task(
        NFCVFM(1, v_smooth=law.model.v_smooth), plant, [recording], FitOptions(**brief)
    )
    (found, *_), refitted, _ = chosen_inputs(task, law)
    assert found.name == "direction"
    assert refitted.residual < 0.2 * law.residual
    dry, viscous, share = refitted.model.schedule.values[0].tolist()
    assert (viscous * (1 + share), viscous * (1 - share)) == pytest.approx((0.5, 0.3), rel=0.03)
    offset = float(refitted.plant.torque_offset)
    assert dry * (1 + share) - offset == pytest.approx(1.0, rel=0.03)
    assert dry * (1 - share) + offset == pytest.approx(0.7, rel=0.03)
    strict = replace(task, options=replace(task.options, input_evidence=1e6))
    assert not chosen_inputs(strict, law)[0]


@pytest.mark.parametrize("cooling_time", [COOLING, 60.0])
@pytest.mark.slow
def test_heat_dependence_is_recovered(cooling_time) -> None:
    """Although it cools faster than a long window lasts, or more slowly than a recording."""
    brief, true = {**BRIEF, "windows": (0.5, 3.0)}, truth("heat")
    true.schedule.set_heat(CAPACITY, cooling_time, 2e-3)
    recording = swing(pendulum(), true, seconds=6.0)
    law = fit(CVFM(2, v_smooth=V_SMOOTH), pendulum(), recording, **brief)
    model = NFCVFM(2, v_smooth=V_SMOOTH)
    task = prepare_task(model, pendulum(), [recording], FitOptions(**brief))
    found = widened_start(task, law, ["heat"])
    (motion,) = task.motions
    qd, qdd = torch.as_tensor(motion.qd), torch.as_tensor(motion.qdd)
    # Heat is defined up to a scale: its capacity and the coefficient k_h scale each other.
    expected, fall = (
        m.coefficients_from(qd, qdd, m.schedule.states(qd, qdd))[..., -2:].prod(-1)
        for m in (true, found.model)
    )
    assert expected.amax() > 0.6
    torch.testing.assert_close(fall, expected, rtol=0, atol=0.05)
    if cooling_time == COOLING:
        assert found.model.schedule.cooling_time == pytest.approx(COOLING, rel=0.5)
    else:  # 6 s hardly determine it
        assert found.model.schedule.cooling_time > 12.0
    assert found.residual < 0.1 * law.residual


@pytest.mark.parametrize(
    ("name", "intervals", "expected"),
    [
        ("position", {"F_p of joint1": (1e-12, 0.08), "F_p of joint2": (1e-12, 0.05)}, set()),
        ("position", {"F_p of joint1": (1e-12, 0.08), "F_p of joint2": (0.01, 0.05)}, {1}),
        ("direction", {"d of joint1": (-1.6, 2.3)}, set()),
        ("direction", {"d of joint1": (-0.6, -0.3)}, {0}),
        ("load", {"F_c of joint1": (0.2, 0.3)}, set()),
    ],
)
def test_input_must_be_nonzero_at_some_joint(name, intervals, expected):
    found = SimpleNamespace(
        intervals=[Interval(n, 0.0, *ends) for n, ends in intervals.items()],
        plant=SimpleNamespace(joint_names=["joint1", "joint2"]),
    )
    assert significant(found, name) == expected


@pytest.mark.parametrize("where", [pytest.param(set(), marks=pytest.mark.slow), {0}])
def test_heat_and_position_are_described_only_where_they_are_significant(where, monkeypatch):
    monkeypatch.setattr(neurofuzzy._Contest, "train", lambda self: None)
    monkeypatch.setattr(neurofuzzy.inputs, "significant", lambda found, name: where)
    recording = swing(pendulum(), truth("nothing"), seconds=1.0)
    model = NFCVFM(2, v_smooth=V_SMOOTH, inputs=["position", "heat"])
    status = fit(model, pendulum(), recording, max_steps=1, **BRIEF).status
    assert ("Heat cools within" in status) == bool(where)
    assert ("largest at" in status) == ("(joint1)" in status) == bool(where)
    assert "(joint2)" not in status


@pytest.mark.slow
def test_an_accepted_network_has_the_interval_of_the_fall_by_heat(monkeypatch) -> None:
    monkeypatch.setattr(neurofuzzy, "improves", lambda *_, **__: True)
    monkeypatch.setattr(neurofuzzy.Validation, "trained_on", lambda self, trial: trial)
    monkeypatch.setattr(neurofuzzy.Validation, "lost_over_long_windows", lambda self, end: "")
    recording = swing(pendulum(), truth("heat"), seconds=1.0)
    model = NFCVFM(2, v_smooth=V_SMOOTH, terms=(2, 2), head_units=2, inputs=["heat"])
    found = fit(model, pendulum(), recording, max_steps=1, **BRIEF)
    assert found.effective_parameters
    assert [i.name for i in found.intervals] == ["k_h of joint1", "k_h of joint2"]
    falls = [i.value for i in found.intervals]
    assert falls == pytest.approx(model.schedule.rest_coefficients()[:, 2].tolist())


@pytest.mark.slow
@pytest.mark.parametrize("inputs", [pytest.param(["heat"], marks=pytest.mark.slow), []])
def test_friction_change_counts_against_a_network_only_without_heat(inputs, monkeypatch):
    falls = [("friction", "The friction of joint1 falls by 30 %.")]
    monkeypatch.setattr("nfriction.fitting.task.changing_friction", lambda *_: falls)
    recording = swing(pendulum(), truth("heat"), seconds=3.0)
    law = fit(CVFM(2, v_smooth=V_SMOOTH), pendulum(), recording, **BRIEF)
    assert "falls by 30 %" in law.usability[1]
    model = NFCVFM(2, v_smooth=V_SMOOTH, inputs=inputs)
    found = fit(model, pendulum(), recording, start=law, max_steps=1, **BRIEF)
    assert (falls[0][1] in found.warnings) == (not inputs)
    assert ("falls by 30 %" in found.usability[1]) == (not inputs)


@pytest.mark.parametrize(("name", "explained"), [("direction", True), ("heat", False)])
def test_inputs_that_leave_only_noise_answer_the_warnings_of_their_law(
    name, explained, monkeypatch
) -> None:
    late, drift = "Perhaps torques are recorded later.", "The friction of joint1 falls by 30 %."

    def begin(task):
        return constant_start(task).with_warnings([late], unmodelled=[late])

    def choose(plain):
        task = replace(plain.task, model=neurofuzzy._seeing(plain.task.model, ["direction"]))
        start = widened_start(task, plain.start, ["direction"])
        return (InputGain("direction", 0.5, (0.5, 0.1)),), neurofuzzy._Contest(task, start)

    constant_start = neurofuzzy.constant_start
    monkeypatch.setattr(neurofuzzy, "constant_start", begin)
    monkeypatch.setattr(neurofuzzy, "_with_chosen_inputs", choose)
    monkeypatch.setattr(neurofuzzy._Contest, "train", lambda self: None)
    monkeypatch.setattr(
        "nfriction.fitting.task.changing_friction", lambda *_: [("friction", drift)]
    )
    recording = swing(pendulum(), truth(name), seconds=2.0)
    found = fit(NFCVFM(2, v_smooth=V_SMOOTH), pendulum(), recording, **BRIEF)
    shown = [w for w in found.warnings if "recorded later" in w or "falls by 30" in w]
    late = late.replace(".", ", as found with the constant law.")
    assert shown == ([] if explained else [drift, late])
    assert [w for w in found.unmodelled if w in shown] == shown


ONE = torch.ones(6, dtype=torch.float64)


class Contest:
    """A rival whose law and network have these errors; without inputs they are 1.0."""

    found, several = None, True

    def __init__(self, task, start, of_law=ONE, error=ONE, apart=None, accepted=True) -> None:
        self.task, self.start, self.validation = task, start, self
        self.accepted = accepted
        self.of_law, self.final = of_law, error
        self.law_by_recording = of_law if apart is None else apart
        self.trained = False

    @property
    def squares(self) -> torch.Tensor:
        return self.final if self.trained else self.of_law

    def train(self) -> None:
        self.trained = True

    def explains(self, squares: torch.Tensor) -> bool:
        return False


@pytest.fixture(scope="module")
def task():
    recording = swing(pendulum(), truth("nothing"), seconds=1.0)
    return prepare_task(NFCVFM(2), pendulum(), recording, FitOptions(**BRIEF))


@pytest.mark.parametrize(
    ("rival", "driving", "wins", "trained"),
    [
        ({"of_law": 0.8 * ONE, "error": 0.7 * ONE}, False, True, True),
        ({"of_law": 0.8 * ONE, "error": 0.7 * ONE}, True, False, True),
        ({"of_law": 0.8 * ONE, "error": torch.linspace(0.2, 1.6, 6)}, False, False, True),
        ({"of_law": 1.1 * ONE, "error": 0.1 * ONE}, False, False, False),
        # An input that only the network detects.
        ({"of_law": torch.linspace(0.2, 1.6, 6), "error": 0.1 * ONE}, False, True, True),
        ({"of_law": 0.8 * ONE, "error": 0.7 * ONE, "apart": 1.1 * ONE}, False, False, False),
        # A loss of 1.2 standard errors on hold-out recordings does not overrule a clear gain.
        (
            {"of_law": 0.8 * ONE, "error": 0.7 * ONE, "apart": torch.linspace(0.7, 1.6, 6)},
            False,
            True,
            True,
        ),
        # A law whose network is rejected.
        ({"of_law": 0.8 * ONE, "error": 0.8 * ONE, "accepted": False}, False, True, True),
    ],
)
def test_inputs_must_improve_the_network_and_not_worsen_its_law(
    task, monkeypatch, rival, driving, wins, trained
):
    gains, made = (InputGain("direction", 0.5, (0.5, 0.1)),), []

    def contest(task, start):
        made.append(Contest(task, start, **rival))
        return made[-1]

    monkeypatch.setattr(neurofuzzy.inputs, "chosen_inputs", lambda *given: (gains, *given[::-1]))
    monkeypatch.setattr(neurofuzzy, "_Contest", contest)
    monkeypatch.setattr(
        neurofuzzy.inputs, "friction_drives", lambda found, own: driving and own == 2
    )
    plain = Contest(task, "law")
    chosen, best = neurofuzzy._with_chosen_inputs(plain)
    (found,) = made
    assert (best is found, chosen == gains, found.trained) == (wins, wins, trained)
    assert found.task.model.inputs == ["direction"]
    assert task.model.inputs is None


def test_a_network_that_leaves_only_noise_needs_no_inputs(task, monkeypatch):
    plain = Contest(task, "law")
    monkeypatch.setattr(Contest, "explains", lambda self, squares: True)
    monkeypatch.setattr(neurofuzzy.inputs, "chosen_inputs", None)
    assert neurofuzzy._with_chosen_inputs(plain) == ((), plain)


def test_inputs_that_a_fit_selected_are_selected_again(monkeypatch, tmp_path) -> None:
    seen = []

    def choose(plain):
        seen.append(plain.task.model.law)
        assert not plain.task.plant.has_position_load
        if len(seen) == 2:
            return (), plain
        task = with_position_load(plain.task, plain.start)
        task = replace(task, model=neurofuzzy._seeing(task.model, ["position"]))
        start = widened_start(task, plain.start, ["position"])
        return (InputGain("position", 0.5, (0.5, 0.1)),), neurofuzzy._Contest(task, start)

    monkeypatch.setattr(neurofuzzy, "_with_chosen_inputs", choose)
    monkeypatch.setattr(neurofuzzy._Contest, "train", lambda self: None)
    recording, model = swing(pendulum(), truth("nothing"), seconds=1.0), NFCVFM(2)
    settings = {"max_steps": 2, **BRIEF}
    found = fit(model, pendulum(), recording, **settings)
    assert model.inputs == found.model.inputs == ["position"]
    assert found.plant.has_position_load
    saved = load(save(model, tmp_path / "model.json"))
    again = fit(model, found.plant, recording, **settings)
    assert model.inputs is again.model.inputs is None
    assert seen == [COULOMB_VISCOUS] * 2
    # Those of a file count as given.
    assert fit(saved, pendulum(), recording, **settings).model.inputs == ["position"]
    assert len(seen) == 2


@pytest.mark.slow
def test_chosen_input_improves_the_model_or_is_dropped(recorded) -> None:
    name, recording, law = recorded
    model = NFCVFM(2, v_smooth=V_SMOOTH, terms=(2, 2), head_units=2)
    found = fit(model, pendulum(), recording, start=law, max_steps=3, **BRIEF)
    assert torch.equal(*(m.schedule.parameter_vector() for m in (found.model, model)))
    if name == "nothing":
        assert model.inputs is None
        assert not found.inputs
        return
    assert model.inputs == [name]
    assert f"Input {name} reduces" in found.status
    assert found.to_dict()["inputs"][0]["name"] == name
    still = torch.zeros(1, 2, dtype=torch.float64)
    expected = torch.tensor(TRUTHS[name][1], dtype=torch.float64)[:, -1]
    term = model.coefficients(still, still)[0, :, -1]
    torch.testing.assert_close(term, expected, rtol=0.3, atol=0)
    loads = found.plant.load(still + 1.0, still + 4.0)
    bearing = pendulum(normal_load="bearing").load(still + 1.0, still + 4.0)
    assert torch.equal(loads, bearing) == (name == "load")


@pytest.mark.slow
@pytest.mark.parametrize("recorded", ["load"], indirect=True)
def test_given_inputs_are_kept(recorded) -> None:
    _, recording, _ = recorded
    model = NFCVFM(2, v_smooth=V_SMOOTH, terms=(2, 2), head_units=2, inputs=())
    assert not fit(model, pendulum(), recording, max_steps=2, **BRIEF).inputs


def choice_of(gradient: float, lower: float = -9.0) -> _Choice:
    """Errors 20 + g x + 3 x^2 / 2 of a candidate together with a law variable; priors of 1."""
    one, zero = torch.eye(2).double(), torch.zeros(2).double()
    slope = torch.tensor([0.0, gradient]).double()
    bounds = torch.tensor([0.0, lower]).double(), torch.tensor([0.0, 9.0]).double()
    errors = Quadratic(torch.tensor(20.0).double(), slope, 3.0 * one)
    return _Choice(errors, Quadratic(0.0, zero, one), bounds, {"load": [1]})


def test_evidence_is_the_integral_over_the_coefficient() -> None:
    choice, x = choice_of(-6.0), torch.linspace(-9.0, 9.0, 20001, dtype=torch.float64)
    density = torch.exp(6.0 * x - 2.0 * x**2) / (2.0 * torch.pi) ** 0.5
    expected = float(torch.trapezoid(density, x).log())
    (after, cost, _), (before, whole, _) = choice.evidence([1]), choice.evidence([])
    assert after - before == pytest.approx(expected, rel=1e-9)
    assert (cost, whole) == pytest.approx((20.0 - 6.0 * 1.5 + 1.5 * 1.5**2, 20.0))
    best = choice.best([], 1.0)
    assert best is not None
    assert best[0] == pytest.approx(after - before)
    assert best[1].share == pytest.approx((6.0 * 1.5 - 1.5 * 1.5**2) / 20.0)


def test_input_of_the_wrong_sign_has_no_evidence() -> None:
    choice = choice_of(6.0, lower=0.0)
    assert choice.evidence([1])[0] < choice.evidence([])[0]
    assert choice.best([], 0.0) is None


def test_input_is_chosen_in_addition_to_earlier_ones() -> None:
    eye, slope = torch.eye(2).double(), torch.tensor([-18.0, -3.0]).double()
    bounds = torch.full((2,), -9.0).double(), torch.full((2,), 9.0).double()
    errors = Quadratic(torch.tensor(18.0).double(), slope, 10.0 * eye)
    prior = Quadratic(0.0, 0.0 * slope, eye)
    choice = _Choice(errors, prior, bounds, {"heat": [0], "load": [1]})
    first, second = choice.best([], 0.0), choice.best(["heat"], -9.0)
    assert first is not None
    assert second is not None
    assert (first[1].name, second[1].name) == ("heat", "load")
    # It gains less than its coefficient costs.
    assert choice.best(["heat"], 0.0) is None


def test_window_states_are_optimal() -> None:
    # (2 x + s - 1)^2 / 2 + s^2 / 2 at x = 0 and s = 1, which is least at s = 1 / 2 - x.
    hessian = torch.tensor([[4.0, 2.0], [2.0, 2.0]]).double()
    found = _of_shared(Quadratic(torch.tensor(0.5).double(), torch.tensor([0.0, 1.0]).double(),
                                 hessian), 1)  # fmt: skip
    assert float(found.cost) == 0.25
    torch.testing.assert_close(found.gradient, torch.tensor([-1.0]).double())
    torch.testing.assert_close(found.hessian, torch.tensor([[2.0]]).double())


@pytest.mark.parametrize(
    ("viscous", "by_direction", "driving"),
    [(1e-4, 0.4, False), (1e-4, -1.8, True), (1e-3, -0.9, False)],
)
def test_constant_torque_is_not_direction_dependent_friction(
    viscous, by_direction, driving
) -> None:
    law = with_inputs(COULOMB_VISCOUS, ["direction"])
    model = FrictionModel(law, Constant(law, 1, [5e-3, viscous, by_direction]), V_SMOOTH)
    time = 2e-3 * np.arange(500)
    q = np.sin(9.0 * time)[:, None]
    motion = Motion(time, q, 9.0 * np.cos(9.0 * time)[:, None], -81.0 * q)
    found = SimpleNamespace(model=model, plant=Rotor(0.01), motions=(motion,))
    assert friction_drives(found, 2) is driving


@pytest.mark.parametrize("largest", [0.3, 0.5])
def test_candidates_depend_on_plant_and_motion(largest) -> None:
    """A motor has no bearing load, and less than half of the shortest wave is not a wave."""
    rotor = Rotor(inertia=0.02, mass=0.5, com=0.1)
    time = torch.arange(400).double().numpy() * 2e-3
    recording = Recording(time, largest * np.sin(9.0 * time)[:, None])
    task = prepare_task(NFCVFM(1), rotor, [recording], FitOptions(**BRIEF))
    position = ("position",) if 2 * largest > math.pi / 4 else ()
    assert candidates(task) == ("direction", *position, "heat")


def test_load_dependent_friction_uses_the_same_loads_in_simulation(tmp_path) -> None:
    start = torch.tensor([1.0, 0.5], dtype=torch.float64)
    given = {"steps": 3, "sample_time": 1e-3, "gradients": False}
    rollout(pendulum(normal_load="bearing"), truth("load"), start, 0 * start, **given)
    with pytest.raises(ValueError, match="loads of the bearings"):
        rollout(pendulum(), truth("load"), start, 0 * start, **given)
    with pytest.raises(ValueError, match="loads of the bearings"):
        c(truth("load"), tmp_path, ModelInfo(rig=pendulum().to_dict()))


def test_given_load_is_the_bearing_load(monkeypatch) -> None:
    def begun(task):
        raise RuntimeError(task.plant.to_dict()["normal_load"])

    monkeypatch.setattr("nfriction.fitting.strategy.neurofuzzy.constant_start", begun)
    time = torch.arange(300).double().numpy() * 2e-3
    recording = Recording(time, 0.1 * np.sin(9.0 * time)[:, None].repeat(2, 1))
    with pytest.raises(RuntimeError, match="bearing"):
        fit(NFCVFM(2, inputs=["load"]), pendulum(), recording, **BRIEF)


def test_position_dependent_friction_uses_the_same_positions() -> None:
    start = torch.tensor([1.0, 0.5], dtype=torch.float64)
    given = {"steps": 3, "sample_time": 1e-3, "gradients": False}
    rollout(rig("position"), truth("position"), start, 0 * start, **given)
    rollout(rig("position"), CVFM(2), start, 0 * start, **given)  # which has no load
    with pytest.raises(ValueError, match="depends on loads that follow the position"):
        rollout(pendulum(), truth("position"), start, 0 * start, **given)
    with pytest.raises(ValueError, match="depends on normal loads"):
        rollout(rig("position"), LFM(2), start, 0 * start, **given)


def test_fit_by_load_can_start_from_the_plant_of_a_fit_by_position() -> None:
    recording = swing(pendulum(), truth("nothing"), seconds=1.0)
    found, plain = (fit(LFM(2), plant, recording, **BRIEF) for plant in (rig("position"),
                    pendulum(normal_load="bearing")))  # fmt: skip
    assert not found.plant.has_position_load
    assert found.residual == plain.residual
    with pytest.raises(ValueError, match="depends on loads that follow the position"):
        fit(truth("position"), pendulum(), recording, **BRIEF)


def test_exports_refuse_a_rig_with_other_loads(tmp_path) -> None:
    model, info = truth("position"), ModelInfo(rig=pendulum().to_dict())
    for write in (torchscript, onnx):
        with pytest.raises(ValueError, match="depends on loads that follow the position"):
            write(model, tmp_path / "model", info)
    still = np.zeros((9, 2))
    with pytest.raises(ValueError, match="by position needs `load"):
        mjcf(model, tmp_path / "model.xml", Motion(0.1 * np.arange(9.0), still, still + 1.0, still))


@pytest.mark.parametrize(("law", "inputs"), [(COULOMB_VISCOUS, ["load", "position"]),
                                             (LINEAR, ["position"])])  # fmt: skip
def test_position_and_load_exclude_each_other(law, inputs) -> None:
    with pytest.raises(ValueError, match="replaces the load"):
        with_inputs(law, inputs)


@pytest.mark.slow
def test_wavelengths_of_an_axis_are_limited_by_its_stroke() -> None:
    axis, stroke = LinearAxis(mass=2.0), 2.5
    law = with_inputs(COULOMB_VISCOUS, ["position"])
    rippled = axis.replace(load_waves=torch.tensor([2 * math.pi * 2 / stroke]).double(),
                           load_phase=torch.tensor([1.0]).double())  # fmt: skip
    true = FrictionModel(law, Constant(law, 1, [1.0, 2.0, 3.0]), V_SMOOTH).requires_grad_(False)
    time = 2e-3 * np.arange(2000)
    force = (12.0 * np.sin(5.0 * time) + 8.0 * np.sin(2.0 * time))[:-1, None]
    begin = torch.zeros(1).double()
    run = rollout(rippled, true, begin, begin, tau=torch.as_tensor(force), sample_time=2e-3,
                  substeps=4, gradients=False)  # fmt: skip
    q, rate = run.q.numpy(), float(rippled.load_waves)
    recording = Recording(run.time.numpy(), q, np.vstack([force, force[-1:]]), unit="m")
    law = fit(CVFM(1, v_smooth=V_SMOOTH), axis, recording, **BRIEF)
    task = prepare_task(NFCVFM(1, v_smooth=V_SMOOTH), axis, [recording], FitOptions(**BRIEF))
    possible = 2 * math.pi * np.arange(1, 5) / np.ptp(q)
    nearest = min(possible, key=lambda one: abs(one - rate))
    seeing = with_position_load(task, law)
    assert float(seeing.plant.load_waves) == pytest.approx(nearest, rel=1e-3)
    # Each half contains the wave, too, though it covers less of the stroke.
    halves = [recording[:1000], recording[1000:]]
    task = prepare_task(NFCVFM(1, v_smooth=V_SMOOTH), axis, halves, FitOptions(**BRIEF))
    seeing = with_position_load(task, law)
    assert _recurring(task, law, seeing) == {0}
    other = seeing.plant.replace(load_waves=2.0 * seeing.plant.load_waves)
    assert _recurring(task, law, replace(seeing, plant=other)) == set()


def zeroed(model: FrictionModel, seconds: float = 6.0) -> tuple[PendulumChain, Recording]:
    """A driven link with a true encoder, whose zero a fit may doubt."""
    plant = PendulumChain([0.5], [0.3], com=[0.2], inertia=[5e-3])
    time = 2e-3 * torch.arange(round(500 * seconds), dtype=torch.float64)
    tau = 0.8 * torch.sin(4 * time) + 0.5 * torch.sin(9.3 * time) + 0.4 * torch.sin(1.1 * time)
    zero = torch.full((1,), math.pi, dtype=torch.float64)
    run = rollout(plant, model, zero, 0 * zero, tau[:-1, None], sample_time=2e-3)
    q = quantise(run.q.numpy() - math.pi, 65536)
    recording = Recording(
        time.numpy(), q, tau=tau.numpy()[:, None], convention=("relative", "hanging")
    )
    return plant, recording


def test_encoder_offsets_are_fitted_again_with_inputs() -> None:
    """A law without the input shifts them, and then no value of the input fits the data."""
    law = with_inputs(COULOMB_VISCOUS, ["direction"])
    true = FrictionModel(law, Constant(law, 1, [[0.1, 0.02, 0.3]]), V_SMOOTH).requires_grad_(False)
    plant, recording = zeroed(true)
    brief = {"windows": (0.5, 2.0), "fit_plant": False, "encoder_reference": "per_recording"}
    start = fit(CVFM(1, v_smooth=V_SMOOTH), plant, recording, **brief)
    model = NFCVFM(1, v_smooth=V_SMOOTH)
    task = prepare_task(model, plant, [recording], FitOptions(**brief))
    recordings, motions = apply_encoder_offsets(
        start.encoder_offsets, plant, task.recordings, task.motions
    )
    task = replace(task, recordings=recordings, motions=motions)
    found = widened_start(task, start, ["direction"])
    assert abs(start.encoder_offsets[0][0]) > 1e-2
    assert abs(found.encoder_offsets[0][0]) < 1e-4
    assert found.residual < 1.2 * found.noise
    moved = realigned(task, start, found)
    np.testing.assert_allclose(moved.recordings[0].q, recording.q + math.pi, atol=1e-4)


@pytest.mark.slow
def test_encoder_offsets_are_fitted_again_with_a_network() -> None:
    true = Stribeck(1, [0.1, 0.1, 0.02, 1.0, 2.0], v_smooth=V_SMOOTH).requires_grad_(False)
    plant, recording = zeroed(true)
    brief = {"windows": (0.5, 2.0), "fit_plant": False, "encoder_reference": "per_recording"}
    start = fit(CVFM(1, v_smooth=V_SMOOTH), plant, recording, **brief)
    found = fit(NFCVFM(1, v_smooth=V_SMOOTH, inputs=[]), plant, recording, **brief)
    assert found.effective_parameters
    (before,), (after,) = start.encoder_offsets[0], found.encoder_offsets[0]
    assert abs(after) < 0.3 * abs(before)
    assert found.residual < 1.5 * found.noise
