"""Figures of position errors: along recordings, by model and joint, by horizon."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from nfriction.evaluation.compare import LIMIT, NO_FRICTION, Comparison, Part
from nfriction.evaluation.score import Score
from nfriction.plots import style
from nfriction.recording import Recording

# Room that a bar and its number need side by side with others [in].
_BAR = 0.13


def positions(
    recording: Recording, scores: Mapping[str, Score], *, width: float = style.PAGE
) -> Figure:
    """Measured against simulated position, a pair of panels a joint: position, error below.

    A panel spans the measured range, and the errors of models that did not diverge, up to half of
    that; larger ones, such as of a simulation without friction, are cut off.

    Args:
        recording: the measured motion, in its own convention and unit.
        scores: scores on this very recording by model name, simulated positions included.
        width: of the figure [in].

    Raises:
        ValueError: if there are no scores, or one belongs to another recording.
    """
    if not scores:
        raise ValueError("`scores` is empty; give at least one model's score on the recording.")
    for name, score in scores.items():
        if score.simulated.shape != recording.q.shape:
            raise ValueError(
                f"the score of {name!r} has simulated positions {score.simulated.shape}, the "
                f"recording {recording.q.shape}; scores must be of this very recording."
            )
    joints = recording.joints
    figure, axes = style.panels(
        2 * joints, 1, width, 0.4 + 1.7 * joints, sharex=True, height_ratios=[1.5, 1] * joints
    )
    looks = style.looks(scores)
    # Errors that diverge or ignore friction would hide all others.
    whole = {n for n, s in scores.items() if not np.isfinite(s.diverged_at)} or set(scores)
    whole = whole - {NO_FRICTION} or whole
    for joint, name in enumerate(recording.names):
        measured = recording.q[:, joint]
        # A joint at rest has no range.
        span = float(np.ptp(measured)) or 1.0
        position, below = axes[2 * joint, 0], axes[2 * joint + 1, 0]
        position.plot(recording.time, measured, **style.MEASURED)
        errors = {n: s.simulated[:, joint] - measured for n, s in scores.items()}
        shown = min(max(_largest(e) for n, e in errors.items() if n in whole), 0.5 * span) or span
        factor, unit = style.scaled(recording.unit, shown)
        for model, error in errors.items():
            position.plot(recording.time, scores[model].simulated[:, joint], **looks[model].line)
            below.plot(recording.time, factor * error, **looks[model].line)
        low, high = float(measured.min()), float(measured.max())
        position.set_ylim(low - 0.25 * span, high + 0.25 * span)
        below.set_ylim(style.padded(-factor * shown, factor * shown))
        position.set_ylabel(f"{name} [{recording.unit}]")
        below.set_ylabel(f"error [{unit}]")
        for ax in (position, below):
            ax.yaxis.set_major_locator(MaxNLocator(4))
            ax.margins(x=0.01)
    axes[-1, 0].set_xlabel("time [s]")
    figure.align_ylabels(axes[:, 0])
    handles = [Line2D([], [], **style.MEASURED), *(looks[name].handle for name in scores)]
    style.legend(figure, handles, ["measured", *(_label(n, s) for n, s in scores.items())])
    return figure


def rmse_bars(table: pd.DataFrame, unit: str, *, width: float | None = None) -> Figure:
    """Bars of the position error by joint and model; those that diverged reach the top.

    Args:
        table: a row a model, a column a joint, as `Comparison.table` gives it; infinite where a
            simulation diverged.
        unit: of its values, `"rad"` or `"m"`.
        width: of the figure [in]; default by the number of bars.

    Raises:
        ValueError: if the table is empty.
    """
    values = table.to_numpy(dtype=np.float64)
    if values.size == 0:
        raise ValueError("`table` is empty; it needs a row a model and a column a joint.")
    factor, unit = style.scaled(unit, values)
    models, joints = [str(name) for name in table.index], [str(name) for name in table.columns]
    # Numbers above bars must not overlap.
    room = _BAR * (len(models) + 1) * len(joints) + 0.6
    width = width or (style.COLUMN if room <= style.COLUMN else style.PAGE)
    figure, axes = style.panels(1, 1, width, 2.2)
    ax = axes[0, 0]
    finite = factor * values[np.isfinite(values) & (values > 0)]
    largest, smallest = (finite.max(), finite.min()) if finite.size else (1.0, 1.0)
    if style.spread(values) > style.LOG_FROM:
        # A number above a bar takes a share of the axis, not of the value.
        bottom, top = smallest / 2.5, largest * (largest / smallest) ** 0.3
        style.log_axis(ax, bottom, top)
    else:
        bottom, top = 0.0, 1.3 * largest
        ax.set_ylim(bottom, top)
    bar = 0.84 / len(models)
    looks = style.looks(models)
    for m, model in enumerate(models):
        x = np.arange(len(joints)) + (m - 0.5 * (len(models) - 1)) * bar
        height = np.where(np.isinf(values[m]), top, factor * values[m])
        bars = ax.bar(x, height - bottom, 0.92 * bar, bottom=bottom, **looks[model].bar)
        for patch, value in zip(bars, values[m], strict=True):
            _name_bar(ax, patch.get_x() + patch.get_width() / 2, factor * value, top, bottom)
            patch.set_alpha(0.35 if np.isinf(value) else 1.0)
    ax.set_xticks(range(len(joints)), joints)
    ax.tick_params(axis="x", length=0)
    ax.grid(False, axis="x")
    ax.set_ylabel(f"position RMSE [{unit}]")
    style.legend(figure, ax.containers, models)
    return figure


def horizon_curve(
    comparison: Comparison,
    *,
    part: Part | None = None,
    column: str = "all",
    width: float = style.COLUMN,
) -> Figure:
    """Position error over the length of the simulation, by model.

    The band is the limit of these data, the effect of the start's uncertainty on the best model:
    differences between models below it are not meaningful.

    Args:
        comparison: fits and scores.
        part: `"test"` or `"train"`; default test recordings where there are any.
        column: joint of the tables, or `"all"`.
        width: of the figure [in].
    """
    part = part or comparison.parts[0]
    horizons = [*comparison.horizons(), None]
    tables = [comparison.table(horizon, part=part)[column] for horizon in horizons]
    values = np.stack([table.to_numpy(dtype=np.float64) for table in tables], -1)
    limits = [comparison.limit(h, column, part=part) for h in horizons]
    limit = np.array([np.nan if value is None else value for value in limits])
    shown = values[np.isfinite(values)]
    factor, unit = style.scaled(comparison.unit, shown)
    figure, axes = style.panels(1, 1, width, 2.2)
    ax = axes[0, 0]
    known = factor * np.append(shown, limit[np.isfinite(limit)])
    known = known[known > 0] if (known > 0).any() else np.ones(1)
    bottom, top = known.min() / 1.6, known.max() * 1.6
    diverged = np.isinf(values)
    if diverged.any():
        top *= 1.8
    style.log_axis(ax, bottom, top)
    models = [str(name) for name in tables[0].index]
    looks = style.looks(models)
    x = np.arange(len(horizons))
    handles = []
    for model, errors in zip(models, factor * values, strict=True):
        # A diverged run has no number; its line leaves through the top.
        y = np.where(np.isinf(errors), top, errors)
        handles += ax.plot(x, y, **looks[model].line, **looks[model].marker)
    for k in np.flatnonzero(diverged.any(0)):
        ax.annotate(
            "diverged", (float(k), top), xytext=(0, 5), textcoords="offset points",
            ha="right" if k == x[-1] else "center", fontsize=style.TINY, color=style.INK,
        )  # fmt: skip
    if np.isfinite(limit).any():
        band = ax.fill_between(x, bottom, factor * limit, color=style.BAND, alpha=0.6, lw=0)
        handles.append(band)
        models = [*models, LIMIT]
    ax.set_xlim(-0.3, x[-1] + 0.3)
    ax.set_xticks(x, [f"{h} s" if h else "free run" for h in horizons])
    ax.set_xlabel("length of simulation")
    ax.set_ylabel(f"position RMSE [{unit}]")
    style.legend(figure, handles, models)
    return figure


def _largest(error: np.ndarray) -> float:
    return float(np.max(np.abs(error), where=np.isfinite(error), initial=0.0))


def _label(name: str, score: Score) -> str:
    at = score.diverged_at
    return f"{name} (diverged at {at:.2g} s)" if np.isfinite(at) else name


def _name_bar(ax: Axes, x: float, value: float, top: float, bottom: float) -> None:
    """The value above a bar, upright; in words where there is none."""
    inside = np.isinf(value)
    text = "diverged" if inside else ("n/a" if np.isnan(value) else _digits(value))
    ax.annotate(
        text, (x, top if inside else max(np.nan_to_num(value), bottom)), rotation=90,
        xytext=(0, -3 if inside else 2), textcoords="offset points",
        ha="center", va="top" if inside else "bottom", fontsize=style.TINY, color=style.INK,
    )  # fmt: skip


def _digits(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:#.3g}"
