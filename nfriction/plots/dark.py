"""Turn a finished figure's colours for a dark screen."""

from collections.abc import Callable
from typing import Any

from matplotlib.collections import Collection
from matplotlib.colors import to_hex, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text

from nfriction.plots import style

GROUND = "#14171b"
# Each keeps its hue and is light enough on the ground; grounds become clear.
_LIGHTER = {
    "#ffffff": "none",
    style.INK: "#e7eaee",
    style.GRID: "#39414b",
    style.FAINT: "#8f98a3",
    str(style.MEASURED["color"]): "#6b7480",
    "#000000": "#e7eaee",
    "#0072b2": "#4aa8e0",
    "#d55e00": "#ff8a3d",
    "#009e73": "#2fc79a",
    "#5d3a9b": "#b79bef",
    "#bbbbbb": "#5a626d",
    "#f2f2f2": "#1e2329",
    "#c4c4c4": "#454d58",
}


def for_dark_screen(figure: Figure, *, ground: str = "none") -> Figure:
    """Change a figure's colours, in place, to be read on a dark screen.

    Colours of models keep their hue, maps stay as they are.

    Args:
        figure: one of ours; colours that are not of our palette stay.
        ground: behind it, clear by default (`dark.GROUND` fits the report's page).

    Returns:
        The same figure; save it with `figure.savefig(path)`.
    """
    for artist in figure.findobj():
        if isinstance(artist, Text):
            _turn(artist.get_color, artist.set_color)
        elif isinstance(artist, Line2D):
            _turn(artist.get_color, artist.set_color)
            _turn(artist.get_markerfacecolor, artist.set_markerfacecolor)
            _turn(artist.get_markeredgecolor, artist.set_markeredgecolor)
        elif isinstance(artist, Patch):
            _turn_patch(artist)
        elif isinstance(artist, Collection) and artist.get_array() is None:
            artist.set_facecolor([_lighter(c) for c in artist.get_facecolor()])
            artist.set_edgecolor([_lighter(c) for c in artist.get_edgecolor()])
    for ax in figure.axes:
        for axis in (ax.xaxis, ax.yaxis):
            # Ticks that are drawn later take their colours from here.
            axis.set_tick_params(which="both", colors=_LIGHTER[style.INK])
            axis.set_tick_params(which="both", grid_color=_LIGHTER[style.GRID])
    figure.patch.set_facecolor(ground)
    return figure


def _turn_patch(patch: Patch) -> None:
    face, edge = patch.get_facecolor(), patch.get_edgecolor()
    patch.set_facecolor(_lighter(face))
    # The white seams of hatched bars stay visible as seams of the ground.
    seam = to_hex(edge) == "#ffffff" and patch.get_hatch()
    patch.set_edgecolor(GROUND if seam else _lighter(edge))


def _turn(get: Callable[[], Any], put: Callable[[Any], None]) -> None:
    colour = get()
    if isinstance(colour, str) and colour in ("none", "auto"):
        return
    put(_lighter(colour))


def _lighter(colour: Any) -> Any:
    """The colour for a dark ground, as opaque as it was; unknown ones stay."""
    rgba = to_rgba(colour)
    if rgba[3] == 0:
        return "none"
    found = _LIGHTER.get(to_hex(rgba))
    return colour if found is None else (found if found == "none" else to_rgba(found, rgba[3]))
