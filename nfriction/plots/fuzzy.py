"""Figures of fuzzy models: memberships, maps, and a controller's surface."""

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
from nfriction.fuzzy.membership import FuzzyRules
from nfriction.plots import style

Array = NDArray[np.float64]

_BEFORE: dict[str, Any] = {"linestyle": (0, (3, 1.5)), "linewidth": 0.8}
_AFTER: dict[str, Any] = {"linestyle": "-", "linewidth": 1.3}
_POINTS = 400  # of a membership's line


def memberships(
    model: FrictionModel,
    before: FrictionModel | None = None,
    *,
    joint_names: Sequence[str] | None = None,
    unit: str = "rad",
) -> Figure:
    """Fuzzy sets of velocity and acceleration, a row a joint.

    Args:
        model: a neuro-fuzzy model.
        before: the same model before its training, drawn dashed over the range of `model`.
        joint_names: for the labels.
        unit: of a position, `"rad"` or `"m"`.

    Raises:
        ValueError: if a model is no neuro-fuzzy one, or the two differ in joints or sets.
    """
    rules = fuzzy_rules(model)
    drawn = [(rules, _AFTER)]
    if before is not None:
        start = fuzzy_rules(before)
        shapes = [[tuple(c.shape) for c in of.centres] for of in (rules, start)]
        if shapes[0] != shapes[1]:
            raise ValueError(
                "`before` must have the joints and sets of `model`, (joint, set) of each input: "
                f"{shapes[0]}, got {shapes[1]}."
            )
        drawn.insert(0, (start, _BEFORE))
    names = style.joint_labels(joint_names, model.joints)
    figure, axes = style.panels(model.joints, 2, style.PAGE, 0.45 + 1.1 * model.joints, sharey=True)
    for j, row in enumerate(axes):
        for i, ax in enumerate(row):
            low, high = rules.lower[j, i], rules.upper[j, i]
            x = torch.as_tensor(np.linspace(float(low), float(high), _POINTS))
            # Before and after share colours, so that each set can be followed.
            ax.set_prop_cycle(color=style.COLOURS[: rules.centres[i].shape[1]])
            for of, look in drawn:
                ax.plot(x, of.memberships(i, j, x), **look)
            ax.set_ylim(0, 1.05)
            ax.set_xlim(float(low), float(high))
        row[0].set_ylabel(f"{names[j]}\nmembership [-]")
    for ax, label in zip(axes[-1], input_labels(rules, unit), strict=True):
        ax.set_xlabel(label)
    if before is not None:
        lines = [Line2D([], [], color=style.INK, **look) for _, look in drawn]
        style.legend(figure, lines, ["before", "after"])
    return figure


def controller_surface(controller: Any, *, points: int = 81) -> Figure:
    """A rule-table controller's outputs over its two inputs, a map an output, inputs in SI.

    Args:
        controller: with two inputs, such as `nfriction.papers.controller.MamdaniController`:
            `infer` gives outputs in the units of its `rule_base`, `si_factor` those of the inputs.
        points: of the map along each axis.

    Raises:
        ValueError: if the controller has not two inputs.
    """
    rules = controller.rule_base
    if len(rules.inputs) != 2:
        raise ValueError(f"a map needs two inputs, the controller has {len(rules.inputs)}.")
    own = [variable.universe for variable in rules.inputs]
    grids = [np.linspace(low, high, points) for low, high in own]
    with torch.no_grad():
        values = controller.infer(torch.as_tensor(np.stack(np.meshgrid(*grids), -1))).numpy()
    x, y = (grid * float(si) for grid, si in zip(grids, controller.si_factor, strict=True))
    # The controller takes degrees to radians; a bare number stays one.
    labels = [
        f"{variable.name} [{variable.unit.replace('deg', 'rad').replace('^2', '²')}]"
        for variable in rules.inputs
    ]
    figure, axes = style.panels(1, len(rules.outputs), style.PAGE, 2.5, sharey=True)
    for k, (ax, output) in enumerate(zip(axes[0], rules.outputs, strict=True)):
        draw_map(ax, (x, y), values[..., k], label=(output.name, output.unit))
        ax.set_xlabel(labels[0])
    axes[0, 0].set_ylabel(labels[1])
    return figure


def fuzzy_rules(model: FrictionModel) -> FuzzyRules:
    """The model's rules; ValueError where it has none."""
    rules = model.schedule.fuzzy_rules()
    if rules is None:
        raise ValueError(
            f"only a neuro-fuzzy model has fuzzy sets and coefficient maps, got "
            f"{type(model).__name__} with a {type(model.schedule).__name__} schedule."
        )
    return rules


def input_labels(rules: FuzzyRules, unit: str) -> tuple[str, str]:
    """Labels of both inputs for positions in `"rad"` or `"m"`."""
    along = " along motion" if rules.along_motion else ""
    return f"|velocity| [{unit}/s]", f"acceleration{along} [{unit}/s²]"


def draw_map(
    ax: Axes,
    axes: tuple[Array, Array],
    values: Array,
    *,
    label: tuple[str, str],
    seen: NDArray[np.bool_] | None = None,
    opacity: Array | None = None,
) -> None:
    """Draw a map (y, x) of cells with these edges, or a smooth one of these middles.

    Cells that are not `seen` are a hatched ground, over which others have their `opacity`. The
    colour bar's `label` is a name and its SI unit.
    """
    shown = values if seen is None else np.ma.masked_where(~seen, values)
    low, high = (float(shown.min()), float(shown.max())) if np.ma.count(shown) else (0.0, 1.0)
    # A constant map would show rounding errors in full colour.
    if high - low < 1e-6 * max(abs(low), abs(high)):
        low, high = style.padded(low, low)
    factor, unit = style.scaled(label[1], [low, high])
    ax.grid(False)
    ax.spines[:].set_visible(True)
    ax.patch.set(facecolor=style.UNSEEN, hatch="////", edgecolor=style.HATCH)
    # Rasterised: as vectors, thousands of cells would make a PDF slow to open.
    mesh = ax.pcolormesh(
        *axes, factor * shown, cmap=style.MAP, vmin=factor * low, vmax=factor * high,
        shading="flat" if len(axes[0]) > values.shape[1] else "gouraud", rasterized=True,
    )  # fmt: skip
    bar = ax.figure.colorbar(mesh, ax=ax, pad=0.02, aspect=14)
    if opacity is not None:
        mesh.set(alpha=opacity)  # of the map, not of its bar
    bar.outline.set(linewidth=0.6, edgecolor=style.INK)
    bar.ax.tick_params(colors=style.INK, labelsize=style.SMALL, width=0.6, length=2.0)
    bar.ax.yaxis.set_major_locator(MaxNLocator(5))
    bar.ax.yaxis.get_offset_text().set(fontsize=style.SMALL, color=style.INK)
    bar.set_label(f"{style.symbol(label[0])} [{unit}]", fontsize=style.LABEL, color=style.INK)
