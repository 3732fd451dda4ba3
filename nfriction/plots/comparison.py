"""Figures of a comparison: errors, torque over velocity, intervals of its fits."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from nfriction.evaluation.compare import LIMIT, NO_FRICTION, Comparison, Part
from nfriction.evaluation.score import Score
from nfriction.fitting.equation_error import friction_torque
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.identifiability import NORMAL_95, CoefficientUncertainty
from nfriction.friction import both_names
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant
from nfriction.plots import style
from nfriction.recording import Recording
from nfriction.signals import Motion, kalman_smoother

Array = NDArray[np.float64]

# Room that a bar and its number need side by side with others [in].
_BAR = 0.13
_POINTS = 3000  # of the scatter of torques, a joint


def motion(
    recording: Recording,
    scores: Mapping[str, Score] | None = None,
    *,
    joints: Sequence[int] | None = None,
) -> Figure:
    """Measured positions over time, a panel a joint, under simulated ones.

    Args:
        recording: the measured motion, in its own convention and unit.
        scores: scores on this very recording by name, whose simulated positions are drawn.
        joints: places of the joints to draw; all by default.

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
        # Simulations that leave the measured range would flatten it.
        ax.set_ylim(style.padded(float(measured.min()), float(measured.max()), 0.25))
        ax.set_ylabel(f"{recording.names[joint]} [{recording.unit}]")
        ax.margins(x=0.01)
    axes[-1, 0].set_xlabel("time [s]")
    figure.align_ylabels(axes[:, 0])
    handles = [Line2D([], [], **style.MEASURED), *(looks[name].handle for name in scores)]
    style.legend(figure, handles, ["measured", *scores])
    return figure


def positions(recording: Recording, scores: Mapping[str, Score]) -> Figure:
    """Measured against simulated position, a pair of panels a joint: position, error below.

    A panel spans the measured range, and the errors of models that did not diverge, up to half of
    that. The error without friction, which would leave it at every swing, is drawn only where
    there is no other model.

    Args:
        recording: the measured motion, in its own convention and unit.
        scores: scores on this very recording by model name, simulated positions included.

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
        shown = min(max(_largest(e) for n, e in errors.items() if n in whole), 0.5 * span) or span
        factor, unit = 1e3, f"m{recording.unit}"  # as in every table
        for model, error in errors.items():
            position.plot(recording.time, scores[model].simulated[:, joint], **looks[model].line)
            if model != NO_FRICTION or len(scores) == 1:
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


def rmse_bars(table: pd.DataFrame, unit: str) -> Figure:
    """Bars of the position error by joint and model; those that diverged reach the top.

    Args:
        table: a row a model, a column a joint, as `Comparison.table` gives it; infinite where a
            simulation diverged.
        unit: of its values, `"rad"` or `"m"`.

    Raises:
        ValueError: if the table is empty.
    """
    values = table.to_numpy(dtype=np.float64)
    if values.size == 0:
        raise ValueError("`table` is empty; it needs a row a model and a column a joint.")
    values = 1e3 * values  # as in every table
    models, joints = [str(name) for name in table.index], [str(name) for name in table.columns]
    # Numbers above bars must not overlap.
    room = _BAR * (len(models) + 1) * len(joints) + 0.6
    width = style.COLUMN if room <= style.COLUMN else style.PAGE
    figure, axes = style.panels(1, 1, width, 2.2)
    ax = axes[0, 0]
    finite = values[np.isfinite(values) & (values > 0)]
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
    comparison: Comparison,
    *,
    part: Part | None = None,
    column: str = "all",
) -> Figure:
    """Position error over the length of the simulation, by model.

    The band is the limit of these data, the effect of the start's uncertainty on the best model:
    differences between models below it are not meaningful.

    Args:
        comparison: fits and scores.
        part: `"test"` or `"train"`; default test recordings where there are any.
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


def torque_over_velocity(
    plant: Plant,
    models: Mapping[str, FrictionModel],
    recordings: Sequence[Recording],
    motions: Sequence[Motion] | None = None,
    *,
    uncertainty: Mapping[str, CoefficientUncertainty] | None = None,
) -> Figure:
    """Friction torque of each law over velocity, a panel a joint, over that of the motion.

    Lines are at the load at rest and without acceleration, with 95 % bands; dots are
    `tau - M qdd - bias` along the recordings, averaged over 30 ms in which the joint turns one way.

    Args:
        plant: the mechanism, with its fitted terms where there are any.
        models: friction models by name.
        recordings: in any convention.
        motions: their smoothed motion in joint coordinates; computed where not given.
        uncertainty: of the models' fits by name (`FitResult.uncertainty`), for the bands.
    """
    joint = [r.joint_coordinates(plant) for r in recordings]
    motions = motions or [kalman_smoother(r.time, r.q) for r in joint]
    known = uncertainty or {}
    with torch.no_grad():
        parts = [
            _averaged(*friction_torque(plant, r, m)[::2], r.sample_time)
            for r, m in zip(joint, motions, strict=True)
        ]
    qd, torque = (np.concatenate(x) for x in zip(*parts, strict=True))
    columns = min(plant.joints, 3) if plant.joints != 4 else 2
    figure, axes = style.panel_each(
        plant.joints, columns, style.PAGE if columns > 1 else style.COLUMN, 2.0
    )
    looks = style.looks(models)
    for k, ax in enumerate(axes):
        grid = velocities(qd[:, k])
        lines = {name: _torque(model, grid, k) for name, model in models.items()}
        seen = np.flatnonzero(np.isfinite(torque[:, k]))
        # Dots may scatter far beyond any friction; the laws and most dots set the limits.
        most = np.quantile(torque[seen, k], [0.05, 0.95]) if len(seen) else np.zeros(0)
        extremes = np.concatenate([*lines.values(), most])
        factor, unit = style.scaled(style.sliding("N m", plant.unit), extremes)
        some = seen[np.linspace(0, len(seen) - 1, min(_POINTS, len(seen))).astype(int)]
        ax.plot(
            qd[some, k], factor * torque[some, k], ".", color=style.FAINT, markersize=2.5,
            alpha=0.5, markeredgewidth=0, rasterized=True,
        )  # fmt: skip
        for name, line in lines.items():
            ax.plot(grid, factor * line, **looks[name].line)
            if name in known:
                reach = NORMAL_95 * _torque_sd(known[name], models[name], grid, k)
                low, high = (factor * (line + sign * reach) for sign in (-1, 1))
                colour = looks[name].line["color"]
                ax.fill_between(grid, low, high, color=colour, alpha=0.25, linewidth=0)
        ax.set_ylim(style.padded(factor * extremes.min(), factor * extremes.max(), 0.15))
        ax.margins(x=0.02)
        style.title(ax, plant.joint_names[k])
        ax.set_ylabel(f"friction {'torque' if plant.unit == 'rad' else 'force'} [{unit}]")
        if k + columns >= plant.joints:
            ax.set_xlabel(f"joint velocity [{plant.unit}/s]")
    handles: list[Artist] = [
        Line2D([], [], linestyle="", marker=".", color=style.FAINT),
        *(looks[name].handle for name in models),
    ]
    labels = ["from the motion", *models]
    if any(name in known for name in models):
        handles.append(Patch(facecolor=style.FAINT, alpha=0.4))
        labels.append("95 % bands")
    style.legend(figure, handles, labels)
    return figure


def _averaged(qd: torch.Tensor, torque: torch.Tensor, step: float) -> tuple[Array, Array]:
    """Means over blocks of samples, NaN where a joint does not turn one way throughout."""
    size = max(1, round(DEFAULTS.diagnosis_block / step))
    size = min(size, max(1, len(qd)))
    whole = len(qd) // size * size
    speeds, torques = (x[:whole].reshape(-1, size, x.shape[-1]) for x in (qd, torque))
    one_way = torch.sign(speeds).mean(1).abs() == 1
    # Dry friction takes any value at rest.
    return speeds.mean(1).numpy(), torch.where(one_way, torques.mean(1), torch.nan).numpy()


def coefficient_intervals(fits: Mapping[str, FitResult]) -> Figure:
    """Fitted coefficients with their 95 % intervals, a panel a coefficient; joints side by side.

    Intervals of unidentifiable coefficients reach from edge to edge of a panel.

    Args:
        fits: of models with constant coefficients of one law, by name: of other recordings, say.

    Raises:
        ValueError: if there is no such fit, or one is of another law.
    """
    laws = {found.model.law.name for found in fits.values()}
    if len(laws) != 1 or any(found.model.schedule.follows_motion for found in fits.values()):
        raise ValueError(
            f"`fits` must be of constant coefficients of one law, got laws {sorted(laws)}."
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
                f"recording {recording.q.shape}; scores must be of this very recording."
            )


def _largest(error: np.ndarray) -> float:
    return float(np.max(np.abs(error), where=np.isfinite(error), initial=0.0))


def _label(name: str, score: Score) -> str:
    at = score.diverged_at
    return f"{both_names(name)}, diverged at {at:.2g} s" if np.isfinite(at) else name


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


def velocities(qd: Array) -> Array:
    """The range of the data, dense about zero, where laws turn over a few thousandths."""
    low, high = float(qd.min()), float(qd.max())
    # Evenly spaced velocities would draw the step at zero as a slope.
    near = np.geomspace(1e-5, 1.0, 100) * max(abs(low), abs(high))
    grid = np.unique(np.concatenate([np.linspace(low, high, 300), -near, [0.0], near]))
    return grid[(grid >= low) & (grid <= high)]


def _torque(model: FrictionModel, qd: Array, joint: int) -> Array:
    """Torque of one joint over its velocity, at the load at rest and without acceleration."""
    velocity = torch.as_tensor(qd)[:, None].expand(-1, model.joints)
    with torch.no_grad():
        held = model.coefficients(velocity, torch.zeros_like(velocity))
        torque = model.steady_torque(velocity, torch.ones_like(velocity), held)
    return torque[:, joint].numpy()


def _torque_sd(known: CoefficientUncertainty, model: FrictionModel, qd: Array, joint: int) -> Array:
    """Standard deviation of one joint's torque over its velocity."""
    velocity = torch.as_tensor(qd)[:, None].expand(-1, model.joints).contiguous()
    return known.torque_sd(model, velocity)[:, joint].numpy()


def _intervals(found: FitResult, name: str, k: int) -> Array:
    """Value, lower and upper end of a coefficient of every joint, (3, joint)."""
    ends = {i.name: (i.low, i.high) for i in found.intervals}
    values = found.model.schedule.coefficient_sets()["always"][:, k].tolist()
    return np.array([
        (value, *ends.get(f"{name} of {joint}", (-math.inf, math.inf)))
        for joint, value in zip(found.plant.joint_names, values, strict=True)
    ]).T  # fmt: skip
