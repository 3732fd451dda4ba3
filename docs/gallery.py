"""Take the figures of the gallery: `python docs/gallery.py runs/demo runs/wheel runs/contact`."""

import sys
from pathlib import Path

from PIL import Image

# File of the run, and its name here.
FIGURES = (
    {
        "torque_over_velocity": "torque",
        "positions_test_test_hanging": "positions",
        "rmse_test": "errors",
        "horizons_test": "horizons",
        "sections_NFCVFM": "sections",
        "coefficients_NFCVFM": "maps",
        "mechanism": "mechanism",
        "memberships_NFCVFM": "memberships",
    },
    {"torque_over_velocity": "motor"},
    {"friction": "loops"},
)


def main(runs: list[str]) -> None:
    for run, names in zip(runs, FIGURES, strict=True):
        for figure, name in names.items():
            picture = Image.open(Path(run) / "figures" / f"{figure}.png").convert("RGB")
            # Lines and text need few colours, and a repository small files.
            small = picture.quantize(96, method=Image.Quantize.MEDIANCUT)
            small.save(Path(__file__).with_suffix("") / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main(sys.argv[1:])
