"""A network that corrects coefficients by class: the adaptive schedule until it has learned."""

import pytest
import torch

from nfriction import NFLFM, rollout
from nfriction.friction.laws import LINEAR, NONLINEAR
from nfriction.papers.afem.adaptive import Adaptive
from nfriction.papers.nffem.adaptive_neurofuzzy import AdaptiveNeuroFuzzy
from tests.fitting.recordings import pendulum
from tests.friction.samples import motion

F64 = torch.float64


def adaptive(law=LINEAR, **options: float) -> Adaptive:
    """Coefficients of every class and joint apart, one of them zero."""
    g = torch.Generator().manual_seed(7)
    values = 0.1 + torch.rand(2, 3, len(law.names), generator=g, dtype=F64)
    values[0, :, 1] = 0.0
    made = Adaptive(law, 2, values, **options)
    made.set_classes([[5.0, 30.0], [8.0, 60.0]], [3.0, 4.0])
    return made


def corrected(law=LINEAR, spread: float = 0.5) -> AdaptiveNeuroFuzzy:
    made = AdaptiveNeuroFuzzy(law, 2, terms=(3, 2), head_units=4)
    made.set_adaptive(adaptive(law))
    made.deviation.set_range(20.0, [-200.0, 200.0])
    g = torch.Generator().manual_seed(1)
    shape = made.parameter_vector().shape
    made.set_parameter_vector(spread * torch.randn(shape, generator=g, dtype=F64))
    return made


@pytest.mark.parametrize("law", [LINEAR, NONLINEAR], ids=lambda law: law.name)
def test_until_it_has_learned_it_is_the_adaptive_schedule(law) -> None:
    qd, qdd, _ = motion(60, 2)
    reference = adaptive(law, time_constant=0.5, sample_time=2e-3)
    made = AdaptiveNeuroFuzzy(law, 2)
    made.set_adaptive(reference, torch.full((2, len(law.names)), 0.5, dtype=F64))
    made.deviation.set_range(40.0, [-400.0, 400.0])
    states = reference.states(qd, qdd)
    torch.testing.assert_close(made.states(qd, qdd), states)
    expected = reference.coefficients_from(qd, qdd, states)
    found = made.coefficients_from(qd, qdd, states)
    assert torch.equal(found, expected)
    # A coefficient of zero can rise all the same.
    zero = (expected < 1e-9) & made.positive
    found = made.sensitivities_from(qd, qdd, states)
    slope = found.parameters[..., found.joint == 0].abs().sum(-1)
    assert zero[:, 0].any()
    assert bool((slope[zero[:, 0]] > 1e-4).all())


def test_what_is_positive_stays_so() -> None:
    made = corrected(NONLINEAR, spread=5.0)
    qd, qdd, _ = motion(200, 2)
    found = made.coefficients_from(qd, qdd, made.states(qd, qdd))
    assert bool((found >= 0)[..., made.positive].all())
    assert bool((found < 0)[..., ~made.positive].any())


def test_memory_advances_as_that_of_its_classes() -> None:
    made = corrected()
    qd, qdd, _ = motion(40, 2)
    state = made.initial_state(qd[0], qdd[0])
    rows = [state]
    for v, a in zip(qd[1:], qdd[1:], strict=True):
        rows.append(made.advance(v, a, rows[-1]))
    torch.testing.assert_close(torch.stack(rows), made.states(qd, qdd))
    assert torch.equal(made(qd, qdd), made.coefficients_from(qd, qdd, made.initial_state(qd, qdd)))


def test_sensitivities_are_derivatives_at_a_given_memory() -> None:
    made = corrected(NONLINEAR)
    qd, qdd, _ = motion(12, 2)
    qd = qd.sign() * (0.5 + qd.abs()).clamp(max=19.0)
    qdd = qdd.clamp(-190, 190)
    states = made.states(qd, qdd)
    found, start = made.sensitivities_from(qd, qdd, states), made.parameter_vector()
    step = 1e-5
    for i in torch.linspace(0, len(start) - 1, 15).long().tolist():
        ends = []
        for sign in (1, -1):
            moved = start.clone()
            moved[i] += sign * step
            made.set_parameter_vector(moved)
            ends.append(made.coefficients_from(qd, qdd, states).detach())
        made.set_parameter_vector(start)
        slope = (ends[0] - ends[1]) / (2 * step)
        joint = int(found.joint[i])
        # Truncation step^2, rounding 1e-16 / step, of coefficients below 2.
        torch.testing.assert_close(found.parameters[:, :, i], slope[:, joint], rtol=0, atol=1e-9)
        assert not slope[:, 1 - joint].any()
    for got, where, width in ((found.qd, 0, 1e-5), (found.qdd, 1, 1e-4)):
        ends = []
        for sign in (1, -1):
            moved = [qd, qdd]
            moved[where] = moved[where] + sign * width
            ends.append(made.coefficients_from(*moved, states).detach())
        torch.testing.assert_close(got, (ends[0] - ends[1]) / (2 * width), rtol=0, atol=1e-8)
    assert torch.equal(made.joint_of_parameters(), found.joint)


def test_every_class_may_hold_at_rest() -> None:
    made = AdaptiveNeuroFuzzy(LINEAR, 2)
    made.set_adaptive(adaptive())
    assert torch.equal(made.rest_coefficients(), made.adaptive.rest_coefficients())


def test_a_model_with_it_simulates_and_scripts_alike() -> None:
    """Compiled, stepped in torch, and TorchScript: one definition."""
    model = NFLFM(2, v_smooth=0.1, network="by_class", terms=(3, 2), head_units=4)
    model.schedule.set_adaptive(adaptive(sample_time=1e-3))
    vector = corrected(spread=0.2).parameter_vector()
    model.schedule.set_parameter_vector(vector)
    model.schedule.adaptive.set_coefficients(1e-2 * model.schedule.adaptive.values)
    model.schedule.deviation.scale.mul_(1e-2)
    model.requires_grad_(False)
    q0, qd0 = torch.tensor([2.0, 0.5], dtype=F64), torch.zeros(2, dtype=F64)
    runs = [
        rollout(pendulum(), model, q0, qd0, sample_time=1e-3, steps=60, backend=backend)
        for backend in ("auto", "torch")
    ]
    torch.testing.assert_close(runs[0].q, runs[1].q, rtol=1e-11, atol=1e-12)
    qd, qdd, _ = motion(20, 2)
    torch.testing.assert_close(torch.jit.script(model.schedule)(qd, qdd), model.schedule(qd, qdd))


def test_options_make_the_same_again() -> None:
    model = NFLFM(2, network="by_class", terms=(3, 2), head_units=4)
    model.schedule.set_adaptive(adaptive(time_constant=0.7, hysteresis=0.1))
    again = NFLFM(2, **model.schedule.options())
    again.load_state_dict(model.state_dict())
    assert again.schedule.options() == model.schedule.options()
    qd, qdd, _ = motion(20, 2)
    torch.testing.assert_close(again.schedule.states(qd, qdd), model.schedule.states(qd, qdd))
