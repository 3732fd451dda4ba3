"""Figures of a run: PNG files, read without trust."""

from dataclasses import dataclass
from pathlib import Path

# Far beyond any run of ours; what is larger is no figure.
LARGEST_FIGURE, MOST_FIGURES = 16 * 2**20, 100
_PNG = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Figure:
    """A PNG file with its size in pixels."""

    name: str
    png: bytes
    width: int
    height: int


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
        found.append(Figure(path.stem, png, width, height))
    return tuple(found), notes
