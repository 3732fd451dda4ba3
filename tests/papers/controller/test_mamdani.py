"""The controller equals textbook inference, is bounded, differentiable, independent of names."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nfriction.fuzzy import FuzzySet
from nfriction.papers.controller.fis import parse_fis
from nfriction.papers.controller.mamdani import (
    MamdaniController,
    controller_surface,
    paper_controller,
)
from nfriction.papers.controller.rules import Rule, RuleBase, Variable

FLOAT64 = torch.float64
DEGREE = math.pi / 180


def samples(controller: MamdaniController, count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(count, controller.inputs, generator=generator, dtype=FLOAT64)
    return controller.lower + (controller.upper - controller.lower) * draw


def naive(rules: RuleBase, x: np.ndarray, points: int, centroid: str) -> np.ndarray:
    """Mamdani inference of one sample, rule by rule and point by point."""
    outputs = []
    for o, variable in enumerate(rules.outputs):
        universe = np.linspace(*variable.universe, points)
        total = np.zeros(points)
        for rule in rules.rules:
            held = [1.0]
            for value, term, asked in zip(x, rule.given, rules.inputs, strict=True):
                if term != "*":
                    member = next(one for one in asked.sets if one.name == term)
                    held.append(float(member(torch.tensor(value, dtype=FLOAT64))))
            if rule.then[o] != "*":
                consequent = next(one for one in variable.sets if one.name == rule.then[o])
                shape = consequent(torch.as_tensor(universe)).numpy()
                total = np.maximum(total, np.minimum(shape, min(held) * rule.weight))
        weight = np.ones(points)
        if centroid == "trapezoid":
            weight[[0, -1]] = 0.5
        outputs.append(np.sum(weight * total * universe) / np.sum(weight * total))
    return np.array(outputs)


@pytest.mark.parametrize("joint", [2, 3, 4])
@pytest.mark.parametrize("centroid", ["trapezoid", "sum"])
def test_output_equals_textbook_inference(joint: int, centroid: str) -> None:
    controller = paper_controller(joint, centroid=centroid)
    x = samples(controller, 20)
    expected = np.stack([naive(controller.rule_base, one, 101, centroid) for one in x.numpy()])
    np.testing.assert_allclose(controller.infer(x).numpy(), expected, rtol=1e-12)


def test_output_agrees_with_simpful() -> None:
    simpful = pytest.importorskip("simpful")
    controller = paper_controller(2, centroid="sum", points=101)
    rules = controller.rule_base
    system = simpful.FuzzySystem(show_banner=False)
    for variable in (*rules.inputs, *rules.outputs):
        sets = []
        for term in variable.sets:
            # Within the universe, a shoulder at its end is one half of a Gaussian.
            member = simpful.Gaussian_MF(*term.parameters)
            sets.append(simpful.FuzzySet(function=member, term=term.name))
        system.add_linguistic_variable(
            variable.name,
            simpful.LinguisticVariable(sets, universe_of_discourse=list(variable.universe)),
        )
    first, second = (variable.name for variable in rules.inputs)
    system.add_rules(
        [
            f"IF ({first} IS {rule.given[0]}) AND ({second} IS {rule.given[1]}) "
            f"THEN ({output.name} IS {term})"
            for rule in rules.rules
            for output, term in zip(rules.outputs, rule.then, strict=True)
        ]
    )
    for x in samples(controller, 15):
        system.set_variable(first, float(x[0]))
        system.set_variable(second, float(x[1]))
        theirs = system.Mamdani_inference(["B", "C"], subdivisions=101)
        ours = controller.infer(x)
        assert ours.tolist() == pytest.approx([theirs["B"], theirs["C"]], rel=1e-12)


@given(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5), st.sampled_from([2, 3, 4]))
def test_output_stays_in_its_universe(velocity: float, acceleration: float, joint: int) -> None:
    controller = paper_controller(joint)
    x = torch.tensor([velocity, acceleration], dtype=FLOAT64)
    for value, variable in zip(controller.infer(x), controller.rule_base.outputs, strict=True):
        assert variable.universe[0] < value < variable.universe[1]


def test_inputs_are_in_radians_and_any_batch_shape_is_kept() -> None:
    controller = paper_controller(3)
    x = samples(controller, 1200)
    y = controller(x[:, 0] * DEGREE, x[:, 1] * DEGREE)
    torch.testing.assert_close(y, controller.infer(x), rtol=1e-9, atol=0)
    assert torch.equal(controller.infer(x.view(3, 400, 2)).view(1200, 2), controller.infer(x))
    assert controller(torch.tensor(1.0), torch.tensor(2.0)).shape == (2,)


def test_inputs_are_clamped_to_the_universe_and_nan_is_kept() -> None:
    controller = paper_controller(2)
    edge = torch.stack([controller.upper, controller.lower])
    beyond = edge + torch.tensor([[1e4], [-1e4]])
    assert torch.equal(controller.infer(beyond), controller.infer(edge))
    assert torch.isnan(controller.infer(torch.tensor([math.nan, 0.0], dtype=FLOAT64))).all()


def test_order_of_rules_and_names_of_terms_do_not_matter() -> None:
    controller = paper_controller(2)
    rules = controller.rule_base
    x = samples(controller, 300)
    turned = MamdaniController(replace(rules, rules=rules.rules[7:] + rules.rules[:7]))
    assert torch.equal(turned.infer(x), controller.infer(x))

    def renamed(variable: Variable) -> Variable:
        sets = tuple(replace(term, name=f"no. {term.name}") for term in variable.sets)
        return replace(variable, sets=sets)

    relabelled = RuleBase(
        "other names",
        tuple(renamed(v) for v in rules.inputs),
        tuple(renamed(v) for v in rules.outputs),
        tuple(
            Rule(tuple(f"no. {t}" for t in r.given), tuple(f"no. {t}" for t in r.then))
            for r in rules.rules
        ),
    )
    assert torch.equal(MamdaniController(relabelled).infer(x), controller.infer(x))


def test_mirrored_outputs_mirror_the_controller() -> None:
    rules = paper_controller(2).rule_base

    def mirrored(variable: Variable) -> Variable:
        sets = []
        for term in reversed(variable.sets):
            shape = {"left_shoulder": "right_shoulder", "right_shoulder": "left_shoulder"}
            centre, sigma = term.parameters
            sets.append(FuzzySet(term.name, shape.get(term.shape, term.shape), (-centre, sigma)))
        low, high = variable.universe
        return Variable(variable.name, variable.unit, (-high, -low), tuple(sets))

    controller = MamdaniController(rules)
    other = MamdaniController(replace(rules, outputs=tuple(mirrored(v) for v in rules.outputs)))
    x = samples(controller, 300)
    torch.testing.assert_close(other.infer(x), -controller.infer(x), rtol=1e-12, atol=0)


def test_finer_universes_converge_with_second_order() -> None:
    x = samples(paper_controller(2), 50)
    exact = paper_controller(2, points=12801).infer(x)
    errors = [
        (paper_controller(2, points=n).infer(x) - exact).abs().mean().item() for n in (51, 201, 801)
    ]
    # Kinks of the clipped sets between points give second order on average, not for every x.
    assert errors[1] < errors[0] / 8
    assert errors[2] < errors[1] / 8


def test_gradients_equal_finite_differences() -> None:
    controller = paper_controller(4)
    x = samples(controller, 6).requires_grad_()
    span = controller.upper - controller.lower
    scaled = (x / span).detach().requires_grad_()
    middle = controller.middle
    assert torch.autograd.gradcheck(lambda z: controller.infer(z * span) / middle, (scaled,))


GAPPED = """
[System]
Type='mamdani'
NumInputs=2
NumOutputs=1
NumRules=2
[Input1]
Name='velocity'
Range=[0 10]
NumMFs=2
MF1='slow':'trimf',[0 0 4]
MF2='fast':'trimf',[6 10 10]
[Input2]
Name='acceleration'
Range=[-1 1]
NumMFs=1
MF1='any':'trapmf',[-1 -1 1 1]
[Output1]
Name='B'
Range=[0 2]
NumMFs=2
MF1='low':'trimf',[0 0.5 1]
MF2='high':'trimf',[1 1.5 2]
[Rules]
1 0, 1 (1) : 1
2 1, 2 (1) : 1
"""


def test_output_without_firing_rules_is_the_middle_with_zero_gradient() -> None:
    controller = MamdaniController(parse_fis(GAPPED, units=("1", "1")))
    x = torch.tensor([[5.0, 0.0], [0.0, 0.0], [10.0, 0.0]], dtype=FLOAT64, requires_grad=True)
    y = controller.infer(x)
    assert y[:, 0].tolist() == pytest.approx([1.0, 0.5, 1.5])
    (gradient,) = torch.autograd.grad(y.sum(), x)
    assert (gradient[0] == 0).all()


def test_unsound_options_are_refused() -> None:
    with pytest.raises(ValueError, match="joint"):
        paper_controller(1)
    rules = paper_controller(2).rule_base
    with pytest.raises(ValueError, match="centroid"):
        MamdaniController(rules, centroid="mean")
    with pytest.raises(ValueError, match="points"):
        MamdaniController(rules, points=1)


def test_controller_map_shows_the_controller_in_si():
    controller = paper_controller(2)
    figure = controller_surface(controller)
    maps = [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]
    assert maps[0].get_xlabel() == "velocity [rad/s]"
    for k, ax in enumerate(maps):
        mesh = ax.collections[0]
        qd, qdd = (torch.as_tensor(x) for x in np.moveaxis(mesh.get_coordinates(), -1, 0))
        expected = 1e3 * controller(qd, qdd)[..., k].numpy()
        np.testing.assert_allclose(mesh.get_array(), expected, rtol=1e-9)
