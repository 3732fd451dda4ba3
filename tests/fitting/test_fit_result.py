"""Output of a result: text, table, notebook, figure."""

from dataclasses import replace

import pytest
import torch

from nfriction import FrictionModel, LinearAxis
from nfriction.fitting.fit import fit
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.identifiability import Interval
from nfriction.fitting.result.of_search import _one_way
from nfriction.friction import laws
from nfriction.friction.coefficients import Constant
from nfriction.friction.models import CVFM, LFM, NCFM, Stribeck
from nfriction.friction.neurofuzzy import NFCVFM, NFLFM
from nfriction.papers.afem.adaptive import ALFM
from tests.fitting.recordings import driven_axis, pendulum, swing

AXIS = LinearAxis(2.0)


@pytest.fixture(scope="module")
def found() -> FitResult:
    recording = driven_axis(AXIS, LFM(1, [2.0, 1.5], v_smooth=0.01))
    return fit(LFM(1, v_smooth=0.01), AXIS, recording, method="equation_error", fit_plant=False)


def test_the_table_has_every_coefficient_with_its_interval(found: FitResult) -> None:
    table = found.to_pandas()
    joint = AXIS.joint_names[0]
    assert list(table.index) == [f"B of {joint}", f"C of {joint}"]
    for interval in found.intervals:
        row = table.loc[interval.name]
        assert tuple(row[["value", "low", "high"]]) == (
            interval.value, interval.low, interval.high
        )  # fmt: skip
    assert not table["note"].any()


def test_table_marks_active_bounds_and_unidentifiable_values(found: FitResult) -> None:
    b, c = found.to_pandas().index
    assert list(replace(found, at_bounds=(b,)).to_pandas()["note"]) == ["at a bound", ""]
    unknown = replace(found, at_bounds=(b,), unidentifiable=(f"{b} with {c}",))
    assert list(unknown.to_pandas()["note"]) == ["not identifiable"] * 2


def test_too_few_integration_steps_are_reported_once() -> None:
    rig, truth = pendulum(), CVFM(2, [[5e-3, 1e-3], [2e-3, 5e-4]], v_smooth=0.05)
    recording = swing(rig, truth.requires_grad_(False), seconds=2.0)
    result = fit(CVFM(2, v_smooth=1e-5), rig, recording, windows=(0.5,), max_steps=1)
    (warning,) = (text for text in result.warnings if text.startswith("Near rest a sample needs"))
    assert "fits take 8" in warning


def test_table_marks_fixed_coefficients(found: FitResult) -> None:
    table = replace(found, model=Stribeck(found.plant.joints), intervals=()).to_pandas()
    assert set(table["note"][["delta" in name for name in table.index]]) == {"not fitted"}
    assert not table["note"][["delta" not in name for name in table.index]].any()


def test_collinear_plant_terms_do_not_make_a_fit_doubtful(found: FitResult) -> None:
    b = found.intervals[0].name
    good = replace(found, noise=found.residual, converged=True)
    for unknown, verdict in (
        ("inertia 11 with armature 1", "good"),
        (f"{b} with drag", "doubtful"),
    ):
        assert replace(good, unidentifiable=(unknown,)).usability[0] == verdict


def test_coefficients_without_an_interval_show_their_value(found: FitResult) -> None:
    table = replace(found, model=Stribeck(1), intervals=()).to_pandas()
    assert table.index[-1].startswith("delta of ")
    assert table["value"].iloc[-1] == 2.0
    assert table["low"].isna().all()


@pytest.mark.parametrize("kind", [NFLFM, ALFM])
def test_motion_dependent_coefficients_name_their_reference_motion(
    found: FitResult, kind: type
) -> None:
    model = kind(1, [2.0, 1.5])
    result = replace(found, model=model, intervals=(), uncertainty=None)
    assert not any(", " in name for name in result.to_pandas().index)
    vector = model.schedule.parameter_vector()
    model.schedule.set_parameter_vector(vector + 0.1 * torch.arange(len(vector)))
    table = result.to_pandas()
    assert all(", " in name for name in table.index)
    assert set(
        model.schedule.coefficient_sets()["at_rest" if kind is NFLFM else "low"].flatten().tolist()
    ) < set(table["value"])
    assert result.plot().axes


def test_decrease_by_heat_has_the_interval_of_the_constant_fit(
    found: FitResult,
) -> None:
    model, joint = NFCVFM(1, [2.0, 1.5, 0.3, 0.0], inputs=["heat"]), AXIS.joint_names[0]
    vector = model.schedule.parameter_vector()
    model.schedule.set_parameter_vector(vector + 0.1 * torch.arange(len(vector)))
    fall = Interval(f"k_h of {joint}", 0.3, 0.2, 0.4)
    table = replace(found, model=model, intervals=(fall,), uncertainty=None).to_pandas()
    assert [name for name in table.index if "k_h" in name] == [fall.name]
    assert list(table.loc[fall.name]) == [0.3, 0.2, 0.4, "fitted with the constant law"]


def test_a_summary_names_model_status_numbers_and_warnings(found: FitResult) -> None:
    summary = replace(found, warnings=("Too short: 1 < 2.",)).summary()
    assert summary.startswith("load-coulomb (LFM): good. Converged")
    assert " mN RMS" in summary
    assert f"{found.intervals[0].value:.4g}" in summary
    assert summary.endswith("- Too short: 1 < 2.")
    assert all(line == line.rstrip() for line in summary.splitlines())


def test_a_result_is_printed_in_two_lines(found: FitResult) -> None:
    head, warned = repr(replace(found, warnings=("Too short: 1 < 2.",))).splitlines()
    assert head.startswith("FitResult of load-coulomb (LFM): good. Converged")
    assert warned == "Warnings: 1; see `summary()`."
    assert str(found) == repr(found)


def test_a_notebook_shows_the_same_with_text_escaped(found: FitResult) -> None:
    page = replace(found, warnings=("Too short: 1 < 2.",))._repr_html_()
    assert "load-coulomb (LFM): good" in page
    assert "<table" in page
    assert "<li>Too short: 1 &lt; 2.</li>" in page


def test_user_defined_law_has_a_summary_too(found: FitResult) -> None:
    own = replace(laws.VISCOUS, name="grease")
    summary = replace(found, model=FrictionModel(own, Constant(own, 1)), intervals=()).summary()
    assert summary.startswith("FrictionModel: good")


def test_constants_are_drawn_with_their_intervals(found: FitResult) -> None:
    assert len(found.plot().axes) == 2
    assert replace(found, model=NCFM(1, [2.0]), intervals=()).plot().axes


def test_residual_larger_than_the_motion_is_doubtful(found: FitResult) -> None:
    motions = tuple(replace(m, q=0.0 * m.q) for m in found.motions)
    for noise in (0.0, 1e-9):
        verdict, reason = replace(found, motions=motions, noise=noise, residual=1e-3).usability
        assert verdict == "doubtful"
        assert "the residual is larger than the motion" in reason


def test_remedy_of_a_constant_torque_has_no_minus_sign() -> None:
    for value, remedy in ((0.1, "subtract 0.1 N from a command"), (-0.1, "add 0.1 N to a command")):
        assert remedy in _one_way(
            LinearAxis(1.0), 0, constant=True, value=value, largest=torch.ones(1)
        )
