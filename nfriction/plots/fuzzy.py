"""Figures of fuzzy models: memberships, and a controller's surface."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.papers.controller.mamdani import MamdaniController
from nfriction.plots import style

Array = NDArray[np.float64]
Edges = tuple[Array, Array]

_BEFORE: dict[str, Any] = {"linestyle": (0, (3, 1.5)), "linewidth": 0.8}
_AFTER: dict[str, Any] = {"linestyle": "-", "linewidth": 1.3}
_POINTS = 400  # of a membership's line


def memberships(
    model: FrictionModel,
    before: FrictionModel | None = None,
    *,
    joint_names: Sequence[str] | None = None,
    unit: str = "rad",
    width: float = style.PAGE,
) -> Figure:
    """Fuzzy sets of velocity and acceleration, a row a joint.

    Args:
        model: a neuro-fuzzy model.
        before: the same model before its training, drawn dashed over the range of `model`.
        joint_names: for the labels.
        unit: of a position, `"rad"` or `"m"`.
        width: of the figure [in].

    Raises:
        ValueError: if a model is no neuro-fuzzy one, or the two differ in joints or sets.
    """
    schedule = neuro_fuzzy(model)
    start = None if before is None else neuro_fuzzy(before)
    if start and (start.joints, start.terms) != (schedule.joints, schedule.terms):
        raise ValueError(
            f"`before` must have the joints and sets of `model`, {schedule.joints} and "
            f"{schedule.terms}, got {start.joints} and {start.terms}."
        )
    names = style.joint_labels(joint_names, model.joints)
    figure, axes = style.panels(model.joints, 2, width, 0.45 + 1.1 * model.joints, sharey=True)
    along = " along motion" if schedule.along_motion else ""
    labels = (f"|velocity| [{unit}/s]", f"acceleration{along} [{unit}/s²]")
    for j, row in enumerate(axes):
        for i, ax in enumerate(row):
            low, high = range_of(schedule, j, i)
            x = np.linspace(low, high, _POINTS)
            ax.set_prop_cycle(color=style.COLOURS[: schedule.terms[i]])
            if start is not None:
                ax.plot(x, _sets(start, x, j, i), **_BEFORE)
            ax.plot(x, _sets(schedule, x, j, i), **_AFTER)
            ax.set_ylim(0, 1.05)
            ax.set_xlim(low, high)
        row[0].set_ylabel(f"{names[j]}\nmembership [-]")
    for ax, label in zip(axes[-1], labels, strict=True):
        ax.set_xlabel(label)
    if start is not None:
        lines = [Line2D([], [], color=style.INK, **options) for options in (_BEFORE, _AFTER)]
        style.legend(figure, lines, ["before", "after"])
    return figure


def controller_surface(
    controller: MamdaniController, *, points: int = 81, width: float = style.PAGE
) -> Figure:
    """A rule-table controller's outputs over its two inputs, a map an output, inputs in SI.

    Args:
        controller: with two inputs.
        points: of the map along each axis.
        width: of the figure [in].

    Raises:
        ValueError: if the controller has not two inputs.
    """
    rules = controller.rule_base
    if len(rules.inputs) != 2:
        raise ValueError(f"a map needs two inputs, the controller has {len(rules.inputs)}.")
    low, high = (bound * controller.si_factor for bound in (controller.lower, controller.upper))
    x, y = (np.linspace(float(low[i]), float(high[i]), points) for i in range(2))
    inputs = torch.as_tensor(np.stack(np.meshgrid(x, y), -1))
    with torch.no_grad():
        values = controller.infer(inputs / controller.si_factor).numpy()
    figure, axes = style.panels(1, controller.outputs, width, 2.5, sharey=True)
    for k, (ax, output) in enumerate(zip(axes[0], rules.outputs, strict=True)):
        draw_map(figure, ax, (x, y), values[..., k], None, output.name, output.unit)
        ax.set_xlabel(_input_label(rules.inputs[0].name, rules.inputs[0].unit))
    axes[0, 0].set_ylabel(_input_label(rules.inputs[1].name, rules.inputs[1].unit))
    return figure


def neuro_fuzzy(model: FrictionModel) -> NeuroFuzzy:
    """The model's schedule; ValueError where it is no neuro-fuzzy one."""
    if not isinstance(model.schedule, NeuroFuzzy):
        raise ValueError(
            f"only a neuro-fuzzy model has fuzzy sets and coefficient maps, got "
            f"{type(model).__name__} with a {type(model.schedule).__name__} schedule."
        )
    return model.schedule


def range_of(schedule: NeuroFuzzy, joint: int, variable: int) -> tuple[float, float]:
    """Trained range of velocity (0) or acceleration (1)."""
    if variable == 0:
        return 0.0, float(schedule.get_buffer("velocity_range")[joint])
    lower, upper = (schedule.get_buffer(f"acceleration_{end}") for end in ("lower", "upper"))
    return float(lower[joint]), float(upper[joint])


def _sets(schedule: NeuroFuzzy, x: Array, joint: int, variable: int) -> Array:
    """Memberships (point, term) of one input of a joint, over its values in SI."""
    low, high = range_of(schedule, joint, variable)
    scaled = torch.as_tensor(np.clip((x - low) / (high - low), 0.0, 1.0))
    inputs = scaled[:, None, None].expand(-1, schedule.joints, 2)
    with torch.no_grad():
        return schedule.network.anfis.memberships(inputs)[variable][:, joint].numpy()


def draw_map(
    figure: Figure,
    ax: Axes,
    axes: Edges,
    values: Array,
    seen: NDArray[np.bool_] | None,
    name: str,
    unit: str,
    opacity: Array | None = None,
) -> None:
    """One map with its colour bar; cells not seen show a hatched ground, others as it says."""
    shown = values if seen is None else np.ma.masked_where(~seen, values)
    low, high = (float(shown.min()), float(shown.max())) if np.ma.count(shown) else (0.0, 1.0)
    if high - low < 1e-6 * max(abs(low), abs(high)):
        low, high = style.padded(low, low)
    factor, unit = style.scaled(unit, [low, high])
    style.bare(ax)
    ax.patch.set(facecolor="#f2f2f2", hatch="////", edgecolor="#c4c4c4")
    mesh = ax.pcolormesh(
        *axes, factor * shown, cmap=style.MAP, vmin=factor * low, vmax=factor * high,
        shading="flat" if len(axes[0]) > values.shape[1] else "gouraud", rasterized=True,
    )  # fmt: skip
    bar = figure.colorbar(mesh, ax=ax, pad=0.02, aspect=14)
    if opacity is not None:
        mesh.set(alpha=opacity)  # of the map, not of its bar
    bar.outline.set(linewidth=0.6, edgecolor=style.INK)
    bar.ax.tick_params(colors=style.INK, labelsize=style.SMALL, width=0.6, length=2.0)
    bar.ax.yaxis.set_major_locator(MaxNLocator(5))
    bar.ax.yaxis.get_offset_text().set(fontsize=style.SMALL, color=style.INK)
    bar.set_label(f"{style.symbol(name)} [{unit}]", fontsize=style.LABEL, color=style.INK)


def _input_label(name: str, unit: str) -> str:
    # The controller takes degrees to radians; a bare number stays one.
    return f"{name} [{unit.replace('deg', 'rad').replace('^2', '²')}]"
