"""Neuro-fuzzy coefficients equal a constant law until trained, and outside the trained range."""

import copy
import pickle
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import functional_call, jacrev

from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import LINEAR, NONLINEAR, STRIBECK, VISCOUS
from nfriction.friction.memory import ELASTO_PLASTIC
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import LEAST_RATIO, LOGIT_SD, NFCVFM, NeuroFuzzy
from nfriction.io.model_file import load, save
from tests.friction.samples import LAWS, QUADRATIC, motion, normal, randomise

every_law = pytest.mark.parametrize("law", [*LAWS, QUADRATIC], ids=lambda law: law.name)
both_ways = pytest.mark.parametrize("acceleration", ["along_motion", "signed"])


def trained(law=LINEAR, joints: int = 2, spread: float = 0.5, seed: int = 0, **options: object):
    learn_sets = bool(options.pop("learn_sets", False))
    schedule = NeuroFuzzy(law, joints, **options)
    randomise(schedule, spread, seed)
    schedule.learn_sets = learn_sets
    return schedule


@every_law
def test_untrained_network_equals_the_constant_law(law) -> None:
    constant = Constant(law, 3)
    schedule = NeuroFuzzy(law, 3, constant.values)
    qd, qdd, _ = motion(100, 3)
    expected = constant.values.expand(100, -1, -1)
    torch.testing.assert_close(schedule(qd, qdd), expected, rtol=1e-14, atol=0)
    torch.testing.assert_close(schedule.reference_coefficients(), constant.values)


def test_a_coefficient_near_zero_can_rise() -> None:
    schedule = NeuroFuzzy(LINEAR, 1)
    scale = torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    schedule.set_reference(torch.tensor([[0.0, 0.5]], dtype=torch.float64), scale)
    found = schedule.reference_coefficients()
    torch.testing.assert_close(found, torch.tensor([[LEAST_RATIO, 0.5]], dtype=torch.float64))
    assert torch.equal(schedule.scale, scale)


def test_a_signed_coefficient_of_zero_starts_at_zero() -> None:
    schedule = NeuroFuzzy(NONLINEAR, 2)
    assert not schedule(*motion(5, 2)[:2])[..., 0].any()


@every_law
@settings(max_examples=20)
# With a larger spread, the square of a distance over a width of e^-350 overflows.
@given(seed=st.integers(0, 1000), spread=st.floats(0.01, 80.0))
def test_coefficients_are_positive_for_any_parameters(law, seed: int, spread: float):
    schedule = trained(law, 2, spread, seed)
    values = schedule(*motion(50, 2, seed=seed)[:2])
    assert torch.isfinite(values).all()
    assert (values[..., schedule.positive] >= 0).all()


@every_law
@both_ways
@settings(max_examples=20)
@given(seed=st.integers(0, 1000), spread=st.floats(0.01, 10.0))
def test_without_an_offset_friction_is_passive(law, acceleration: str, seed: int, spread: float):
    schedule = trained(law, 2, spread, seed, acceleration=acceleration)
    silence_offset(schedule)
    qd, qdd, load = motion(50, 2, seed=seed)
    assert (qd * FrictionModel(law, schedule)(qd, qdd, load) >= 0).all()


@torch.no_grad()
def silence_offset(schedule: NeuroFuzzy) -> None:
    """Keep signed coefficients at zero, as a user without an offset would."""
    signed = ~schedule.positive[: schedule.outputs]
    schedule.network.anfis.consequents[:, signed] = 0.0
    schedule.network.head.output_weight[:, signed] = 0.0
    schedule.network.head.output_bias[:, signed] = 0.0


@every_law
def test_reversed_velocity_only_reverses_the_torque(law) -> None:
    schedule = trained(law)
    silence_offset(schedule)
    model = FrictionModel(law, schedule)
    qd, qdd, load = motion(100, 2)
    assert torch.equal(model(-qd, -qdd, load), -model(qd, qdd, load))


def test_signed_acceleration_makes_directions_differ() -> None:
    schedule = trained(acceleration="signed")
    qd, qdd, _ = motion(100, 2)
    assert not torch.allclose(schedule(-qd, -qdd), schedule(qd, qdd), rtol=1e-3)
    torch.testing.assert_close(schedule(-qd, qdd), schedule(qd, qdd), rtol=0, atol=0)


@both_ways
def test_coefficients_return_to_the_constant_law_outside_the_range(acceleration: str):
    schedule = trained(acceleration=acceleration)
    schedule.set_range([4.0, 5.0], [[-30.0, 60.0], [-20.0, 20.0]])
    law = schedule.reference_coefficients()
    edge = torch.tensor([4.0, 5.0], dtype=torch.float64), torch.tensor([60.0, 20.0]).double()
    # Half the range beyond it, in velocity for one joint and in acceleration for the other.
    far = torch.tensor([6.0, 5.0], dtype=torch.float64), torch.tensor([60.0, 40.0]).double()
    farther = torch.tensor([400.0, 5.1], dtype=torch.float64), torch.tensor([61.0, 1e9]).double()
    assert (schedule(*edge) != law).all()
    for gone in (far, farther, (torch.full_like(edge[0], torch.inf), edge[1])):
        assert torch.equal(schedule(*gone), law)
    way = torch.linspace(0.0, 1.0, 101, dtype=torch.float64)[:, None]
    found = schedule(*(a + way * (b - a) for a, b in zip(edge, far, strict=True)))
    left = (found - law) / (found[0] - law)
    assert (left.diff(dim=0) < 1e-9).all()
    assert (left.diff(dim=0) > -0.1).all()


@both_ways
def test_nearest_trained_motion_is_found(acceleration: str) -> None:
    schedule = trained(acceleration=acceleration)
    schedule.set_range([4.0, 5.0], [[-30.0, 60.0], [-20.0, 20.0]])
    qd, qdd = 10 * normal(200, 2), 100 * normal(200, 2, seed=1)
    qd[:50] *= 1e-3
    nearest = schedule.within_range(qd, qdd)
    # Motion close to the range is unchanged, and no point is nearer than the clamped inputs.
    scaled = schedule.scaled(qd, qdd)
    torch.testing.assert_close(schedule.scaled(*nearest), scaled.clamp(0, 1))
    rest = torch.zeros(1, 2, dtype=torch.float64), qdd[:1]
    assert all(torch.isfinite(x).all() for x in schedule.within_range(*rest))


@pytest.mark.parametrize(
    ("velocity", "acceleration"),
    [(0.0, [-1, 1]), (1.0, [1, 1]), (float("nan"), [-1, 1]), (1.0, [-float("inf"), 1])],
)
def test_an_empty_range_is_refused(velocity: float, acceleration: list[float]) -> None:
    schedule = NeuroFuzzy(LINEAR, 2)
    before = schedule.velocity_range.clone()
    with pytest.raises(ValueError, match="finite and not empty"):
        schedule.set_range(velocity, acceleration)
    assert torch.equal(schedule.velocity_range, before)


@pytest.mark.parametrize("which", [0, 1])
def test_nan_affects_only_its_sample_and_joint(which: int) -> None:
    schedule = trained()
    inputs = list(motion(5, 2)[:2])
    clean = schedule(*inputs)
    inputs[which][2, 1] = torch.nan
    found = schedule(*inputs)
    lost = torch.zeros(5, 2, 1, dtype=torch.bool)
    lost[2, 1] = True
    assert torch.equal(torch.isnan(found), lost.expand(found.shape))
    assert torch.equal(torch.where(lost, clean, found), clean)


def test_joints_are_independent() -> None:
    schedule = trained(joints=3)
    qd, qdd, _ = motion(10, 3)
    together = schedule(qd, qdd)
    qd[:, 1], qdd[:, 1] = 1.0, 2.0
    apart = schedule(qd, qdd)
    assert torch.equal(together[:, [0, 2]], apart[:, [0, 2]])
    assert not torch.equal(together[:, 1], apart[:, 1])


def test_any_batch_shape_is_accepted() -> None:
    schedule = trained()
    qd, qdd, _ = motion(3, 4, 2)
    flat = schedule(qd.reshape(-1, 2), qdd.reshape(-1, 2))
    torch.testing.assert_close(schedule(qd, qdd).reshape(flat.shape), flat, rtol=1e-13, atol=0)
    torch.testing.assert_close(schedule(qd[0, 0], qdd[0, 0]), flat[0], rtol=1e-13, atol=0)


def test_parameter_vector_round_trip_is_exact() -> None:
    schedule, other = trained(), NeuroFuzzy(LINEAR, 2)
    vector = schedule.parameter_vector()
    other.set_parameter_vector(vector)
    assert torch.equal(other.parameter_vector(), vector)
    before = vector.clone()
    vector.zero_()  # a copy: the model must not follow
    assert torch.equal(schedule.parameter_vector(), before)
    with pytest.raises(RuntimeError):
        other.set_parameter_vector(before[1:])


def test_prior_is_centred_on_the_reference() -> None:
    schedule = trained(prior_sd=0.2, learn_sets=True, interpretable=True)
    mean, sd = schedule.prior()
    # Weights, widths relative to their initial values, spacings as logits, and centres in widths.
    widths = schedule.network.head.log_widths.detach().exp().reshape(-1)
    units = {"set spacings": LOGIT_SD / 0.2, "head centres": widths}
    for k, name in enumerate(schedule.group_names()):
        expected = torch.ones(int((schedule.groups() == k).sum())).double() * units.get(name, 1.0)
        torch.testing.assert_close(sd[schedule.groups() == k], 0.2 * expected)
    with torch.no_grad():
        schedule.network.head.output_bias.zero_()
    schedule.set_parameter_vector(mean)
    expected = schedule.reference_coefficients().expand(5, -1, -1)
    torch.testing.assert_close(schedule(*motion(5, 2)[:2]), expected, rtol=1e-14, atol=0)


@pytest.mark.parametrize(
    ("law", "constant", "outputs", "fixed"),
    [(STRIBECK, ["delta"], 4, 0), (ELASTO_PLASTIC, ["sigma_0", "rho"], 6, 1)],
)
def test_fixed_coefficient_stays_constant(law, constant, outputs, fixed) -> None:
    schedule = NeuroFuzzy(law, 2)
    lower, upper = schedule.bounds()
    bound = lower == upper
    # The planes of all rules and the units, for both joints; no output for the last coefficients.
    assert len(lower) == outputs * 2 * (25 * 3 + 10)
    assert int(bound.sum()) == fixed * 2 * (25 * 3 + 10)
    assert torch.isinf(lower[~bound]).all()
    assert torch.isinf(upper[~bound]).all()
    schedule.set_parameter_vector(0.1 * normal(len(lower)).clamp(lower, upper))
    found = schedule(*motion(20, 2)[:2])
    same = torch.tensor([name in constant for name in law.names])
    torch.testing.assert_close(
        found[..., same], schedule.reference_coefficients()[:, same].expand(20, -1, -1)
    )
    assert (found.std(0) > 1e-3 * found.mean(0))[:, ~same].all()


def by_parameters(schedule: NeuroFuzzy, qd: Tensor, qdd: Tensor) -> Tensor:
    """Jacobian (sample, joint, coefficient, parameter) by full reverse-mode differentiation."""
    values = schedule.trained()
    by_identity = {id(p): name for name, p in schedule.named_parameters()}
    names = [by_identity[id(p)] for p in values]
    sizes = [p.numel() for p in values]

    def coefficients(vector: Tensor) -> Tensor:
        parts = zip(vector.split(sizes), values, strict=True)
        state = dict(zip(names, (part.reshape(p.shape) for part, p in parts), strict=True))
        return functional_call(schedule, state, (qd, qdd))

    return jacrev(coefficients)(schedule.parameter_vector())


@both_ways
@pytest.mark.parametrize("sets", [None, {"interpretable": False}, {"interpretable": True}])
def test_parameter_sensitivities_equal_the_full_jacobian(acceleration: str, sets: dict | None):
    learnt = sets is not None
    schedule = trained(
        NONLINEAR, 2, terms=(3, 2), head_units=4, acceleration=acceleration, learn_sets=learnt,
        **(sets or {}),
    )  # fmt: skip
    qd, qdd, _ = motion(6, 2)
    qd[0] = 0.0
    found = schedule.sensitivities(qd, qdd)
    own = torch.nn.functional.one_hot(found.joint, 2).T.to(qd)  # (joint, parameter)
    expanded = found.parameters[:, None] * own[:, None]
    expected = by_parameters(schedule, qd, qdd).detach()
    torch.testing.assert_close(expanded, expected, rtol=1e-11, atol=1e-14)
    assert not found.parameters.requires_grad


@pytest.mark.parametrize("learnt", [False, True])
def test_factored_sensitivities_equal_the_expanded_ones(learnt: bool) -> None:
    schedule = trained(NONLINEAR, 2, terms=(3, 2), head_units=4, learn_sets=learnt)
    qd, qdd, _ = motion(6, 2)
    found = schedule.sensitivities(qd, qdd)
    held = torch.randn(3, 4, 2, 2, 5, generator=torch.Generator().manual_seed(3), dtype=qd.dtype)
    whole, samples = found.parameters.unflatten(0, (3, 2)), held[..., found.joint, :]
    expected = torch.einsum("bskp,brspk->brp", whole, samples)
    # Part of a larger array, whose other columns stay.
    whole = torch.full((3, 4, expected.shape[-1] + 2), 7.0, dtype=qd.dtype)
    found.contract(held, whole[..., :-2])
    torch.testing.assert_close(whole[..., :-2], expected, rtol=1e-12, atol=1e-14)
    assert (whole[..., -2:] == 7.0).all()


def central(function: Callable[[Tensor], Tensor], x: Tensor, step: float) -> Tensor:
    with torch.no_grad():
        return (function(x + step) - function(x - step)) / (2 * step)


@both_ways
def test_motion_sensitivities_equal_finite_differences(acceleration: str) -> None:
    schedule = trained(acceleration=acceleration)
    qd, qdd, _ = motion(40, 2)
    # Away from the kinks of |qd| and of the clamp to the trained range.
    qd = qd.sign() * (0.5 + qd.abs()).clamp(max=19.0)
    qdd = qdd.clamp(-190, 190)
    found = schedule.sensitivities(qd, qdd)
    scale = schedule.scale
    by_qd = central(lambda v: schedule(v, qdd), qd, 1e-5)
    by_qdd = central(lambda a: schedule(qd, a), qdd, 1e-4)
    # Truncation step^2, rounding 1e-16 / step, both below 1e-9 of the coefficients' scale.
    assert ((found.qd - by_qd).abs() / scale).max() < 1e-8
    assert ((found.qdd - by_qdd).abs() / scale).max() < 1e-8
    assert (found.qdd.abs() / scale).max() > 1e-4


def test_sensitivities_at_rest_are_finite() -> None:
    zero = torch.zeros(3, 2, dtype=torch.float64)
    found = trained().sensitivities(zero, zero)
    assert all(torch.isfinite(t).all() for t in (found.parameters, found.qd, found.qdd))


@pytest.mark.parametrize("outputs", [1, 2])
def test_bias_of_the_head_is_redundant_with_the_rules_constants(outputs: int) -> None:
    law = (VISCOUS, LINEAR)[outputs - 1]
    biased, shifted = NeuroFuzzy(law, 2), NeuroFuzzy(law, 2)
    with torch.no_grad():
        biased.network.head.output_bias.fill_(0.3)
        shifted.network.anfis.consequents[..., -1] = 0.3
    qd, qdd, _ = motion(20, 2)
    torch.testing.assert_close(biased(qd, qdd), shifted(qd, qdd), rtol=1e-13, atol=0)
    assert not any(p is biased.network.head.output_bias for p in biased.trained())


def test_options_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match='"along_motion" or "signed", got \'papers\''):
        NeuroFuzzy(LINEAR, 2, acceleration="papers")
    with pytest.raises(ValueError, match="`prior_sd` must be positive"):
        NeuroFuzzy(LINEAR, 2, prior_sd=0.0)
    with pytest.raises(ValueError, match="2 inputs"):
        NeuroFuzzy(LINEAR, 2, terms=(5, 5, 5))


def test_parameter_names_match_where_a_parameter_acts() -> None:
    schedule = trained(learn_sets=True)
    joints = [f"pivot {k + 1}" for k in range(schedule.joints)]
    names = schedule.parameter_names(joints)
    vector = schedule.parameter_vector()
    assert len(set(names)) == len(names) == len(vector)
    qd, qdd, _ = motion(30, schedule.joints)
    # The head takes the rules' output, so with one other coefficients of the joint would change.
    vector[[k for k, name in enumerate(names) if "head" in name]] = 0.0
    schedule.set_parameter_vector(vector)
    before = schedule(qd, qdd).detach()
    acting = 0
    tried = range(0, len(names), 7)
    for k in tried:
        schedule.set_parameter_vector(vector + 0.1 * (torch.arange(len(vector)) == k))
        moved = (schedule(qd, qdd).detach() - before).abs().amax(0)
        where = names[k].split(":")[0]
        # Sets and units belong to a joint, consequents and weights to one of its coefficients.
        whole = where.startswith("network")
        found = {
            f"{'network' if whole else schedule.coefficient_names[c]} of {joints[j]}"
            for j, c in moved.nonzero().tolist()
        }
        assert found <= {where}
        acting += len(found)
    # Rules that no sample of the motion fires have no effect.
    assert acting > 0.5 * len(tried)


@every_law
@both_ways
@pytest.mark.parametrize("interpretable", [False, True])
def test_derivatives_equal_automatic_differentiation(law, acceleration: str, interpretable: bool):
    """In closed form, also with clamped inputs and at rest."""
    schedule = trained(law, acceleration=acceleration, interpretable=interpretable)
    qd, qdd = (scale * normal(100, 2, seed=seed) for seed, scale in enumerate((20.0, 200.0)))
    qd[0] = qd[26, 0] = 0.0
    qd, qdd = qd.requires_grad_(), qdd.requires_grad_()
    held = schedule(qd, qdd)
    slopes = schedule.sensitivities(qd, qdd)
    found = slopes.qd, slopes.qdd
    for k in range(held.shape[-1]):
        expected = torch.autograd.grad(held[..., k].sum(), (qd, qdd), retain_graph=True)
        for ours, automatic in zip(found, expected, strict=True):
            # Both are exact; digits are lost only where the positive map is nearly flat.
            torch.testing.assert_close(
                ours[..., k], automatic, rtol=1e-10, atol=1e-13 * float(automatic.abs().max())
            )


def test_added_inputs_do_not_change_the_law_initially() -> None:
    plain = NFCVFM(2, [0.1, 0.2])
    model = NFCVFM(2, [0.1, 0.2, 0.03, 0.04], inputs=["direction", "load"])
    qd, qdd = torch.tensor([[-2.0, 3.0]]).double(), torch.zeros(1, 2).double()
    load = torch.tensor([[0.5, 1.5]]).double()
    expected = (plain(qd, qdd, load) + 0.04 * load * qd.sign()) * (1 + 0.03 * qd.sign())
    torch.testing.assert_close(model(qd, qdd, load), expected, rtol=1e-6, atol=1e-9)
    assert not model(0 * qd, qdd, load).any()
    copied = pickle.loads(pickle.dumps(model))
    assert copied.law == copy.deepcopy(model).law == model.law
    assert torch.equal(copied(qd, qdd, load), model(qd, qdd, load))


@pytest.mark.parametrize("inputs", [["colour"], ["load", "load"]])
def test_inputs_are_refused_by_name(inputs: list[str]) -> None:
    with pytest.raises(ValueError, match="direction, load"):
        NFCVFM(2, inputs=inputs)


def test_choice_of_no_inputs_is_kept_in_a_file(tmp_path) -> None:
    assert load(save(NFCVFM(1, inputs=()), tmp_path / "m.json")).inputs == []
    assert load(save(NFCVFM(1), tmp_path / "m.json")).inputs is None
