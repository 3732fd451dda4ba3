"""Intervals have their stated coverage, and unidentifiable parameters are named."""

import math

import pytest
import torch

from nfriction.fitting.result.identifiability import (
    Information,
    Interval,
    confidence_intervals,
    exceeds_drive_torque,
    information,
    model_error_warning,
    null_directions,
    standard_deviations,
    warnings_of,
    weakly_identified,
)
from nfriction.friction.laws import STRIBECK

F64 = torch.float64
NAMES = ("a", "b", "c")


def regression(samples=200, parameters=3):
    g = torch.Generator().manual_seed(3)
    return torch.randn(samples, parameters, generator=g, dtype=F64), g


def test_truncation_by_a_bound_does_not_reduce_the_uncertainty():
    assert Interval("b", 0.1, 0.0, 0.1 + 1.959964 * 0.3).sd == pytest.approx(0.3)
    assert Interval("b", -0.1, -0.1 - 1.959964 * 0.3, 0.0).sd == pytest.approx(0.3)


def test_intervals_of_a_linear_fit_have_their_stated_coverage():
    design, g = regression()
    truth, noise = torch.tensor([1.0, -2.0, 0.5], dtype=F64), 0.3
    known = information(design.T @ design / noise**2, torch.zeros(3, dtype=F64), 3)
    sd, free = standard_deviations(known), torch.full((3,), torch.inf, dtype=F64)
    hits = []
    for _ in range(400):
        y = design @ truth + noise * torch.randn(len(design), generator=g, dtype=F64)
        found = torch.linalg.lstsq(design, y[:, None]).solution[:, 0]
        intervals = confidence_intervals(NAMES, found, sd, -free, free)
        hits += [i.low <= t <= i.high for i, t in zip(intervals, truth.tolist(), strict=True)]
    # 1200 trials of 95 %: a standard deviation is 0.6 %.
    assert sum(hits) / len(hits) == pytest.approx(0.95, abs=0.02)


def test_eliminating_window_states_marginalises_them():
    design, _ = regression(parameters=5)
    precision = torch.tensor([0.0, 2.0, 0.0, 1.0, 3.0], dtype=F64)
    hessian = design.T @ design / 0.7**2 + torch.diag(precision)
    found = standard_deviations(information(hessian, precision, 3))
    torch.testing.assert_close(found, torch.linalg.inv(hessian).diagonal()[:3].sqrt())


def test_diverged_windows_determine_nothing():
    """Their states are collinear to the last digit, and no solver separates them."""
    growth = torch.tensor([1e15, 1.0, 1.0, 3.0], dtype=F64)
    state = growth.outer(growth)
    hessian = torch.block_diag(torch.eye(3, dtype=F64), state)
    across = torch.linspace(1.0, 2.0, 12, dtype=F64).reshape(3, 4) * growth
    hessian[:3, 3:], hessian[3:, :3] = across, across.T
    for score in (None, hessian):
        known = information(hessian, torch.ones(7, dtype=F64), 3, score)
        assert torch.isinf(standard_deviations(known)).all()
        assert null_directions(NAMES, known) == NAMES


def test_score_covariance_equal_to_the_curvature_changes_nothing():
    design, _ = regression(parameters=5)
    precision = torch.tensor([0.0, 2.0, 0.0, 1.0, 3.0], dtype=F64)
    data = design.T @ design / 0.25
    hessian = data + torch.diag(precision)
    plain = information(hessian, precision, 3)
    same = information(hessian, precision, 3, data)
    torch.testing.assert_close(standard_deviations(same), standard_deviations(plain))
    # Doubled errors double the intervals, whether entered by the score or by all residuals.
    wide = information(design.T @ design, 0 * precision, 3)
    score = information(data, 0 * precision, 3, 4 * data)
    torch.testing.assert_close(standard_deviations(score), standard_deviations(wide))


def test_intervals_cover_with_heteroscedastic_residuals():
    """Half the samples have ten times the error and more leverage: only their share must widen."""
    design, g = regression()
    design[:100] *= 3
    sizes = torch.cat([torch.full((100,), 1.0), torch.full((100,), 0.1)]).to(F64)
    hessian, zero = design.T @ design, torch.zeros(3, dtype=F64)
    score = design.T @ (sizes[:, None] ** 2 * design)
    pooled = float(sizes.square().mean().sqrt())
    free = torch.full((3,), torch.inf, dtype=F64)
    hits: dict[str, list[bool]] = {"sandwich": [], "pooled": []}
    sd = {
        "sandwich": standard_deviations(information(hessian, zero, 3, score)),
        "pooled": standard_deviations(information(hessian / pooled**2, zero, 3)),
    }
    for _ in range(400):
        y = sizes * torch.randn(len(design), generator=g, dtype=F64)
        found = torch.linalg.lstsq(design, y[:, None]).solution[:, 0]
        for name, spread in sd.items():
            intervals = confidence_intervals(NAMES, found, spread, -free, free)
            hits[name] += [i.low <= 0 <= i.high for i in intervals]
    covered = {name: sum(hit) / len(hit) for name, hit in hits.items()}
    # 1200 trials of 95 %: a standard deviation is 0.6 %.
    assert covered["sandwich"] == pytest.approx(0.95, abs=0.02)
    assert covered["pooled"] < 0.9


def test_intervals_scale_with_units():
    design, _ = regression()
    units = torch.tensor([1e-6, 1.0, 1e5], dtype=F64)
    zero = torch.zeros(3, dtype=F64)
    scaled = design * units
    one = standard_deviations(Information(design.T @ design, zero))
    other = standard_deviations(Information(scaled.T @ scaled, zero))
    torch.testing.assert_close(other * units, one)


def test_singular_direction_and_insensitive_parameter_are_named():
    design, _ = regression()
    design[:, 1] = 2.0 * design[:, 0]
    known = Information(design.T @ design, torch.zeros(3, dtype=F64))
    (direction,) = null_directions(NAMES, known)
    assert set(direction.split(" with ")) == {"a", "b"}
    assert torch.isinf(standard_deviations(known)).tolist() == [True, True, False]
    design[:, 1] = 0.0
    # Nor does a score of round-off in that direction make it identifiable.
    nearly = known.data + 1e-12 * torch.eye(3, dtype=F64)
    for score in (None, 4 * known.data, torch.zeros(3, 3, dtype=F64)):
        sd = standard_deviations(Information(nearly, known.prior, score))
        assert sd[:2].min() > 1e4
    blind = Information(design.T @ design, torch.tensor([0.0, 1.0, 0.0], dtype=F64))
    assert null_directions(NAMES, blind) == ("b",)
    # Its prior still applies.
    assert float(standard_deviations(blind)[1]) == pytest.approx(1.0)


def test_value_is_open_only_if_others_compensate_for_it():
    design, _ = regression()
    design[:, 1] = design[:, 0] + 0.01 * design[:, 1]
    known = Information(design.T @ design, torch.zeros(3, dtype=F64))
    assert null_directions(NAMES, known) == ()
    sd = standard_deviations(known)
    assert weakly_identified(NAMES, 1.5 * sd, known) == ("a", "b")
    assert weakly_identified(NAMES[:2], 3.0 * sd[:2], known) == ()
    # One that is determined by itself is just small.
    assert weakly_identified(NAMES, torch.tensor([1e3, 1e3, 0.0], dtype=F64), known) == ()


def test_coefficient_is_open_if_its_interval_exceeds_the_drive_torque():
    sd, slope = torch.tensor([1.0, 1.0, 1e-3], dtype=F64), torch.tensor([1.0, -1.0, 1.0], dtype=F64)
    need = torch.tensor([2.0, 1.9, 0.1], dtype=F64)
    # However near to zero the values are.
    assert exceeds_drive_torque(NAMES, sd, slope, need) == ("b",)
    assert exceeds_drive_torque(NAMES, torch.full_like(sd, torch.inf), slope, need) == NAMES


def test_well_conditioned_problem_has_no_null_directions():
    design, _ = regression()
    assert null_directions(NAMES, Information(design.T @ design, torch.zeros(3, dtype=F64))) == ()


def test_intervals_end_at_the_bounds():
    value, sd = torch.tensor([0.1], dtype=F64), torch.tensor([1.0], dtype=F64)
    (interval,) = confidence_intervals(("c",), value, sd, torch.zeros(1), torch.full((1,), 0.5))
    assert (interval.low, interval.high) == (0.0, 0.5)


def test_warnings_appear_only_for_problems_and_name_them():
    good = {"converged": True, "at_bounds": (), "unidentifiable": ()}
    assert warnings_of(**good) == ()
    bad = warnings_of(
        converged=False, at_bounds=["B of joint1"], unidentifiable=["drag reach", "F_c with F_d"]
    )
    assert len(bad) == 3
    assert "B of joint1" in bad[1]
    assert bad[2].endswith("drag reach; F_c and F_d (only their combination).")
    assert model_error_warning(9e-4, 3e-4, 3e-4, "rad") == ()
    (model_error,) = model_error_warning(3e-3, 3e-4, 3e-4, "rad")
    assert "3 mrad RMS, 10x the measurement noise" in model_error
    none, beyond = warnings_of(**good | {"at_bounds": ["B", "v_s", "C"]}, at_zero=["B", "C"])
    assert none == "At zero: B, C; the data show no such effect."
    assert beyond == "At a bound: v_s; the data favour values beyond it."
    (warning,) = warnings_of(
        **good | {"at_bounds": ["B"], "unidentifiable": ["B of joint1"]}, at_zero=["B"]
    )
    assert "Not identifiable" in warning


def test_intervals_of_scales_are_multiplicative():
    """A Stribeck velocity may be half or twice the estimate, but not negative."""
    names = ("F_c of joint1", "v_s of joint1")
    value, sd = torch.tensor([0.3, 0.1], dtype=F64), torch.tensor([0.01, 0.05], dtype=F64)
    free = torch.full((2,), torch.inf, dtype=F64)
    linear, scale = confidence_intervals(names, value, sd, -free, free, STRIBECK)
    assert linear.high - linear.value == pytest.approx(linear.value - linear.low)
    assert scale.high / scale.value == pytest.approx(scale.value / scale.low)
    assert scale.high / scale.value == pytest.approx(math.exp(1.96 * 0.5), rel=1e-4)
