"""Friction torque over velocity of a table, with the laws fitted to it."""

from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from nfriction.fitting.result.identifiability import NORMAL_95
from nfriction.friction import plain_name
from nfriction.plots import style

if TYPE_CHECKING:
    from nfriction.evaluation.torque_tables import TorqueFits
    from nfriction.fitting.torque_table import JointFit
    from nfriction.recording.torque_table import JointTorque

Array = NDArray[np.float64]

_POINTS = 3000  # rows that are drawn, a joint
_BINS = 24  # of medians


def friction_curves(fits: "TorqueFits") -> Figure:
    """Friction torque over velocity, a panel a joint: rows, medians of bins, and the laws.

    Lines are the laws at the median load and without acceleration; of laws with memory, where the
    joint slides at a constant velocity. The law chosen is drawn thick, with the 95 % band that the
    uncertainty of its coefficients leaves; bars are the quartiles of each bin of velocity.
    """
    joints = fits.table.joints
    columns = min(len(joints), 3) if len(joints) != 4 else 2
    width = style.PAGE if columns > 1 else style.COLUMN
    figure, axes = style.panel_each(len(joints), columns, width, 2.0)
    looks = style.looks(fits.fits)
    for k, (joint, ax) in enumerate(zip(joints, axes, strict=True)):
        chosen = fits.chosen[joint.name]
        grid = _velocities(joint.qd)
        lines = {name: _steady(found[k], joint, grid) for name, found in fits.fits.items()}
        middle, low, median, high = _binned(joint)
        extremes = np.concatenate([low, high, *(line[0] for line in lines.values())])
        factor, unit = style.scaled(fits.unit, extremes)
        some = np.linspace(0, len(joint) - 1, min(_POINTS, len(joint))).astype(int)
        ax.plot(
            joint.qd[some], factor * joint.tau[some], ".", color=style.FAINT, markersize=2.0,
            alpha=0.35, markeredgewidth=0, rasterized=True,
        )  # fmt: skip
        for name, (line, _) in lines.items():
            ax.plot(grid, factor * line, **looks[name].line | {"linewidth": 0.8, "alpha": 0.7})
        line, sd = lines[chosen]
        reach, look = NORMAL_95 * sd, looks[chosen].line
        ax.fill_between(
            grid, factor * (line - reach), factor * (line + reach), color=look["color"],
            alpha=0.2, linewidth=0,
        )  # fmt: skip
        ax.plot(grid, factor * line, **look | {"linewidth": 1.8})
        ax.errorbar(
            middle, factor * median, factor * np.stack([median - low, high - median]), fmt="o",
            color=style.INK, markersize=2.2, elinewidth=0.6, zorder=3,
        )  # fmt: skip
        ax.set_ylim(style.padded(factor * extremes.min(), factor * extremes.max(), 0.1))
        ax.margins(x=0.02)
        style.title(ax, f"{joint.name}: {plain_name(chosen)}")
        kind = "torque" if fits.table.unit == "rad" else "force"
        ax.set_ylabel(f"friction {kind} [{unit}]")
        if k + columns >= len(joints):
            ax.set_xlabel(f"velocity [{fits.table.unit}/s]")
    handles = [
        Line2D([], [], linestyle="", marker=".", color=style.FAINT),
        Line2D([], [], linestyle="", marker="o", color=style.INK, markersize=2.2),
        *(looks[name].handle for name in fits.fits),
        Patch(facecolor=style.FAINT, alpha=0.4),
    ]
    names = [plain_name(name) for name in fits.fits]
    labels = ["rows", "median and quartiles", *names, "95 % of the law chosen (thick)"]
    style.legend(figure, handles, labels)
    return figure


def _velocities(qd: Array) -> Array:
    """The range of the rows, dense about zero, where friction turns."""
    low, high = float(qd.min()), float(qd.max())
    near = np.geomspace(1e-5, 1.0, 100) * max(abs(low), abs(high))
    grid = np.unique(np.concatenate([np.linspace(low, high, 300), -near, [0.0], near]))
    return grid[(grid >= low) & (grid <= high)]


def _steady(found: "JointFit", joint: "JointTorque", qd: Array) -> tuple[Array, Array]:
    """Torque over velocity at the median load, and its standard deviation."""
    load = 1.0 if joint.load is None else float(np.median(joint.load))
    velocity = torch.as_tensor(qd)
    zero = torch.zeros_like(velocity)
    torque, sd = found.steady(velocity, zero, torch.full_like(velocity, load))
    return torque.numpy(), sd.numpy()


def _binned(joint: "JointTorque") -> tuple[Array, Array, Array, Array]:
    """Median velocity, and quartiles and median of the torque, in bins of equally many rows."""
    bins = np.array_split(np.argsort(joint.qd), min(_BINS, len(joint)))
    middle = np.array([np.median(joint.qd[rows]) for rows in bins])
    low, median, high = np.array([np.quantile(joint.tau[b], [0.25, 0.5, 0.75]) for b in bins]).T
    return middle, low, median, high
