"""Friction torque of a table over velocity or position, with the laws fitted to it."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from nfriction.fitting.hysteresis import path_of
from nfriction.fitting.result.identifiability import NORMAL_95
from nfriction.fitting.torque_table import predict
from nfriction.friction import model_by_name, plain_name
from nfriction.plots import style
from nfriction.plots.comparison import velocities

if TYPE_CHECKING:
    from nfriction.evaluation.torque_tables import TorqueFits
    from nfriction.fitting.torque_table import JointFit
    from nfriction.recording.torque_table import JointTorque

Array = NDArray[np.float64]

_POINTS = 3000  # rows that are drawn, a joint
_BINS = 24  # of medians


def friction_curves(fits: "TorqueFits") -> Figure:
    """Friction torque of the rows and of the laws, a panel a joint.

    Over velocity, with medians of bins, where the law chosen has no memory: it is drawn thick at
    the median load and without acceleration, with the 95 % band that the uncertainty of its
    coefficients leaves; bars are the quartiles of each bin of velocity. Over position, row by row,
    where it has memory, as no curve over velocity shows a loop. Beside it is the best law of the
    other kind.
    """
    joints = fits.table.joints
    columns = min(len(joints), 3) if len(joints) != 4 else 2
    width = style.PAGE if columns > 1 else style.COLUMN
    figure, axes = style.panel_each(len(joints), columns, width, 2.0)
    looks = style.looks(fits.fits)
    shown: list[str] = []
    bins = False
    for k, (joint, ax) in enumerate(zip(joints, axes, strict=True)):
        chosen, *others = _drawn(fits, joint)
        shown += [chosen, *others]
        looped = _remembers(chosen)
        draw = _loops if looped else _curves
        unit = draw(ax, fits, k, [(name, looks[name].line) for name in (chosen, *others)])
        bins = bins or not looped
        style.title(ax, f"{joint.name}: {plain_name(chosen)}")
        kind = "torque" if fits.table.unit == "rad" else "force"
        ax.set_ylabel(f"friction {kind} [{unit}]")
        ax.margins(x=0.02)
        ax.set_xlabel(f"position [{fits.table.unit}]" if looped
                      else f"velocity [{fits.table.unit}/s]")  # fmt: skip
    names = [name for name in fits.fits if name in shown]
    entries: dict[str, Artist] = {
        "rows": Line2D([], [], linestyle="", marker=".", color=style.FAINT),
        **{plain_name(name): looks[name].handle for name in names},
    }
    if bins:
        entries["median and quartiles"] = Line2D(
            [], [], linestyle="", marker="o", color=style.INK, markersize=2.2
        )
        entries["95 % of the law chosen"] = Patch(facecolor=style.FAINT, alpha=0.4)
    style.legend(figure, entries.values(), list(entries))
    return figure


def _remembers(name: str) -> bool:
    return model_by_name(name).definition.memory is not None


def _drawn(fits: "TorqueFits", joint: "JointTorque") -> list[str]:
    """The law chosen, and the best with or without memory, unlike it, if there is one."""
    chosen = fits.chosen[joint.name]
    others = [c for c in fits.candidates[joint.name] if _remembers(c.name) != _remembers(chosen)]
    return [chosen, *(c.name for c in sorted(others, key=lambda c: c.error)[:1])]


def _loops(ax: Axes, fits: "TorqueFits", k: int, lines: list[tuple[str, dict[str, Any]]]) -> str:
    """Torque over position; returns its unit."""
    joint = fits.table.joints[k]
    path = np.cumsum(path_of(joint)) if joint.q is None else joint.q
    torques = {name: predict(fits.fits[name][k].model, joint).numpy() for name, _ in lines}
    factor, unit = style.scaled(fits.unit, joint.tau)
    ax.plot(
        path, factor * joint.tau, ".", color=style.FAINT, markersize=1.5, alpha=0.5,
        markeredgewidth=0, rasterized=True,
    )  # fmt: skip
    # The one chosen on top.
    for name, look in reversed(lines):
        first = name == lines[0][0]
        ax.plot(path, factor * torques[name], **look | {"linewidth": 0.9 if first else 0.5},
                alpha=1.0 if first else 0.6, rasterized=len(joint) > _POINTS)  # fmt: skip
    return unit


def _curves(ax: Axes, fits: "TorqueFits", k: int, lines: list[tuple[str, dict[str, Any]]]) -> str:
    """Torque over velocity; returns its unit."""
    joint = fits.table.joints[k]
    grid = velocities(joint.qd)
    found = {name: _steady(fits.fits[name][k], joint, grid) for name, _ in lines}
    middle, low, median, high = _binned(joint)
    extremes = np.concatenate([low, high, *(line for line, _ in found.values())])
    factor, unit = style.scaled(fits.unit, extremes)
    some = np.linspace(0, len(joint) - 1, min(_POINTS, len(joint))).astype(int)
    ax.plot(
        joint.qd[some], factor * joint.tau[some], ".", color=style.FAINT, markersize=2.0,
        alpha=0.35, markeredgewidth=0, rasterized=True,
    )  # fmt: skip
    for name, look in reversed(lines):
        first = name == lines[0][0]
        ax.plot(grid, factor * found[name][0], **look | {"linewidth": 1.8 if first else 0.8})
    look, (line, sd) = lines[0][1], found[lines[0][0]]
    reach = NORMAL_95 * sd
    ax.fill_between(
        grid, factor * (line - reach), factor * (line + reach), color=look["color"],
        alpha=0.2, linewidth=0,
    )  # fmt: skip
    ax.errorbar(
        middle, factor * median, factor * np.stack([median - low, high - median]), fmt="o",
        color=style.INK, markersize=2.2, elinewidth=0.6, zorder=3,
    )  # fmt: skip
    ax.set_ylim(style.padded(factor * extremes.min(), factor * extremes.max(), 0.1))
    return unit


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
