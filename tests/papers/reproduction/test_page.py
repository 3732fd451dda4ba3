"""The page of a reproduction, its conclusion, and the agreement of simulations."""

from dataclasses import replace

import numpy as np
import pytest

from nfriction import rigs
from nfriction.papers.reproduction import tables
from nfriction.papers.reproduction.agreement import MUJOCO, TWIN, agreement, missed_torque
from nfriction.papers.reproduction.figures import second_swing
from nfriction.papers.reproduction.page import ITEMS, SWING_UP, write_page
from nfriction.papers.twin.dataset import make
from tests.papers.reproduction.test_tables import workspace

CHECK_POSE = np.deg2rad([200.56, 32.21, 45.0])


def test_files_have_unique_names() -> None:
    # The swing-up's animation is shown next to its table.
    names = [name for item in ITEMS for name in (*item.tables, *item.figures)]
    assert len(names) == len(set(names)) > 30
    assert SWING_UP in names


def test_the_page_is_self_contained_and_in_the_papers_order(tmp_path) -> None:
    made = workspace(tmp_path, {"NFLFM": 0.123})
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "rmse.png").write_bytes(b"\x89PNG")
    page = write_page(made).read_text(encoding="utf-8")
    places = [page.index(f"<h3>{item.title}") for item in ITEMS if "'" not in item.title]
    assert places == sorted(places)
    assert "data:image/png;base64," in page
    assert "http" not in page.replace("http-equiv", "")
    assert "NOT reproduced" in page
    # The final status of the fit is next to its figure.
    assert "NFNLFM: ended" in page
    assert "0.1397" not in page  # printed errors are shown in mrad, like ours
    assert "139.7" in page


def test_conclusion_follows_from_the_errors(tmp_path) -> None:
    errors = {"NCFM": 4.0, "LFM": 4.0, "NLFM": 4.0, "rtip-NLFM": 0.5}
    errors |= dict.fromkeys(tables.ADAPTIVE, 3.0) | dict.fromkeys(tables.NEURO_FUZZY, 2.0)
    errors |= dict.fromkeys(tables.PAPERS_WAY, 3.5) | {"NFLFM": 3.2}
    lines = tables.conclusion(workspace(tmp_path, errors)).splitlines()
    assert len(lines) == 8
    held = [line.split(":")[0] for line in (*lines[1:3], *lines[5:7])]
    assert held == ["reproduced", "reproduced for 2 of 3", "NOT reproduced", "reproduced"]
    assert "on every joint, median of ten fresh releases: no (NFLFM 3200 > ALFM 3000" in lines[3]
    assert lines[4].startswith("best of the nine: joint 2 NFNCFM = NFNLFM, joint 3")
    assert lines[7].startswith("Why: ")
    assert "fails to explain 25.0%" in lines[7]
    assert "12.5%; 1 of 19 fits" in lines[7]


@pytest.mark.parametrize("effect", [0.0, 1.0])
def test_explanation_detects_the_effect_of_acceleration(effect) -> None:
    made = make("tlrip", duration=2.0)
    truth = {
        label: replace(m, tau_f=np.sign(m.qd) * (1.0 + np.abs(m.qd)) + effect * m.qdd)
        for label, m in made.truth.items()
    }
    found = missed_torque(replace(made, truth=truth))
    if effect:
        assert found["speed and acceleration"] < 0.5 * found["speed"]
    else:
        # The torque varies little within a cell of speed.
        assert max(found.values()) < 0.2


def test_second_papers_swing_uses_that_papers_convention() -> None:
    lines = [ax.lines[0].get_ydata() for ax in second_swing().axes]
    np.testing.assert_allclose([q[0] for q in lines], np.deg2rad([0.0, 20.0, 30.0, 40.0]))
    # From hanging, so that no link swings over the top.
    assert max(np.abs(q).max() for q in lines) < np.pi


def test_independent_simulations_agree() -> None:
    found = agreement(rigs.tlrip(), CHECK_POSE, np.zeros(3))
    # The twin's mechanics use half the step: the error of our RK4 is 1e-8 after ten seconds.
    assert (found.loc[TWIN].to_numpy() < 1e-7).all()


def test_mujoco_agrees_to_rounding() -> None:
    pytest.importorskip("mujoco")
    found = agreement(rigs.tlrip(), CHECK_POSE, np.zeros(3))
    # Both use the same RK4 steps.
    assert (found.loc[MUJOCO].to_numpy() < 1e-10).all()
