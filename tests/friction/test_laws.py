"""Friction laws: odd, passive, smooth through zero, broadcasting; and their descriptions."""

import copy
import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nfriction.friction.laws import (
    LINEAR,
    NONLINEAR,
    STRIBECK,
    Coefficient,
    Law,
    coulomb,
    coulomb_viscous,
    linear,
    nonlinear,
    smooth_sign,
    stribeck,
)
from nfriction.friction.models import LFM
from tests.friction.samples import LAWS, QUADRATIC, motion, normal

V_SMOOTH = 3e-3
every_law = pytest.mark.parametrize("law", [*LAWS, QUADRATIC], ids=lambda law: law.name)
positive = st.floats(0, 1e3)


def positive_coefficients(law: Law, *shape: int, seed: int = 0) -> Tensor:
    """Random coefficients; an offset, if the law has one, is zero."""
    values = normal(*shape, len(law.names), seed=seed).exp()
    signed = torch.tensor([not c.positive for c in law.coefficients])
    return values.masked_fill(signed, 0.0)


@every_law
@given(data=st.data())
def test_friction_without_an_offset_is_passive(law: Law, data: st.DataObject) -> None:
    qd, load = (data.draw(st.floats(-1e3, 1e3)), data.draw(positive))
    values = [data.draw(positive) if c.positive else 0.0 for c in law.coefficients]
    for k, c in enumerate(law.coefficients):
        if c.name == "v_s":  # a width; no schedule returns zero
            values[k] += 1e-12
    qd, load, coefficients = (torch.tensor(v, dtype=torch.float64) for v in (qd, load, values))
    power = qd * law.torque(qd, load, coefficients, V_SMOOTH)
    assert power >= 0


@every_law
def test_friction_without_an_offset_is_odd(law: Law) -> None:
    qd, _, load = motion(200, 3)
    coefficients = positive_coefficients(law, 3)
    forth = law.torque(qd, load, coefficients, V_SMOOTH)
    assert torch.equal(law.torque(-qd, load, coefficients, V_SMOOTH), -forth)


def test_the_offset_is_the_torque_at_rest() -> None:
    coefficients = torch.tensor([0.3, 0.1, 0.1, 0.1, 1.0], dtype=torch.float64)
    zero = torch.zeros((), dtype=torch.float64)
    assert nonlinear(zero, zero, coefficients, V_SMOOTH) == 0.3


@every_law
def test_gradients_equal_finite_differences_at_and_around_rest(law: Law) -> None:
    # A v_smooth as small as the step would make the differences inaccurate, not the gradients.
    qd = torch.tensor([0.0, -0.0, 0.05, -2.0], dtype=torch.float64, requires_grad=True)
    load = torch.tensor([1.0, 0.5, 0.0, 2.0], dtype=torch.float64, requires_grad=True)
    coefficients = positive_coefficients(law, 4).requires_grad_()

    def torque(qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor:
        return law.torque(qd, load, coefficients, 0.3)

    assert torch.autograd.gradcheck(torque, (qd, load, coefficients))


@every_law
def test_gradients_stay_finite_if_intermediate_values_overflow(law: Law) -> None:
    speeds = torch.tensor([0.0, 1e-300, -1e-8, 1.0, 1e3, -1e6], dtype=torch.float64)
    sizes = torch.tensor([1e-12, 1e-3, 1.0, 1e3], dtype=torch.float64)
    qd = speeds[:, None].expand(6, 4).clone().requires_grad_()
    coefficients = sizes[:, None].expand(4, len(law.names)).clone().requires_grad_()
    law.torque(qd, torch.ones_like(qd), coefficients, V_SMOOTH).sum().backward()
    assert torch.isfinite(qd.grad).all()
    assert torch.isfinite(coefficients.grad).all()


@every_law
def test_batched_coefficients_equal_single_ones(law: Law) -> None:
    qd, _, load = motion(7, 3)
    many = positive_coefficients(law, 5, 1, 3)
    together = law.torque(qd, load, many, V_SMOOTH)
    assert together.shape == (5, 7, 3)
    for one, torque in zip(many, together, strict=True):
        torch.testing.assert_close(law.torque(qd, load, one, V_SMOOTH), torque, rtol=1e-14, atol=0)


@every_law
def test_dtype_follows_the_inputs(law: Law) -> None:
    qd = torch.ones(3, dtype=torch.float32)
    assert law.torque(qd, qd, torch.ones(3, len(law.names)), V_SMOOTH).dtype == torch.float32


def test_coulomb_friction_grows_only_with_the_load() -> None:
    qd, _, load = motion(50, 2)
    coefficients = torch.tensor([0.0, 0.7], dtype=torch.float64)
    expected = 0.7 * load * smooth_sign(qd, V_SMOOTH)
    torch.testing.assert_close(linear(qd, load, coefficients, V_SMOOTH), expected)


def test_the_laws_of_dry_friction_are_nested() -> None:
    qd, _, load = motion(50, 2)
    ones = torch.ones_like(load)
    f_c, f_v = torch.tensor([0.7, 0.02], dtype=torch.float64)
    plain = coulomb_viscous(qd, load, torch.stack([f_c, f_v]), V_SMOOTH)
    assert torch.equal(plain, coulomb_viscous(qd, 2 * load, torch.stack([f_c, f_v]), V_SMOOTH))
    without_drop = torch.tensor([0.7, 0.0, 0.02, 0.3, 2.0], dtype=torch.float64)
    without_arctangent = torch.tensor([0.0, 0.7, 0.02, 0.0, 1.0], dtype=torch.float64)
    for other in (
        linear(qd, ones, torch.stack([f_v, f_c]), V_SMOOTH),
        stribeck(qd, load, without_drop, V_SMOOTH),
        nonlinear(qd, load, without_arctangent, V_SMOOTH),
    ):
        torch.testing.assert_close(other, plain, rtol=1e-14, atol=1e-15)


def test_stribeck_falls_from_breakaway_to_coulomb_friction() -> None:
    f_c, f_d, v_s = 1.0, 0.5, 0.1
    load = torch.ones((), dtype=torch.float64)

    def torque(qd: float, delta: float = 2.0, f_v: float = 0.0) -> float:
        coefficients = torch.tensor([f_c, f_d, f_v, v_s, delta], dtype=torch.float64)
        return float(stribeck(torch.tensor(qd, dtype=torch.float64), load, coefficients, 1e-9))

    # Just above standstill the sign is complete (1e-6 >> 1e-9) and the drop of order (1e-5)^2.
    assert torque(1e-6) == pytest.approx(f_c + f_d, rel=1e-9)
    assert torque(20 * v_s) == pytest.approx(f_c, rel=1e-12)
    assert torque(20 * v_s, f_v=0.3) == pytest.approx(f_c + 0.3 * 20 * v_s, rel=1e-12)
    for delta in (0.5, 1.0, 2.0, 50.0):
        # At v_s a share of 1/e remains, whatever the exponent.
        assert torque(v_s, delta) == pytest.approx(f_c + f_d / torch.e, rel=1e-9)
    speeds = torch.logspace(-5, 1, 50).tolist()
    torques = [torque(v) for v in speeds]
    assert all(a >= b for a, b in itertools.pairwise(torques))


def test_stribeck_exponent_is_fixed_by_default() -> None:
    assert [c.name for c in STRIBECK.coefficients if not c.fitted] == ["delta"]


def test_laws_unsuitable_for_fits_or_files_are_refused() -> None:
    with pytest.raises(ValueError, match="initial_grid"):
        Coefficient("v_s", "rad/s", linear=False)
    with pytest.raises(ValueError, match="`prior_scale` of 'v_s' must be positive, and is for"):
        Coefficient("v_s", "rad/s", linear=False, initial_grid=(1.0,), prior_scale=0.1)
    with pytest.raises(ValueError, match="`prior_scale`"):
        Coefficient("f_o", "N m", prior_scale=0.0)
    with pytest.raises(ValueError, match="each with its own name"):
        Law("twice", (Coefficient("B", "N m"), Coefficient("B", "N m")), linear)
    with pytest.raises(ValueError, match="each with its own name"):
        Law("none", (), linear)


def test_law_names_the_coefficients_of_its_nested_law():
    own = (Coefficient("a", "N m"), Coefficient("b", "N m s/rad"))
    assert Law("more", own, coulomb_viscous, LINEAR, ("b", "a")).nested_coefficients == ("b", "a")
    wrong = ((), ("a",), ("a", "c"), ("a", "b", "a"))
    for simpler, shared in (*((LINEAR, names) for names in wrong), (None, ("a",))):
        with pytest.raises(ValueError, match="law 'more' must name the"):
            Law("more", own, coulomb_viscous, simpler, shared)


def test_law_refuses_a_nested_law_that_it_cannot_represent():
    with pytest.raises(TypeError, match="`nested_law` must be a Law, got 'linear'"):
        Law("more", (Coefficient("a", "N m"),), coulomb_viscous, "linear", ("a",))
    signed = Law("signed", (Coefficient("o", "N m", positive=False),), coulomb)
    with pytest.raises(ValueError, match="'a' of law 'more' is positive, 'o' of the nested"):
        Law("more", (Coefficient("a", "N m"),), coulomb, signed, ("a",))


@pytest.mark.parametrize("law", [NONLINEAR, STRIBECK])
def test_law_equals_its_nested_law_if_other_terms_are_zero(law):
    simpler = law.nested_law
    qd, load = torch.linspace(-3, 3, 7, dtype=torch.float64), torch.ones(7, dtype=torch.float64)
    values = torch.tensor([0.3, 0.2], dtype=torch.float64)
    lifted = torch.tensor([0.0 if c.linear else 0.7 for c in law.coefficients], dtype=torch.float64)
    lifted[[law.names.index(name) for name in law.nested_coefficients]] = values
    torch.testing.assert_close(
        law.torque(qd, load, lifted.expand(7, -1), 0.1),
        simpler.torque(qd, load, values.expand(7, -1), 0.1),
    )


def test_description_of_wrong_type_is_refused() -> None:
    for wrong in (Coefficient("B", "N m"), ["B"], [Coefficient("B", "N m")]):
        with pytest.raises(TypeError, match="`coefficients` of law 'odd' must be a tuple of"):
            Law("odd", wrong, coulomb)  # type: ignore[arg-type]


@pytest.mark.parametrize("start", [-1.0, 0.0, float("nan"), float("inf")])
def test_initial_values_are_within_bounds(start: float) -> None:
    with pytest.raises(ValueError, match="`initial_grid` of 'v_s' must be positive and finite"):
        Coefficient("v_s", "rad/s", linear=False, initial_grid=(1.0, start))


def test_copies_of_a_model_share_its_law() -> None:
    """Fits copy their model in every search; a law is immutable."""
    model = LFM(1)
    again = copy.deepcopy(model)
    assert again.law is model.law
    assert again.schedule.raw is not model.schedule.raw


def test_a_law_needs_a_function() -> None:
    with pytest.raises(TypeError, match="`torque` of law 'odd' must be a function, got None"):
        Law("odd", (Coefficient("B", "N m"),), None)  # type: ignore[arg-type]
