"""Figures of coefficients over velocity and acceleration, with what the data leave open."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, gaussian_filter

from nfriction.fitting.result.identifiability import NORMAL_95
from nfriction.fitting.result.uncertainty import CoefficientUncertainty
from nfriction.fitting.strategy.extrapolation_prior import visit_histogram
from nfriction.friction.laws import Coefficient
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.plots import style
from nfriction.plots.fuzzy import Array, Edges, draw_map, neuro_fuzzy, range_of
from nfriction.signals import Motion

CELLS = 60
"""Cells of a map along each axis."""
NEAR = 3
"""Cells that a sample vouches for around its own: a twentieth of the range."""
VAGUE = 0.5
"""Standard deviation, as a share of the coefficient's mean size, at which a map is half faded."""
_FIRST, _BESIDE, _APART = 2, 2, 10  # cells, of error bars
_LEAST = 0.15  # opacity of what is there but vague; nothing is drawn where nothing was seen
_UNDER, _OVER = "#101010", "#fefefe"  # none of the palette's, which turn for a dark screen
_UNSEEN: dict[str, Any] = {"linewidth": 0.6, "alpha": 0.5}


def coefficient_surfaces(
    model: FrictionModel,
    motions: Sequence[Motion] | None = None,
    *,
    uncertainty: CoefficientUncertainty | None = None,
    joint_names: Sequence[str] | None = None,
    unit: str = "rad",
    width: float | None = None,
) -> Figure:
    """Coefficients of a neuro-fuzzy model as maps over |velocity| and acceleration.

    Args:
        model: a neuro-fuzzy model.
        motions: smoothed motions in joint coordinates. White lines hold 50 % and 90 % of their
            samples; where they never came near, the map is hatched.
        uncertainty: of its fit (`Fit.uncertainty`). A map fades into the hatching as its standard
            deviation grows, about by half where that is half of the coefficient's mean size.
        joint_names: for the titles.
        unit: of a position, `"rad"` or `"m"`.
        width: of the figure [in].

    Returns:
        A map a joint and coefficient that is fitted.

    Raises:
        ValueError: if the model's coefficients do not follow a neuro-fuzzy schedule.
    """
    schedule = neuro_fuzzy(model)
    names = style.joint_labels(joint_names, model.joints)
    coefficients = _varied(model)
    # The fewer of the two stand side by side: the maps with their bars need the room.
    across = model.joints <= len(coefficients)
    rows, columns = sorted((model.joints, len(coefficients)), reverse=True)
    share = "col" if across else "row"
    figure, axes = style.panels(
        rows, columns, width or (style.COLUMN if columns == 1 else style.PAGE), 0.7 + 1.5 * rows,
        sharex=share, sharey=share,
    )  # fmt: skip
    visited = None if motions is None else visit_histogram(schedule, motions, CELLS)
    for j, maps in enumerate(axes.T if across else axes):
        edges = _edges(schedule, j)
        qd, qdd = _middles(schedule, edges)
        with torch.no_grad():
            values = schedule(qd, qdd)[:, :, j].numpy()
        counts = None if visited is None else visited[j].T
        seen = None if counts is None else binary_dilation(counts > 0, iterations=NEAR)
        sd = None if uncertainty is None else uncertainty.sd(qd, qdd)[:, :, j].numpy()
        for ax, (k, coefficient) in zip(maps, coefficients, strict=True):
            value = values[..., k]
            opacity = None if sd is None else _opacity(value, sd[..., k], seen)
            label = style.sliding(coefficient.unit, unit)
            draw_map(figure, ax, edges, value, seen, coefficient.name, label, opacity)
            if counts is not None:
                _density_lines(ax, edges, counts)
            style.title(ax, names[j])
            # Ranges differ between joints, so every map says its own.
            ax.tick_params(labelbottom=True, labelleft=True)
    figure.supxlabel(f"|velocity| [{unit}/s]", fontsize=style.LABEL, color=style.INK)
    label = _acceleration_label(schedule, unit)
    figure.supylabel(label, fontsize=style.LABEL, color=style.INK)
    return figure


def coefficient_sections(
    model: FrictionModel,
    motions: Sequence[Motion] | None = None,
    *,
    uncertainty: CoefficientUncertainty | None = None,
    joint_names: Sequence[str] | None = None,
    unit: str = "rad",
    width: float | None = None,
) -> Figure:
    """Coefficients of a neuro-fuzzy model over |velocity|, at three accelerations.

    Args:
        model: a neuro-fuzzy model.
        motions: smoothed motions in joint coordinates; lines are faint where they never came
            near.
        uncertainty: of its fit (`Fit.uncertainty`): bars are 95 % intervals.
        joint_names: for the titles.
        unit: of a position, `"rad"` or `"m"`.
        width: of the figure [in].

    Returns:
        A panel a joint and coefficient that is fitted; a joint's accelerations stand in its title.

    Raises:
        ValueError: if the model's coefficients do not follow a neuro-fuzzy schedule.
    """
    schedule = neuro_fuzzy(model)
    names = style.joint_labels(joint_names, model.joints)
    coefficients = _varied(model)
    rows, columns = model.joints, len(coefficients)
    figure, axes = style.panels(
        rows, columns, width or (style.COLUMN if columns == 1 else style.PAGE), 0.4 + 1.5 * rows,
        sharex="row",
    )  # fmt: skip
    levels = ("negative", "none", "positive")
    if schedule.along_motion:
        levels = ("braking", "steady", "speeding up")
    looks = style.looks(levels)
    visited = None if motions is None else visit_histogram(schedule, motions, CELLS)
    for j, panels in enumerate(axes):
        edges = _edges(schedule, j)
        accelerations = _levels(*range_of(schedule, j, 1))
        speed = 0.5 * (edges[0][1:] + edges[0][:-1])
        value, sd = _sections(schedule, uncertainty, j, speed, accelerations)
        counts = None if visited is None else visited[j].T
        seen = [_seen_along(counts, edges, a) for a in accelerations]
        told = ", ".join(f"{float(f'{a:.2g}'):g}" for a in accelerations).replace("-", "−")
        style.title(panels[0], f"{names[j]}, at {told} {unit}/s²")
        for ax, (k, coefficient) in zip(panels, coefficients, strict=True):
            label = style.sliding(coefficient.unit, unit)
            factor, label = style.scaled(label, value[..., k])
            for n, level in enumerate(levels):
                line = looks[level].line
                _line(ax, speed, factor * value[n, :, k], seen[n], line)
                if sd is not None:
                    some = slice(_FIRST + n * _BESIDE, None, _APART)  # side by side
                    ax.errorbar(
                        speed[some], factor * value[n, some, k],
                        factor * NORMAL_95 * sd[n, some, k], fmt="none", ecolor=line["color"],
                        elinewidth=0.9, capsize=1.5, capthick=0.9,
                    )  # fmt: skip
            reach = 0.0 if sd is None else NORMAL_95 * sd[..., k]
            _limit(ax, factor * value[..., k], factor * reach, bool(schedule.positive[k]))
            ax.set_ylabel(f"{style.symbol(coefficient.name)} [{label}]")
            ax.set_xlim(0.0, edges[0][-1])
            ax.yaxis.set_major_locator(MaxNLocator(4))
    for ax in axes[-1]:
        ax.set_xlabel(f"|velocity| [{unit}/s]")
    handles = [Line2D([], [], **looks[level].line) for level in levels]
    style.legend(figure, handles, list(levels))
    return figure


def _varied(model: FrictionModel) -> list[tuple[int, Coefficient]]:
    """Coefficients that are fitted, with their places; the others are the same everywhere."""
    return [(k, c) for k, c in enumerate(model.law.coefficients) if c.fitted]


def _levels(low: float, high: float) -> list[float]:
    """Three accelerations, about zero where there are both signs."""
    middle, step = (0.0, 0.5 * min(-low, high)) if low < 0 < high else (
        0.5 * (low + high), 0.25 * (high - low))  # fmt: skip
    return [middle - step, middle, middle + step]


def _sections(
    schedule: NeuroFuzzy,
    uncertainty: CoefficientUncertainty | None,
    joint: int,
    speed: Array,
    accelerations: Sequence[float],
) -> tuple[Array, Array | None]:
    """Coefficients and their standard deviation, (acceleration, speed, coefficient)."""
    qd, qdd = (
        torch.as_tensor(np.ascontiguousarray(x))[..., None].expand(*x.shape, schedule.joints)
        for x in np.meshgrid(speed, np.array(accelerations))
    )
    with torch.no_grad():
        value = schedule(qd, qdd)[:, :, joint].numpy()
    return value, None if uncertainty is None else uncertainty.sd(qd, qdd)[:, :, joint].numpy()


def _line(ax: Axes, x: Array, y: Array, seen: NDArray[np.bool_], look: dict[str, Any]) -> None:
    """A line that is faint where nothing was seen."""
    ax.plot(x, np.where(seen, y, np.nan), **look)
    if not seen.all():
        # The two share a point wherever they meet.
        unseen = ~seen | ~np.roll(seen, 1) | ~np.roll(seen, -1)
        ax.plot(x, np.where(unseen, y, np.nan), **look | _UNSEEN)


def _limit(ax: Axes, values: Array, reach: Array | float, positive: bool) -> None:
    """Limits that hold the bars, unless these leave nothing to see of the lines."""
    low, high = float(values.min()), float(values.max())
    most = max(high - low, abs(low), abs(high)) or 1.0
    bottom = max(float((values - reach).min()), low - most, 0.0 if positive else -np.inf)
    ax.set_ylim(*style.padded(bottom, min(float((values + reach).max()), high + most)))
    if positive:
        ax.set_ylim(bottom=max(ax.get_ylim()[0], 0.0))


def _opacity(value: Array, sd: Array, seen: NDArray[np.bool_] | None) -> Array:
    """How firmly a map is drawn: 1 where all is known, about half at a deviation of `VAGUE`."""
    among = np.abs(value) if seen is None or not seen.any() else np.abs(value[seen])
    size = float(among.mean()) or 1.0
    return _LEAST + (1.0 - _LEAST) / (1.0 + (sd / (VAGUE * size)) ** 4)


def _acceleration_label(schedule: NeuroFuzzy, unit: str) -> str:
    return f"acceleration{' along motion' if schedule.along_motion else ''} [{unit}/s²]"


def _seen_along(counts: Array | None, edges: Edges, acceleration: float) -> NDArray[np.bool_]:
    """Where along a line of constant acceleration samples came near, (cell,)."""
    if counts is None:
        return np.ones(CELLS, dtype=bool)
    near = binary_dilation(counts > 0, iterations=NEAR)
    row = np.clip(np.searchsorted(edges[1], acceleration) - 1, 0, CELLS - 1)
    return np.asarray(near[row], dtype=bool)


def _edges(schedule: NeuroFuzzy, joint: int) -> Edges:
    velocity, acceleration = (
        np.linspace(*range_of(schedule, joint, i), CELLS + 1) for i in range(2)
    )
    return velocity, acceleration


def _middles(schedule: NeuroFuzzy, edges: Edges) -> tuple[torch.Tensor, torch.Tensor]:
    """Velocity and acceleration of the cells' middles, (acceleration, velocity, joint)."""
    grid = np.meshgrid(*(0.5 * (e[1:] + e[:-1]) for e in edges))
    qd, qdd = (torch.as_tensor(g)[..., None].expand(*g.shape, schedule.joints) for g in grid)
    return qd, qdd


def _density_lines(ax: Axes, edges: Edges, counts: Array) -> None:
    """Lines around the densest cells that hold half and nine tenths of the samples."""
    smooth = gaussian_filter(counts, 2.5)
    falling = np.sort(smooth.ravel())[::-1]
    held = np.cumsum(falling) / falling.sum()
    levels = sorted({float(falling[np.searchsorted(held, share)]) for share in (0.5, 0.9)})
    if levels[0] <= 0 or levels[-1] >= falling[0]:
        return  # all in one cell: nothing to draw a line around
    middles = [0.5 * (e[1:] + e[:-1]) for e in edges]
    dashes = ["--", "-"][-len(levels) :]
    # Dark below, so that the lines stand out on light and dark parts of the map alike, whichever
    # the screen.
    for colour, width in ((_UNDER, 1.4), (_OVER, 0.7)):
        ax.contour(*middles, smooth, levels, colors=colour, linewidths=width, linestyles=dashes)
