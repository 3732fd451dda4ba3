"""The papers' figures from the results of a reproduction."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from nfriction.evaluation.score import RMSE, Score
from nfriction.io.model_file import load
from nfriction.papers.controller.mamdani import paper_controller
from nfriction.papers.controller.rules import Variable
from nfriction.papers.nffem.rbf_coefficients import RBFCoefficients
from nfriction.papers.reproduction import tables
from nfriction.papers.reproduction.agreement import simulations
from nfriction.papers.reproduction.stages import ADAPTIVE, EXPERIMENT, LAWS
from nfriction.papers.reproduction.workspace import Array, Workspace
from nfriction.plant import PendulumChain, rigs
from nfriction.plots import coefficients_over_time, motion, positions, style, torque_over_velocity
from nfriction.plots.neurofuzzy import draw_map, on_grid
from nfriction.recording import Recording
from nfriction.recording.angles import AngleConvention
from nfriction.simulation.rollout import rollout

SHOWN, SECOND_SHOWN = "test_hanging", "test_bent"
"""Test recordings shown in the figures: from the poses of the papers' own model checks."""
SECOND_SECONDS = 10.0  # as shown in the RTIP paper
INERTIA_SECONDS = 3.0
"""Beyond this, a frictionless swing from upright shows round-off rather than inertia."""
WITHOUT_FRICTION_SECONDS = 6.0
"""After this, frictionless motion has nothing in common with the measured one."""
FULL_TENSOR = tuple((0.1 * izz, izz, izz, 0.0, 0.0, 0.0) for izz in (0.04, 0.05, 0.05))
"""Ixx, Iyy, Izz, products of each link [kg m^2]: Izz as printed across it, a tenth along it."""
CLASS_COLOURS = {"low": "#eef3f7", "medium": "#cfe0ec", "high": "#a3c4dc"}
_POINTS = 600  # points of a membership curve
_CELLS = 81  # cells of a map along each axis


def inertia_cases() -> Figure:
    """Frictionless swings of the TLRIP rig with its arm free, by joint (TLRIP paper, Fig. 2).

    Links as point masses, with only the printed Izz, and with a full tensor (`FULL_TENSOR`; the
    paper prints none). The last two nearly agree while the arm turns slowly, and diverge later.
    """
    cases = {
        "inertia neglected": rigs.tlrip("free", "none"),
        "Izz only": rigs.tlrip("free", "izz"),
        "full tensor": rigs.tlrip("free", FULL_TENSOR),
    }
    return _swings(cases, INERTIA_SECONDS)


def second_swing() -> Figure:
    """Frictionless swing of the RTIP rig with its arm free, by joint (RTIP paper, Fig. 3).

    Angles are measured from hanging, as in that paper.
    """
    return _swings({"without friction": rigs.rtip("free")}, 2.0 * INERTIA_SECONDS)


def _swings(plants: Mapping[str, PendulumChain], seconds: float) -> Figure:
    """Joint positions of rigs with a free arm, released at 0, 20, 30, 40° in their convention."""
    q0 = np.deg2rad([0.0, 20.0, 30.0, 40.0])
    figure, axes = style.panels(len(q0), 1, style.PAGE, 1.3 * len(q0), sharex=True)
    looks = style.looks(plants)
    for label, plant in plants.items():
        convention, first = AngleConvention.of(plant), plant.first_link
        start = torch.as_tensor(convention.position_to_joint(q0, first))
        steps = round(seconds * 1000)
        run = rollout(plant, None, start, torch.zeros_like(start), sample_time=1e-3, steps=steps)
        shown = convention.position_from_joint(run.q.numpy(), first)
        for ax, q in zip(axes[:, 0], shown.T, strict=True):
            ax.plot(np.arange(steps + 1) / 1000, q, **looks[label].line)
    for ax, name in zip(axes[:, 0], ("joint 1", *tables.JOINTS), strict=True):
        ax.set_ylabel(f"{name} [rad]")
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.margins(x=0.01)
    axes[-1, 0].set_xlabel("time [s]")
    figure.align_ylabels(axes[:, 0])
    style.legend(figure, [looks[label].handle for label in plants], list(plants))
    return figure


def without_friction(workspace: Workspace) -> Figure:
    """Measured positions and frictionless simulations from one release (TLRIP paper, Fig. 4).

    One simulation is by the library, one by the twin's own mechanics, which share no code with it,
    and one by MuJoCo if installed; the paper compares its equations with SimMechanics.
    """
    bench = workspace.bench("tlrip")
    recording = next(r for r in bench.test if r.name == SHOWN)
    convention = recording.resolve_convention(bench.plant)
    q0, qd0 = bench.states[SHOWN]
    assert isinstance(bench.plant, PendulumChain)
    first = recording[recording.time < recording.time[0] + WITHOUT_FRICTION_SECONDS]
    simulated = simulations(
        bench.plant, convention.position_to_joint(q0), convention.rate_to_joint(qd0), len(first) - 1
    )
    moved = {n: convention.position_from_joint(q) for n, q in simulated.items()}
    figure = motion(first, {name: _score(first, q) for name, q in moved.items()})
    for ax in figure.axes:
        # The simulations that leave the measured motion should be visible here.
        ax.autoscale(axis="y")
    return figure


def network_surfaces(workspace: Workspace) -> Figure:
    """B and C as learnt from the controllers by the papers' networks, one row per joint."""
    model = load(workspace.model("NFLFM-papers"))
    schedule = model.schedule
    assert isinstance(schedule, RBFCoefficients)
    figure, axes = style.panels(model.joints, 2, style.PAGE, 0.5 + 1.6 * model.joints, sharey="row")
    low, high = schedule.input_lower.numpy(), schedule.input_upper.numpy()
    for joint, row in enumerate(axes):
        x = np.linspace(0.0, high[joint, 0], _CELLS)
        y = np.linspace(low[joint, 1], high[joint, 1], _CELLS)
        values, _ = on_grid(model, None, joint, x, y)
        for k, (ax, coefficient) in enumerate(zip(row, model.law.coefficients, strict=True)):
            draw_map(ax, (x, y), values[..., k], label=(coefficient.name, coefficient.unit))
            style.title(ax, tables.JOINTS[joint])
            ax.set_xlabel("|velocity| [rad/s]" if joint == model.joints - 1 else "")
        row[0].set_ylabel("acceleration [rad/s²]")
    return figure


def coefficients(workspace: Workspace, name: str) -> Figure:
    """Coefficients of a network over the experiment, by joint (TLRIP paper, Figs. 11 to 13)."""
    (moved,) = workspace.bench(EXPERIMENT).motions
    models = {name: load(workspace.model(name))}
    return coefficients_over_time(models, moved, joint_names=tables.JOINTS)


def group_positions(
    workspace: Workspace, models: Sequence[str], among: Sequence[str] = tables.NINE
) -> Figure:
    """Measured and simulated positions, errors on a common scale (TLRIP paper, Fig. 14)."""
    recording = next(r for r in workspace.bench("tlrip").test if r.name == SHOWN)
    simulated = {name: workspace.arrays(name)[SHOWN] for name in among}
    return _on_one_scale(recording, simulated, models)


def fresh_errors(workspace: Workspace) -> Figure:
    """Errors over fresh releases, one panel per joint: all, the middle half, the median."""
    errors = tables.fresh_runs(workspace, tables.NINE)
    figure, axes = style.panels(1, len(tables.JOINTS), style.PAGE, 2.3, sharex=True, sharey=True)
    places, looks = range(len(errors)), style.looks(errors)
    finite = [own[np.isfinite(own)] for own in errors.values()]
    beyond = 1e4 * float(np.concatenate(finite).max(initial=1e-3))
    for joint, (ax, name) in enumerate(zip(axes[0], tables.JOINTS, strict=True)):
        runs = 1e3 * np.stack(list(errors.values()))[..., joint]
        for k, (model, own) in enumerate(zip(errors, runs, strict=True)):
            # Without interpolation: the error of a diverged run is infinite, beyond all others.
            ends = np.percentile(own, [0, 25, 75, 100], method="nearest")
            least, low, high, most = np.minimum(ends, beyond)
            colour = looks[model].line["color"]
            ax.plot([least, most], [k, k], color=colour, linewidth=0.8)
            ax.plot([low, high], [k, k], color=colour, linewidth=3.5, solid_capstyle="butt")
            ax.plot(np.median(own), k, "o", color=style.INK, markersize=3.5, zorder=4)
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.set_yticks(places, list(errors))
        ax.set_ylim(len(errors) - 0.5, -0.5)
        ax.set_xlabel("position RMSE [mrad]")
        style.title(ax, name)
    return figure


def second_torque(workspace: Workspace) -> Figure:
    """Friction torque of each law over velocity, by joint (RTIP paper, Fig. 8)."""
    bench = workspace.bench("rtip")
    models = {law: load(workspace.model(f"rtip-{law}")) for law in LAWS}
    return torque_over_velocity(bench.plant, models, bench.train, bench.train_motions)


def experiment(workspace: Workspace) -> Figure:
    """Position, velocity and acceleration of the friction experiment, one column per joint.

    Shaded by the class of acceleration found; a strip at the top shows the printed classes (TLRIP
    paper, Table 6).
    """
    (moved,) = workspace.bench(EXPERIMENT).motions
    intervals = workspace.found(ADAPTIVE[-1])["intervals"]
    figure, axes = style.panels(3, len(tables.JOINTS), style.PAGE, 4.6, sharex=True)
    rows = {
        "position [rad]": moved.q, "velocity [rad/s]": moved.qd,
        "acceleration [rad/s²]": moved.qdd,
    }  # fmt: skip
    end = float(moved.time[-1])
    for joint, name in enumerate(tables.JOINTS):
        for ax, (label, values) in zip(axes[:, joint], rows.items(), strict=True):
            for known, start, stop in intervals[joint]:
                ax.axvspan(start, stop, color=CLASS_COLOURS[known], linewidth=0, zorder=0)
            ax.plot(moved.time, values[:, joint], color=style.INK, linewidth=0.6)
            ax.grid(False)
            ax.yaxis.set_major_locator(MaxNLocator(4))
            ax.set_xlim(moved.time[0], end)
            if joint == 0:
                ax.set_ylabel(label)
        style.title(axes[0, joint], name)
        axes[-1, joint].set_xlabel("time [s]")
        for known, start, stop in tables.TABLE_6[name]:
            # A short run ends before the printed intervals.
            if start < end:
                axes[0, joint].axvspan(
                    start, min(stop, end), ymin=0.93, facecolor=CLASS_COLOURS[known],
                    edgecolor=style.INK, linewidth=0.4, zorder=4,
                )  # fmt: skip
        low, high = axes[0, joint].get_ylim()
        axes[0, joint].set_ylim(low, high + 0.1 * (high - low))
    figure.align_ylabels(axes[:, 0])
    handles: list[Any] = [Patch(facecolor=colour) for colour in CLASS_COLOURS.values()]
    handles.append(Patch(facecolor="none", edgecolor=style.INK, linewidth=0.4))
    texts = [f"{known} acceleration" for known in CLASS_COLOURS]
    style.legend(figure, handles, [*texts, "strip at the top: as printed"])
    return figure


def controller_memberships() -> Figure:
    """Fuzzy sets of joint 2's controller, one panel each (TLRIP paper, Fig. 7 and Table 4)."""
    rules = paper_controller(2).rule_base
    figure, axes = style.panels(2, 2, style.PAGE, 3.6, sharey=True)
    for row, variables in zip(axes, (rules.inputs, rules.outputs), strict=True):
        for ax, variable in zip(row, variables, strict=True):
            _sets(ax, variable)
        row[0].set_ylabel("membership [-]")
    return figure


def second_positions(workspace: Workspace, law: str) -> Figure:
    """Measured and simulated positions on the second rig, first 10 s (RTIP paper, Figs. 5 to 7)."""
    recording = next(r for r in workspace.bench("rtip").test if r.name == SECOND_SHOWN)
    first = recording[recording.time < recording.time[0] + SECOND_SECONDS]
    simulated = {
        name: workspace.arrays(f"rtip-{name}")[SECOND_SHOWN][: len(first)] for name in LAWS
    }
    return _on_one_scale(first, simulated, [law])


def _on_one_scale(
    recording: Recording, simulated: Mapping[str, Array], shown: Sequence[str]
) -> Figure:
    """Positions of the models shown, with errors on a common scale, to compare figures by eye."""
    figure = positions(recording, {name: _score(recording, simulated[name]) for name in shown})
    errors = np.abs(np.stack(list(simulated.values())) - recording.q)
    largest = np.where(np.isfinite(errors), errors, 0.0).max((0, 1))
    # A model that diverges must not flatten the curves of all others.
    largest = np.minimum(largest, 0.5 * np.ptp(recording.q, axis=0))
    for ax, most in zip(figure.axes[1::2], 1e3 * largest, strict=True):
        ax.set_ylim(style.padded(-most, most))
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


def _sets(ax: Axes, variable: Variable) -> None:
    low, high = variable.universe
    x = torch.linspace(low, high, _POINTS, dtype=torch.float64)
    # The papers give inputs in degrees, which need no SI prefix.
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
