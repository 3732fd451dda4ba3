"""The papers' figures from the results of a reproduction."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from tqdm import tqdm

from nfriction.evaluation.score import RMSE, Score
from nfriction.io.files import atomic_write
from nfriction.io.model_file import load
from nfriction.papers.control.study import SAMPLE_TIME, SHARED, THINNED, balance_figure
from nfriction.papers.controller.mamdani import paper_controller
from nfriction.papers.controller.rules import Variable
from nfriction.papers.nffem.rbf_coefficients import RBFCoefficients
from nfriction.papers.reproduction import tables
from nfriction.papers.reproduction.agreement import simulations
from nfriction.papers.reproduction.stages import (
    ADAPTIVE,
    EXPERIMENT,
    LAWS,
    NEURO_FUZZY,
    SECOND_PAPER,
)
from nfriction.papers.reproduction.workspace import Array, Workspace
from nfriction.plant import PendulumChain, rigs
from nfriction.plots import (
    animate,
    coefficients_over_time,
    controller_surface,
    positions,
    rmse_bars,
    style,
    torque_over_velocity,
)
from nfriction.plots.neurofuzzy import draw_map
from nfriction.recording import Recording
from nfriction.recording.angles import AngleConvention
from nfriction.signals import Motion
from nfriction.simulation.rollout import rollout

DPI = 150
SHOWN, SECOND_SHOWN = "test_hanging", "test_bent"
"""Held-out recordings that the figures show: the poses of the papers' own model checks."""
SECOND_SECONDS = 10.0  # as the RTIP paper shows
INERTIA_SECONDS = 3.0
"""Beyond this a frictionless swing from upright shows rounding rather than inertia."""
WITHOUT_FRICTION_SECONDS = 6.0
"""Then the motion without friction has nothing in common with the measured one any more."""
MEASURED = "measured"
FULL_TENSOR = tuple((0.1 * izz, izz, izz, 0.0, 0.0, 0.0) for izz in (0.04, 0.05, 0.05))
"""Ixx, Iyy, Izz, products of each link [kg m^2]: the printed Izz across, a tenth along it."""
CLASS_COLOURS = {"low": "#eef3f7", "medium": "#cfe0ec", "high": "#a3c4dc"}
_POINTS = 600  # of a membership's line
_CELLS = 81  # of a map along each axis


def draw_all(workspace: Workspace, *, progress: bool = False) -> list[Path]:
    """Draw every figure of both papers as PNG in `figures/`.

    Returns:
        The files written.
    """
    written = []
    drawers = figures(workspace)
    for name, draw in tqdm(drawers.items(), unit="figure", disable=not progress, leave=False):
        figure = draw()
        path = workspace.folder / "figures" / f"{name}.png"
        # An interrupt must not leave half a picture under the final name.
        with atomic_write(path) as temporary:
            figure.savefig(temporary, dpi=DPI, format="png")
        figure.clear()
        written.append(path)
    lifted = workspace.arrays("control")[f"swing-up, {SHARED}"]
    time = THINNED * SAMPLE_TIME * np.arange(len(lifted), dtype=np.float64)
    gif = workspace.folder / "figures" / "control_swing_up.gif"
    motion = {f"swing-up, {SHARED} compensated": lifted}
    return [*written, animate(rigs.rtip("free"), time, motion, gif, seconds=8.0)]


def figures(workspace: Workspace) -> dict[str, Callable[[], Figure]]:
    """The function that draws each figure, by the name of its file."""
    seconds = {
        f"second_fig_{number}_{law}": partial(second_positions, workspace, law)
        for number, law in zip((5, 6, 7), LAWS, strict=True)
    }
    return {
        "fig_02_inertia": inertia_cases,
        "fig_04_without_friction": partial(without_friction, workspace),
        "fig_07_memberships": controller_memberships,
        **{
            f"fig_08_surfaces_joint_{joint}": partial(controller_surface, paper_controller(joint))
            for joint in (2, 3, 4)
        },
        "networks_NFLFM": partial(network_surfaces, workspace),
        **{
            f"fig_{number}_coefficients_{model}": partial(coefficients, workspace, model)
            for number, model in zip((11, 12, 13), NEURO_FUZZY, strict=True)
        },
        f"fig_14_positions_{NEURO_FUZZY[-1]}": partial(best_positions, workspace),
        "second_fig_3_free_arm": second_swing,
        **seconds,
        "second_fig_8_torque": partial(second_torque, workspace),
        "control_balance": lambda: balance_figure(workspace.arrays("control")),
        "experiment_classes": partial(experiment, workspace),
        **{
            f"positions_joint_{joint + 2}": partial(model_groups, workspace, joint)
            for joint in range(3)
        },
        "rmse": lambda: rmse_bars(tables.rmse(workspace, tables.NINE), "rad"),
        "second_rmse": lambda: rmse_bars(
            tables.rmse(workspace, SECOND_PAPER).set_axis(list(LAWS)), "rad"
        ),
    }


def inertia_cases() -> Figure:
    """Frictionless swings of the TLRIP rig with its arm free, a panel a joint.

    Links as point masses, with the printed Izz alone, and with a full tensor (`FULL_TENSOR`; the
    paper prints none). The last two nearly agree while the arm turns slowly, and part later.

    References:
        TLRIP paper, Fig. 2.
    """
    cases = {
        "inertia neglected": rigs.tlrip("free", "none"),
        "Izz only": rigs.tlrip("free", "izz"),
        "full tensor": rigs.tlrip("free", FULL_TENSOR),
    }
    return _swings(cases, INERTIA_SECONDS)


def second_swing() -> Figure:
    """Frictionless swing of the RTIP rig with its arm free, a panel a joint.

    The angles count from hanging, as in that paper.

    References:
        RTIP paper, Fig. 3.
    """
    return _swings({"without friction": rigs.rtip("free")}, 2.0 * INERTIA_SECONDS)


def _swings(plants: Mapping[str, PendulumChain], seconds: float) -> Figure:
    """Joint positions of rigs with a free arm, released at 0, 20, 30, 40 degrees as they count."""
    q0 = np.deg2rad([0.0, 20.0, 30.0, 40.0])
    motions = {}
    for label, plant in plants.items():
        convention, first = AngleConvention.of(plant), plant.first_link
        start = torch.as_tensor(convention.position_to_joint(q0, first))
        steps = round(seconds * 1000)
        run = rollout(plant, None, start, torch.zeros_like(start), sample_time=1e-3, steps=steps)
        motions[label] = convention.position_from_joint(run.q.numpy(), first)
    return _lines(motions, ("joint 1", *tables.JOINTS))


def _lines(motions: Mapping[str, Array], names: Sequence[str]) -> Figure:
    """Joint positions at 1 ms (sample, joint), a panel a joint, a line a motion."""
    figure, axes = style.panels(len(names), 1, style.PAGE, 1.3 * len(names), sharex=True)
    looks = style.looks(n for n in motions if n != MEASURED)
    handles: list[Any] = []
    # Later lines are thinner, so that lines can be distinguished where they coincide.
    widths = iter((2.2, 1.6, 1.0))
    for label, motion in motions.items():
        line = style.MEASURED
        if label != MEASURED:
            line = looks[label].line | {"linewidth": next(widths)}
        for ax, q in zip(axes[:, 0], motion.T, strict=True):
            ax.plot(np.arange(len(q)) / 1000, q, **line)
        handles.append(Line2D([], [], **line))
    _joint_axes(axes[:, 0].tolist(), names, "rad")
    figure.align_ylabels(axes[:, 0])
    style.legend(figure, handles, list(motions))
    return figure


def without_friction(workspace: Workspace) -> Figure:
    """Measured positions and frictionless simulations from the same release.

    One simulation is the library's, one the twin's own mechanics, which share no code with it, one
    MuJoCo's where it is installed; the paper compares its equations with SimMechanics.

    References:
        TLRIP paper, Fig. 4.
    """
    bench = workspace.bench("tlrip")
    recording = next(r for r in bench.test if r.name == SHOWN)
    convention = recording.resolve_convention(bench.plant)
    q0, qd0 = bench.states[SHOWN]
    assert isinstance(bench.plant, PendulumChain)
    first = recording[recording.time < recording.time[0] + WITHOUT_FRICTION_SECONDS]
    simulated = simulations(
        bench.plant, convention.position_to_joint(q0), convention.rate_to_joint(qd0),
        len(first) - 1,
    )  # fmt: skip
    motions = {name: convention.position_from_joint(q) for name, q in simulated.items()}
    return _lines({MEASURED: first.q} | motions, tables.JOINTS)


def network_surfaces(workspace: Workspace) -> Figure:
    """B and C as the papers' networks learnt them from the controllers, a row a joint."""
    model = load(workspace.model("NFLFM-papers"))
    schedule = model.schedule
    assert isinstance(schedule, RBFCoefficients)
    figure, axes = style.panels(model.joints, 2, style.PAGE, 0.5 + 1.6 * model.joints, sharey="row")
    low, high = schedule.input_lower.numpy(), schedule.input_upper.numpy()
    for joint, row in enumerate(axes):
        # Speed and acceleration of this joint; the others' do not enter.
        x = np.linspace(0.0, high[joint, 0], _CELLS)
        y = np.linspace(low[joint, 1], high[joint, 1], _CELLS)
        qd, qdd = (torch.as_tensor(v)[..., None].expand(_CELLS, _CELLS, model.joints)
                   for v in np.meshgrid(x, y))  # fmt: skip
        with torch.no_grad():
            values = schedule(qd, qdd)[..., joint, :].numpy()
        for k, (ax, coefficient) in enumerate(zip(row, model.law.coefficients, strict=True)):
            draw_map(ax, (x, y), values[..., k], label=(coefficient.name, coefficient.unit))
            style.title(ax, tables.JOINTS[joint])
            ax.set_xlabel("|velocity| [rad/s]" if joint == model.joints - 1 else "")
        row[0].set_ylabel("acceleration [rad/s²]")
    return figure


def coefficients(workspace: Workspace, name: str) -> Figure:
    """Coefficients of a neuro-fuzzy model over the friction experiment, a column a joint.

    References:
        TLRIP paper, Figs. 11 to 13.
    """
    motion = _experiment_motion(workspace)
    return coefficients_over_time(
        {name: load(workspace.model(name))}, motion, joint_names=tables.JOINTS
    )


def best_positions(workspace: Workspace) -> Figure:
    """Measured position of every joint, and simulated by the nonlinear neuro-fuzzy model.

    References:
        TLRIP paper, Fig. 14.
    """
    recording = next(r for r in workspace.bench("tlrip").test if r.name == SHOWN)
    best = NEURO_FUZZY[-1]
    return positions(recording, {best: _score(recording, workspace.arrays(best)[SHOWN])})


def second_torque(workspace: Workspace) -> Figure:
    """Friction torque of each law over velocity on the second paper's rig, a panel a joint.

    References:
        RTIP paper, Fig. 8.
    """
    bench = workspace.bench("rtip")
    models = {law: load(workspace.model(f"rtip-{law}")) for law in LAWS}
    return torque_over_velocity(bench.plant, models, bench.train, bench.train_motions)


def _experiment_motion(workspace: Workspace) -> Motion:
    (motion,) = workspace.bench(EXPERIMENT).motions
    return motion


def experiment(workspace: Workspace) -> Figure:
    """Position, velocity and acceleration of the friction experiment, a column a joint.

    Shaded by the class of acceleration found; a strip at the top shows the printed classes.

    References:
        TLRIP paper, Table 6.
    """
    motion = _experiment_motion(workspace)
    intervals = workspace.found(ADAPTIVE[-1])["intervals"]
    figure, axes = style.panels(3, len(tables.JOINTS), style.PAGE, 4.6, sharex=True)
    rows = (
        ("position [rad]", motion.q),
        ("velocity [rad/s]", motion.qd),
        ("acceleration [rad/s²]", motion.qdd),
    )
    for joint, name in enumerate(tables.JOINTS):
        for ax, (label, values) in zip(axes[:, joint], rows, strict=True):
            for known, start, end in intervals[joint]:
                ax.axvspan(start, end, color=CLASS_COLOURS[known], linewidth=0, zorder=0)
            ax.plot(motion.time, values[:, joint], color=style.INK, linewidth=0.6)
            ax.grid(False)
            ax.yaxis.set_major_locator(MaxNLocator(4))
            ax.set_xlim(motion.time[0], motion.time[-1])
            if joint == 0:
                ax.set_ylabel(label)
        style.title(axes[0, joint], name)
        axes[-1, joint].set_xlabel("time [s]")
        _strip(axes[0, joint], tables.TABLE_6[name])
    figure.align_ylabels(axes[:, 0])
    handles: list[Any] = [Patch(facecolor=colour) for colour in CLASS_COLOURS.values()]
    handles.append(Patch(facecolor="none", edgecolor=style.INK, linewidth=0.4))
    texts = [f"{known} acceleration" for known in CLASS_COLOURS]
    style.legend(figure, handles, [*texts, "strip at the top: as printed"])
    return figure


def controller_memberships() -> Figure:
    """Fuzzy sets of the inputs and outputs of joint 2's controller, a panel each.

    References:
        TLRIP paper, Fig. 7 and Table 4.
    """
    rules = paper_controller(2).rule_base
    figure, axes = style.panels(2, 2, style.PAGE, 3.6, sharey=True)
    for row, variables in zip(axes, (rules.inputs, rules.outputs), strict=True):
        for ax, variable in zip(row, variables, strict=True):
            _sets(ax, variable)
        row[0].set_ylabel("membership [-]")
    return figure


def model_groups(workspace: Workspace, joint: int) -> Figure:
    """Measured and simulated position of one joint, a column a kind of model, error below."""
    bench = workspace.bench("tlrip")
    recording = next(r for r in bench.test if r.name == SHOWN)
    groups = {"constant": tuple(LAWS), "adaptive": ADAPTIVE, "neuro-fuzzy": NEURO_FUZZY}
    q = {n: workspace.arrays(n)[SHOWN][:, joint] for names in groups.values() for n in names}
    measured = recording.q[:, joint]
    span = float(np.ptp(measured)) or 1.0
    figure, axes = style.panels(
        2, len(groups), style.PAGE, 3.4, sharex=True, sharey="row", height_ratios=[1.5, 1]
    )
    # The groups are side by side, so the models of each take the same looks.
    looks = [look for name, look in style.looks(LAWS).items() if name in LAWS]
    errors = np.concatenate(list(q.values())) - np.tile(measured, len(q))
    largest = float(np.abs(errors[np.isfinite(errors)]).max(initial=0.0))
    # A model that diverges must not flatten all others.
    shown = min(largest, 0.5 * span) or span
    factor, unit = style.scaled(recording.unit, shown)
    for (group, models), (above, below) in zip(groups.items(), axes.T, strict=True):
        above.plot(recording.time, measured, **style.MEASURED)
        for look, model in zip(looks, models, strict=True):
            above.plot(recording.time, q[model], **look.line)
            below.plot(recording.time, factor * (q[model] - measured), **look.line)
        style.title(above, group)
        below.set_xlabel("time [s]")
    axes[0, 0].set_ylim(measured.min() - 0.25 * span, measured.max() + 0.25 * span)
    axes[1, 0].set_ylim(style.padded(-factor * shown, factor * shown))
    axes[0, 0].set_ylabel(f"{recording.names[joint]} [{recording.unit}]")
    axes[1, 0].set_ylabel(f"error [{unit}]")
    figure.align_ylabels(axes[:, 0])
    handles = [Line2D([], [], **line) for line in (style.MEASURED, *(x.line for x in looks))]
    labels = [", ".join(models) for models in zip(*groups.values(), strict=True)]
    style.legend(figure, handles, ["measured", *labels])
    return figure


def second_positions(workspace: Workspace, law: str) -> Figure:
    """Measured and simulated positions on the second paper's rig, the first ten seconds.

    References:
        RTIP paper, Figs. 5 to 7.
    """
    recording = next(r for r in workspace.bench("rtip").test if r.name == SECOND_SHOWN)
    first = recording[recording.time < recording.time[0] + SECOND_SECONDS]
    simulated = {
        name: workspace.arrays(f"rtip-{name}")[SECOND_SHOWN][: len(first)] for name in LAWS
    }
    figure = positions(first, {law: _score(first, simulated[law])})
    # One scale of error for the three figures, so that they can be compared by eye.
    errors = np.stack([np.abs(q - first.q) for q in simulated.values()])
    largest = np.nanmax(np.where(np.isfinite(errors), errors, np.nan), axis=(0, 1))
    for ax, most in zip(figure.axes[1::2], largest.tolist(), strict=True):
        factor, unit = style.scaled(first.unit, most)
        (line,) = ax.lines
        line.set_ydata(factor * (simulated[law] - first.q)[:, figure.axes.index(ax) // 2])
        ax.set_ylim(style.padded(-factor * most, factor * most))
        ax.set_ylabel(f"error [{unit}]")
    return figure


def _score(recording: Recording, simulated: Array) -> Score:
    """A score without windows, from simulated positions."""
    lost = ~np.isfinite(simulated).all(-1)
    return Score(
        recording=recording.name,
        free_run=RMSE.of(simulated - recording.q),
        windows={},
        limit=None,
        time=recording.time,
        simulated=simulated,
        diverged_at=float(recording.time[lost.argmax()]) if lost.any() else np.inf,
    )


def _joint_axes(axes: Sequence[Axes], names: Sequence[str], unit: str) -> None:
    for ax, name in zip(axes, names, strict=True):
        ax.set_ylabel(f"{name} [{unit}]")
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.margins(x=0.01)
    axes[-1].set_xlabel("time [s]")


def _sets(ax: Axes, variable: Variable) -> None:
    low, high = variable.universe
    x = torch.linspace(low, high, _POINTS, dtype=torch.float64)
    # The papers give inputs in degrees, which take no prefix.
    is_input = "deg" in variable.unit
    factor, unit = (1.0, variable.unit) if is_input else style.scaled(variable.unit, [low, high])
    colours = style.COLOURS
    for k, term in enumerate(variable.sets):
        y = term(x).numpy()
        ax.plot(factor * x.numpy(), y, color=colours[k % len(colours)], linewidth=1.2)
        peak = float(x[int(np.argmax(y))]) if term.shape == "gaussian" else term.core
        side = {"left_shoulder": "left", "right_shoulder": "right"}.get(term.shape, "center")
        ax.annotate(
            term.name, (factor * peak, 1.0), xytext=(0, 2), textcoords="offset points",
            ha=side, fontsize=style.SMALL, color=colours[k % len(colours)],
        )  # fmt: skip
    ax.set_ylim(0, 1.12)
    ax.set_yticks([0, 0.5, 1])
    ax.set_xlim(factor * low, factor * high)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    name = style.symbol(variable.name) if len(variable.name) == 1 else variable.name
    ax.set_xlabel(f"{name} [{unit.replace('^2', '²')}]")


def _strip(ax: Axes, intervals: Sequence[tuple[str, float, float]]) -> None:
    """Intervals as a strip along the upper edge of a panel."""
    right = ax.get_xlim()[1]
    for known, start, stop in intervals:
        # A short run ends before the printed intervals do.
        if start >= right:
            continue
        ax.axvspan(
            start, min(stop, right), ymin=0.93, facecolor=CLASS_COLOURS[known],
            edgecolor=style.INK, linewidth=0.4, zorder=4,
        )  # fmt: skip
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.1 * (high - low))
