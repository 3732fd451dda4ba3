"""The page in a browser: tables sort, figures open and grow, nothing exceeds the screen width."""

import json
import shutil
import subprocess
import threading
from functools import partial
from html import escape
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from queue import Queue
from typing import Any

import pytest

from nfriction.report import read_run, to_html
from tests.report.runs import write

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)

pytestmark = pytest.mark.skipif(
    BROWSER is None, reason="no Chromium here; install the package `chromium` to run this"
)

# Runs next to two frames that contain the page, each as wide as a screen.
PROBE = """
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
const report = (found) => fetch("/found", {method: "POST", body: JSON.stringify(found)});
const column = (table, k) => [...table.tBodies[0].rows].map((row) => row.cells[k].textContent);
const look = async (frame) => {
  const page = frame.contentDocument;
  const wide = page.documentElement.scrollWidth;
  const found = {width: frame.clientWidth, wide, title: page.title};
  const table = page.querySelector("table");
  const head = table.tHead.rows[0].cells[1];
  found.before = column(table, 0);
  head.querySelector("button").click();
  found.ascending = [column(table, 0), head.getAttribute("aria-sort")];
  head.querySelector("button").click();
  found.descending = [column(table, 0), head.getAttribute("aria-sort")];
  table.tHead.rows[0].cells[0].querySelector("button").click();
  found.words = [column(table, 0), head.getAttribute("aria-sort")];
  const dialog = page.querySelector("dialog");
  page.querySelector(".zoom").click();
  const large = dialog.querySelector("img");
  while (!large.clientWidth) await wait(10);  // until it is decoded
  found.opened = [dialog.open, large.alt.length > 0, large.clientWidth];
  dialog.querySelector("[data-do=in]").click();
  found.grown = large.clientWidth;
  dialog.querySelector("[data-do=fit]").click();
  found.fitted = large.clientWidth;
  dialog.querySelector("[data-do=close]").click();
  found.closed = !dialog.open;
  found.narrow = [...page.querySelectorAll("thead button, .tools button")]
    .filter((b) => b.clientHeight > 0 && b.clientHeight < 24).length;
  return found;
};
addEventListener("load", async () => {
  const found = [];
  for (const frame of document.querySelectorAll("iframe")) found.push(await look(frame));
  await report(found);
});
"""

# How a figure is shown, small and enlarged.
DARK = """
addEventListener("load", async () => {
  const page = document.querySelector("iframe").contentDocument;
  page.querySelector(".zoom").click();
  const style = (of) => page.defaultView.getComputedStyle(page.querySelector(of));
  const filters = ["figure img", "dialog img"].map((of) => style(of).filter);
  const ground = style("body").backgroundColor;
  await fetch("/found", {method: "POST", body: JSON.stringify({filters, ground})});
});
"""


@pytest.fixture(scope="module")
def looks(tmp_path_factory: pytest.TempPathFactory) -> list[dict]:
    """Findings of the probe on a phone and on a desktop."""
    folder = tmp_path_factory.mktemp("browser")
    page = escape(to_html(read_run(write(folder / "run"))))
    frames = "".join(
        f'<iframe srcdoc="{page}" style="width:{w}px;height:{h}px;border:0"></iframe>'
        for w, h in ((375, 812), (1280, 900))
    )
    outer = folder / "outer.html"
    outer.write_text(f"<!DOCTYPE html><body>{frames}<script>{PROBE}</script>", encoding="utf-8")
    return found_in_browser(outer, folder / "profile")


def found_in_browser(page: Path, profile: Path, *options: str) -> Any:
    """Report of the probe; the browser stays open until the page has posted it."""
    answers: Queue[bytes] = Queue()

    class Handler(SimpleHTTPRequestHandler):
        def do_POST(self) -> None:
            answers.put(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=page.parent)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        command = [
            str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--disable-sync",
            f"--user-data-dir={profile}", "--remote-debugging-port=0", *options,
            f"http://127.0.0.1:{server.server_port}/{page.name}",
        ]  # fmt: skip
        quiet = subprocess.DEVNULL
        browser = subprocess.Popen(command, stdout=quiet, stderr=quiet)
        try:
            return json.loads(answers.get(timeout=120))
        finally:
            browser.terminate()
            browser.wait(30)
            server.shutdown()


def test_nothing_is_wider_than_the_screen(looks):
    assert [look["width"] for look in looks] == [375, 1280]
    assert all(look["wide"] <= look["width"] for look in looks)


def test_names_from_files_run_no_script(looks):
    assert all(look["title"].startswith("Friction models") for look in looks)


def test_headings_sort_their_table(looks):
    for look in looks:
        linear, arctan = "load-coulomb (LFM)", "arctan (NLFM)"
        fuzzy, none = "neuro-fuzzy:load-coulomb (NFLFM)", "no friction"
        assert look["before"] == [none, linear, arctan, fuzzy]
        by_error = [linear, fuzzy, none, arctan]  # arctan diverged
        assert look["ascending"] == [by_error, "ascending"]
        assert look["descending"] == [by_error[::-1], "descending"]
        assert look["words"] == [[arctan, linear, fuzzy, none], "none"]


def test_figures_open_grow_and_close(looks):
    for look in looks:
        opened, has_alt, width = look["opened"]
        assert opened
        assert has_alt
        assert 0 < width <= look["width"]
        assert look["grown"] == pytest.approx(1.5 * width, abs=1.5)  # whole pixels
        assert look["fitted"] == pytest.approx(width, abs=1)
        assert look["closed"]


def test_touch_targets_are_large_enough(looks):
    assert all(look["narrow"] == 0 for look in looks)


def test_dark_mode_shows_dark_figures_small_and_large(tmp_path):
    page = escape(to_html(read_run(write(tmp_path / "run"))))
    outer = tmp_path / "outer.html"
    outer.write_text(
        f'<!DOCTYPE html><body><iframe srcdoc="{page}" style="width:900px;height:900px"></iframe>'
        f"<script>{DARK}</script>",
        encoding="utf-8",
    )
    option = "--blink-settings=preferredColorScheme=0"
    look = found_in_browser(outer, tmp_path / "profile", option)
    assert look["ground"] == "rgb(20, 23, 27)"
    assert look["filters"] == ["invert(0.92) hue-rotate(180deg)"] * 2
