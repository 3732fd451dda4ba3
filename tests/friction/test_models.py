"""Friction models: law times schedule, including user-defined ones."""

import re

import numpy as np
import pytest
import torch

from nfriction.friction import model_by_name, model_list, model_name, model_names, plain_name
from nfriction.friction.coefficients import Constant, Schedule
from nfriction.friction.laws import LINEAR, VISCOUS
from nfriction.friction.models import LFM, NLFM, FrictionModel
from nfriction.friction.neurofuzzy import NFLFM, NeuroFuzzy
from nfriction.friction.parameters import Sensitivity
from tests.friction.samples import QUADRATIC, motion, named_models, normal, quadratic

every_model = pytest.mark.parametrize("name", named_models())


@every_model
def test_the_torque_is_the_law_of_the_coefficients(name: str) -> None:
    model = named_models()[name]
    qd, qdd, load = motion(20, 3)
    coefficients = model.coefficients(qd, qdd)
    expected = model.law.torque(qd, load, coefficients, model.v_smooth)
    found = model(qd, qdd, load)
    assert found.shape == (20, 3)
    assert found.dtype == torch.float64
    assert torch.equal(found, expected)
    assert torch.equal(model.torque(qd, load, coefficients), expected)


@every_model
def test_any_batch_shape_is_accepted(name: str) -> None:
    model = named_models()[name]
    inputs = motion(4, 5, 3)
    flat = model(*(x.reshape(-1, 3) for x in inputs))
    torch.testing.assert_close(model(*inputs).reshape(-1, 3), flat, rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(model(*(x[0, 0] for x in inputs)), flat[0], rtol=1e-12, atol=1e-15)


@every_model
def test_precision_is_double_by_default_and_single_on_request(name: str) -> None:
    model = named_models()[name]
    assert all(t.dtype == torch.float64 for t in model.state_dict().values())
    qd, qdd, load = motion(20, 3)
    expected = model(qd, qdd, load)
    single = model.to(torch.float32)(qd.float(), qdd.float(), load.float())
    assert single.dtype == torch.float32
    # Single precision's 1e-7, times the effect of scaling, exponentials and sums.
    torch.testing.assert_close(single.double(), expected, rtol=1e-3, atol=1e-4)


@every_model
def test_every_trained_parameter_has_a_gradient(name: str) -> None:
    model = named_models()[name]
    model(*motion(50, 3)).square().sum().backward()
    for parameter in model.parameters():
        assert parameter.grad is not None
        assert torch.isfinite(parameter.grad).all()
        assert parameter.grad.any()


@every_model
def test_zero_velocity_damping_equals_finite_differences(name: str) -> None:
    model = named_models()[name]
    rest, load = torch.zeros(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    step = 1e-5 * model.v_smooth
    # Of all sets of coefficients possible at rest, the steepest counts.
    held = model.schedule.rest_coefficients()
    ahead, behind = (model.torque(rest + s, load, held) for s in (step, -step))
    slope = model.zero_velocity_damping()
    assert slope.shape == (3,)
    expected = ((ahead - behind) / (2 * step)).detach().reshape(-1, 3).amax(0)
    # Truncation is (step / v_smooth)^2 / 3, and step / v_s if Stribeck's exponent is near 1.
    torch.testing.assert_close(slope, expected, rtol=1e-6, atol=0)
    assert slope.shape == (3,)
    assert not slope.requires_grad


def test_damping_of_coulomb_friction_is_its_size_over_v_smooth() -> None:
    model = LFM(2, [[0.1, 0.5], [0.2, 0.7]], v_smooth=1e-2)
    expected = torch.tensor([0.1 + 0.5e2, 0.2 + 0.7e2], dtype=torch.float64)
    torch.testing.assert_close(model.zero_velocity_damping(), expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("make", [Constant, NeuroFuzzy])
def test_user_defined_law_works_like_the_named_ones(make: type[Schedule]) -> None:
    values = torch.tensor([[0.1, 0.2], [0.3, 0.4]], dtype=torch.float64)
    model = FrictionModel(QUADRATIC, make(QUADRATIC, 2, values))
    qd, qdd, load = motion(30, 2)
    expected = quadratic(qd, load, values, model.v_smooth)
    torch.testing.assert_close(model(qd, qdd, load), expected, rtol=1e-13, atol=0)
    assert "law=quadratic" in repr(model)


class WithoutParameters(Schedule):
    """A user-defined schedule: viscous friction that falls with the speed."""

    def forward(self, qd: torch.Tensor, qdd: torch.Tensor) -> torch.Tensor:
        return torch.exp(-qd.abs()).unsqueeze(-1)

    def parameter_vector(self) -> torch.Tensor:
        return torch.zeros(0, dtype=torch.float64)

    def set_parameter_vector(self, vector: torch.Tensor) -> None:
        pass

    def bounds(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.parameter_vector(), self.parameter_vector()

    def sensitivities(self, qd: torch.Tensor, qdd: torch.Tensor) -> Sensitivity:
        raise NotImplementedError


def test_user_defined_schedule_works_even_without_parameters() -> None:
    model = FrictionModel(VISCOUS, WithoutParameters(VISCOUS, 2))
    qd, qdd, load = motion(30, 2)
    torch.testing.assert_close(model(qd, qdd, load), torch.exp(-qd.abs()) * qd)
    torch.testing.assert_close(model.zero_velocity_damping(), torch.ones(2, dtype=torch.float64))


def test_constant_coefficients_may_be_batched() -> None:
    model = NLFM(3)
    qd, _, load = motion(7, 3)
    held = normal(4, 7, 3, 5).exp()
    together = model.torque(qd, load, held)
    for one, torque in zip(held, together, strict=True):
        torch.testing.assert_close(model.torque(qd, load, one), torque, rtol=1e-14, atol=0)


def test_nan_inputs_give_nan_outputs() -> None:
    for name, model in named_models().items():
        for which in range(3):
            inputs = list(motion(4, 3))
            clean = model(*inputs)
            changed = clean.clone()
            changed[1, 2] = torch.nan
            # Inputs that a model does not use have no effect; far from rest nor does the sign.
            slow = [1e-4 * x if i == 0 else x for i, x in enumerate(motion(3))]
            reads = torch.autograd.functional.jacobian(
                lambda x, w=which, m=model, s=slow: m(
                    *(x if i == w else y for i, y in enumerate(s))
                ),
                slow[which],
            ).any()
            inputs[which][1, 2] = torch.nan
            expected = changed if reads else clean
            assert torch.equal(torch.isnan(model(*inputs)), torch.isnan(expected)), (name, which)


@pytest.mark.parametrize(
    ("name", "of", "known", "options"),
    [
        ("NFLuGre", "NFLuGre", "terms", {}),
        ("LFM", "LFM", "none", {}),
        ("MaxwellSlip", "MaxwellSlip", "elements", {}),
        ("NFLFM", "network 'anfis'", "network, inputs, terms", {}),
    ],
)
def test_unknown_option_of_a_model_is_named(name, of, known, options) -> None:
    with pytest.raises(ValueError, match=f"{of} has no option depth; it has {known}"):
        model_by_name(name)(2, depth=3, **options)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"network": "rbf", "terms": (3, 3)}, "network 'rbf' has no option terms; it has"),
        ({"head_units": 2.5}, "`head_units` must be a whole number"),
        (
            {"inputs": "load"},
            "`inputs` must be different ones of direction, load, position, heat, got 'load'",
        ),
    ],
)
def test_wrong_options_of_a_network_are_named(given, words) -> None:
    with pytest.raises(ValueError, match=words):
        model_by_name("NFLFM")(2, **given)


def test_options_are_returned_as_given() -> None:
    options = {
        "terms": [3, 2],
        "head_units": 4,
        "acceleration": "signed",
        "interpretable": True,
        "prior_sd": 0.1,
    }
    assert NFLFM(2, **options).schedule.options() == options
    assert LFM(2).schedule.options() == {}
    # A manually built model returns them, too.
    assert FrictionModel(LINEAR, NeuroFuzzy(LINEAR, 2, **options)).schedule.options() == options


def test_number_of_joints_must_match() -> None:
    with pytest.raises(ValueError, match="3 joints, got last axis 2"):
        LFM(3)(*motion(5, 2))
    qd, qdd, load = motion(1, 3)
    with pytest.raises(ValueError, match=r"`load` must be .* 3 joints, got last axis 1"):
        LFM(3)(qd, qdd, load.reshape(3, 1))
    assert LFM(np.int64(3)).schedule.joints == 3


@pytest.mark.parametrize("v_smooth", [0.0, -1.0, float("nan"), float("inf")])
def test_v_smooth_must_be_positive(v_smooth: float) -> None:
    with pytest.raises(ValueError, match="`v_smooth` must be positive and finite"):
        LFM(1, v_smooth=v_smooth)


def test_a_schedule_for_another_law_is_refused() -> None:
    with pytest.raises(ValueError, match="the schedule gives C_p, but the law 'linear' takes B, C"):
        FrictionModel(LINEAR, Constant(VISCOUS, 2))


def test_models_are_found_by_name() -> None:
    assert all(model_by_name(name).__name__ == name for name in model_names())
    with pytest.raises(ValueError, match=r"'XYZ'; there are viscous \(NCFM\).*NFNCFM"):
        model_by_name("XYZ")


@pytest.mark.parametrize(
    ("asked", "meant"),
    [
        ("stribek", "stribeck"),
        ("LFN", "load-coulomb (LFM)"),
        ("coulomb-viscos", "coulomb-viscous (CVFM)"),
        ("neurofuzzy:stribeck", "neuro-fuzzy:stribeck (NFStribeck)"),
        ("adaptive:arctn", "adaptive:arctan (ANLFM)"),
    ],
)
def test_mistyped_name_suggests_the_nearest_one(asked: str, meant: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"did you mean {meant}?")):
        model_by_name(asked)


def test_plain_names_name_law_and_inputs() -> None:
    plain = {name: plain_name(name) for name in model_names()}
    assert len(set(plain.values())) == len(plain)
    constant = {model_by_name(n).definition: p for n, p in plain.items() if ":" not in p}
    for name, text in plain.items():
        kind = model_by_name(text)
        assert kind is model_by_name(name)
        before, _, law = text.rpartition(":")
        assert law == constant[kind.definition]
        schedule = kind(1).schedule
        assert type(schedule).__name__ == {
            "": "Constant", "adaptive": "Adaptive", "neuro-fuzzy": "NeuroFuzzy"
        }[before]  # fmt: skip


def test_names_are_case_insensitive() -> None:
    for name in model_names():
        for text in (name, plain_name(name)):
            forms = (text.upper(), text.lower(), text.title(), f" {text} ", text.replace("-", "_"))
            assert {model_name(form) for form in forms} == {name}
    assert model_name("Neuro-fuzzy:LFM") == "NFLFM"


def test_arrays_and_lists_are_accepted_as_inputs() -> None:
    for name, model in named_models(2).items():
        motion = [[0.5, -1.0]], [[3.0, 20.0]], [[1.0, 0.5]]
        tensors = [torch.tensor(x, dtype=torch.float64) for x in motion]
        expected = model(*tensors)
        assert torch.equal(model(*motion), expected), name
        assert torch.equal(model(*(x.numpy() for x in tensors)), expected), name
        turned = [x.numpy().astype(">f8")[:, ::-1] for x in tensors]
        assert torch.equal(model(*turned), model(*(x.flip(1) for x in tensors))), name


@pytest.mark.parametrize("value", [10**400, "fast", None, [1e-3, 1e-3]])
def test_numbers_beyond_float_range_are_refused_by_name(value: object) -> None:
    with pytest.raises(ValueError, match="`v_smooth` must be positive and finite"):
        LFM(1, v_smooth=value)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="`prior_sd` must be positive and finite"):
        NFLFM(1, prior_sd=value)
    if isinstance(value, int):
        with pytest.raises(ValueError, match="coefficients must be an array of numbers"):
            LFM(1, [value, 1.0])


@every_model
def test_zero_velocity_damping_works_without_gradients(name: str) -> None:
    expected = named_models()[name].zero_velocity_damping()
    with torch.no_grad():
        assert torch.equal(named_models()[name].zero_velocity_damping(), expected)
    model = named_models()[name]
    with torch.inference_mode():
        assert torch.equal(model.zero_velocity_damping(), expected)


def test_values_that_are_no_numbers_are_refused_by_name() -> None:
    for wrong in ("fast", None, [[1.0], [1.0, 2.0]], [10**400, 1.0], np.array([1j, 1.0])):
        with pytest.raises(ValueError, match=r"^load must be an array of numbers, got"):
            LFM(2)([1.0, 2.0], [0.0, 0.0], wrong)
    with pytest.raises(
        TypeError, match=r"`law` must be a Law, such as laws\.VISCOUS, got 'viscous'"
    ):
        Constant("viscous", 1)  # type: ignore[arg-type]


@pytest.mark.parametrize("terms", [5, None, "55", (3.0, 3), ("3", 3)])
def test_the_network_has_two_inputs(terms: object) -> None:
    with pytest.raises(ValueError, match="`terms` must be two whole numbers"):
        NFLFM(1, terms=terms)


def test_models_are_offered_for_data_that_they_can_be_fitted_to() -> None:
    of_motions, of_tables = (re.split(r"[ ,;()]+", model_list(of_tables=x)) for x in (False, True))
    assert "maxwell-slip" in of_motions
    assert not {"slip", "load-slip"} & set(of_motions)
    assert {"slip", "load-slip"} <= set(of_tables)
    assert not {"maxwell-slip", "adaptive:"} & set(of_tables)
