"""Figures on the page: in what order, under what caption, and where one looks closely."""

import base64
from collections.abc import Iterator, Sequence

from nfriction.report.markup import Markup, element
from nfriction.report.png import Figure

_CAPTIONS = {
    "rmse_held_out": "Position error by model and joint, held-out recordings",
    "rmse_train": "Position error by model and joint, recordings trained on",
    "horizons_held_out": "Position error over the length of the simulation, held-out recordings; "
    "the band is what one encoder count at the start does",
    "horizons_train": "Position error over the length of the simulation, recordings trained on",
    "torque_over_velocity": "Friction torque over velocity: the models' laws over what the "
    "recorded motion implies",
}
_ORDER = (
    "rmse_held", "horizons_held", "rmse", "horizons", "positions_held", "positions", "torque",
    "over_time", "coefficients", "sections", "memberships",
)  # fmt: skip
_PREFIXES = {
    "positions_held_out_": "Measured and simulated position with the error below, held out: ",
    "positions_train_": "Measured and simulated position with the error below, trained on: ",
    "coefficients_": "Coefficients over velocity and acceleration (hatched: no data; faded: the "
    "fit leaves much of the value open; lines hold 50 % and 90 % of the samples) of ",
    "sections_": "Coefficients over velocity at three accelerations, with 95 % intervals (faint: "
    "no data) of ",
    "memberships_": "Fuzzy sets of velocity and acceleration of ",
    "over_time_": "Coefficients along the first recording trained on, models of the law: ",
}
# A figure's twin for a dark screen.
_DARK = ".dark"
WIDE = 700
"""Pixels beyond which half a page is too narrow for a figure."""


def shown(figures: Sequence[Figure]) -> Iterator[Markup]:
    """Every figure, in a useful order, with its twin for a dark screen where there is one."""
    by_name = {figure.name: figure for figure in figures}
    for figure in sorted(figures, key=lambda figure: _rank(figure.name)):
        if figure.name.removesuffix(_DARK) in by_name.keys() - {figure.name}:
            continue  # shown with the other
        yield _figure(figure, by_name.get(figure.name + _DARK))


def _figure(figure: Figure, dark: Figure | None) -> Markup:
    caption = caption_of(figure.name)
    picture = element(
        "img", src=_source(figure), alt=caption, width=str(figure.width),
        height=str(figure.height),
    )  # fmt: skip
    if dark is not None:
        picture = element(
            "picture",
            element("source", media="(prefers-color-scheme: dark)", srcset=_source(dark)),
            picture,
        )
    button = element(
        "button", picture, type="button", class_="zoom", aria_label=f"Enlarge: {caption}"
    )
    wide = "wide" if figure.width > WIDE else None
    return element("figure", button, element("figcaption", caption), class_=wide)


def _source(figure: Figure) -> str:
    return "data:image/png;base64," + base64.b64encode(figure.png).decode()


def _rank(name: str) -> int:
    """Errors first, then motions, then what is inside the models."""
    ranks = (k for k, prefix in enumerate(_ORDER) if name.startswith(prefix))
    return next(ranks, len(_ORDER))


def caption_of(name: str) -> str:
    """What a figure of that name shows."""
    if name in _CAPTIONS:
        return _CAPTIONS[name]
    for prefix, words in _PREFIXES.items():
        if name.startswith(prefix):
            return words + name.removeprefix(prefix)
    return name.replace("_", " ")


def enlarged() -> Markup:
    """Where a figure is looked at closely."""
    keys = [("out", "−", "Smaller"), ("fit", "Fit", "Fit to the window"), ("in", "+", "Larger"),
            ("close", "Close", "Close")]  # fmt: skip
    buttons = (
        element("button", sign, type="button", data_do=do, aria_label=word)
        for do, sign, word in keys
    )
    return element(
        "dialog",
        element("div", *buttons, class_="tools"),
        element("div", element("img", alt=""), class_="view", tabindex="0"),
        aria_label="Figure",
    )
