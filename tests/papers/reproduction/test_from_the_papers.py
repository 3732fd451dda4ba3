"""The page that leads from the papers to the code names only what is there."""

import re
from functools import reduce
from importlib import import_module
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[3] / "docs" / "from_the_papers.md"
NAMES = sorted(set(re.findall(r"`(nfriction(?:\.\w+)+)`", PAGE.read_text(encoding="utf-8"))))


def found(name: str) -> object:
    """The thing of a dotted name: the longest part that is a module, then attributes."""
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


def test_the_page_names_files_that_are_there() -> None:
    paths = re.findall(r"`((?:trainers|datasets)/[\w./]+)", PAGE.read_text(encoding="utf-8"))
    assert len(paths) >= 4
    assert all((PAGE.parents[1] / path).exists() for path in paths)


@pytest.mark.parametrize("name", NAMES)
def test_every_name_on_the_page_can_be_imported_and_is_explained(name: str) -> None:
    thing = found(name)
    assert getattr(thing, "__doc__", None) or name.endswith("TABLE_6")
