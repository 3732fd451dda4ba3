"""The worked example of friction compensation builds and reproduces its guide's numbers."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from nfriction import CVFM, export

ROOT = Path(__file__).resolve().parents[2]
GUIDE = ROOT / "docs" / "howto" / "compensation.md"
pytestmark = pytest.mark.skipif(
    not (shutil.which("gcc") and shutil.which("g++")), reason="needs gcc and g++"
)
ROW = re.compile(r"^(\S.*?) +(\d\.\d) +([\d.]+) +([\d.]+) +([\d.]+)$", re.MULTILINE)
Rows = dict[tuple[str, str], list[float]]


def rows(text: str) -> Rows:
    return {(name, gain): [float(x) for x in values] for name, gain, *values in ROW.findall(text)}


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Rows:
    """Error, motion at rest and chatter by velocity signal and gain."""
    folder = tmp_path_factory.mktemp("compensation")
    export.c(CVFM(1, [0.35, 0.12]), folder, name="friction")
    shutil.copy(ROOT / "examples" / "compensation" / "main.cpp", folder)
    for command in (
        "gcc -O2 -c friction.c",
        "g++ -std=c++11 -Wall -Wextra -Werror -O2 main.cpp friction.o -o compensation",
    ):
        subprocess.run(command.split(), cwd=folder, check=True)
    run = subprocess.run([folder / "compensation"], capture_output=True, text=True, check=True)
    return rows(run.stdout)


def test_compensation_reduces_the_error(shown: Rows) -> None:
    without = shown["none", "0.0"][0]
    for velocity in ("measured", "desired"):
        assert shown[velocity, "0.8"][0] < 0.2 * without


def test_high_gain_on_measured_velocity_causes_motion_at_rest(shown: Rows) -> None:
    assert shown["measured", "1.3"][1] > 20 * shown["measured", "0.8"][1]
    assert shown["measured", "1.3"][1] > 20 * shown["measured, faded below 0.05 rad/s", "1.3"][1]
    assert shown["measured", "1.3"][1] > 20 * shown["desired", "1.3"][1]


def test_the_guide_shows_these_numbers(shown: Rows) -> None:
    written = rows(GUIDE.read_text(encoding="utf-8"))
    assert written.keys() == shown.keys()
    for key, (error, *_) in shown.items():
        assert written[key][0] == pytest.approx(error, rel=0.02)
