"""Figures of a comparison: errors, motions, intervals of its fits, and all of them as files."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from nfriction.evaluation.compare import LIMIT, NO_FRICTION, Comparison, Part
from nfriction.evaluation.score import Score
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction import both_names
from nfriction.plots import neurofuzzy, style
from nfriction.plots.drawing import mechanism
from nfriction.plots.friction_torque import torque_over_velocity
from nfriction.recording import Array, Recording

# Width that a bar and its number need next to others [in].
_BAR = 0.13


def motion(
    recording: Recording,
    scores: Mapping[str, Score] | None = None,
    *,
    joints: Sequence[int] | None = None,
) -> Figure:
    """Measured positions over time, one panel per joint, under simulated ones.

    Args:
        recording: the measured motion, in its own convention and unit.
        scores: scores on the same recording by name, whose simulated positions are drawn.
        joints: indices of the joints to draw; all by default.

    Raises:
        ValueError: if a score belongs to another recording.
    """
    scores = scores or {}
    _check_same_recording(recording, scores)
    places = range(recording.joints) if joints is None else joints
    figure, axes = style.panels(len(places), 1, style.PAGE, 0.4 + 1.7 * len(places), sharex=True)
    looks = style.looks(scores)
    for joint, ax in zip(places, axes[:, 0], strict=True):
        measured = recording.q[:, joint]
        ax.plot(recording.time, measured, **style.MEASURED)
        for name, score in scores.items():
            ax.plot(recording.time, score.simulated[:, joint], **looks[name].line)
        # Otherwise simulations that leave the measured range would flatten it.
        ax.set_ylim(style.padded(float(measured.min()), float(measured.max()), 0.25))
        ax.set_ylabel(f"{recording.names[joint]} [{recording.unit}]")
        ax.margins(x=0.01)
    axes[-1, 0].set_xlabel("time [s]")
    figure.align_ylabels(axes[:, 0])
    handles = [Line2D([], [], **style.MEASURED), *(looks[name].handle for name in scores)]
    style.legend(figure, handles, ["measured", *scores])
    return figure


def positions(recording: Recording, scores: Mapping[str, Score]) -> Figure:
    """Measured and simulated position, two panels per joint: position, and the error below.

    Panels span the measured range, and the errors of models that did not diverge, up to half of
    that range. The error without friction, which would exceed it at every swing, is drawn only if
    there is no other model.

    Args:
        recording: the measured motion, in its own convention and unit.
        scores: scores on the same recording by model name, including simulated positions.

    Raises:
        ValueError: if there are no scores, or one belongs to another recording.
    """
    if not scores:
        raise ValueError("`scores` is empty; give at least one model's score on the recording.")
    _check_same_recording(recording, scores)
    joints = recording.joints
    figure, axes = style.panels(
        2 * joints, 1, style.PAGE, 0.4 + 1.7 * joints, sharex=True, height_ratios=[1, 1] * joints
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
        seen = np.abs([e for n, e in errors.items() if n in whole])
        shown = min(np.max(seen, where=np.isfinite(seen), initial=0.0), 0.5 * span) or span
        for model, error in errors.items():
            position.plot(recording.time, scores[model].simulated[:, joint], **looks[model].line)
            if model != NO_FRICTION or len(scores) == 1:
                # In thousandths, as in every table.
                below.plot(recording.time, 1e3 * error, **looks[model].line)
        low, high = float(measured.min()), float(measured.max())
        position.set_ylim(low - 0.25 * span, high + 0.25 * span)
        below.set_ylim(style.padded(-1e3 * shown, 1e3 * shown))
        position.set_ylabel(f"{name} [{recording.unit}]")
        below.set_ylabel(f"error [m{recording.unit}]")
        for ax in (position, below):
            ax.yaxis.set_major_locator(MaxNLocator(4))
            ax.margins(x=0.01)
    axes[-1, 0].set_xlabel("time [s]")
    figure.align_ylabels(axes[:, 0])
    handles = [Line2D([], [], **style.MEASURED), *(looks[name].handle for name in scores)]
    labels = [
        f"{both_names(n)}, diverged at {s.diverged_at:.2g} s" if np.isfinite(s.diverged_at) else n
        for n, s in scores.items()
    ]
    style.legend(figure, handles, ["measured", *labels])
    return figure


def rmse_bars(table: pd.DataFrame, unit: str) -> Figure:
    """Bars of the position error by joint and model; those of diverged simulations reach the top.

    Args:
        table: one row per model, one column per joint, as from `Comparison.table`; infinite if a
            simulation diverged.
        unit: of its values, `"rad"` or `"m"`.

    Raises:
        ValueError: if the table is empty.
    """
    values = table.to_numpy(dtype=np.float64)
    if values.size == 0:
        raise ValueError("`table` is empty; it needs one row per model and one column per joint.")
    values = 1e3 * values  # as in every table
    models, joints = [str(name) for name in table.index], [str(name) for name in table.columns]
    # Numbers above bars must not overlap.
    room = _BAR * (len(models) + 1) * len(joints) + 0.6
    width = style.COLUMN if room <= style.COLUMN else style.PAGE
    figure, axes = style.panels(1, 1, width, 2.2)
    ax = axes[0, 0]
    finite = values[np.isfinite(values) & (values > 0)]
    largest, smallest = (finite.max(), finite.min()) if finite.size else (1.0, 1.0)
    if largest > style.LOG_FROM * smallest:
        # A number above a bar takes up a share of the axis, not of the value.
        bottom, top = smallest / 2.5, largest * (largest / smallest) ** 0.3
        style.log_axis(ax, bottom, top)
    else:
        bottom, top = 0.0, 1.3 * largest
        ax.set_ylim(bottom, top)
    bar = 0.84 / len(models)
    looks = style.looks(models)
    for m, model in enumerate(models):
        x = np.arange(len(joints)) + (m - 0.5 * (len(models) - 1)) * bar
        height = np.where(np.isinf(values[m]), top, values[m])
        bars = ax.bar(x, height - bottom, 0.92 * bar, bottom=bottom, **looks[model].bar)
        for patch, value in zip(bars, values[m], strict=True):
            _name_bar(ax, patch.get_x() + patch.get_width() / 2, value, top, bottom)
            patch.set_alpha(0.35 if np.isinf(value) else 1.0)
    ax.set_xticks(range(len(joints)), joints)
    ax.tick_params(axis="x", length=0)
    ax.grid(False, axis="x")
    ax.set_ylabel(f"position RMSE [m{unit}]")
    style.legend(figure, ax.containers, models)
    return figure


def horizon_curve(
    comparison: Comparison, *, part: Part | None = None, column: str = "all"
) -> Figure:
    """Position error over the length of the simulation, by model.

    The band is the limit of these data, the effect of noise and integration on the best model:
    smaller differences between models are not meaningful.

    Args:
        part: `"test"` or `"train"`; by default test recordings if there are any.
        column: joint of the tables, or `"all"`.
    """
    part = part or comparison.parts[0]
    horizons = [*comparison.horizons(), None]
    tables = [comparison.table(horizon, part=part)[column] for horizon in horizons]
    # In thousandths, as in every table.
    values = 1e3 * np.stack([table.to_numpy(dtype=np.float64) for table in tables], -1)
    limits = [comparison.limit(h, column, part=part) for h in horizons]
    limit = 1e3 * np.array([np.nan if value is None else value for value in limits])
    figure, axes = style.panels(1, 1, style.COLUMN, 2.2)
    ax = axes[0, 0]
    known = np.append(values[np.isfinite(values)], limit[np.isfinite(limit)])
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
    for model, errors in zip(models, values, strict=True):
        # A diverged run has no number; its line leaves through the top.
        y = np.where(np.isinf(errors), top, errors)
        handles += ax.plot(x, y, **looks[model].line, **looks[model].marker)
    for k in np.flatnonzero(diverged.any(0)):
        ax.annotate(
            "diverged", (float(k), top), xytext=(0, 5), textcoords="offset points",
            ha="right" if k == x[-1] else "center", fontsize=style.TINY, color=style.INK,
        )  # fmt: skip
    if np.isfinite(limit).any():
        band = ax.fill_between(x, bottom, limit, color=style.BAND, alpha=0.6, lw=0)
        handles.append(band)
        models = [*models, LIMIT]
    ax.set_xlim(-0.3, x[-1] + 0.3)
    ax.set_xticks(x, [f"{h} s" if h else "free run" for h in horizons])
    ax.set_xlabel("length of simulation")
    ax.set_ylabel(f"position RMSE [m{comparison.unit}]")
    style.legend(figure, handles, models)
    return figure


def coefficient_intervals(fits: Mapping[str, FitResult]) -> Figure:
    """Fitted coefficients with 95 % intervals, one panel per coefficient; joints side by side.

    Intervals of unidentifiable coefficients span the whole panel.

    Args:
        fits: of models of one law with constant coefficients, by name, such as of its recording.

    Raises:
        ValueError: if there is no fit, or their laws differ.
    """
    laws = {found.model.law.name for found in fits.values()}
    if len(laws) != 1 or any(found.model.schedule.follows_motion for found in fits.values()):
        raise ValueError(
            f"`fits` must have constant coefficients of one law, got laws {sorted(laws)}."
        )
    first = next(iter(fits.values()))
    joints, law = first.plant.joint_names, first.model.law
    columns = min(len(law.coefficients), 3)
    width = style.COLUMN if columns < 3 else style.PAGE
    figure, axes = style.panel_each(len(law.coefficients), columns, width, 1.7)
    looks = {name: {**look.line, "linestyle": "", **look.marker}
             for name, look in style.looks(fits).items()}  # fmt: skip
    for k, (ax, coefficient) in enumerate(zip(axes, law.coefficients, strict=True)):
        ends = {name: _intervals(found, coefficient.name, k) for name, found in fits.items()}
        known = np.concatenate([e.ravel() for e in ends.values()])
        known = known[np.isfinite(known)]
        low, high = style.padded(float(known.min()), float(known.max()), 0.1)
        factor = style.coefficient_axis(ax, coefficient, first.plant.unit, [low, high])
        for m, (name, of) in enumerate(ends.items()):
            x = np.arange(len(joints)) + 0.6 * ((m + 0.5) / len(fits) - 0.5)
            # Open intervals end at the edges of the panel.
            value, bottom, top = (factor * np.clip(e, low, high) for e in of)
            ax.errorbar(
                x, value, [value - bottom, top - value], capsize=2, elinewidth=1.0, **looks[name]
            )
        ax.set_ylim(factor * low, factor * high)
        ax.set_xlim(-0.6, len(joints) - 0.4)
        ax.set_xticks(range(len(joints)), joints)
        ax.grid(False, axis="x")
    if len(fits) > 1:
        style.legend(figure, [Line2D([], [], **looks[name]) for name in fits], list(fits))
    return figure


def _check_same_recording(recording: Recording, scores: Mapping[str, Score]) -> None:
    for name, score in scores.items():
        if score.simulated.shape != recording.q.shape:
            raise ValueError(
                f"the score of {name!r} has simulated positions {score.simulated.shape}, the "
                f"recording {recording.q.shape}; scores must be of the same recording."
            )


def _name_bar(ax: Axes, x: float, value: float, top: float, bottom: float) -> None:
    """The value above a bar, upright; a word if it is infinite."""
    inside = np.isinf(value)
    digits = f"{value:.0f}" if value >= 100 else f"{value:#.3g}"
    text = "diverged" if inside else "n/a" if np.isnan(value) else digits
    ax.annotate(
        text, (x, top if inside else max(np.nan_to_num(value), bottom)), rotation=90,
        xytext=(0, -3 if inside else 2), textcoords="offset points",
        ha="center", va="top" if inside else "bottom", fontsize=style.TINY, color=style.INK,
    )  # fmt: skip


def _intervals(found: FitResult, name: str, k: int) -> Array:
    """Value, lower and upper end of a coefficient of every joint, (3, joint)."""
    ends = {i.name: (i.low, i.high) for i in found.intervals}
    values = found.model.schedule.coefficient_sets()["always"][:, k].tolist()
    return np.array([
        (value, *ends.get(f"{name} of {joint}", (-math.inf, math.inf)))
        for joint, value in zip(found.plant.joint_names, values, strict=True)
    ]).T  # fmt: skip


DPI = 150
RUN_KEY = "nfriction run"  # key of the text in a PNG file that names its run


def save_all(
    comparison: Comparison,
    recordings: Sequence[Recording],
    folder: str | Path,
    *,
    run: str = "",
    formats: Sequence[str] = (),
) -> list[Path]:
    """Write every figure of a comparison as PNG; returns the files written.

    `mechanism`, `rmse_*` and `horizons_*` for test and training recordings, `positions_*` for each
    given recording, `torque_over_velocity`, `over_time_*` for each law with a model that follows
    the motion, and for each neuro-fuzzy model `coefficients_*`, `sections_*` and `memberships_*`. A
    rejected network has constant coefficients and none of these.

    Args:
        recordings: those compared, or some of them; others raise ValueError.
        folder: made if it does not exist; files of the same name are replaced.
        run: id of the run, written into each PNG file.
        formats: additional ones: `"svg"` or `"pdf"` for papers, `"gif"` for animations of the test
            recordings, `motion_1.gif` and so on.
    """
    scored = {
        s.recording for p in comparison.parts for s in next(iter(comparison.scores(p).values()))
    }
    for recording in recordings:
        if recording.name not in scored:
            raise ValueError(
                f"recording {recording.name!r} is not in the comparison, which has "
                f"{', '.join(sorted(scored))}."
            )
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for name, figure in _figures(comparison, recordings):
        stem = re.sub(r"[^\w-]+", "_", name)
        # Names of recordings may differ only in characters that are replaced here.
        ends = ("", *(f"_{k}" for k in range(2, 3 + len(written))))
        path = next(p for end in ends if (p := folder / f"{stem}{end}.png") not in written)
        kept = {RUN_KEY: run} if run else {}
        figure.savefig(path, dpi=DPI, metadata=kept)
        for ending in dict.fromkeys(f for f in formats if f != "gif"):
            figure.savefig(path.with_suffix(f".{ending}"))
            written.append(path.with_suffix(f".{ending}"))
        figure.clear()
        written.append(path)
    if "gif" in formats and comparison.fits:
        tested = {s.recording for of in comparison.test.values() for s in of}
        for k, recording in enumerate(r for r in recordings if r.name in tested):
            written.append(comparison.animate(recording, folder / f"motion_{k + 1}.gif"))
    return written


def _figures(
    comparison: Comparison, recordings: Sequence[Recording]
) -> Iterator[tuple[str, Figure]]:
    """Name and figure, one after the other, so that only one is in memory."""
    for part in comparison.parts:
        scores = comparison.scores(part)
        table = comparison.table(part=part)
        if len(comparison.joint_names) == 1:
            table = table.drop(columns="all")  # it would repeat the joint's bars
        yield f"rmse_{part}", rmse_bars(table, comparison.unit)
        yield f"horizons_{part}", horizon_curve(comparison, part=part)
        for recording in recordings:
            of = {m: s for m, many in scores.items() for s in many if s.recording == recording.name}
            if of:
                yield f"positions_{part}_{recording.name}", positions(recording, of)
    # A comparison read from a file has only scores.
    if not comparison.fits:
        return
    last = list(comparison.fits.values())[-1]
    yield "mechanism", mechanism(last.plant)
    moved = last.motions
    if last.encoder_offsets:
        # Motions are kept as recorded; the plant expects corrected angles.
        pairs = zip(moved, last.encoder_offsets, strict=True)
        moved = tuple(replace(m, q=m.q + offset) for m, offset in pairs)
    order = [s.recording for s in next(iter(comparison.train.values()))]
    trained = dict(zip(order, moved, strict=True))
    # A mechanism that was held at first is fitted from its release.
    given = [r[r.time >= trained[r.name].time[0]] for r in recordings if r.name in trained]
    models = {name: found.model for name, found in comparison.fits.items()}
    if given:
        motions = [trained[r.name] for r in given]
        bands = {n: f.uncertainty for n, f in comparison.fits.items() if f.uncertainty is not None}
        plants = {name: found.plant for name, found in comparison.fits.items()}
        figure = torque_over_velocity(
            last.plant, models, given, motions, uncertainty=bands, plants=plants
        )
        yield "torque_over_velocity", figure
    labels: dict[str, Any] = {"joint_names": comparison.joint_names, "unit": comparison.unit}
    # Constants along the motion are worth drawing only with coefficients that follow it.
    moving = [m for m in models.values() if "always" not in m.schedule.coefficient_sets()]
    for law in dict.fromkeys(model.law.name for model in moving):
        drawn = neurofuzzy.coefficients_over_time(models, moved[0], law=law, **labels)
        yield f"over_time_{law}", drawn
    for name, found in comparison.fits.items():
        if (rules := found.model.schedule.fuzzy_rules()) is not None and not rules.constant:
            known = labels | {"motions": last.motions, "uncertainty": found.uncertainty}
            yield f"coefficients_{name}", neurofuzzy.coefficient_surfaces(found.model, **known)
            yield f"sections_{name}", neurofuzzy.coefficient_sections(found.model, **known)
            yield f"memberships_{name}", neurofuzzy.memberships(found.model, **labels)
