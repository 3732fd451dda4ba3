"""Figures show the given numbers with units, and no text overlaps or is cut off."""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from PIL import Image

from nfriction import plots
from nfriction.evaluation.compare import NO_FRICTION, Comparison
from nfriction.evaluation.score import RMSE, Errors, Score
from nfriction.fitting.fit import fit
from nfriction.fitting.result.identifiability import CoefficientUncertainty
from nfriction.friction import model_names
from nfriction.friction.models import CVFM, LFM, NCFM, NLFM
from nfriction.friction.neurofuzzy import NFLFM, NFNCFM, NFNLFM
from nfriction.plant import LinearAxis, Motor, Rotor, rigs
from nfriction.plots import comparison as of_comparisons
from nfriction.plots import style
from nfriction.recording import Recording
from nfriction.signals import Motion

NAMES = (NO_FRICTION, "NCFM", "LFM", "NFLFM")


def swing(joints: int, unit: str = "rad", name: str = "swing") -> Recording:
    time = np.linspace(0.0, 2.0, 101)
    q = 0.3 * np.stack([np.cos((3 + j) * time) for j in range(joints)], -1)
    return Recording(time, q, unit=unit, name=name)


def score_of(
    recording: Recording, error: float, *, lost: bool = False, limited: bool = True
) -> Score:
    """A score whose free-run error grows; a diverged one ends in NaN at 1 s."""
    simulated = recording.q + error * np.linspace(0.0, 1.0, len(recording))[:, None]
    if lost:
        simulated[50:] = np.nan
    free_run = RMSE.of(simulated - recording.q)
    windows = {h: RMSE.of(s * (simulated - recording.q)) for h, s in (("1", 0.5), ("2", 0.8))}
    floor = RMSE.of(np.full((2, recording.joints), 1e-3))
    limit = Errors(floor, dict.fromkeys(windows, floor)) if limited else None
    end = 1.0 if lost else np.inf
    return Score(free_run, windows, limit, recording.name, recording.time, simulated, end)


def scores_of(
    recording: Recording, *, lost: Sequence[str] = (), limited: bool = True
) -> dict[str, Score]:
    return {
        name: score_of(recording, 0.1 * 4.0**-k, lost=name in lost, limited=limited)
        for k, name in enumerate(NAMES)
    }


def comparison_of(recording: Recording, *, part: str = "test", **options) -> Comparison:
    scores = {name: [s] for name, s in scores_of(recording, **options).items()}
    sides = ({}, scores) if part == "test" else (scores, {})
    return Comparison({}, *sides, unit=recording.unit, joint_names=recording.names)


def assert_tidy(figure: Figure) -> None:
    """Assert that axes with labels, titles and legends neither overlap nor exceed the figure."""
    figure.draw_without_rendering()
    boxes = [(ax, box) for ax in figure.axes if ax.get_visible() for box in parts(ax)]
    boxes += [(text, text.get_window_extent()) for text in (*figure.texts, *figure.legends)]
    # One pixel of tolerance; parts of one panel may touch.
    boxes = [(owner, box.padded(-1.0)) for owner, box in boxes]
    for _, box in boxes:
        assert box.x0 >= 0
        assert box.x1 <= figure.bbox.x1
        assert box.y0 >= 0
        assert box.y1 <= figure.bbox.y1
    pairs = itertools.combinations(boxes, 2)
    assert not any(a.overlaps(b) for (one, a), (other, b) in pairs if one is not other)


def parts(ax: Axes) -> list[Bbox]:
    found = [axis.get_tightbbox() for axis in (ax.xaxis, ax.yaxis)]
    found += [text.get_window_extent() for text in (ax.title, *ax.texts) if text.get_text()]
    return [ax.get_window_extent(), *(box for box in found if box is not None)]


def texts(ax: Axes) -> list[str]:
    return [t.get_text() for t in ax.texts]


@pytest.mark.parametrize(
    ("joints", "unit", "lost"), [(1, "rad", ()), (4, "rad", ("NCFM",)), (1, "m", NAMES)]
)
def test_positions_show_measurement_simulations_and_errors(joints, unit, lost):
    recording = swing(joints, unit)
    scores = scores_of(recording, lost=lost)
    figure = plots.positions(recording, scores)
    assert len(figure.axes) == 2 * joints
    for j, (above, below) in enumerate(zip(figure.axes[::2], figure.axes[1::2], strict=True)):
        assert above.get_ylabel() == f"joint{j + 1} [{unit}]"
        factor = {f"error [{unit}]": 1.0, f"error [m{unit}]": 1e3}[below.get_ylabel()]
        measured, *simulated = (line.get_ydata() for line in above.lines)
        np.testing.assert_array_equal(measured, recording.q[:, j])
        for shown, score in zip(simulated, scores.values(), strict=True):
            np.testing.assert_array_equal(shown, score.simulated[:, j])
        # Without friction, the error would leave the panel in every swing.
        drawn = [score for name, score in scores.items() if name != NO_FRICTION]
        for error, score in zip(below.lines, drawn, strict=True):
            expected = score.simulated[:, j] - recording.q[:, j]
            np.testing.assert_allclose(error.get_ydata() / factor, expected, rtol=1e-12)
    labels = [t.get_text() for t in figure.legends[0].get_texts()]
    assert sum("diverged at 1 s" in label for label in labels) == len(lost)
    assert_tidy(figure)


def test_motion_shows_the_requested_joints_in_the_measured_range():
    recording = swing(3)
    scores = {"no friction": score_of(recording, 1e3), "LFM": score_of(recording, 1e-3)}
    figure = plots.motion(recording, scores, joints=[2, 0])
    for ax, joint in zip(figure.axes, (2, 0), strict=True):
        assert ax.get_ylabel() == f"joint{joint + 1} [rad]"
        measured, *simulated = (line.get_ydata() for line in ax.lines)
        np.testing.assert_array_equal(measured, recording.q[:, joint])
        for shown, score in zip(simulated, scores.values(), strict=True):
            np.testing.assert_array_equal(shown, score.simulated[:, joint])
        assert max(np.abs(ax.get_ylim())) < 1
    assert_tidy(figure)
    assert_tidy(recording.plot())
    with pytest.raises(ValueError, match="the same recording"):
        plots.motion(swing(2), scores)


def test_comparison_draws_its_errors_by_horizon():
    figure = comparison_of(swing(1)).plot()
    assert figure.axes[0].get_xlabel() == "length of simulation"


def test_diverged_error_does_not_set_the_scale():
    recording = swing(1)
    scores = scores_of(recording) | {"LFM": score_of(recording, 1e9, lost=True)}
    assert max(plots.positions(recording, scores).axes[1].get_ylim()) < 200  # mrad


def test_positions_of_another_recording_are_refused():
    with pytest.raises(ValueError, match="the same recording"):
        plots.positions(swing(2), scores_of(swing(1)))
    with pytest.raises(ValueError, match="empty"):
        plots.positions(swing(1), {})


@pytest.mark.parametrize("unit", ["rad", "m"])
@pytest.mark.parametrize("spread", [2.0, 100.0])
def test_heights_of_bars_equal_the_errors(unit, spread):
    table = pd.DataFrame(
        [[1e-3, 2e-3], [1e-3 * spread, np.inf]], index=["LFM", "NCFM"], columns=["joint1", "all"]
    )
    figure = plots.rmse_bars(table, unit)
    ax = figure.axes[0]
    assert ax.get_ylabel() == f"position RMSE [m{unit}]"
    assert ax.get_yscale() == ("log" if spread > style.LOG_FROM else "linear")
    tops = [[p.get_y() + p.get_height() for p in bars] for bars in ax.containers]
    expected = np.minimum(1e3 * table.to_numpy(), ax.get_ylim()[1])
    np.testing.assert_allclose(tops, expected, rtol=1e-12)
    assert texts(ax).count("diverged") == 1
    assert_tidy(figure)


def test_bars_show_all_models_of_four_joints_and_diverged_runs():
    columns = ["arm", "joint2", "joint3", "joint4", "all"]
    many = pd.DataFrame(0.02, index=[NO_FRICTION, *model_names()], columns=columns)
    assert_tidy(plots.rmse_bars(many, "rad"))
    ax = plots.rmse_bars(many * np.inf, "rad").axes[0]
    assert texts(ax).count("diverged") == many.size
    with pytest.raises(ValueError, match="empty"):
        plots.rmse_bars(many.iloc[:0], "rad")


@pytest.mark.parametrize("part", ["test", "train"])
@pytest.mark.parametrize("unit", ["rad", "m"])
def test_horizon_curve_shows_each_horizon_relative_to_the_limit(part, unit):
    comparison = comparison_of(swing(2, unit), part=part)
    figure = plots.horizon_curve(comparison)
    ax = figure.axes[0]
    assert [t.get_text() for t in ax.get_xticklabels()] == ["1 s", "2 s", "free run"]
    assert ax.get_ylabel() == f"position RMSE [m{unit}]"
    for k, horizon in enumerate(("1", "2", None)):
        expected = 1e3 * comparison.table(horizon, part=part)["all"]
        shown = [line.get_ydata()[k] for line in ax.lines]
        np.testing.assert_allclose(shown, expected, rtol=1e-12)
    (band,) = ax.collections
    np.testing.assert_allclose(band.get_paths()[0].vertices[:, 1].max(), 1.0)  # 1e-3 rad in mrad
    assert_tidy(figure)


def test_horizon_curve_names_diverged_runs_and_omits_an_unknown_limit():
    figure = plots.horizon_curve(comparison_of(swing(1), lost=("NCFM",), limited=False))
    ax = figure.axes[0]
    assert set(texts(ax)) == {"diverged"}
    assert not ax.collections
    assert_tidy(figure)


def axis_data(law: NCFM | LFM | NLFM, mass: float = 2.0) -> tuple[LinearAxis, Recording, Motion]:
    """A carriage whose force is exactly that of its motion and of a friction law."""
    time = np.linspace(0.0, 3.0, 1501)
    sine, cosine = (f(4 * time)[:, None] for f in (np.sin, np.cos))
    q, qd, qdd = 0.2 * sine, 0.8 * cosine, -3.2 * sine
    velocity = torch.as_tensor(qd)
    with torch.no_grad():
        friction = law(velocity, torch.zeros_like(velocity), torch.ones_like(velocity)).numpy()
    recording = Recording(time, q, tau=mass * qdd + friction, unit="m", name="push/1 µ")
    return LinearAxis(mass), recording, Motion(time, q, qd, qdd)


def test_torque_points_lie_on_the_true_law():
    law = LFM(1, [3.0, 5.0])
    plant, recording, motion = axis_data(law)
    figure = plots.torque_over_velocity(plant, {"LFM": law}, [recording], [motion])
    (ax,) = figure.axes
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("joint velocity [m/s]", "friction force [N]")
    dots, line = ax.lines[0], ax.lines[-1]
    velocity = torch.as_tensor(line.get_xdata())[:, None]
    expected = law(velocity, 0 * velocity, torch.ones_like(velocity)).detach()[:, 0]
    np.testing.assert_allclose(line.get_ydata(), expected, rtol=1e-12)
    x, y = dots.get_data()
    clear = np.abs(x) > 0.05  # away from the sign's transition, in which a line has corners
    np.testing.assert_allclose(y[clear], np.interp(x, *line.get_data())[clear], rtol=1e-3)
    assert_tidy(figure)


def test_friction_that_follows_a_load_is_drawn_at_its_median():
    law = LFM(1, [3.0, 5.0])
    plant, recording, motion = axis_data(law)
    placed = plant.replace(load_waves=torch.tensor([2.0]).double())
    figure = plots.torque_over_velocity(
        plant, {"LFM": law}, [recording], [motion], plants={"LFM": placed}
    )
    x, y = figure.axes[0].lines[-1].get_data()
    fast = torch.as_tensor(x[-1:])[:, None]
    load = np.median(0.5 + 0.5 * np.cos(2.0 * motion.q))
    expected = law(fast, 0 * fast, torch.full_like(fast, load))
    assert y[-1] == pytest.approx(float(expected.detach()), rel=1e-6)


def test_medians_show_the_friction_despite_noise():
    law = CVFM(1, [3.0, 5.0])
    plant, recording, motion = axis_data(law)
    noise = np.random.default_rng(1).normal(0, 30.0, recording.tau.shape)
    noisy = recording._replace(tau=recording.tau + noise)
    (ax,) = plots.torque_over_velocity(plant, {"CVFM": law}, [noisy], [motion]).axes
    (bars,) = (c for c in ax.containers if isinstance(c, ErrorbarContainer))
    x, y = bars.lines[0].get_data()
    assert np.abs(y - np.interp(x, *ax.lines[-1].get_data())).mean() < 5.0
    assert np.ptp(ax.get_ylim()) < np.ptp(ax.lines[0].get_ydata())


def test_band_around_a_law_shows_its_parameter_uncertainty():
    law = CVFM(1, [3.0, 5.0])
    plant, recording, motion = axis_data(law)
    # Deviations of 0.1 N and 0.2 N s/m, independent of each other.
    known = CoefficientUncertainty(law.schedule, torch.diag(torch.tensor([0.1, 0.2]).double()))
    figure = plots.torque_over_velocity(
        plant, {"CVFM": law}, [recording], [motion], uncertainty={"CVFM": known}
    )
    (ax,) = figure.axes
    (band,) = (c for c in ax.collections if isinstance(c, PolyCollection))
    corners = band.get_paths()[0].vertices
    at = corners[np.isclose(corners[:, 0], corners[:, 0].max()), 1]
    v = float(corners[:, 0].max())
    assert np.ptp(at) / 2 == pytest.approx(1.96 * np.hypot(0.1, 0.2 * v), rel=1e-3)
    assert (at.min() + at.max()) / 2 == pytest.approx(3.0 + 5.0 * v, rel=1e-6)
    assert_tidy(figure)


def test_every_joint_has_a_torque_panel():
    plant = rigs.multiarm_triple()
    recording = swing(3)
    models = {"NCFM": NCFM(3), "NFLFM": NFLFM(3)}
    figure = plots.torque_over_velocity(plant, models, [recording])
    assert [ax.get_title() for ax in figure.axes] == list(plant.joint_names)
    assert all(ax.get_ylabel().startswith("friction torque [") for ax in figure.axes)
    assert_tidy(figure)


@pytest.mark.parametrize(("joints", "unit"), [(1, "m"), (4, "rad")])
def test_coefficient_maps_show_the_schedule_inside_the_data(joints, unit):
    model = NFLFM(joints)
    start = model.schedule.parameter_vector()
    noise = torch.randn(len(start), generator=torch.Generator().manual_seed(1), dtype=start.dtype)
    model.schedule.set_parameter_vector(start + 0.1 * noise)
    slow = np.linspace(0.0, 3.0, 400)[:, None].repeat(joints, 1)
    motion = Motion(slow[:, 0], slow, -slow, 0 * slow)
    figure = plots.coefficient_surfaces(model, [motion], unit=unit)
    maps = [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]
    bars = [ax for ax in figure.axes if ax.get_label() == "<colorbar>"]
    assert len(maps) == 2 * joints
    assert figure.get_supylabel() == f"acceleration along motion [{unit}/s²]"
    torque = "N m" if unit == "rad" else "N"
    assert bars[-1].get_ylabel() == f"$C$ [m{torque}]"
    for k, j in itertools.product(range(2), range(joints)):
        mesh = maps[j * 2 + k if joints > 2 else k].collections[0]
        grid = mesh.get_coordinates()
        qd, qdd = (torch.as_tensor(0.5 * (grid[1:, 1:, i] + grid[:-1, :-1, i])) for i in range(2))
        expected = model.schedule(
            qd[..., None].expand(-1, -1, joints), qdd[..., None].expand(-1, -1, joints)
        )[..., j, k].detach()
        shown = mesh.get_array()
        seen = ~np.ma.getmaskarray(shown)
        np.testing.assert_allclose(shown[seen], 1e3 * expected.numpy()[seen], rtol=1e-9)
        assert seen[qd < 3.0].any()
        assert not seen[(qd > 5.0) | (qdd.abs() > 30.0)].any()  # no data within a twentieth
    assert_tidy(figure)


def test_map_of_a_constant_coefficient_is_tidy():
    assert_tidy(plots.coefficient_surfaces(NFNCFM(1)))


@pytest.mark.slow
def test_maps_of_five_coefficients_of_four_joints_are_tidy():
    assert_tidy(plots.coefficient_surfaces(NFNLFM(4)))


@pytest.mark.parametrize("joints", [1, 4])
def test_memberships_are_gaussians_in_si(joints):
    before, after = NFNCFM(joints), NFNCFM(joints)
    after.schedule.set_range(torch.full((joints,), 8.0), torch.tensor([-50.0, 90.0]))
    figure = plots.memberships(after, before)
    centres, widths = (x.detach().numpy() for x in after.schedule.network.anfis.sets())
    for j, i in itertools.product(range(joints), range(2)):
        ax = figure.axes[2 * j + i]
        low, span = ((0.0, 8.0), (-50.0, 140.0))[i]
        assert len(ax.lines) == 10
        for term, line in enumerate(ax.lines[5:], 5 * i):
            x, y = line.get_data()
            middle, sigma = low + span * centres[j, term], span * widths[j, term]
            np.testing.assert_allclose(y, np.exp(-0.5 * ((x - middle) / sigma) ** 2), atol=1e-9)
    labels = [ax.get_xlabel() for ax in figure.axes[-2:]]
    assert labels == ["|velocity| [rad/s]", "acceleration along motion [rad/s²]"]
    assert_tidy(figure)


def test_only_neuro_fuzzy_models_have_sets_and_maps():
    for draw in (plots.memberships, plots.coefficient_surfaces):
        with pytest.raises(ValueError, match="LFM with a Constant schedule"):
            draw(LFM(2))
        with pytest.raises(ValueError, match="joint_names"):
            draw(NFLFM(2), joint_names=["one"])
    with pytest.raises(ValueError, match="before"):
        plots.memberships(NFLFM(2), NFLFM(2, terms=(3, 5)))


@given(st.floats(1e-6, 1e6), st.sampled_from(["rad", "m", "N m s/rad"]))
def test_unit_prefix_matches_the_factor(size, unit):
    factor, label = style.scaled(unit, [size, np.inf, np.nan])
    assert label.removesuffix(unit) == {1.0: "", 1e3: "m", 1e6: "µ"}[factor]
    assert factor == 1.0 or 0.2 <= factor * size <= 200.0 * (1 + 1e-12) or size < 2e-4


def rc_params() -> dict:
    # Reading the backend would itself select one.
    return {key: mpl.rcParams[key] for key in mpl.rcParams if key != "backend"}


def test_save_all_writes_every_figure_and_keeps_matplotlib_settings(tmp_path, monkeypatch):
    monkeypatch.setattr(of_comparisons, "DPI", 40)
    plant, recording, motion = axis_data(NCFM(1, [3.0]))
    unseen = swing(1, "m", name="unseen")
    found = fit(NCFM(1), plant, recording, method="equation_error", motions=[motion])
    network = NFNCFM(1)
    start = network.schedule.parameter_vector()
    noise = torch.randn(len(start), generator=torch.Generator().manual_seed(1), dtype=start.dtype)
    network.schedule.set_parameter_vector(start + 0.1 * noise)
    fits = {"NCFM": found, "NFNCFM": replace(found, model=network)}
    train, test = (
        {n: [score_of(r, 0.01)] for n in (NO_FRICTION, *fits)} for r in (recording, unseen)
    )
    before = rc_params()
    comparison = Comparison(fits, train, test, "m", plant.joint_names)
    files = plots.save_all(comparison, [recording, unseen], tmp_path / "figures")
    expected = {
        "rmse_train", "horizons_train", "positions_train_push_1_µ", "rmse_test",
        "horizons_test", "positions_test_unseen", "torque_over_velocity",
        "mechanism", "over_time_viscous",
        "coefficients_NFNCFM", "sections_NFNCFM", "memberships_NFNCFM",
    }  # fmt: skip
    assert {f.name for f in files} == {f"{n}.png" for n in expected}
    assert all(f.read_bytes().startswith(b"\x89PNG") for f in files)
    assert rc_params() == before
    assert (tmp_path / "figures" / "rmse_test.png").is_file()
    # A network with constant coefficients, like a rejected one, has nothing to show.
    rejected = replace(comparison, fits=fits | {"NFNCFM": replace(found, model=NFNCFM(1))})
    names = {f.name for f in plots.save_all(rejected, [recording], tmp_path / "fewer")}
    assert "torque_over_velocity.png" in names
    assert not any("NFNCFM" in name or "over_time" in name for name in names)
    law = replace(comparison, fits={}, test={})  # read from a file: scores only
    paper = plots.save_all(law, [], tmp_path / "paper", formats=("svg", "pdf"))
    assert {f.suffix for f in paper} == {".png", ".svg", ".pdf"}
    assert (tmp_path / "paper" / "rmse_train.pdf").read_bytes().startswith(b"%PDF")
    assert not any("test" in f.name or "positions" in f.name for f in paper)
    with pytest.raises(ValueError, match="not in the comparison"):
        plots.save_all(comparison, [swing(1, "m", name="other")], tmp_path)


def test_drawn_mass_centres_give_the_gravity_of_the_plant():
    plant = rigs.tlrip(arm="free")
    figure = plots.mechanism(plant)
    _, along, _ = figure.axes
    (line, *crosses) = along.lines
    corners = np.stack(line.get_data(), -1)
    np.testing.assert_allclose(np.hypot(*np.diff(corners, axis=0).T), plant.length, rtol=1e-12)
    angles = np.arctan2(-np.diff(corners[:, 0]), np.diff(corners[:, 1]))  # from upright
    pose = torch.as_tensor(np.diff(angles, prepend=0.0))
    weight = 9.81 * np.array(plant.to_dict()["mass"])
    levers = np.array([cross.get_xdata()[0] for cross in crosses])
    still = torch.cat([torch.zeros(1, dtype=pose.dtype), pose])
    gravity = plant.bias(still, torch.zeros_like(still))
    np.testing.assert_allclose(weight @ levers, gravity[1], rtol=1e-9)
    assert_tidy(figure)


@pytest.mark.parametrize("plant", [Rotor(0.02), Rotor(0.1, 0.5, 0.3), LinearAxis(2.0)])
def test_every_kind_of_rig_is_drawn_with_its_data(plant):
    figure = plots.mechanism(plant)
    words = "\n".join(text.get_text() for text in figure.axes[-1].texts)
    given = plant.to_dict()
    assert all(f"{given[key]:g}" in words for key in ("inertia", "mass", "com") if given.get(key))
    assert_tidy(figure)


def test_animation_has_a_frame_every_40_ms_and_the_requested_end(tmp_path):
    time = np.arange(200) * 0.01
    q = np.sin(3 * time)[:, None] * [0.5, -0.3]
    lost = np.where(time[:, None] > 1.0, np.nan, q)
    plant = rigs.of("multiarm-double")
    path = plots.animate(
        plant, time, {"measured": q, "NCFM": lost}, tmp_path / "a.gif", seconds=0.4
    )
    with Image.open(path) as gif:
        assert (gif.n_frames, gif.info["duration"]) == (10, 40)


def test_models_are_distinguished_by_marker_and_dashes():
    looks = [style.looks(model_names())[name] for name in model_names()]
    assert len({(look.line["color"], look.marker["marker"]) for look in looks}) == len(
        model_names()
    )
    assert len({(look.line["color"], str(look.line["linestyle"])) for look in looks}) == len(
        model_names()
    )


def test_dashes_leave_equal_curves_visible_in_any_order():
    looks = style.looks(["CVFM", "NFCVFM", "LFM", "NFLFM", "NLFM", "NFNLFM"])
    whole = [x.line["zorder"] for x in looks.values() if x.line["linestyle"] == "-"]
    assert len(whole) == 2
    dashed = [look.line["zorder"] for name, look in looks.items() if name in ("NFCVFM", "NFNLFM")]
    assert max(whole) < min(dashed)
    # It is behind all models and fades out.
    assert looks["no friction"].line["zorder"] < min(dashed)


def test_motor_is_drawn_with_its_data_and_without_a_frame():
    figure = plots.mechanism(Rotor(0.02, motor=Motor(50, 1.2e-5, 0.03), name="wheel"))
    wheel, words = figure.axes
    assert not wheel.axison
    (text,) = words.texts
    for line in ("wheel", "gear ratio 50", "rotor inertia 1.2e-05 kg m²", "N m/A"):
        assert line in text.get_text()


def test_legends_show_paper_names_and_plain_names():
    figure = comparison_of(swing(1)).plot()
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert {"no friction", "viscous (NCFM)", "neuro-fuzzy:load-coulomb (NFLFM)"} < set(labels)
