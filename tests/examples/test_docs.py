"""The documentation is consistent with the code: commands parse, code compiles, names resolve."""

import importlib
import math
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import nfriction
from nfriction import LinearAxis, Motor, PendulumChain, Rotor, cli, friction, rigs
from tests.cli.benches import pendulum, swing

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
README = ROOT / "README.md"
FILE = re.compile(r"\S+\.(csv|csv\.gz|json|xml|pt|c)$")


def blocks(language: str) -> Iterator[tuple[str, str]]:
    """Page and text of every code block in a language."""
    for page in (README, *PAGES):
        text = page.read_text(encoding="utf-8")
        for block in re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            yield page.name, block


def commands() -> list[tuple[str, str]]:
    found = []
    for page, block in blocks("sh"):
        for line in block.replace("\\\n", " ").splitlines():
            if line.startswith("nfriction "):
                found.append((page, line.split("#")[0].strip()))
    return found


def test_links_of_the_readme_exist_in_the_repository() -> None:
    targets = re.findall(r"\]\(([^)#]+)", README.read_text(encoding="utf-8"))
    assert len(targets) > 5
    assert [t for t in targets if not t.startswith("http") and not (ROOT / t).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_and_figures_of_every_page_exist(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.M)
    text = re.sub(r"`[^`]*`", "", text)
    for target in re.findall(r"\]\(([^)#\s]+)", text):
        assert target.startswith("http") or (page.parent / target).exists(), target
    for name, _, section in (n.partition(":") for n in re.findall(r'^--8<-- "(.*)"$', text, re.M)):
        assert not section or f"[start:{section}]" in (ROOT / name).read_text(encoding="utf-8")


def test_command_reference_has_every_command_and_option() -> None:
    hooks = runpy.run_path(str(ROOT / "docs" / "hooks.py"))
    page = (ROOT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    text = hooks["on_page_markdown"](page)
    for words in (["fit", "--columns"], ["compare", "--also"], ["export", "--law"], ["info"]):
        assert f"## nfriction {words[0]}\n" in text
        assert all(f"`{option}" in text for option in words[1:])
    assert "%(" not in text
    assert hooks["MARK"] not in text
    # A bar would begin another cell, and a line break another row.
    rows = [line for line in text.splitlines() if line.startswith("| `")]
    assert len(rows) > 60
    assert all(row.count("|") == 3 for row in rows)


def test_rig_reference_has_every_key() -> None:
    text = (ROOT / "docs" / "reference" / "rig_keys.md").read_text(encoding="utf-8")
    kinds = text.split("\n## ")[1:]
    named = [set(re.findall(r"`(\w+)`", kind)) for kind in kinds]
    for part, kind in zip(named, (PendulumChain, Rotor, LinearAxis), strict=False):
        assert {*kind.required, *kind.optional} <= part
    assert {field.name for field in fields(Motor)} <= named[3]


def test_shapes_are_not_rendered_in_italics() -> None:
    markdown = pytest.importorskip("markdown", reason="`pip install .[docs]` to run this")
    pytest.importorskip("pymdownx", reason="`pip install .[docs]` to run this")
    assert "pymdownx.betterem: {smart_enable: all}" in (ROOT / "mkdocs.yml").read_text()
    html = markdown.markdown(
        "qd, load: (*batch, joint); output (*batch, joint)",
        extensions=["pymdownx.betterem"],
        extension_configs={"pymdownx.betterem": {"smart_enable": "all"}},
    )
    assert "<em>" not in html


def test_pages_and_commands_are_found() -> None:
    assert len(PAGES) > 10
    assert len(commands()) > 8


@pytest.mark.parametrize(("page", "line"), commands())
def test_commands_parse(
    page: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = shlex.split(line)[1:]
    if words == ["--help"]:
        return
    monkeypatch.chdir(tmp_path)
    for name in ("_LAWS", "_MODELS", "_ALL", "_BY_TEXT", "_OWN"):
        monkeypatch.setattr(friction, name, dict(getattr(friction, name)))
    shutil.copy(ROOT / "examples" / "own_law.py", tmp_path)
    for word in filter(FILE.match, words):
        (tmp_path / word).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / word).touch()
    assert cli.make_parser().parse_args(words).run


@pytest.mark.parametrize(("page", "block"), list(blocks("python")))
def test_code_compiles_and_its_imports_exist(page: str, block: str) -> None:
    snippets = re.findall(r'^--8<-- "(.*)"$', block, re.MULTILINE)
    assert len(snippets) == block.count("--8")
    for snippet in snippets:
        assert (ROOT / snippet).is_file()
    code = re.sub(r"^--8<--.*$", "", block, flags=re.MULTILINE)
    compile(code, page, "exec")
    for names in re.findall(r"^from nfriction import (.*)$", code, re.MULTILINE):
        for name in names.split(","):
            assert getattr(nfriction, name.strip())


REFERENCES = [
    name
    for page in PAGES
    for name in re.findall(r"^::: (\S+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
]


@pytest.mark.parametrize("name", REFERENCES)
def test_reference_describes_existing_objects(name: str) -> None:
    thing, parts = importlib.import_module("nfriction"), name.split(".")
    for k, part in enumerate(parts[1:], 2):
        if not hasattr(thing, part):
            importlib.import_module(".".join(parts[:k]))
        thing = getattr(thing, part)
    assert thing.__doc__


def test_pages_are_in_the_menu_and_figure_functions_in_the_reference() -> None:
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in PAGES:
        assert page.relative_to(ROOT / "docs").as_posix() in menu
    from nfriction import plots

    described = {name.rpartition(".")[2] for name in REFERENCES}
    assert set(plots.__all__) - described <= {"save_all"}


# Preparation of the pages' commands, and how readers get the files.
TWIN = """nfriction twin --seconds 5 --out twin
    for k in 1 2; do gunzip -c twin/train_*$k.csv.gz > run$k.csv; done
    gunzip -c twin/test_1.csv.gz > run3.csv; cp twin/rig.json ."""
BEFORE = {
    "README.md": TWIN,
    "motor.md": """python examples/motor_bench.py; head -3 runs/motor/run1.csv
        sed /rotor_inertia/d runs/motor/rig.json > no_inertia.json
        nfriction fit runs/motor/run[12].csv --rig no_inertia.json --model coulomb-viscous \\
            --columns "time=Zeit [ms],motor1=Geber:counts/8192,current1=Strom [A]" 2>&1""",
    "own_rig.md": "python examples/own_rig.py; head -3 runs/own_rig/log.csv",
    "export.md": "python examples/fit_a_recording.py",
    "own_law.md": f"{TWIN}; cp examples/own_law.py .",
    "torque_table.md": """gunzip -c $DATA/kuka_kr300/kr300_A_friction.csv.gz > table.csv
        cp table.csv other_table.csv""",
}
# Pages that build on each other run in one folder.
QUICK = {"which_law.md", "from_the_papers.md"}
SESSIONS = [
    pytest.param(pages.split(), marks=[] if pages in QUICK else pytest.mark.slow, id=pages)
    for pages in (
        "which_law.md", "own_rules.md", "own_law.md", "explanation.md", "tour.md",
        "motor.md compensation.md", "own_rig.md export.md", "torque_table.md", "README.md",
        "from_the_papers.md",
    )
]  # fmt: skip
# They need a user's robot file, a network, make, or minutes that another test takes.
NOT_RUN = (
    'rig = rigs.read("robot.urdf")', "nfriction: error: arm.urdf", "nfriction data get",
    "cd data/", "make demo", "Without friction, simulations of the test",
    "recording, signals", "pip install", " encoder ──▶",
)  # fmt: skip


@pytest.mark.parametrize("pages", SESSIONS)
def test_pages_print_what_they_show(
    pages: list[str], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    for name in ("examples", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    if "torque_table.md" in pages:
        environment["DATA"] = str(request.getfixturevalue("data_dir"))
    head = "set -e; " + "".join(
        f'{word}() {{ "{sys.executable}" {option} "$@"; }}; '
        for word, option in (("python", ""), ("nfriction", "-m nfriction"))
    )
    printed: list[str] = []

    def run(command: str) -> None:
        done = subprocess.run(
            ["bash", "-c", head + command], cwd=tmp_path, env=environment, text=True,
            capture_output=True, timeout=1200,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
        printed.extend(f"{done.stdout} {done.stderr}".split())

    for name in pages:
        page = next(p for p in (README, *PAGES) if p.name == name)
        run(BEFORE.get(name, "true"))
        text = page.read_text(encoding="utf-8")
        for language, block in re.findall(r"^ *```(\w*)\n(.*?)^ *```", text, re.DOTALL | re.M):
            if block.startswith(NOT_RUN):
                continue
            if language == "sh":
                run(block)
            elif language == "python":
                snippet = re.fullmatch(r'--8<-- "(.*)"\n', block)
                run(f"python {snippet[1]}" if snippet else f"python -c {shlex.quote(block)}")
            elif not language:
                place = 0
                for line in filter(None, map(str.split, block.splitlines())):
                    found = [k for k in range(place, len(printed)) if shown_at(k, line, printed)]
                    assert found, f"{name} shows what no command prints: {' '.join(line)}"
                    place = found[0] + len(line)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("page", ["scikit_learn.md", "many_fits.md"])
def test_python_of_pages_runs_from_top_to_bottom(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("sklearn", reason="`pip install nfriction[sklearn]` to run this")
    monkeypatch.chdir(tmp_path)
    plant = pendulum()
    rigs.write(plant, tmp_path / "rig.json")
    recordings = [swing(f"run{k}", 0.6 + 0.2 * k) for k in range(6)]
    for recording in recordings:
        for folder in (tmp_path, tmp_path / "logs"):
            folder.mkdir(exist_ok=True)
            recording.write(folder / f"{recording.name}.csv")
    given = recordings[0].to_pandas()
    table = pd.DataFrame({"t": 1e3 * given["time"], "enc": np.rad2deg(given["q1"])})
    known = {"table": table, "rig": plant, "train": recordings[:2], "test": recordings[2:3]}
    ran = 0
    for name, block in blocks("python"):
        if name == page and "--8<--" not in block and "dask" not in block:
            one_job = re.sub(r"jobs=-?\d+", "jobs=1", block)
            exec(compile(one_job, page, "exec"), known)
            ran += 1
    assert ran > 1


def shown_at(place: int, shown: list[str], printed: list[str]) -> bool:
    """Compare shown words with those printed; numbers to 1 %, as processors round differently."""

    def same(a: str, b: str) -> bool:
        if a == b:
            return True
        try:
            x, y = (float(word.strip("()[],;%")) for word in (a, b))
        except ValueError:
            return False
        return math.isclose(x, y, rel_tol=0.01, abs_tol=1e-12)

    there = printed[place : place + len(shown)]
    return len(there) == len(shown) and all(map(same, shown, there))


@pytest.mark.slow
def test_demo_output_matches_the_readme(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["demo", "--out", "runs/demo", "--no-figures"]) == 0
    end = "\n".join(capsys.readouterr().out.splitlines()[-4:])
    assert f"```\n{end}\n```" in README.read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("mkdocs", path=Path(sys.executable).parent) is None,
    reason="no mkdocs here; `pip install .[docs]` to run this",
)
def test_the_site_builds_and_needs_no_network(tmp_path: Path) -> None:
    command = [str(Path(sys.executable).parent / "mkdocs"), "build", "--strict", "-d", tmp_path]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=300)
    for page in tmp_path.rglob("*.html"):
        html = page.read_text(encoding="utf-8")
        assert not re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="https?://', html), page
