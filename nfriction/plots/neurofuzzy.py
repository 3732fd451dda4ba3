"""Figures of fuzzy sets and of coefficients that follow the motion: over time, maps, sections."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, gaussian_filter

from nfriction.evaluation.tables import ZERO, joint_labels
from nfriction.fitting.result.identifiability import NORMAL_95, CoefficientUncertainty
from nfriction.friction.laws import Coefficient
from nfriction.friction.models import FrictionModel
from nfriction.fuzzy.membership import FuzzyRules
from nfriction.io.model_file import unit_for
from nfriction.plots import style
from nfriction.signals import Motion

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
) -> Figure:
    """Fuzzy sets of velocity and acceleration, one row per joint.

    Args:
        before: the same model before its training, drawn dashed over the range of `model`.
        unit: of a position, `"rad"` or `"m"`.

    Raises:
        ValueError: if a model is not neuro-fuzzy, or the two differ in joints or sets.
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
    names = joint_labels(joint_names, model.joints)
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


def fuzzy_rules(model: FrictionModel) -> FuzzyRules:
    """The model's rules; ValueError if it has none."""
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
    """Draw a map (y, x) of cells with given edges, or a smooth one with given centres.

    Cells that are not `seen` are hatched; the others are drawn with their `opacity`. The colour
    bar's `label` is a name and its SI unit.
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
        mesh.set(alpha=opacity)  # for the map, not for its colour bar
    bar.outline.set(linewidth=0.6, edgecolor=style.INK)
    bar.ax.tick_params(colors=style.INK, labelsize=style.SMALL, width=0.6, length=2.0)
    bar.ax.yaxis.set_major_locator(MaxNLocator(5))
    bar.ax.yaxis.get_offset_text().set(fontsize=style.SMALL, color=style.INK)
    bar.set_label(f"{style.symbol(label[0])} [{unit}]", fontsize=style.LABEL, color=style.INK)


CELLS = 60  # of a map along each axis
NEAR = 3  # cells around a sample that count as seen: a twentieth of the range
# Standard deviation, as a share of the coefficient's mean size, at which a map is half faded.
VAGUE = 0.5
_FIRST, _BESIDE, _APART = 2, 2, 10  # cells, of error bars
_LEAST = 0.15  # opacity of seen but uncertain cells; nothing is drawn where nothing was seen
_UNDER, _OVER = "#101010", "#fefefe"
_UNSEEN: dict[str, Any] = {"linewidth": 0.6, "alpha": 0.5}
# A network's line is steep in places, where dashes would not show its course.
_SOLID: dict[str, Any] = {"linestyle": "-", "linewidth": 0.8}


def coefficients_over_time(
    models: Mapping[str, FrictionModel],
    motion: Motion,
    *,
    law: str | None = None,
    joint_names: Sequence[str] | None = None,
    unit: str = "rad",
) -> Figure:
    """Coefficients of models of one law along a motion, one panel per coefficient and joint.

    Those that are constant in all models and joints have no panel: their values are in the title,
    in the order of the models.

    Args:
        models: by name, with equally many joints; constant, adaptive or neuro-fuzzy.
        motion: in joint coordinates.
        law: name of the law whose models are drawn, each in its usual colour; by default all.
        unit: of a position, `"rad"` or `"m"`.

    Raises:
        ValueError: if there is no model, or their coefficients differ.
    """
    looks = style.looks(models)
    models = {name: m for name, m in models.items() if law in (None, m.law.name)}
    if len(laws := {model.law.name for model in models.values()}) != 1:
        raise ValueError(f"`models` must be one or several of one law, got {sorted(laws)}.")
    first = next(iter(models.values()))
    names = joint_labels(joint_names, first.joints)
    along, of_law = np.stack([_along(m, motion) for m in models.values()]), first.law.coefficients
    varies = (np.ptp(along, 1) > 1e-6 * np.abs(along).max(1)).any((0, 1))  # more than rounding
    rows, still = np.flatnonzero(varies), np.flatnonzero(~varies)
    height = 0.5 + 1.25 * len(rows) + 0.15 * len(still)
    figure, axes = style.panels(len(rows) or 1, first.joints, style.PAGE, height, sharex=True)
    rules = {name: model.schedule.fuzzy_rules() for name, model in models.items()}
    lines = {n: looks[n].line | (_SOLID if r and not r.constant else {}) for n, r in rules.items()}
    for j, column in enumerate(axes.T):
        text = [_value(of_law[k], unit, along[:, 0, j, k]) for k in still]
        style.title(column[0], "\n".join([names[j], *["constant:"][: len(text)], *text]))
        column[0].axison = len(rows) > 0
        column[-1].set_xlabel("time [s]")
        for k, ax in zip(rows, column, strict=False):
            values = along[:, :, j, k]
            values = style.coefficient_axis(ax, of_law[k], unit, values) * values
            for line, value in zip(lines.values(), values, strict=True):
                ax.plot(motion.time, value, **line)
            ax.set_ylim(style.padded(float(values.min()), float(values.max())))
            ax.margins(x=0.01)
    style.legend(figure, [Line2D([], [], **line) for line in lines.values()], list(lines))
    return figure


def _value(coefficient: Coefficient, position: str, values: Array) -> str:
    """A coefficient of every model with its unit; one number if they are equal."""
    values = np.where(np.abs(values) > ZERO, values, 0.0)
    factor, unit = style.scaled(unit_for(coefficient.unit, position), values)
    texts = [f"{x:.3g}" for x in factor * values]
    number = " / ".join(texts) if len(set(texts)) > 1 else texts[0]
    return f"{style.symbol(coefficient.name)} = {number} {unit}".removesuffix(" -")


def _along(model: FrictionModel, motion: Motion) -> Array:
    """Coefficients at every sample, (sample, joint, coefficient)."""
    qd, qdd, time = (torch.tensor(x) for x in (motion.qd, motion.qdd, motion.time))
    with torch.no_grad():
        found = model.coefficients_from(qd, qdd, model.schedule.states(qd, qdd, time))
    return found.expand(len(qd), -1, -1).numpy()


def coefficient_surfaces(
    model: FrictionModel,
    motions: Sequence[Motion] | None = None,
    *,
    uncertainty: CoefficientUncertainty | None = None,
    joint_names: Sequence[str] | None = None,
    unit: str = "rad",
) -> Figure:
    """Coefficients of a neuro-fuzzy model as maps over |velocity| and acceleration.

    Args:
        motions: smoothed motions in joint coordinates. White lines enclose 50 % and 90 % of their
            samples; the map is hatched where there are no samples nearby.
        uncertainty: of its fit (`FitResult.uncertainty`). The map fades into the hatching as the
            standard deviation grows, to about half when it is half of the coefficient's mean size.
        unit: of a position, `"rad"` or `"m"`.

    Returns:
        One map per joint and fitted coefficient.

    Raises:
        ValueError: if the model has no fuzzy rules.
    """
    rules, coefficients = fuzzy_rules(model), _fitted(model)
    names = joint_labels(joint_names, model.joints)
    # The fewer of the two go side by side, because maps with their colour bars need space.
    across = model.joints <= len(coefficients)
    rows, columns = sorted((model.joints, len(coefficients)), reverse=True)
    share = "col" if across else "row"
    figure, axes = style.panels(
        rows, columns, style.COLUMN if columns == 1 else style.PAGE, 0.7 + 1.5 * rows,
        sharex=share, sharey=share,
    )  # fmt: skip
    for j, maps in enumerate(axes.T if across else axes):
        edges = _edges(rules, j)
        middles = _middles(edges)
        values, sd = on_grid(model, uncertainty, j, *middles)
        counts = None if motions is None else _visits(rules, motions, j)
        seen = None if counts is None else _near(counts)
        for ax, (k, coefficient) in zip(maps, coefficients, strict=True):
            opacity = None
            if sd is not None:
                # 1 without uncertainty, about half at a deviation of `VAGUE`.
                among = np.abs(values[..., k][... if seen is None or not seen.any() else seen])
                vague = VAGUE * (float(among.mean()) or 1.0)
                opacity = _LEAST + (1.0 - _LEAST) / (1.0 + (sd[..., k] / vague) ** 4)
            label = (coefficient.name, unit_for(coefficient.unit, unit))
            draw_map(ax, edges, values[..., k], label=label, seen=seen, opacity=opacity)
            if counts is not None:
                _density_lines(ax, middles, counts)
            style.title(ax, names[j])
            # Ranges differ between joints, so every map has its own.
            ax.tick_params(labelbottom=True, labelleft=True)
    velocity, acceleration = input_labels(rules, unit)
    figure.supxlabel(velocity, fontsize=style.LABEL, color=style.INK)
    figure.supylabel(acceleration, fontsize=style.LABEL, color=style.INK)
    return figure


def coefficient_sections(
    model: FrictionModel,
    motions: Sequence[Motion] | None = None,
    *,
    uncertainty: CoefficientUncertainty | None = None,
    joint_names: Sequence[str] | None = None,
    unit: str = "rad",
) -> Figure:
    """Coefficients of a neuro-fuzzy model over |velocity|, at three accelerations.

    Arguments and errors are those of `coefficient_surfaces`. Lines are faint where there are no
    samples nearby; bars are 95 % intervals.

    Returns:
        One panel per joint and fitted coefficient; titles state the accelerations.
    """
    rules, coefficients = fuzzy_rules(model), _fitted(model)
    names = joint_labels(joint_names, model.joints)
    rows, columns = model.joints, len(coefficients)
    figure, axes = style.panels(
        rows, columns, style.COLUMN if columns == 1 else style.PAGE, 0.4 + 1.5 * rows, sharex="row"
    )
    levels = ("negative", "none", "positive")
    if rules.along_motion:
        levels = ("braking", "steady", "speeding up")
    looks = style.looks(levels)
    for j, panels in enumerate(axes):
        edges = _edges(rules, j)
        low, high = edges[1][[0, -1]].tolist()
        middle, step = 0.5 * (low + high), 0.25 * (high - low)
        if low < 0 < high:  # around zero if both signs occur
            middle, step = 0.0, 0.5 * min(-low, high)
        speed, accelerations = _middles(edges)[0], [middle - step, middle, middle + step]
        values, sd = on_grid(model, uncertainty, j, speed, np.array(accelerations))
        seen = np.ones((len(levels), CELLS), dtype=bool)
        if motions is not None:
            row = np.searchsorted(edges[1], accelerations) - 1
            seen = _near(_visits(rules, motions, j))[np.clip(row, 0, CELLS - 1)]
        at = ", ".join(f"{float(f'{a:.2g}'):g}" for a in accelerations).replace("-", "−")
        for ax, (k, coefficient) in zip(panels, coefficients, strict=True):
            style.title(ax, f"{names[j]}, at {at} {unit}/s²")
            factor = style.coefficient_axis(ax, coefficient, unit, values[..., k])
            value = factor * values[..., k]
            reach = 0.0 * value if sd is None else factor * NORMAL_95 * sd[..., k]
            for n, level in enumerate(levels):
                line = looks[level].line
                _line(ax, speed, value[n], seen[n], line)
                if sd is not None:
                    some = slice(_FIRST + n * _BESIDE, None, _APART)  # side by side
                    ax.errorbar(
                        speed[some], value[n, some], reach[n, some], fmt="none",
                        ecolor=line["color"], elinewidth=0.6, capsize=1.5, capthick=0.6, alpha=0.6,
                    )  # fmt: skip
            _limit(ax, value, reach, coefficient.positive)
            ax.set_xlim(0.0, edges[0][-1])
    for ax in axes[-1]:
        ax.set_xlabel(input_labels(rules, unit)[0])
    style.legend(figure, [looks[level].handle for level in levels], list(levels))
    return figure


def _fitted(model: FrictionModel) -> list[tuple[int, Coefficient]]:
    """Coefficients that networks fit, with their indices; the others are constant."""
    return [(k, c) for k, c in enumerate(model.law.coefficients) if c.fitted and not c.stores]


def _edges(rules: FuzzyRules, joint: int) -> Edges:
    """Edges of cells over the trained range of velocity and of acceleration."""
    velocity, acceleration = (
        np.linspace(float(rules.lower[joint, i]), float(rules.upper[joint, i]), CELLS + 1)
        for i in range(2)
    )
    return velocity, acceleration


def _middles(edges: Edges) -> Edges:
    return 0.5 * (edges[0][1:] + edges[0][:-1]), 0.5 * (edges[1][1:] + edges[1][:-1])


def on_grid(
    model: FrictionModel,
    uncertainty: CoefficientUncertainty | None,
    joint: int,
    speed: Array,
    acceleration: Array,
) -> tuple[Array, Array | None]:
    """Coefficients and their standard deviation, (acceleration, speed, coefficient)."""
    qd, qdd = (
        torch.as_tensor(np.ascontiguousarray(x))[..., None].expand(*x.shape, model.joints)
        for x in np.meshgrid(speed, acceleration)
    )
    with torch.no_grad():
        values = model.schedule(qd, qdd)[:, :, joint].numpy()
    return values, None if uncertainty is None else uncertainty.sd(qd, qdd)[:, :, joint].numpy()


def _visits(rules: FuzzyRules, motions: Sequence[Motion], joint: int) -> Array:
    """Samples in each cell (acceleration, speed); those outside the range count at the edge."""
    qd, qdd = (np.concatenate([getattr(m, of)[:, joint] for m in motions]) for of in ("qd", "qdd"))
    if rules.along_motion:
        qdd = np.where(qd < 0, -qdd, qdd)
    speeds, accelerations = _edges(rules, joint)
    speed = np.minimum(np.abs(qd), speeds[-1])
    acceleration = np.clip(qdd, accelerations[0], accelerations[-1])
    return np.histogram2d(acceleration, speed, [accelerations, speeds])[0]


def _near(counts: Array) -> NDArray[np.bool_]:
    """Cells in or near which there are samples."""
    return np.asarray(binary_dilation(counts > 0, iterations=NEAR), dtype=bool)


def _line(ax: Axes, x: Array, y: Array, seen: NDArray[np.bool_], look: dict[str, Any]) -> None:
    """A line that is faint where there are no samples."""
    ax.plot(x, np.where(seen, y, np.nan), **look)
    if not seen.all():
        # The two parts share a point where they meet.
        unseen = ~seen | ~np.roll(seen, 1) | ~np.roll(seen, -1)
        ax.plot(x, np.where(unseen, y, np.nan), **look | _UNSEEN)


def _limit(ax: Axes, values: Array, reach: Array, positive: bool) -> None:
    """Limits that include the bars, unless these would hide the lines."""
    low, high = float(values.min()), float(values.max())
    most = max(high - low, abs(low), abs(high)) or 1.0
    bottom = max(float((values - reach).min()), low - most, 0.0 if positive else -np.inf)
    ax.set_ylim(*style.padded(bottom, min(float((values + reach).max()), high + most)))
    if positive:
        ax.set_ylim(bottom=max(ax.get_ylim()[0], 0.0))


def _density_lines(ax: Axes, middles: Edges, counts: Array) -> None:
    """Lines around the densest cells with 50 % and 90 % of the samples."""
    smooth = gaussian_filter(counts, 2.5)
    falling = np.sort(smooth.ravel())[::-1]
    held = np.cumsum(falling) / falling.sum()
    levels = sorted({float(falling[np.searchsorted(held, share)]) for share in (0.5, 0.9)})
    if levels[0] <= 0 or levels[-1] >= falling[0]:
        return  # all in one cell: no line would enclose anything
    dashes = ["--", "-"][-len(levels) :]
    # With a dark outline, so that the lines are visible on light and dark parts of the map.
    for colour, width in ((_UNDER, 1.4), (_OVER, 0.7)):
        ax.contour(*middles, smooth, levels, colors=colour, linewidths=width, linestyles=dashes)
