"""Figures of the papers that show a motion or a rule table, rather than a comparison."""

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from nfriction.papers.controller.mamdani import MamdaniController
from nfriction.papers.controller.rules import Variable
from nfriction.plots import style
from nfriction.recording import Recording
from nfriction.signals import Motion

Array = NDArray[np.float64]
Groups = Mapping[str, Mapping[str, Array]]

CLASS_COLOURS = {"low": "#eef3f7", "medium": "#cfe0ec", "high": "#a3c4dc"}
_POINTS = 600  # of a membership's line


def free_swings(
    time: Array, motions: Mapping[str, Array], names: Sequence[str], *, width: float = style.PAGE
) -> Figure:
    """Positions of several simulated swings from one release, a panel a joint.

    Args:
        time: [s], (sample,).
        motions: positions [rad] by what sets them apart, (sample, joint).
        names: of the joints.
        width: of the figure [in].

    References:
        TLRIP paper, Fig. 2 (cases of inertia).
    """
    figure, axes = style.panels(len(names), 1, width, 0.4 + 1.3 * len(names), sharex=True)
    looks = style.looks(motions)
    # Lines that coincide are told apart by drawing the later ones thinner.
    thickness = np.linspace(2.2, 1.0, len(motions))
    handles: list[Any] = []
    for (label, q), thick in zip(motions.items(), thickness, strict=True):
        line = looks[label].line | {"linewidth": float(thick)}
        for ax, positions in zip(axes[:, 0], q.T, strict=True):
            ax.plot(time, positions, **line)
        handles.append(Line2D([], [], **line))
    _joint_axes(axes[:, 0].tolist(), names, "rad")
    figure.align_ylabels(axes[:, 0])
    style.legend(figure, handles, list(motions))
    return figure


def motion_with_classes(
    motion: Motion,
    classes: NDArray[np.int64],
    names: Sequence[str],
    *,
    printed: Mapping[str, Sequence[tuple[str, float, float]]] | None = None,
    width: float = style.PAGE,
) -> Figure:
    """Position, velocity and acceleration of every joint, classes of acceleration shaded.

    Args:
        motion: as measured, in joint coordinates.
        classes: 0 low, 1 medium, 2 high at every sample, (sample, joint).
        names: of the joints, one column each.
        printed: intervals (class, from, to [s]) by joint for a strip above, in the same order.
        width: of the figure [in].

    References:
        TLRIP paper, Fig. 4 and Table 6.
    """
    figure, axes = style.panels(3, len(names), width, 4.6, sharex=True)
    rows = (
        ("position [rad]", motion.q),
        ("velocity [rad/s]", motion.qd),
        ("acceleration [rad/s²]", motion.qdd),
    )
    labels = list(CLASS_COLOURS)
    for joint, name in enumerate(names):
        for row, (label, values) in enumerate(rows):
            ax = axes[row, joint]
            for first, last, known in _runs(classes[:, joint]):
                span = motion.time[first], motion.time[last]
                ax.axvspan(*span, color=CLASS_COLOURS[labels[known]], linewidth=0, zorder=0)
            ax.plot(motion.time, values[:, joint], color=style.INK, linewidth=0.6)
            ax.grid(False)
            ax.yaxis.set_major_locator(MaxNLocator(4))
            ax.set_xlim(motion.time[0], motion.time[-1])
            if joint == 0:
                ax.set_ylabel(label)
        style.title(axes[0, joint], name)
        axes[-1, joint].set_xlabel("time [s]")
        if printed:
            _strip(axes[0, joint], list(printed.values())[joint])
    figure.align_ylabels(axes[:, 0])
    handles: list[Any] = [Patch(facecolor=colour) for colour in CLASS_COLOURS.values()]
    texts = [f"{known} acceleration" for known in labels]
    if printed:
        texts[-1] += "; strip at the top: as printed"
    style.legend(figure, handles, texts)
    return figure


def controller_memberships(controller: MamdaniController, *, width: float = style.PAGE) -> Figure:
    """Fuzzy sets of a controller's inputs and outputs, a panel each, in their own units.

    References:
        TLRIP paper, Fig. 7 and Table 4.
    """
    rules = controller.rule_base
    columns = max(len(rules.inputs), len(rules.outputs))
    figure, axes = style.panels(2, columns, width, 3.6, sharey=True)
    for row, variables in zip(axes, (rules.inputs, rules.outputs), strict=True):
        for ax, variable in zip(row, variables, strict=False):
            _sets(ax, variable)
        for ax in row[len(variables) :]:
            ax.set_visible(False)
        row[0].set_ylabel("membership [-]")
    return figure


def positions_by_group(
    recording: Recording,
    joint: int,
    groups: Groups,
    *,
    width: float = style.PAGE,
) -> Figure:
    """Measured against simulated position of one joint, a column a group of models, error below.

    Args:
        recording: what was measured.
        joint: which of its joints, from 0.
        groups: simulated positions (sample, joint) by model, by group; all in the recording's
            convention.
        width: of the figure [in].

    References:
        TLRIP paper, Figs. 11 to 13.
    """
    measured = recording.q[:, joint]
    span = float(np.ptp(measured)) or 1.0
    figure, axes = style.panels(
        2, len(groups), width, 3.4, sharex=True, sharey="row", height_ratios=[1.5, 1]
    )
    errors = {m: q[:, joint] - measured for models in groups.values() for m, q in models.items()}
    # The groups stand side by side, so the models of each take the same looks again.
    looks = list(style.looks(map(str, range(max(map(len, groups.values()))))).values())[1:]
    known = np.concatenate([e[np.isfinite(e)] for e in errors.values()])
    largest = float(np.abs(known).max(initial=0.0))
    shown = min(largest, 0.5 * span) or span
    factor, unit = style.scaled(recording.unit, shown)
    for (group, models), (above, below) in zip(groups.items(), axes.T, strict=True):
        above.plot(recording.time, measured, **style.MEASURED)
        for look, (model, q) in zip(looks, models.items(), strict=False):
            above.plot(recording.time, q[:, joint], **look.line)
            below.plot(recording.time, factor * errors[model], **look.line)
        style.title(above, group)
        below.set_xlabel("time [s]")
    axes[0, 0].set_ylim(measured.min() - 0.25 * span, measured.max() + 0.25 * span)
    axes[1, 0].set_ylim(style.padded(-factor * shown, factor * shown))
    axes[0, 0].set_ylabel(f"{recording.names[joint]} [{recording.unit}]")
    axes[1, 0].set_ylabel(f"error [{unit}]")
    figure.align_ylabels(axes[:, 0])
    handles = [Line2D([], [], **style.MEASURED)]
    handles += [Line2D([], [], **look.line) for look in looks]
    alike = zip_longest(*groups.values())
    labels = [", ".join(model for model in models if model) for models in alike]
    style.legend(figure, handles, ["measured", *labels])
    return figure


def recorded_motion(recordings: Sequence[Recording], *, width: float = style.PAGE) -> Figure:
    """Measured positions of recordings of one rig, a panel a joint, a column a recording.

    References:
        RTIP paper, Fig. 3.
    """
    joints = recordings[0].joints
    figure, axes = style.panels(
        joints, len(recordings), width, 0.3 + 1.2 * joints, sharex="col", sharey="row"
    )
    for column, recording in zip(axes.T, recordings, strict=True):
        for ax, q in zip(column, recording.q.T, strict=True):
            ax.plot(recording.time, q, color=style.INK, linewidth=0.7)
        style.title(column[0], recording.name.replace("_", " "))
        column[-1].set_xlabel("time [s]")
    _joint_axes(axes[:, 0].tolist(), recordings[0].names, recordings[0].unit)
    figure.align_ylabels(axes[:, 0])
    return figure


def _joint_axes(axes: Sequence[Axes], names: Sequence[str], unit: str) -> None:
    for ax, name in zip(axes, names, strict=True):
        ax.set_ylabel(f"{name} [{unit}]")
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.margins(x=0.01)
    axes[-1].set_xlabel("time [s]")


def _sets(ax: Axes, variable: Variable) -> None:
    low, high = variable.universe
    x = torch.linspace(low, high, _POINTS, dtype=torch.float64)
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


def _runs(values: NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """First and last sample of every run of equal values, with the value."""
    edges = np.flatnonzero(np.diff(values)) + 1
    firsts, lasts = [0, *edges.tolist()], [*edges.tolist(), len(values) - 1]
    return [(a, b, int(values[a])) for a, b in zip(firsts, lasts, strict=True)]


def _strip(ax: Axes, intervals: Sequence[tuple[str, float, float]]) -> None:
    """Intervals as a strip along the upper edge of a panel."""
    right = ax.get_xlim()[1]
    for known, start, stop in intervals:
        if start >= right:
            continue
        ax.axvspan(
            start, min(stop, right), ymin=0.93, facecolor=CLASS_COLOURS[known],
            edgecolor=style.INK, linewidth=0.4, zorder=4,
        )  # fmt: skip
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.1 * (high - low))
