"""Figures of the control study: balanced motions, and the rig in motion as a GIF."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from nfriction.io.files import atomic_write
from nfriction.papers.control.study import (
    NONE,
    SAMPLE_TIME,
    SHARED,
    THINNED,
    TRUTH,
    reference,
    single_link,
)
from nfriction.plots import style

Array = NDArray[np.float64]
SHOWN = (NONE, SHARED, TRUTH)
FRAMES_A_SECOND, DPI = 25, 80


def balance_figure(motions: Mapping[str, Array]) -> Figure:
    """Arm and tilt of the links while the arm follows its reference, a line a compensation."""
    shown = {n: motions[f"follow, {n}"] for n in SHOWN if f"follow, {n}" in motions}
    figure, axes = style.panels(2, 1, style.PAGE, 3.6, sharex=True)
    looks = style.looks(shown)
    above, below = axes[:, 0]
    for name, q in shown.items():
        time = THINNED * SAMPLE_TIME * np.arange(len(q))
        above.plot(time, q[:, 0], **looks[name].line)
        tilt = np.abs(q[:, 1:].cumsum(-1)).max(-1)
        below.plot(time, 1e3 * tilt, **looks[name].line)
    (asked,) = above.plot(time, [reference(t)[0] for t in time.tolist()], **style.MEASURED)
    asked.set_zorder(0)
    above.set_ylabel("arm [rad]")
    below.set_ylabel("largest tilt [mrad]")
    below.set_xlabel("time [s]")
    handles = [asked, *(looks[name].handle for name in shown)]
    style.legend(figure, handles, ["reference", *(_label(name) for name in shown)])
    return figure


def swing_up_animation(q: Array, path: Path) -> Path:
    """Write the swing-up of a single link as a GIF: the rig from above, and along its arm.

    Args:
        q: arm and link [rad], a sample every `THINNED`.
        path: of the GIF.
    """
    from matplotlib.animation import FuncAnimation, PillowWriter  # slow to import

    plant = single_link().to_dict()
    arm, link = plant["arm"]["length"], plant["length"][0]
    figure, axes = style.panels(1, 2, style.PAGE, 2.8)
    views = []
    for ax, title, reach in zip(axes[0], ("from above", "along the arm"), (arm, link), strict=True):
        style.title(ax, title)
        ax.set_aspect("equal")
        ax.set_xlim(-1.2 * reach, 1.2 * reach)
        ax.set_ylim(-1.2 * reach, 1.2 * reach)
        ax.set_xlabel("[m]")
        (line,) = ax.plot([], [], color=style.COLOURS[0], linewidth=3, marker="o")
        views.append(line)
    every = round(1.0 / (FRAMES_A_SECOND * THINNED * SAMPLE_TIME))
    frames = q[::every]
    clock = axes[0, 1].text(0.02, 0.94, "", transform=axes[0, 1].transAxes, fontsize=style.SMALL)

    def draw(k: int) -> None:
        theta, phi = frames[k]
        views[0].set_data([0.0, arm * np.cos(theta)], [0.0, arm * np.sin(theta)])
        # Positive angles tilt the link against the arm's sense of turning.
        views[1].set_data([0.0, -link * np.sin(phi)], [0.0, link * np.cos(phi)])
        clock.set_text(f"{k / FRAMES_A_SECOND:.1f} s")

    moving = FuncAnimation(figure, draw, frames=len(frames))
    with atomic_write(path) as temporary:
        gif = temporary.with_suffix(".gif")
        moving.save(gif, writer=PillowWriter(fps=FRAMES_A_SECOND), dpi=DPI)
        gif.replace(temporary)
    return path


def _label(name: str) -> str:
    return {NONE: "no compensation", TRUTH: "true friction compensated"}.get(
        name, f"{name} compensated"
    )
