"""Figures of coefficients: along a motion, and with the intervals that a fit claims."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction.coefficients import Constant
from nfriction.friction.models import FrictionModel
from nfriction.plots import style
from nfriction.signals import Motion


def coefficients_over_time(
    models: Mapping[str, FrictionModel],
    motion: Motion,
    *,
    joint_names: Sequence[str] | None = None,
    unit: str = "rad",
    width: float = style.PAGE,
) -> Figure:
    """Coefficients of models of one law along a motion, a panel a coefficient and joint.

    Args:
        models: by name, all of one law and of as many joints; constant, adaptive or neuro-fuzzy.
        motion: in joint coordinates.
        joint_names: for the titles.
        unit: of a position, `"rad"` or `"m"`.
        width: of the figure [in].

    Raises:
        ValueError: if there is no model, or their coefficients differ.
    """
    laws = {model.law.name for model in models.values()}
    if len(laws) != 1:
        raise ValueError(f"`models` must be one or several of one law, got {sorted(laws)}.")
    first = next(iter(models.values()))
    names = style.joint_labels(joint_names, first.joints)
    along = {name: _along(model, motion) for name, model in models.items()}
    rows, columns = len(first.law.coefficients), first.joints
    figure, axes = style.panels(rows, columns, width, 0.4 + 1.25 * rows, sharex=True)
    looks = style.looks(models)
    for k, coefficient in enumerate(first.law.coefficients):
        for j, ax in enumerate(axes[k]):
            values = [found[:, j, k] for found in along.values()]
            factor, label = style.scaled(style.sliding(coefficient.unit, unit), values)
            for name, value in zip(models, values, strict=True):
                ax.plot(motion.time, factor * value, **looks[name].line)
            both = np.concatenate(values) * factor
            ax.set_ylim(style.padded(float(both.min()), float(both.max())))
            ax.yaxis.set_major_locator(MaxNLocator(4))
            ax.margins(x=0.01)
            ax.set_ylabel(f"{style.symbol(coefficient.name)} [{label}]")
            if k == 0:
                style.title(ax, names[j])
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    style.legend(figure, [Line2D([], [], **looks[name].line) for name in models], list(models))
    return figure


def coefficient_intervals(fits: Mapping[str, FitResult], *, width: float | None = None) -> Figure:
    """Fitted coefficients with their 95 % intervals, a panel a coefficient; joints side by side.

    Intervals reach from edge to edge of a panel where the data tell nothing.

    Args:
        fits: of models with constant coefficients of one law, by name: of other recordings, say.
        width: of the figure [in].

    Raises:
        ValueError: if there is no such fit, or one is of another law.
    """
    laws = {found.model.law.name for found in fits.values()}
    constant = all(isinstance(found.model.schedule, Constant) for found in fits.values())
    if len(laws) != 1 or not constant:
        raise ValueError(
            f"`fits` must be of constant coefficients of one law, got laws {sorted(laws)}."
        )
    first = next(iter(fits.values()))
    joints, law = first.plant.joint_names, first.model.law
    columns = min(len(law.coefficients), 3)
    rows = -(-len(law.coefficients) // columns)
    width = width or (style.COLUMN if columns < 3 else style.PAGE)
    figure, axes = style.panels(rows, columns, width, 0.2 + 1.7 * rows)
    looks = style.looks(fits)
    panels: list[Axes] = axes.ravel().tolist()
    for ax in panels[len(law.coefficients) :]:
        ax.set_visible(False)
    for k, (ax, coefficient) in enumerate(zip(panels, law.coefficients, strict=False)):
        ends = {name: _intervals(found, coefficient.name, k) for name, found in fits.items()}
        known = np.concatenate([e.ravel() for e in ends.values()])
        known = known[np.isfinite(known)]
        low, high = style.padded(float(known.min()), float(known.max()), 0.1)
        unit = style.sliding(coefficient.unit, first.plant.unit)
        factor, label = style.scaled(unit, [low, high])
        for m, (name, of) in enumerate(ends.items()):
            x = np.arange(len(joints)) + 0.6 * ((m + 0.5) / len(fits) - 0.5)
            value, bottom, top = (factor * np.clip(e, low, high) for e in of)
            ax.errorbar(
                x, value, [value - bottom, top - value], capsize=2, elinewidth=1.0,
                **looks[name].line | {"linestyle": ""}, **looks[name].marker,
            )  # fmt: skip
        ax.set_ylim(factor * low, factor * high)
        ax.set_xlim(-0.6, len(joints) - 0.4)
        ax.set_xticks(range(len(joints)), joints)
        ax.grid(False, axis="x")
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.set_ylabel(f"{style.symbol(coefficient.name)} [{label}]")
    if len(fits) > 1:
        handles = [
            Line2D([], [], **looks[n].line | {"linestyle": ""}, **looks[n].marker) for n in fits
        ]
        style.legend(figure, handles, list(fits))
    return figure


def _along(model: FrictionModel, motion: Motion) -> NDArray[np.float64]:
    """Coefficients at every sample, (sample, joint, coefficient)."""
    qd, qdd = torch.tensor(motion.qd), torch.tensor(motion.qdd)
    with torch.no_grad():
        if model.state_size:
            found = model.coefficients_from(qd, qdd, model.schedule.states(qd, qdd))
        else:
            found = model.coefficients(qd, qdd)
    return found.expand(len(qd), -1, -1).numpy()


def _intervals(found: FitResult, name: str, k: int) -> NDArray[np.float64]:
    """Value, lower and upper end of a coefficient of every joint, (3, joint)."""
    schedule = found.model.schedule
    assert isinstance(schedule, Constant)
    told = {i.name: (i.low, i.high) for i in found.intervals}
    rows = []
    for joint, value in zip(
        found.plant.joint_names, schedule.values.detach()[:, k].tolist(), strict=True
    ):
        rows.append((value, *told.get(f"{name} of {joint}", (-math.inf, math.inf))))
    return np.array(rows).T
