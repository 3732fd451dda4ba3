"""Figures of a fit: torque over velocity against what the motion implies, and its convergence."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from nfriction.fitting.equation_error import friction_torque
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
    """Friction torque of each law over velocity, a panel a joint, over what the motion implies.

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
    figure, axes, columns = _joint_grid(plant.joints, width)
    looks = style.looks(models)
    torque_unit = style.sliding("N m", plant.unit)
    for k, ax in enumerate(axes):
        grid = _velocities(qd[:, k])
        lines = {name: _law(model, grid, k) for name, model in models.items()}
        middle = _binned_median(qd[:, k], torque[:, k])
        # The dots scatter far beyond any friction; the laws and most medians set the limits.
        extremes = np.concatenate([*lines.values(), np.quantile(middle[1], [0.05, 0.95])])
        factor, unit = style.scaled(torque_unit, extremes)
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
            ax.set_xlabel(f"joint velocity [{style.velocity_unit(plant.unit)}]")
    handles = [
        Line2D([], [], linestyle="", marker=".", color=style.FAINT),
        Line2D([], [], linestyle="", marker="o", color=style.INK, markersize=2.2),
        *(Line2D([], [], **looks[name].line) for name in models),
    ]
    style.legend(figure, handles, ["from the motion", "its median", *models])
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
        quantity: what they are, with its unit.
        width: of the figure [in].

    Raises:
        ValueError: if there is nothing to show.
    """
    named = history if isinstance(history, Mapping) else {"": history}
    curves = {
        str(name): np.array([s.cost if isinstance(s, Step) else float(s) for s in steps])
        for name, steps in named.items()
    }
    values = np.concatenate([np.zeros(0), *curves.values()])
    if not np.isfinite(values).any():
        raise ValueError("`history` has no finite value; give the cost at each step.")
    figure, axes = style.panels(1, 1, width, 2.3)
    ax = axes[0, 0]
    looks = style.looks(curves)
    for name, curve in curves.items():
        ax.plot(np.arange(len(curve)), curve, **looks[name].line, marker=".", markersize=4)
    finite = values[np.isfinite(values)]
    if finite.min() > 0 and style.spread(finite) > style.LOG_FROM:
        ax.set_yscale("log")
    else:
        ax.ticklabel_format(axis="y", useOffset=False)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("step")
    ax.set_ylabel(quantity)
    if any(curves):
        style.legend(figure, ax.lines, list(curves))
    return figure


def _joint_grid(joints: int, width: float | None) -> tuple[Figure, list[Axes], int]:
    """A panel a joint, up to three side by side; what is left over of the grid is blank."""
    columns = min(joints, 3) if joints != 4 else 2
    rows = -(-joints // columns)
    width = width or (style.COLUMN if columns == 1 else style.PAGE)
    figure, axes = style.panels(rows, columns, width, 0.2 + 2.0 * rows)
    for ax in axes.flat[joints:]:
        ax.set_visible(False)
    return figure, list(axes.flat[:joints]), columns


def _velocities(qd: Array) -> Array:
    """The range of the data, dense about zero, where laws turn over a few thousandths."""
    low, high = float(qd.min()), float(qd.max())
    near = np.geomspace(1e-5, 1.0, 100) * max(abs(low), abs(high))
    grid = np.unique(np.concatenate([np.linspace(low, high, 300), -near, [0.0], near]))
    return grid[(grid >= low) & (grid <= high)]


def _law(model: FrictionModel, qd: Array, joint: int) -> Array:
    """Torque of one joint over its velocity, at the load at rest and without acceleration."""
    velocity = torch.as_tensor(qd)[:, None].expand(-1, model.joints)
    with torch.no_grad():
        torque = model(velocity, torch.zeros_like(velocity), torch.ones_like(velocity))
    return torque[:, joint].numpy()


def _binned_median(x: Array, y: Array) -> tuple[Array, Array]:
    """Medians of x and y in bins of equally many samples of ascending x."""
    bins = np.array_split(np.argsort(x), min(_BINS, len(x)))
    return np.array([np.median(x[b]) for b in bins]), np.array([np.median(y[b]) for b in bins])
