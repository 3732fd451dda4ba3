"""The page is self-contained, escapes its input, and shows the contents of the run."""

import itertools
import math
import re
from html.parser import HTMLParser
from importlib import resources

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from nfriction import LFM, NFLFM, ModelInfo, save
from nfriction.evaluation.tables import Table, error_table
from nfriction.plots import style
from nfriction.report import read_run, to_html
from nfriction.report.page import _cards
from tests.report.runs import EVIL, JOINTS, results, write


class Page(HTMLParser):
    """Tags with their attributes and the text of a document; ill-nested tags are an error."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self._open: list[str] = []
        self.feed(html)
        assert not self._open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "source"):
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def html(tmp_path_factory):
    return to_html(read_run(write(tmp_path_factory.mktemp("run"))))


@pytest.fixture(scope="module")
def page(html):
    return Page(html)


def test_page_has_no_external_resources(html, page):
    for tag, attributes in page.tags:
        for key in ("src", "srcset", "href", "action", "poster", "data"):
            reference = attributes.get(key)
            assert reference is None or reference.startswith(("data:image/png;base64,", "#")), tag
        assert not any(key.startswith("on") or key == "style" for key in attributes)
    assert not page.all("link")
    style = html[html.index("<style>") : html.index("</style>")]
    assert "url(" not in style
    assert "@import" not in style


def test_contents_of_files_are_escaped(html, page):
    assert len(page.all("script")) == 1
    assert EVIL not in html
    assert EVIL in "".join(page.text)  # and is shown unchanged


def test_security_policy_allows_only_the_pages_own_script(page):
    (policy,) = (m["content"] for m in page.all("meta") if "http-equiv" in m)
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy


def test_wide_figures_use_the_width_of_the_page(page):
    assert [figure.get("class") for figure in page.all("figure")] == [None, "wide"]


def luminance(rgb: np.ndarray) -> float:
    """Relative luminance (WCAG 2)."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_figures_have_enough_contrast_in_dark_mode():
    """Colours as shown by the style's filter (W3C Filter Effects: invert, hue-rotate)."""
    css = (resources.files("nfriction.report") / "templates" / "page.css").read_text()
    (inverted,) = re.findall(r"filter: invert\(([\d.]+)\) hue-rotate\(180deg\)", css)
    grey = np.array([0.213, 0.715, 0.072])

    def shown(colour: str) -> float:
        rgb = np.array(to_rgb(colour))
        rgb = float(inverted) * (1 - 2 * rgb) + rgb
        return luminance(np.clip(2 * (grey @ rgb) - rgb, 0, 1))

    ground = shown("#ffffff") + 0.05
    assert (shown(style.INK) + 0.05) / ground > 7.0
    for colour in (*style.COLOURS, style.FAINT):
        assert (shown(colour) + 0.05) / ground > 3.0, colour


def test_an_animation_moves_on_the_page(tmp_path):
    folder = write(tmp_path)
    still = Image.new("P", (30, 20))
    still.save(folder / "figures" / "motion_1.gif", save_all=True, append_images=[still])
    page = Page(to_html(read_run(folder)))
    (shown,) = (i for i in page.all("img") if i.get("src", "").startswith("data:image/gif"))
    assert (shown["width"], shown["height"]) == ("30", "20")
    assert "simulated motion of the best model" in shown["alt"]


def test_screen_readers_get_headings_and_alternative_texts(page):
    assert page.all("html")[0]["lang"] == "en"
    assert all(a["alt"] for a in page.all("img")[:-1])  # the last one is the empty large picture
    tables = len(page.all("table"))
    assert tables == len(page.all("caption")) > 8
    assert all("scope" in a for a in page.all("th"))
    levels = [int(tag[1]) for tag, _ in page.tags if re.fullmatch(r"h\d", tag)]
    assert levels[0] == 1
    assert all(b - a <= 1 for a, b in itertools.pairwise(levels))
    anchors = {a["href"].removeprefix("#") for a in page.all("a")}
    assert anchors == {a["id"] for a in page.all("h2")}


def test_verdicts_warnings_and_rules_are_shown(page):
    text = " ".join("".join(page.text).split())
    for expected in (
        "load-coulomb (LFM) predicts the test recordings best: 100 mrad, where no friction leaves "
        "2000.",
        "Fit of load-coulomb (LFM): good",
        "0.002 N m s/rad",
        "inertia 1 (0.05 -> 0.051 kg m^2)",
        f"it is statistically tied with {EVIL}; the simplest of them is {EVIL}.",
        "Doubtful.",
        "Not identifiable: f_a with f_v.",
        "At a bound: f_b.",
        "IF velocity is slow AND acceleration is about zero THEN",
        "diverged",
        "nfriction export",
        "training recording",
    ):
        assert expected in text
    assert text.count("At a bound") == 1


def test_rejected_network_has_no_rules_and_unnamed_rig_is_marked(tmp_path):
    folder = write(tmp_path)
    info = ModelInfo(joint_names=JOINTS, rig={"name": ""})
    for model in (LFM(2, [2e-3, 1e-2]), NFLFM(2, [2e-3, 1e-2])):
        save(model, folder / "models" / f"{type(model).__name__}.json", info)
    text = " ".join("".join(Page(to_html(read_run(folder))).text).split())
    assert "Its network was rejected" in text
    assert "THEN" not in text
    assert "Rig: unnamed." in text


def test_a_coefficient_of_a_network_ranges_over_its_recordings(tmp_path):
    content = results()
    content["best"]["model"] = "NFLFM"
    sets = content["models"]["NFLFM"]["coefficients"]
    sets["lowest_in_training"] = {"B": [4e-3, 5e-3], "C": [6e-3, 1e-2]}
    sets["highest_in_training"] = {"B": [8e-3, 9e-3], "C": [7e-3, 1e-2]}
    first, second = _cards(read_run(write(tmp_path, content)))
    shown = [line["value"].split("\N{NO-BREAK SPACE}")[0] for line in first["lines"]]
    assert shown == ["0.004 to 0.008", "0.006 to 0.007"]
    assert [line["note"] for line in second["lines"]] == ["follows the motion", ""]


def test_errors_within_the_limit_of_the_least_are_grey(tmp_path):
    """LFM has 100 mrad, NFLFM 200; for LFM the initial state alone may cause 150."""
    content = results()
    near = {"joints": [0.15, 0.01], "all": 0.15}
    content["models"]["LFM"]["test"][EVIL]["limit"] = {"free_run": near, "windows": {}}
    run = read_run(write(tmp_path, content))
    table = error_table(run.comparison, "test")
    assert table.limit[:4] == ("limit of these data", 150, 10, 150)
    assert math.isnan(table.limit[4])
    tied = {(r[0], k) for r in table.rows for k in range(len(r)) if table.is_tied(r, k)}
    assert tied == {(model, k) for model in ("LFM", "NFLFM") for k in (1, 3)}
    assert [line.split()[-1] for line in str(table).splitlines()[-2:]] == ["90", "n/a"]
    html = to_html(run)
    assert html.count('class="best tied"') == 2
    assert html.count('class=" tied"') == 2
    assert '<tfoot><tr><th scope="row">limit of these data</th><td>150</td>' in html


def test_least_error_of_a_column_is_marked_but_never_a_diverged_one(tmp_path):
    table = error_table(read_run(write(tmp_path)).comparison, "test")
    marked = {(r[0], k) for r in table.rows for k in range(len(r)) if table.is_marked(r, k)}
    assert marked == {("LFM", k) for k in range(1, 5)}
    (lost,) = (row for row in table.rows if row[0] == "NLFM")
    assert [table.text(value) for value in lost[1:5]] == ["diverged"] * 4
    saved = {row[0]: row[-1] for row in table.rows}
    assert saved["LFM"] == pytest.approx(95.0)


@pytest.mark.parametrize(
    ("value", "text"),
    [(12345.6, "12346"), (0.0123456, "0.01235"), (1234.4, "1234"), (math.inf, "unknown"),
     (math.nan, "n/a"), (0.0, "0"), (1e-12, "0"), (2e-6, "2e-06")],
)  # fmt: skip
def test_numbers_are_rounded_for_reading(value, text):
    assert Table("", (), ()).text(value) == text
