"""Figures for a dark screen: every text and line stands out from the ground, none is lost."""

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text

from nfriction import NFLFM, plots
from nfriction.plots import style
from nfriction.signals import Motion


def luminance(colour: object) -> float:
    """Relative luminance (WCAG 2)."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(colour: object) -> float:
    """Against the ground (WCAG 2)."""
    one, other = sorted((luminance(colour), luminance(style.DARK_GROUND)))
    return (other + 0.05) / (one + 0.05)


def figures() -> list[Figure]:
    models = ["no friction", "A", "B", "C", "D", "E", "F", "G"]
    table = pd.DataFrame(0.01, index=models, columns=["joint1", "all"])
    slow = np.linspace(0.0, 3.0, 400)[:, None]
    motion = Motion(slow[:, 0], slow, -slow, 0 * slow)
    return [
        plots.rmse_bars(table, "rad"),
        plots.coefficient_surfaces(NFLFM(1), [motion]),
        plots.memberships(NFLFM(1), NFLFM(1)),
        plots.coefficient_sections(NFLFM(1), [motion]),
    ]


@pytest.mark.parametrize("k", range(4))
def test_texts_and_lines_stand_out(k):
    figure = plots.for_dark_screen(figures()[k])
    figure.draw_without_rendering()
    for text in figure.findobj(Text):
        if text.get_text():
            assert contrast(text.get_color()) >= 4.5  # WCAG 2 AA, of text
    for ax in figure.axes:
        for line in ax.lines:
            assert contrast(line.get_color()) >= 3.0  # of graphics


def test_colours_of_models_stay_apart():
    before, after = (figures()[0] for _ in range(2))
    plots.for_dark_screen(after)
    shades = [{to_hex(p.get_facecolor()) for p in f.axes[0].patches} for f in (before, after)]
    assert len(shades[0]) == len(shades[1]) == len(style.COLOURS) + 1
    assert to_hex(after.patch.get_facecolor(), keep_alpha=True).endswith("00")


def test_turning_twice_changes_nothing_more():
    figure = plots.for_dark_screen(figures()[0])
    colours = [to_hex(t.get_color()) for t in figure.findobj(Text)]
    plots.for_dark_screen(figure)
    assert colours == [to_hex(t.get_color()) for t in figure.findobj(Text)]
