"""Friction torque over velocity, or position, with laws: of a motion, and of a table."""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from nfriction.fitting.equation_error import friction_torque
from nfriction.fitting.hysteresis import path_of
from nfriction.fitting.options import DEFAULTS
from nfriction.fitting.result.identifiability import NORMAL_95, CoefficientUncertainty
from nfriction.fitting.torque_table import predict
from nfriction.friction import model_by_name, plain_name
from nfriction.friction.memory import load_at_rest
from nfriction.friction.models import FrictionModel
from nfriction.io.model_file import unit_for
from nfriction.plant import Plant
from nfriction.plots import style
from nfriction.recording import Array, Recording
from nfriction.signals import Motion, kalman_smoother

if TYPE_CHECKING:
    from nfriction.evaluation.torque_tables import TorqueFits

_POINTS = 3000  # drawn per joint
_BINS = 24  # of velocity, for medians
_DOT = Line2D([], [], linestyle="", marker=".", color=style.FAINT)
_MEDIAN = Line2D([], [], linestyle="", marker="o", color=style.INK, markersize=2.2)
_BAND = Patch(facecolor=style.FAINT, alpha=0.4)


def torque_over_velocity(
    plant: Plant,
    models: Mapping[str, FrictionModel],
    recordings: Sequence[Recording],
    motions: Sequence[Motion] | None = None,
    *,
    uncertainty: Mapping[str, CoefficientUncertainty] | None = None,
    plants: Mapping[str, Plant] | None = None,
) -> Figure:
    """Friction torque of each law over velocity, one panel per joint, over that of the motion.

    Lines are at the median load (or, for a gear, without torque), without acceleration and cold,
    with 95 % bands; dots are `tau - M qdd - bias` along the recordings, averaged over 30 ms in
    which the joint does not reverse. Medians and quartiles in velocity bins show the friction where
    dots scatter widely.

    Args:
        plant: the mechanism, with its fitted terms if there are any.
        models: friction models by name.
        recordings: in any convention.
        motions: their smoothed motion in joint coordinates; computed if not given.
        uncertainty: of the models' fits by name (`FitResult.uncertainty`), for the bands.
        plants: of the models' fits by name, for their loads; `plant` if not given.
    """
    joint = [r.joint_coordinates(plant) for r in recordings]
    motions = motions or [kalman_smoother(r.time, r.q) for r in joint]
    known = uncertainty or {}
    loads = {
        name: _median_load(model, (plants or {}).get(name, plant), motions)
        for name, model in models.items()
    }
    with torch.no_grad():
        parts = [
            _averaged(*friction_torque(plant, r, m)[::2], r.sample_time)
            for r, m in zip(joint, motions, strict=True)
        ]
    qd, torque = (np.concatenate(x) for x in zip(*parts, strict=True))
    figure, axes, columns = _panels(plant.joints)
    looks = style.looks(models)
    for k, ax in enumerate(axes):
        grid = velocities(qd[:, k])
        lines = {name: _torque(model, grid, k, loads[name]) for name, model in models.items()}
        seen = np.flatnonzero(np.isfinite(torque[:, k]))
        binned = _binned(qd[seen, k], torque[seen, k])
        # Dots may scatter far beyond the friction, so laws and quartiles set the limits.
        extremes = np.concatenate([*lines.values(), *binned[1:]])
        factor, unit = style.scaled(unit_for("N m", plant.unit), extremes)
        _dots(ax, qd[seen, k], factor * torque[seen, k])
        _medians(ax, binned, factor)
        for name, line in lines.items():
            ax.plot(grid, factor * line, **looks[name].line)
            if name in known:
                at = torch.as_tensor(grid)[:, None].expand(-1, plant.joints).contiguous()
                load = loads[name].expand_as(at)
                sd = known[name].torque_sd(models[name], at, load)[:, k].numpy()
                _band(ax, grid, factor * line, factor * sd, looks[name].line["color"])
        ax.set_ylim(style.padded(factor * extremes.min(), factor * extremes.max(), 0.15))
        _name_axes(ax, plant.joint_names[k], plant.unit, unit)
        if k + columns >= plant.joints:
            ax.set_xlabel(f"joint velocity [{plant.unit}/s]")
    handles: list[Artist] = [_DOT, _MEDIAN, *(looks[name].handle for name in models)]
    labels = ["from the motion", "median and quartiles", *models]
    if any(name in known for name in models):
        handles.append(_BAND)
        labels.append("95 % bands")
    style.legend(figure, handles, labels)
    return figure


def _averaged(qd: torch.Tensor, torque: torch.Tensor, step: float) -> tuple[Array, Array]:
    """Means over blocks of samples, NaN if a joint reverses within a block."""
    size = max(1, min(round(DEFAULTS.diagnosis_block / step), len(qd)))
    whole = len(qd) // size * size
    speeds, torques = (x[:whole].reshape(-1, size, x.shape[-1]) for x in (qd, torque))
    one_way = torch.sign(speeds).mean(1).abs() == 1
    # Dry friction can have any value at rest.
    return speeds.mean(1).numpy(), torch.where(one_way, torques.mean(1), torch.nan).numpy()


def _panels(joints: int) -> tuple[Figure, list[Axes], int]:
    """One panel per joint, and the number of columns."""
    columns = min(joints, 3) if joints != 4 else 2
    width = style.PAGE if columns > 1 else style.COLUMN
    return *style.panel_each(joints, columns, width, 2.0), columns


def _dots(ax: Axes, x: Array, y: Array) -> None:
    some = np.linspace(0, len(x) - 1, min(_POINTS, len(x))).astype(int)
    ax.plot(
        x[some], y[some], ".", color=style.FAINT, markersize=2.5, alpha=0.5, markeredgewidth=0,
        rasterized=True,
    )  # fmt: skip


def _band(ax: Axes, x: Array, y: Array, sd: Array, colour: str) -> None:
    """The 95 % band of a line."""
    low, high = y - NORMAL_95 * sd, y + NORMAL_95 * sd
    ax.fill_between(x, low, high, color=colour, alpha=0.25, linewidth=0)


def _name_axes(ax: Axes, title: str, position: str, unit: str) -> None:
    style.title(ax, title)
    ax.set_ylabel(f"friction {'torque' if position == 'rad' else 'force'} [{unit}]")
    ax.margins(x=0.02)


def velocities(qd: Array) -> Array:
    """The range of the data, dense near zero, where laws change over a few thousandths."""
    low, high = float(qd.min()), float(qd.max())
    # Evenly spaced velocities would draw the step at zero as a slope.
    near = np.geomspace(1e-5, 1.0, 100) * max(abs(low), abs(high))
    grid = np.unique(np.concatenate([np.linspace(low, high, 300), -near, [0.0], near]))
    return grid[(grid >= low) & (grid <= high)]


def _median_load(model: FrictionModel, plant: Plant, motions: Sequence[Motion]) -> torch.Tensor:
    """Median load of each joint along motions, (joint,); zero drive torque for a gear."""
    loads = [plant.load(torch.as_tensor(m.q), torch.as_tensor(m.qd)) for m in motions]
    median = torch.cat(loads).median(0).values
    return load_at_rest(model.law, median) * median


def _torque(model: FrictionModel, qd: Array, joint: int, load: torch.Tensor) -> Array:
    """Torque of one joint over its velocity at a load (joint,), without acceleration."""
    velocity = torch.as_tensor(qd)[:, None].expand(-1, model.joints)
    with torch.no_grad():
        held = model.coefficients(velocity, torch.zeros_like(velocity))
        torque = model.steady_torque(velocity, load.expand_as(velocity), held)
    return torque[:, joint].numpy()


def friction_curves(fits: "TorqueFits") -> Figure:
    """Friction torque of the rows and of the laws, one panel per joint.

    If the chosen law has no memory, it is drawn over velocity, thick, at the median load and
    without acceleration, with the 95 % band due to the uncertainty of its coefficients, over
    medians and quartiles in velocity bins. If it has memory, it is drawn over position, row by row,
    because a curve over velocity cannot show a loop. The best law of the other kind is also drawn.
    """
    joints = fits.table.joints
    figure, axes, _ = _panels(len(joints))
    looks = style.looks(fits.fits)
    shown: list[str] = []
    for k, (joint, ax) in enumerate(zip(joints, axes, strict=True)):
        chosen = fits.chosen[joint.name]
        looped = _remembers(chosen)
        unlike = [c for c in fits.candidates[joint.name] if _remembers(c.name) != looped]
        others = [c.name for c in sorted(unlike, key=lambda c: c.error)[:1]]
        shown += [chosen, *others]
        draw = _loops if looped else _curves
        unit = draw(ax, fits, k, [(name, looks[name].line) for name in (chosen, *others)])
        _name_axes(ax, f"{joint.name}: {plain_name(chosen)}", fits.table.unit, unit)
        ax.set_xlabel(f"position [{fits.table.unit}]" if looped
                      else f"velocity [{fits.table.unit}/s]")  # fmt: skip
    names = [name for name in fits.fits if name in shown]
    entries: dict[str, Artist] = {
        "rows": _DOT,
        **{plain_name(name): looks[name].handle for name in names},
    }
    if not all(map(_remembers, fits.chosen.values())):
        entries["median and quartiles"] = _MEDIAN
        entries["95 % of the law chosen"] = _BAND
    style.legend(figure, entries.values(), list(entries))
    return figure


def _remembers(name: str) -> bool:
    return model_by_name(name).definition.memory is not None


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
    # The chosen one on top.
    for name, look in reversed(lines):
        first = name == lines[0][0]
        ax.plot(path, factor * torques[name], **look | {"linewidth": 0.9 if first else 0.5},
                alpha=1.0 if first else 0.6, rasterized=len(joint) > _POINTS)  # fmt: skip
    return unit


def _curves(ax: Axes, fits: "TorqueFits", k: int, lines: list[tuple[str, dict[str, Any]]]) -> str:
    """Torque over velocity; returns its unit."""
    joint = fits.table.joints[k]
    grid = velocities(joint.qd)
    velocity = torch.as_tensor(grid)
    load = torch.full_like(velocity, 1.0 if joint.load is None else float(np.median(joint.load)))
    found = {
        name: [x.numpy() for x in fits.fits[name][k].steady(velocity, 0.0 * velocity, load)]
        for name, _ in lines
    }
    binned = _binned(joint.qd, joint.tau)
    extremes = np.concatenate([*binned[1:], *(line for line, _ in found.values())])
    factor, unit = style.scaled(fits.unit, extremes)
    _dots(ax, joint.qd, factor * joint.tau)
    for name, look in reversed(lines):
        first = name == lines[0][0]
        ax.plot(grid, factor * found[name][0], **look | {"linewidth": 1.8 if first else 0.8})
    look, (line, sd) = lines[0][1], found[lines[0][0]]
    _band(ax, grid, factor * line, factor * sd, look["color"])
    _medians(ax, binned, factor)
    ax.set_ylim(style.padded(factor * extremes.min(), factor * extremes.max(), 0.1))
    return unit


def _binned(qd: Array, tau: Array) -> Array:
    """Median velocity, quartile, median and quartile of the torque, in bins of about equal size.

    No bin contains both directions, in which friction has opposite signs.
    """
    order = np.argsort(qd)
    sides = [s for s in np.split(order, [np.searchsorted(qd[order], 0.0)]) if len(s)]
    share = min(1.0, _BINS / max(1, len(qd)))
    bins = [b for s in sides for b in np.array_split(s, math.ceil(share * len(s)))]
    rows = [[np.median(qd[b]), *np.quantile(tau[b], [0.25, 0.5, 0.75])] for b in bins]
    return np.array(rows).reshape(-1, 4).T


def _medians(ax: Axes, binned: Array, factor: float) -> None:
    x, low, median, high = binned
    bars = factor * np.stack([median - low, high - median])
    ax.errorbar(x, factor * median, bars, fmt="o", color=style.INK, markersize=2.2,
                elinewidth=0.6, zorder=3)  # fmt: skip
