"""The mechanism, drawn from its plant, and its motion as a GIF."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from numpy.typing import NDArray

from nfriction.io.files import atomic_write
from nfriction.plant import LinearAxis, PendulumChain, Plant, Rotor
from nfriction.plots import style

Array = NDArray[np.float64]
MEASURED = "measured"
_FRAMES_A_SECOND, _DPI = 25, 80
_MOTOR = {"gear_ratio": "", "rotor_inertia": "kg m²", "torque_constant": "N m/A"}
_UNITS = {"inertia": "kg m² about the axis", "mass": "kg", "com": "m to the mass centre"}
_BENT = 0.5  # between links of the drawing, so that none hides another [rad]


class _View(NamedTuple):
    title: str
    reach: float  # of the drawing from its middle [m]
    points: Callable[[Array], Array]  # joints in a pose (joint,) -> (point, 2) [m]


def mechanism(plant: Plant) -> Figure:
    """The mechanism in a pose near rest: links, joints, centres of mass, and their data."""
    views = _views(plant)
    figure, axes = style.panels(
        1, len(views) + 1, style.PAGE, 2.8, width_ratios=[*[1.0] * len(views), 1.1]
    )
    pose = np.zeros(plant.joints)
    if plant.unit == "rad":
        links = pose[plant.first_link :]
        links[:] = np.diff(_BENT * (-1.0) ** np.arange(len(links)), prepend=0.0)
        links[0] += np.pi if plant.convention[1] == "hanging" else 0.0
    for ax, view in zip(axes[0], views, strict=False):
        _frame(ax, view, plant)
        points = view.points(pose)
        ax.plot(*points.T, **_line(style.COLOURS[0]))
        if isinstance(plant, PendulumChain) and not isinstance(plant, Rotor):
            ax.autoscale()
            ax.margins(0.2)
            ax.set_adjustable("datalim")
        if isinstance(plant, PendulumChain) and view is views[-1]:
            steps = np.diff(points, axis=0)
            # Mass centres as shares of the links' lengths; none for a balanced rotor.
            shares = [0.5] * bool(plant.to_dict()["mass"])
            if not isinstance(plant, Rotor):
                shares = np.divide(plant.to_dict()["com"], plant.length.detach().numpy())
            for share, start, step in zip(shares, points, steps, strict=False):
                ax.plot(*(start + share * step), "X", color=style.COLOURS[1], zorder=3)
    words = axes[0, -1]
    words.set_axis_off()
    words.set(xticks=[], yticks=[])
    words.text(0, 0.95, "\n".join(_data(plant)), va="top", fontsize=style.SMALL, color=style.INK)
    return figure


def animate(
    plant: Plant,
    time: Array,
    motions: Mapping[str, Array],
    path: str | Path,
    *,
    seconds: float = 10.0,
) -> Path:
    """Write overlaid motions of a mechanism as a GIF, in real time.

    Args:
        time: [s], (time,).
        motions: positions in joint coordinates by name, (time, joint); "measured" is drawn broad
            and grey. A motion is hidden while it is not finite.
        seconds: longest duration drawn.
    """
    from matplotlib.animation import FuncAnimation, PillowWriter  # slow to import

    views = _views(plant)
    if plant.unit == "m":
        known = np.concatenate([np.abs(q[np.isfinite(q)]) for q in motions.values()])
        views = [views[0]._replace(reach=float(known.max(initial=1e-3)))]
    figure, axes = style.panels(1, len(views), style.COLUMN * len(views), 3.0)
    looks = style.looks(name for name in motions if name != MEASURED)
    lines = {}
    for name in motions:
        look: dict[str, object] = {"color": style.FAINT, "linewidth": 6.0}
        if name != MEASURED:
            look = _line(looks[name].line["color"])
        lines[name] = [ax.plot([], [], **look)[0] for ax in axes[0]]
    for ax, view in zip(axes[0], views, strict=True):
        _frame(ax, view, plant)
    clock = axes[0, -1].text(
        0.02, 0.93, "", transform=axes[0, -1].transAxes, fontsize=style.SMALL, color=style.INK
    )
    handles: list[Line2D] = [of[0] for of in lines.values()]
    style.legend(figure, handles, list(motions))
    end = min(float(time[-1]), float(time[0]) + seconds)
    frames = np.searchsorted(time, np.arange(float(time[0]), end, 1 / _FRAMES_A_SECOND))

    def draw(frame: int) -> Sequence[Line2D]:
        for name, q in motions.items():
            for line, view in zip(lines[name], views, strict=True):
                line.set_data(*view.points(q[frame]).T)
        clock.set_text(f"{time[frame] - time[0]:.1f} s")
        return handles

    moving = FuncAnimation(figure, draw, frames=frames.tolist())
    with atomic_write(path) as temporary:
        gif = temporary.with_suffix(".gif")
        moving.save(gif, writer=PillowWriter(fps=_FRAMES_A_SECOND), dpi=_DPI)
        gif.replace(temporary)
    return Path(path)


def _views(plant: Plant) -> list[_View]:
    """Views of the mechanism: of an arm from above, and of links along it."""
    if isinstance(plant, LinearAxis):
        return [_View("", 1.0, lambda q: np.array([[q[0], 0.0]]))]
    if not isinstance(plant, PendulumChain):
        raise ValueError(f"a {type(plant).__name__} cannot be drawn.")
    lengths, first = plant.length.detach().numpy(), plant.first_link

    def links(q: Array) -> Array:
        # Positive angles tilt a link against the direction in which an arm turns.
        angles = np.cumsum(q[first:])
        ends = np.cumsum(lengths[:, None] * np.stack([-np.sin(angles), np.cos(angles)], -1), 0)
        return np.concatenate([np.zeros((1, 2)), ends])

    views = [_View("along the arm" if first else "", float(lengths.sum()), links)]
    if first:
        arm = float(plant.to_dict()["arm"]["length"])
        views.insert(0, _View("from above", arm, lambda q: arm * np.array(
            [[0.0, 0.0], [np.cos(q[0]), np.sin(q[0])]]
        )))  # fmt: skip
    return views


def _frame(ax: Axes, view: _View, plant: Plant) -> None:
    style.title(ax, view.title)
    ax.set_aspect("equal")
    for limit in (ax.set_xlim, ax.set_ylim):
        limit(-1.15 * view.reach, 1.15 * view.reach)
    ax.set(xlabel="[m]", ylabel="[m]")
    if isinstance(plant, LinearAxis):
        ax.axhline(0, color=style.FAINT, linewidth=1.0)
        ax.set(yticks=[], ylabel="")
    elif isinstance(plant, Rotor) and not plant.to_dict()["mass"]:
        ax.set(xticks=[], yticks=[], xlabel="")  # the size of a flywheel is unknown
        ax.set_axis_off()
        ax.add_patch(Circle((0, 0), view.reach, facecolor=style.UNSEEN, edgecolor=style.FAINT))


def _line(colour: str) -> dict[str, object]:
    return {"color": colour, "linewidth": 2.5, "marker": "o", "markersize": 6.0}


def _data(plant: Plant) -> list[str]:
    """The plant's parameters in words, one line each."""
    given = plant.to_dict()
    lines = [plant.name or f"{given['kind']} without a name", ""]
    if isinstance(plant, PendulumChain) and not isinstance(plant, Rotor):
        lines += [f"arm: {given['arm']['length']:.4g} m"] if plant.first_link else []
        for name, *of in zip(
            plant.joint_names[plant.first_link :], given["mass"], given["length"], given["com"],
            strict=True,
        ):  # fmt: skip
            text = "{}: {:.4g} kg\n    length {:.4g} m, mass centre at {:.4g} m"
            lines.append(text.format(name, *of))
        lines += ["", "× mass centres"]
    else:
        lines += [f"{key} {given[key]:.4g} {_UNITS[key]}" for key in _UNITS if given.get(key)]
        lines += ["", "flywheel, not to scale"] if given.get("mass") == 0 else []
    motor = given.get("motor", {})
    for key in motor:
        numbers = motor[key] if isinstance(motor[key], list) else [motor[key]]
        text = ", ".join(f"{x:.4g}" for x in numbers)
        lines.append(f"{key.replace('_', ' ')} {text} {_MOTOR[key]}")
    return lines
