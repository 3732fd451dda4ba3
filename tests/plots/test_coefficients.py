"""Figures of coefficients show the models' own values and the intervals of the fit."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from nfriction import ALFM, LFM, NCFM, NFCVFM, NFLFM, Recording, fit, plots, rigs
from nfriction.fitting.result.identifiability import Interval
from nfriction.friction.models import FrictionModel
from nfriction.signals import Motion


@pytest.fixture(scope="module")
def motion() -> Motion:
    time = np.linspace(0.0, 2.0, 401)
    q, qd, qdd = (np.stack([a * f(3 * time) for a in (1.0, 2.0)], -1) for f in
                  (np.sin, lambda t: 3 * np.cos(t), lambda t: -9 * np.sin(t)))  # fmt: skip
    return Motion(time, q, qd, qdd)


def varying(model: FrictionModel) -> FrictionModel:
    """The same with other parameters, whose coefficients depend on the motion."""
    start = model.schedule.parameter_vector()
    model.schedule.set_parameter_vector(start + 0.2 * torch.sin(torch.arange(1.0, len(start) + 1)))
    return model


def test_lines_show_the_coefficients_along_the_motion(motion):
    models = {"LFM": LFM(2, [2e-3, 1e-2]), "NFLFM": varying(NFLFM(2, [1e-3, 2e-2]))}
    figure = plots.coefficients_over_time(models, motion, joint_names=["a", "b"])
    assert len(figure.axes) == 4
    qd, qdd = torch.tensor(motion.qd), torch.tensor(motion.qdd)
    for k, j in np.ndindex(2, 2):
        ax = figure.axes[2 * k + j]
        factor = 1e3 if "[m" in ax.get_ylabel() else 1.0
        for line, model in zip(ax.lines, models.values(), strict=True):
            expected = model.coefficients(qd, qdd).detach().expand(len(qd), -1, -1)[:, j, k]
            np.testing.assert_allclose(line.get_ydata() / factor, expected, rtol=1e-9)
    figure.draw_without_rendering()


def test_models_of_one_law_keep_their_colours_in_every_figure(motion):
    models = {"NCFM": NCFM(2), "LFM": LFM(2), "NFLFM": varying(NFLFM(2))}
    figure = plots.coefficients_over_time(models, motion, law=models["LFM"].law.name)
    looks = plots.style.looks(models)
    expected = [looks[name].line["color"] for name in ("LFM", "NFLFM")]
    lines = figure.axes[0].lines
    assert [line.get_color() for line in lines] == expected
    assert lines[1].get_linestyle() == "-"  # a network's, which may be steep


def test_constant_coefficients_are_printed_instead_of_drawn(motion):
    model = NFCVFM(2, [[8e-3, 2e-3], [5e-3, 0.3]], inputs=["heat"])
    model.schedule.set_heat([2e-3, 4e-3], 60.0, 5e-3)
    figure = plots.coefficients_over_time({"NFCVFM": model}, motion)
    first, second = figure.axes
    assert first.get_ylabel() == "$h$ [-]"
    constants = "constant:\n$F_\\mathrm{c}$ = %s\n$F_\\mathrm{v}$ = %s\n$k_\\mathrm{h}$ = 0"
    assert first.get_title() == "joint1\n" + constants % ("8 mN m", "2 mN m s/rad")
    assert second.get_title() == "joint2\n" + constants % ("5 mN m", "0.3 N m s/rad")
    figure.draw_without_rendering()


def test_figure_of_constants_only_shows_their_values(motion):
    models = {"LFM": LFM(2, [2e-3, 1e-2]), "NFLFM": NFLFM(2, [1e-3, 1e-2])}
    figure = plots.coefficients_over_time(models, motion)
    assert not any(ax.lines or ax.axison for ax in figure.axes)
    constants = "constant:\n$B$ = 2 / 1 mN m s/rad\n$C$ = 10 mN m"
    assert [ax.get_title() for ax in figure.axes] == [f"joint{k}\n{constants}" for k in (1, 2)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # such as of a layout without room for its text
        figure.draw_without_rendering()
        plots.coefficients_over_time({"NCFM": NCFM(2)}, motion).draw_without_rendering()


def test_adaptive_model_switches_as_in_a_controller(motion):
    values = [[1e-3, 1e-2], [2e-3, 2e-2], [3e-3, 3e-2]]
    model = ALFM(2, [values, values])
    qd, qdd = torch.tensor(motion.qd), torch.tensor(motion.qdd)
    model.schedule.thresholds[:] = torch.tensor([2.0, 6.0])  # the motion begins without any
    figure = plots.coefficients_over_time({"ALFM": model}, motion)
    memory, expected = model.schedule.initial_state(qd[0], qdd[0]), []
    for k, (v, a) in enumerate(zip(qd, qdd, strict=True)):
        memory = memory if k == 0 else model.schedule.advance(v, a, memory)
        expected.append(model.coefficients_from(v, a, memory)[:, 0].detach())
    shown = np.stack([ax.lines[0].get_ydata() for ax in figure.axes[:2]], -1)
    np.testing.assert_allclose(1e-3 * shown, torch.stack(expected), rtol=1e-12)
    assert all(len(np.unique(shown[:, j])) > 1 for j in range(2))


def test_intervals_are_those_of_the_fit():
    plant = rigs.multiarm_single()
    time = np.linspace(0, 1, 501)
    recording = Recording(time, np.sin(5 * time)[:, None], convention="relative,hanging")
    found = fit(NCFM(1), plant, recording, method="equation_error")
    value = float(found.model.schedule.values)
    (joint,) = plant.joint_names
    interval = Interval(f"C_p of {joint}", value, 0.5 * value, 2 * value)
    figure = plots.coefficient_intervals({"known": replace(found, intervals=(interval,)),
                                          "unknown": replace(found, intervals=())})  # fmt: skip
    (ax,) = figure.axes
    (low, high), (edge, other) = (
        bars[0].get_segments()[0][:, 1] for _, _, bars in (c.lines for c in ax.containers)
    )
    assert high / low == pytest.approx(4.0)
    assert (edge, other) == pytest.approx(ax.get_ylim())
    figure.draw_without_rendering()


def test_models_that_cannot_be_compared_are_refused(motion):
    with pytest.raises(ValueError, match="one law"):
        plots.coefficients_over_time({"LFM": LFM(2), "NCFM": NCFM(2)}, motion)
    with pytest.raises(ValueError, match="one law"):
        plots.coefficient_intervals({})
