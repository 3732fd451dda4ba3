"""Figures of the control study: balanced motions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from nfriction.papers.control.study import (
    NONE,
    SAMPLE_TIME,
    SHARED,
    THINNED,
    TRUTH,
    reference,
)
from nfriction.plots import style

Array = NDArray[np.float64]
SHOWN = (NONE, SHARED, TRUTH)


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


def _label(name: str) -> str:
    return {NONE: "no compensation", TRUTH: "true friction compensated"}.get(
        name, f"{name} compensated"
    )
