"""Fresh releases: initial poses, their errors, and predictability."""

from pathlib import Path

import numpy as np
import pytest

from nfriction import NCFM
from nfriction.papers.reproduction import figures, stages, tables
from nfriction.papers.twin.dataset import Encoder, specification
from nfriction.papers.twin.mechanics import Links, simulate
from nfriction.plant import rigs
from tests.papers.reproduction.test_tables import entry, workspace


def test_errors_are_those_of_free_runs_from_the_poses() -> None:
    true = stages.true_positions(0.05)
    np.testing.assert_allclose(true[:, 0], np.deg2rad(stages.POSES))
    plant, model = rigs.tlrip(), NCFM(3, [0.05]).requires_grad_(False)
    ours = np.array(stages.free_run_errors(plant, model, true), dtype=float)
    assert ours.shape == (10, 3)
    assert np.all((ours > 0) & (ours < 0.01))
    # Without the first sample's offset, which all later ones would have, too.
    off = np.array(stages.free_run_errors(plant, model, true - [0.1, 0.0, 0.0]), dtype=float)
    assert np.all(off[:, 0] > ours[:, 0])
    lost = np.array(true)
    lost[2, -1] = np.nan
    assert stages.free_run_errors(plant, model, lost)[2] == [None] * 3


def test_single_outlier_does_not_decide_the_order(tmp_path: Path) -> None:
    made = workspace(tmp_path, {"NCFM": 3.0, "ANCFM": 2.0, "NFNCFM": 1.0})
    assert not [text for text in tables.order(made).broken if "NCFM" in text]
    result = made.found("NFNCFM")
    for wild in (99.0, None):
        result["fresh"][0] = entry(wild, "test")["free_run"]["joints"]
        made.finish("NFNCFM", result)
        assert not [text for text in tables.order(made).broken if "NCFM" in text]
        np.testing.assert_allclose(tables.fresh(made).loc["NFNCFM"], [1.0, 2.0, 3.0])


@pytest.mark.slow
@pytest.mark.parametrize("pose", stages.POSES)
def test_fresh_releases_can_be_predicted(pose: tuple[float, float, float]) -> None:
    links, friction = Links.of(rigs.tlrip()), specification("tlrip").friction
    count = Encoder().quantum
    true, off = (
        simulate(links, friction, tuple((np.deg2rad(pose) + e).tolist()), samples=10_000).q
        for e in (0.0, count)
    )
    assert np.abs(off - true).max() <= 16 * count


def test_the_figure_shows_the_medians_of_the_table(tmp_path: Path) -> None:
    made = workspace(tmp_path, {"NFNCFM": 0.5, "LFM": None})
    figure = figures.fresh_errors(made)
    medians = tables.fresh(made, tables.NINE)
    for ax, joint in zip(figure.axes, tables.JOINTS, strict=True):
        dots = [float(line.get_xdata()[0]) for line in ax.lines if line.get_marker() == "o"]
        np.testing.assert_allclose(dots, 1e3 * medians[joint])
