"""The checklist from the papers to the code is complete, and names existing code."""

import re
from collections import Counter
from functools import reduce
from importlib import import_module
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[3] / "docs" / "from_the_papers.md"
TEXT = PAGE.read_text(encoding="utf-8")
NAMES = sorted(set(re.findall(r"`(nfriction(?:\.\w+)+)", TEXT)))
ROMAN = {"I": 1, "II": 2, "III": 3, "IV": 4}

# Contents of the papers, counted in the papers themselves.
PAPERS = {
    "equations of the TLRIP paper": {"": range(1, 31)},
    "tables of the TLRIP paper": {"Table": range(1, 12)},
    "figures of the TLRIP paper": {"Fig.": range(1, 15)},
    "the RTIP paper": {"": range(1, 11), "Table": range(1, 5), "Fig.": range(1, 9)},
}
METHODS = """cases of inertia; independent simulation; experiment; encoders; frequency counting;
    second-order filter; simulation at 1 ms; measured motion; classes of acceleration; by class;
    pattern search; Gaussian sets; min, max, centroid; controllers from the coefficients;
    40,000 measured samples; 2-10-2; Bayesian regularisation; NFFEM as printed"""
FUTURE = """jerk and snap; evolutionary tuning; control with the friction models; online learning;
    adaptive model with velocity and acceleration"""


def rows(heading: str) -> list[list[str]]:
    """Cells of the table below a heading, without its head."""
    part = TEXT.split(f"{heading}\n", 1)[1].split("\n##", 1)[0]
    lines = [line for line in part.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines[2:]]


def numbered(item: str) -> list[tuple[str, int]]:
    """Kind and number of every item that a cell's first words list."""
    if found := re.match(r"(Table|Fig\.)s?\.? ", item.replace("Figs.", "Fig.")):
        kind, words = found[1], re.split(r"[ ,]+", item)[1:]
        counted = []
        for word in words:
            if not (word.isdigit() or word in ROMAN):
                break
            counted.append((kind, int(word) if word.isdigit() else ROMAN[word]))
        return counted
    counted = []
    # (3)-(12), or (13), (14), before any words.
    for first, last in re.findall(r"\((\d+)\)(?:-\((\d+)\))?", re.match(r"[()\d, -]*", item)[0]):
        counted += [("", k) for k in range(int(first), int(last or first) + 1)]
    return counted


@pytest.mark.parametrize("heading", PAPERS)
def test_every_equation_table_and_figure_is_listed_once(heading: str) -> None:
    listed = Counter(n for row in rows(f"Checklist: {heading}") for n in numbered(row[0]))
    wanted = {(kind, k) for kind, numbers in PAPERS[heading].items() for k in numbers}
    assert set(listed) == wanted
    assert max(listed.values()) == 1


@pytest.mark.parametrize(
    ("heading", "listed"),
    [("Checklist: methods of the TLRIP paper", METHODS), ("Future work of the papers", FUTURE)],
)
def test_every_method_and_future_work_is_listed(heading: str, listed: str) -> None:
    items = [row[0] for row in rows(heading)]
    for name in " ".join(listed.split()).split("; "):
        assert any(name in item for item in items), name


def test_every_item_has_a_place_or_a_reason() -> None:
    headings = re.findall(r"^## ((?:Checklist|Future work).*)$", TEXT, re.MULTILINE)
    items = [row for heading in headings for row in rows(heading)]
    assert len(items) > 60
    for item, *_, here, differs in items:
        assert re.search(r"`|\]\(|the same|above", here) or (here == "–" and differs), item


def found(name: str) -> object:
    """Object of a dotted name: the longest part that is a module, then attributes."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            module = import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        return reduce(getattr, parts[end:], module)
    raise AssertionError(f"no part of {name} can be imported")


def test_the_page_names_the_code() -> None:
    assert len(NAMES) > 40


def test_page_names_existing_files() -> None:
    paths = re.findall(r"`((?:trainers|datasets)/[\w./]+)", TEXT)
    assert len(paths) >= 4
    assert all((PAGE.parents[1] / path).exists() for path in paths)


@pytest.mark.parametrize("name", NAMES)
def test_every_name_on_the_page_is_importable_and_documented(name: str) -> None:
    thing = found(name)
    assert getattr(thing, "__doc__", None) or name.endswith("TABLE_6")
