"""Figures of fits: torque over velocity, coefficients with their intervals, convergence."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from nfriction.fitting.equation_error import friction_torque
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import Step
from nfriction.plant import Plant
from nfriction.plots import style
from nfriction.recording import Recording
from nfriction.signals import Motion, kalman_smoother

Array = NDArray[np.float64]

_POINTS = 3000  # of the scatter, a joint
_BINS = 24  # of its medians


def torque_over_velocity(
    plant: Plant,
    models: Mapping[str, FrictionModel],
    recordings: Sequence[Recording],
    motions: Sequence[Motion] | None = None,
    *,
    width: float | None = None,
) -> Figure:
    """Friction torque of each law over velocity, a panel a joint, over that of the motion.

    Lines are at the load at rest and without acceleration; dots are `tau - M qdd - bias` along the
    recordings, with their median in bins of equally many samples.

    Args:
        plant: the mechanism, with its fitted terms where there are any.
        models: friction models by name.
        recordings: in any convention.
        motions: their smoothed motion in joint coordinates; computed where not given.
        width: of the figure [in].
    """
    joint = [r.joint_coordinates(plant) for r in recordings]
    motions = motions or [kalman_smoother(r.time, r.q) for r in joint]
    with torch.no_grad():
        parts = [friction_torque(plant, r, m) for r, m in zip(joint, motions, strict=True)]
        qd = torch.cat([p[0] for p in parts]).numpy()
        torque = torch.cat([p[2] for p in parts]).numpy()
    columns = min(plant.joints, 3) if plant.joints != 4 else 2
    figure, axes = style.panel_each(plant.joints, columns, width, 2.0)
    looks = style.looks(models)
    for k, ax in enumerate(axes):
        grid = _velocities(qd[:, k])
        lines = {name: _torque(model, grid, k) for name, model in models.items()}
        bins = np.array_split(np.argsort(qd[:, k]), min(_BINS, len(qd)))
        middle = [np.array([np.median(x[b, k]) for b in bins]) for x in (qd, torque)]
        # The dots scatter far beyond any friction; the laws and most medians set the limits.
        extremes = np.concatenate([*lines.values(), np.quantile(middle[1], [0.05, 0.95])])
        factor, unit = style.scaled(style.sliding("N m", plant.unit), extremes)
        some = np.linspace(0, len(qd) - 1, min(_POINTS, len(qd))).astype(int)
        ax.plot(
            qd[some, k], factor * torque[some, k], ".", color=style.FAINT, markersize=2.0,
            alpha=0.35, markeredgewidth=0, rasterized=True,
        )  # fmt: skip
        for name, line in lines.items():
            ax.plot(grid, factor * line, **looks[name].line)
        ax.plot(middle[0], factor * middle[1], "o", color=style.INK, markersize=2.2, zorder=3)
        ax.set_ylim(style.padded(factor * extremes.min(), factor * extremes.max(), 0.15))
        ax.margins(x=0.02)
        style.title(ax, plant.joint_names[k])
        ax.set_ylabel(f"friction {'torque' if plant.unit == 'rad' else 'force'} [{unit}]")
        if k + columns >= plant.joints:
            ax.set_xlabel(f"joint velocity [{plant.unit}/s]")
    handles = [
        Line2D([], [], linestyle="", marker=".", color=style.FAINT),
        Line2D([], [], linestyle="", marker="o", color=style.INK, markersize=2.2),
        *(looks[name].handle for name in models),
    ]
    style.legend(figure, handles, ["from the motion", "its median", *models])
    return figure


def coefficient_intervals(fits: Mapping[str, FitResult], *, width: float | None = None) -> Figure:
    """Fitted coefficients with their 95 % intervals, a panel a coefficient; joints side by side.

    Intervals of unidentifiable coefficients reach from edge to edge of a panel.

    Args:
        fits: of models with constant coefficients of one law, by name: of other recordings, say.
        width: of the figure [in].

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
    width = width or (style.COLUMN if columns < 3 else style.PAGE)
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


def convergence(
    history: Sequence[float | Step] | Mapping[str, Sequence[float | Step]],
    *,
    quantity: str = "cost",
    width: float = style.COLUMN,
) -> Figure:
    """A solver's cost over its steps, logarithmic where it falls far.

    Args:
        history: values before each step, or a solver's `Step`s; by name to compare several.
        quantity: label of the values, with their unit.
        width: of the figure [in].

    Raises:
        ValueError: if there is no finite value.
    """
    named = history if isinstance(history, Mapping) else {"": history}
    curves = {
        str(name): np.array([s.cost if isinstance(s, Step) else float(s) for s in steps])
        for name, steps in named.items()
    }
    values = np.concatenate([np.zeros(0), *curves.values()])
    finite = values[np.isfinite(values)]
    if not finite.size:
        raise ValueError("`history` has no finite value; give the cost at each step.")
    figure, axes = style.panels(1, 1, width, 2.3)
    ax = axes[0, 0]
    looks = style.looks(curves)
    for name, curve in curves.items():
        ax.plot(np.arange(len(curve)), curve, **looks[name].line, marker=".", markersize=4)
    if finite.min() > 0 and style.spread(finite) > style.LOG_FROM:
        ax.set_yscale("log")
    else:
        # Offsets hide the size of a cost that changes little.
        ax.ticklabel_format(axis="y", useOffset=False)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("step")
    ax.set_ylabel(quantity)
    if any(curves):
        style.legend(figure, ax.lines, list(curves))
    return figure


def _velocities(qd: Array) -> Array:
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
        torque = model(velocity, torch.zeros_like(velocity), torch.ones_like(velocity))
    return torque[:, joint].numpy()


def _intervals(found: FitResult, name: str, k: int) -> Array:
    """Value, lower and upper end of a coefficient of every joint, (3, joint)."""
    ends = {i.name: (i.low, i.high) for i in found.intervals}
    values = found.model.schedule.coefficient_sets()["always"][:, k].tolist()
    return np.array([
        (value, *ends.get(f"{name} of {joint}", (-math.inf, math.inf)))
        for joint, value in zip(found.plant.joint_names, values, strict=True)
    ]).T  # fmt: skip
