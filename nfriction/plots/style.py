"""Sizes, colours, units and labels of every figure; no global matplotlib state is touched."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from nfriction.evaluation.compare import NO_FRICTION
from nfriction.friction import both_names
from nfriction.friction.laws import Coefficient
from nfriction.io.model_file import unit_for

COLUMN, PAGE = 3.5, 7.0
"""Widths of a figure in a two-column paper [in]: one column, both."""

INK, GRID, FAINT = "#222222", "#dddddd", "#8c8c8c"
UNSEEN, HATCH, BAND = "#f2f2f2", "#c4c4c4", "#bbbbbb"  # grounds of maps without data; the floor
LABEL, SMALL, TINY = 8.0, 7.0, 6.0  # sizes of text [pt]
# Okabe and Ito's palette without its yellow (too pale for lines) and black (text).
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#5D3A9B")
MEASURED: dict[str, Any] = {"color": "#bcbcbc", "linewidth": 3.0}
_DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)))
# Another number than of colours, or both would repeat together.
_MARKERS = ("o", "s", "^", "D", "v", "P", "p", "<")
_HATCHES = ("", "////", "....", "\\\\\\\\")
MAP = "viridis"
LOG_FROM = 30.0
"""Ratio of the largest value to the smallest beyond which an axis is logarithmic."""


def panels(
    rows: int, columns: int, width: float, height: float, **options: Any
) -> tuple[Figure, NDArray[np.object_]]:
    """A figure on white with a grid of plain axes, (rows, columns); `options` as for `subplots`."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for ax in axes.flat:
        dress(ax)
    return figure, axes


def panel_each(count: int, columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A grid of `count` panels of a given height; the rest of the grid is blank."""
    rows = -(-count // columns)
    figure, axes = panels(rows, columns, width, 0.2 + height * rows)
    for ax in axes.flat[count:]:
        ax.set_visible(False)
    return figure, list(axes.flat[:count])


def dress(ax: Axes) -> None:
    """Colours and sizes, set explicitly so that a user's own style cannot make text unreadable."""
    ax.set_facecolor("white")
    ax.set_axisbelow(True)
    ax.grid(True, color=GRID, linewidth=0.5, linestyle="-")
    ax.tick_params(which="both", colors=INK, labelsize=SMALL, width=0.6, length=2.5)
    ax.tick_params(which="minor", length=1.5)
    for side, spine in ax.spines.items():
        spine.set(visible=side in ("left", "bottom"), color=INK, linewidth=0.6)
    for text in (ax.xaxis.label, ax.yaxis.label, ax.title):
        text.set(fontsize=LABEL, color=INK)
    for axis in (ax.xaxis, ax.yaxis):
        axis.get_offset_text().set(fontsize=SMALL, color=INK)


def legend(figure: Figure, handles: Iterable[Artist], labels: Sequence[str]) -> None:
    """A legend above all panels, in as many columns as fit; the figure grows by its height.

    Models are labelled with plain names and abbreviations; other labels are unchanged.
    """
    labels = [both_names(label) for label in labels]
    longest = max(len(label) for label in labels)
    columns = min(len(labels), max(1, int(figure.get_figwidth() / (0.5 + 0.05 * longest))))
    rows = -(-len(labels) // columns)
    # Balanced: no row is left with a single entry.
    columns = -(-len(labels) // rows)
    # Filled column by column, read row by row.
    order = [k for column in range(columns) for k in range(column, len(labels), columns)]
    artists = list(handles)
    figure.set_figheight(figure.get_figheight() + 0.05 + 0.15 * rows)
    figure.legend(
        [artists[k] for k in order], [labels[k] for k in order], loc="outside upper center",
        ncols=columns, frameon=False, fontsize=SMALL, labelcolor=INK, handlelength=2.4,
        columnspacing=1.2,
    )  # fmt: skip


def title(ax: Axes, text: str) -> None:
    """A panel's title, in the size of its labels."""
    ax.set_title(text, fontsize=LABEL, color=INK)


def coefficient_axis(ax: Axes, coefficient: Coefficient, position: str, values: Any) -> float:
    """Label the y axis with a coefficient; return the factor from SI to the displayed unit."""
    factor, unit = scaled(unit_for(coefficient.unit, position), values)
    ax.set_ylabel(f"{symbol(coefficient.name)} [{unit}]")
    ax.yaxis.set_major_locator(MaxNLocator(4))
    return factor


def log_axis(ax: Axes, bottom: float, top: float) -> None:
    """A logarithmic y axis with plain numbers, at least two of them."""
    ax.set_yscale("log")
    ax.set_ylim(bottom, top)
    ratio = top / bottom
    # Over a short range, decades alone would leave an axis with a single number.
    subs = (1,) if ratio > 200 else (1, 2, 5) if ratio > 8 else range(1, 10)
    ax.yaxis.set_major_locator(LogLocator(subs=[float(s) for s in subs]))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())


@dataclass(frozen=True)
class Look:
    """Style of a model's lines, markers and bars, the same in all figures of a run."""

    line: dict[str, Any]
    marker: dict[str, Any]
    bar: dict[str, Any]

    @property
    def handle(self) -> Line2D:
        """A line for the legend."""
        return Line2D([], [], **self.line)


def looks(names: Iterable[str]) -> dict[str, Look]:
    """A style for each model; no friction is always grey."""
    models = [name for name in names if name != NO_FRICTION]
    # Fixed, so that colours of models do not depend on whether no friction was simulated.
    found = {NO_FRICTION: _look(FAINT, (0, (2.5, 2.5)), "x", "xxxx")}
    for k, name in enumerate(models):
        cycles: tuple[Sequence[Any], ...] = (COLOURS, _DASHES, _MARKERS, _HATCHES)
        found[name] = _look(*(cycle[k % len(cycle)] for cycle in cycles))
    return found


def _look(colour: str, dashes: Any, marker: str, hatch: str) -> Look:
    # Dashes of models lie on whole lines, so that an equal curve shows in their gaps.
    order = 2.1 if dashes in _DASHES[1:] else 2.0
    return Look(
        line={"color": colour, "linestyle": dashes, "linewidth": 1.1, "zorder": order},
        marker={"marker": marker, "markersize": 4.0},
        bar={"facecolor": colour, "hatch": hatch, "edgecolor": "white", "linewidth": 0.4},
    )


def scaled(unit: str, values: Any) -> tuple[float, str]:
    """Factor and prefixed unit in which finite values are easy to read: small radians as mrad."""
    sizes = np.abs(np.asarray(values, dtype=np.float64))
    largest = float(np.max(sizes, where=np.isfinite(sizes), initial=0.0))
    if unit in ("", "1", "-") or largest == 0.0 or largest >= 0.2:
        return 1.0, unit
    return (1e3, f"m{unit}") if largest >= 2e-4 else (1e6, f"µ{unit}")


def symbol(name: str) -> str:
    """A coefficient's name in mathematical type: `f_o` with a subscript, `B` in italics."""
    match = re.fullmatch(r"([A-Za-z])(?:_([A-Za-z0-9]+))?", name)
    if match is None:
        return name
    index = f"_\\mathrm{{{match[2]}}}" if match[2] else ""
    return f"${match[1]}{index}$"


def padded(low: float, high: float, share: float = 0.05) -> tuple[float, float]:
    """Limits a little wider than the values, and never empty."""
    # Equal limits have no range to take a share of.
    margin = share * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin
