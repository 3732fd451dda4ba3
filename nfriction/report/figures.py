"""Figures of a run: PNG files, read without trust, in order and with captions."""

import base64
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

# Far above any run of ours; larger files are no figures.
LARGEST_FIGURE, MOST_FIGURES = 16 * 2**20, 100
_PNG = b"\x89PNG\r\n\x1a\n"
# Text that `plots.save_all` puts before the picture.
_RUN = re.compile(rb"tEXtnfriction run\0([0-9a-f]{16})")
# A figure's twin for a dark screen.
_DARK = ".dark"
# In the order of the page: errors first, then motions, then the insides of the models.
_CAPTIONS = {
    "rmse_test": "Position error by model and joint, test recordings",
    "horizons_test": "Position error over the length of the simulation, test recordings; the band "
    "is the effect of one encoder count in the initial state",
    "rmse_train": "Position error by model and joint, training recordings",
    "horizons_train": "Position error over the length of the simulation, training recordings",
    "positions_test_": "Measured and simulated position with the error below, test: ",
    "positions_train_": "Measured and simulated position with the error below, training: ",
    "torque_over_velocity": "Friction torque over velocity: the models' laws over the torque that "
    "the recorded motion implies",
    "over_time_": "Coefficients along the first training recording, models of the law: ",
    "coefficients_": "Coefficients over velocity and acceleration (hatched: no data; faded: "
    "uncertain; lines enclose 50 % and 90 % of the samples) of ",
    "sections_": "Coefficients over velocity at three accelerations, with 95 % intervals (faint: "
    "no data) of ",
    "memberships_": "Fuzzy sets of velocity and acceleration of ",
}


@dataclass(frozen=True)
class Figure:
    """A PNG file with its size in pixels, and the id of its run if it bears one."""

    name: str
    png: bytes
    width: int
    height: int
    run: str = ""

    @property
    def source(self) -> str:
        """The picture as a URL."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode()

    @property
    def caption(self) -> str:
        """Description by the name."""
        for prefix, words in _CAPTIONS.items():
            if self.name == prefix or (prefix.endswith("_") and self.name.startswith(prefix)):
                return words + self.name.removeprefix(prefix)
        return self.name.replace("_", " ")


def read_figures(folder: Path) -> tuple[tuple[Figure, ...], list[str]]:
    """Those in the order of their names, and a sentence on each that could not be read."""
    found: list[Figure] = []
    notes = []
    for path in sorted(folder.glob("*.png"))[:MOST_FIGURES]:
        if not path.is_file() or path.stat().st_size > LARGEST_FIGURE:
            notes.append(f"figure {path.name}: no file, or too large")
            continue
        png = path.read_bytes()
        if not png.startswith(_PNG) or len(png) < 24:
            notes.append(f"figure {path.name}: not a PNG file")
            continue
        width, height = (int.from_bytes(png[k : k + 4], "big") for k in (16, 20))
        # Earlier versions said `held_out` for `test`.
        name = re.sub(r"^(rmse|horizons|positions)_held_out", r"\1_test", path.stem)
        run = _RUN.search(png[:4096])
        found.append(Figure(name, png, width, height, run[1].decode() if run else ""))
    return tuple(found), notes


def with_dark_twins(figures: Sequence[Figure]) -> Iterator[tuple[Figure, Figure | None]]:
    """Every figure in the order of the page, with its twin for a dark screen if there is one."""
    by_name = {figure.name: figure for figure in figures}
    ranks = list(_CAPTIONS)

    def rank(figure: Figure) -> int:
        return next((k for k, p in enumerate(ranks) if figure.name.startswith(p)), len(ranks))

    for figure in sorted(figures, key=rank):
        if figure.name.removesuffix(_DARK) in by_name.keys() - {figure.name}:
            continue  # shown with the other
        yield figure, by_name.get(figure.name + _DARK)
