"""Take the figures of the gallery: `python docs/gallery.py runs/demo runs/wheel runs/contact`.

The demo is run with `--also gif`.
"""

import sys
from pathlib import Path

from PIL import Image, ImageSequence

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


# Of the first run's animation: each second frame of five seconds.
MOTION, FRAMES, EVERY = "motion_1.gif", 126, 2


def main(runs: list[str]) -> None:
    folder = Path(__file__).with_suffix("")
    for run, names in zip(runs, FIGURES, strict=True):
        for figure, name in names.items():
            picture = Image.open(Path(run) / "figures" / f"{figure}.png").convert("RGB")
            # Lines and text need few colours, and a repository small files.
            small = picture.quantize(96, method=Image.Quantize.MEDIANCUT)
            small.save(folder / f"{name}.png", optimize=True)
    moving = Image.open(Path(runs[0]) / "figures" / MOTION)
    step = EVERY * moving.info["duration"]
    frames = [f.convert("RGB").quantize(32) for f in ImageSequence.Iterator(moving)]
    first, *others = frames[:FRAMES:EVERY]
    first.save(
        folder / "motion.gif", save_all=True, append_images=others, duration=step, loop=0,
        optimize=True,
    )  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
