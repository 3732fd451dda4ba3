"""Prose lint: docstrings, messages, comments, test names and documents in standard terms."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "nfriction"
SOURCES = sorted(
    path
    for folder in ("nfriction", "trainers", "datasets", "examples", "benchmarks", "tests")
    for path in (ROOT / folder).rglob("*.py")
    if path != Path(__file__)  # it lists the habits
)
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])

# A docstring begins with a verb or a noun phrase, not with a relative clause used as a noun.
RELATIVE_LEAD = re.compile(
    r"^(What|Whatever|Whether|Which|Who|Whoever|Whose|How|Where|By how|Of|Those (of|that))\b"
)
# Habits of the house that a native engineer stumbles on, each with the standard term.
HABITS = {
    r"\b(is|are|was|were|be|been) told\b": "shown, estimated, reported",
    r"\b(tells?|told) (of|nothing|apart|more|less|how|what|which|whether|that)\b": "show, separate",
    r"\b(tells?|told) (one|them|it|small)\b": "show, separate",
    r"\b(data|fit|run|recording|torque|file|message|sheet|number)s? (can(not)? )?tells?\b": "show",
    r"\b(left|leaves?|leaving) over\b": "residual",
    r"\bmak(e|es|ing) up for\b|\bmade up for\b": "compensate",
    r"\bheld back\b": "hold-out",
    r"\bas it looks\b": "auto",
    r"\bas good as\b": "practically",
    r"\bg(ives?|ave|iving) way\b": "is replaced by",
    r"\bserves?\b": "is used, works",
    r"\bstands? (for|beside|behind|in|on|at|among|there|above)\b": "is, means, is listed",
    r"\bmisgivings?\b": "warnings",
    r"\bharmless\b": "allowed",
    r"\bmend(s|ed|ing)?\b": "fix",
    r"\bearns? its place\b": "helps",
    r"\bbeside other\b": "compared with other",
}
ANY_HABIT = re.compile("|".join(f"(?:{h})" for h in HABITS), re.IGNORECASE)
TEST_NAME_HABIT = re.compile(
    r"(?<![a-z])(told|tells|said|misgivings|harmless|held_back|left_over|made_up_for)(?![a-z])"
)
LONGEST_TEST_NAME = 68


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(tree):
        if isinstance(node, kinds) and (text := ast.get_docstring(node)):
            yield getattr(node, "lineno", 1), text


def prose_of(path: Path) -> Iterator[tuple[int, str]]:
    """Lines of prose: of a document all outside code blocks, of a module comments and strings."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        code = False
        for number, line in enumerate(text.splitlines(), 1):
            code ^= line.lstrip().startswith("```")
            if not code:
                yield number, line
        return
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in (tokenize.COMMENT, tokenize.STRING):
            for offset, line in enumerate(token.string.splitlines()):
                yield token.start[0] + offset, line


def report(found: list[str]) -> None:
    assert not found, f"{len(found)} places\n" + "\n".join(found)


def test_docstrings_begin_with_a_verb_or_a_noun() -> None:
    report(
        [
            f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
            for path in SOURCES
            for line, text in docstrings(ast.parse(path.read_text(encoding="utf-8")))
            if RELATIVE_LEAD.match(text)
        ]
    )


@pytest.mark.parametrize("paths", [SOURCES, DOCUMENTS], ids=["modules", "documents"])
def test_prose_uses_standard_terms(paths: list[Path]) -> None:
    report(
        [
            f"{path.relative_to(ROOT)}:{line}: {text.strip()}"
            for path in paths
            for line, text in prose_of(path)
            if ANY_HABIT.search(text)
        ]
    )


def test_test_names_are_short_and_in_standard_terms() -> None:
    report(
        [
            f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}"
            for path in (ROOT / "tests").rglob("test_*.py")
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
            if len(node.name) > LONGEST_TEST_NAME or TEST_NAME_HABIT.search(node.name)
        ]
    )


# Comments that give reasons; the models that this code is held against have 4 to 8 %.
LEAST_SHARE_OF_COMMENTS = 0.04


def test_comments_give_reasons_on_enough_lines() -> None:
    lines = [line for path in PACKAGE.rglob("*.py") for line in path.read_text().splitlines()]
    commented = sum(line.lstrip().startswith("#") or "  # " in line for line in lines)
    assert commented >= LEAST_SHARE_OF_COMMENTS * len(lines), f"{commented} of {len(lines)} lines"
