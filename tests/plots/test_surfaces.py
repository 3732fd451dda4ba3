"""Maps and sections show the uncertainty of a fit, and fade outside the data."""

import numpy as np
import pytest
import torch
from matplotlib.collections import LineCollection, QuadMesh

from nfriction import LFM, NFLFM, NFStribeck, plots
from nfriction.fitting.result.identifiability import CoefficientUncertainty
from nfriction.signals import Motion

F64 = torch.float64


@pytest.fixture
def known():
    """A model of two joints whose parameters have a random covariance."""
    torch.manual_seed(0)
    model = NFLFM(2, [2e-3, 1e-2])
    root = 0.02 * torch.randn(len(model.schedule.parameter_vector()), 6, dtype=F64)
    return model, CoefficientUncertainty(model.schedule, root)


def slow_motion() -> Motion:
    """Both joints up to only 3 rad/s, a seventh of the range, without acceleration."""
    qd = np.linspace(0.0, 3.0, 400)[:, None].repeat(2, 1)
    return Motion(qd[:, 0], qd, qd, 0 * qd)


def mesh_of(ax) -> QuadMesh:
    (mesh,) = (c for c in ax.collections if isinstance(c, QuadMesh))
    return mesh


@pytest.mark.slow
def test_maps_fade_with_uncertainty(known):
    model, uncertainty = known
    figure = plots.coefficient_surfaces(model, uncertainty=uncertainty)
    maps = [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]
    for j, k in np.ndindex(2, 2):
        mesh = mesh_of(maps[k * 2 + j])
        grid = mesh.get_coordinates()
        middle = torch.as_tensor(0.5 * (grid[1:, 1:] + grid[:-1, :-1]))[..., None, :]
        qd, qdd = middle.expand(-1, -1, 2, -1).unbind(-1)
        sd = uncertainty.sd(qd, qdd)[..., j, k].ravel()
        order = np.argsort(sd.numpy())
        assert (np.diff(mesh.get_alpha().ravel()[order]) <= 1e-12).all()
    sure = CoefficientUncertainty(model.schedule, torch.zeros_like(uncertainty.root))
    plain = plots.coefficient_surfaces(model, uncertainty=sure)
    assert (mesh_of(plain.axes[0]).get_alpha() == 1.0).all()


def test_unknown_coefficients_can_be_drawn(known):
    model, uncertainty = known
    lost = CoefficientUncertainty(model.schedule, torch.full_like(uncertainty.root, torch.inf))
    for draw in (plots.coefficient_surfaces, plots.coefficient_sections):
        figure = draw(model, [slow_motion()], uncertainty=lost)
        figure.draw_without_rendering()
        meshes = [c for ax in figure.axes for c in ax.collections if isinstance(c, QuadMesh)]
        # Nothing is shown as if it were known; a colour bar is a mesh without transparency.
        shown = [mesh.get_alpha() for mesh in meshes if mesh.get_alpha() is not None]
        assert len(shown) == (4 if draw is plots.coefficient_surfaces else 0)
        assert all(np.max(alpha) < 0.5 for alpha in shown)


def test_sections_show_the_coefficients_with_their_intervals(known):
    model, uncertainty = known
    figure = plots.coefficient_sections(model, uncertainty=uncertainty, joint_names=["a", "b"])
    for j, k in np.ndindex(2, 2):
        ax = figure.axes[2 * j + k]
        factor = 1e3 if "[m" in ax.get_ylabel() else 1.0
        lines = [line for line in ax.lines if len(line.get_xdata()) == 60]
        for line, acceleration in zip(lines, (-100.0, 0.0, 100.0), strict=True):
            qd = torch.tensor(line.get_xdata())[:, None].expand(-1, 2)
            value = model.schedule(qd, torch.full_like(qd, acceleration)).detach()[:, j, k]
            np.testing.assert_allclose(line.get_ydata() / factor, value, rtol=1e-9)
        bars = [c for c in ax.collections if isinstance(c, LineCollection)]
        for bar, acceleration in zip(bars, (-100.0, 0.0, 100.0), strict=True):
            ends = np.array(bar.get_segments())
            qd = torch.tensor(ends[:, 0, 0])[:, None].expand(-1, 2)
            sd = uncertainty.sd(qd, torch.full_like(qd, acceleration))[:, j, k]
            half = 0.5 * (ends[:, 1, 1] - ends[:, 0, 1]) / factor
            np.testing.assert_allclose(half, 1.959964 * sd, rtol=1e-6)
    assert figure.axes[0].get_title() == "a, at −100, 0, 100 rad/s²"
    assert [t.get_text() for t in figure.legends[0].get_texts()] == [
        "braking", "steady", "speeding up"]  # fmt: skip
    figure.draw_without_rendering()


def test_sections_are_faint_outside_the_data(known):
    model, _ = known
    ax = plots.coefficient_sections(model, [slow_motion()]).axes[0]
    steady = [line for line in ax.lines if line.get_color() == ax.lines[2].get_color()]
    solid = next(line for line in steady if np.isfinite(line.get_ydata()).any())
    shown = solid.get_xdata()[np.isfinite(solid.get_ydata())]
    assert 2.5 < shown.max() < 5.0  # no data beyond a twentieth of the range
    braking = ax.lines[0]
    assert not np.isfinite(braking.get_ydata()).any()


def test_only_neuro_fuzzy_models_have_sections():
    with pytest.raises(ValueError, match="neuro-fuzzy"):
        plots.coefficient_sections(LFM(2))


@pytest.mark.parametrize("draw", [plots.coefficient_surfaces, plots.coefficient_sections])
def test_fixed_coefficient_is_not_drawn(draw):
    """It is the same everywhere: the exponent of the Stribeck law."""
    model = NFStribeck(1, terms=(2, 2), head_units=2)
    model.schedule.set_range(5.0, [-100.0, 100.0])
    figure = draw(model)
    labels = [f"{ax.get_ylabel()} {ax.get_title()}" for ax in figure.axes]
    symbols = {word for text in labels for word in text.split() if word.startswith("$")}
    assert len(symbols) == 4
    assert not any("delta" in symbol for symbol in symbols)
