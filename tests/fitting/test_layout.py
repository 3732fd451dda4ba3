"""`fitting` stays shallow: few import levels, few arguments, no type tests."""

import ast
from functools import cache
from pathlib import Path

import nfriction.fitting

ROOT = Path(nfriction.fitting.__file__).parent
TREES = {
    "nfriction.fitting." + ".".join(path.relative_to(ROOT).with_suffix("").parts): ast.parse(
        path.read_text(encoding="utf-8")
    )
    for path in ROOT.rglob("*.py")
    if path.name != "__init__.py"
}


@cache
def level(module: str) -> int:
    imported = {
        node.module for node in ast.walk(TREES[module]) if isinstance(node, ast.ImportFrom)
    } & TREES.keys()
    return 1 + max(map(level, imported), default=0)


def test_at_most_eight_import_levels() -> None:
    assert max(map(level, TREES)) <= 8


def test_only_the_entry_point_has_more_than_eight_arguments() -> None:
    many = [
        node.name
        for tree in TREES.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        and len([a for a in node.args.args + node.args.kwonlyargs if a.arg != "self"]) > 8
    ]
    assert many == ["fit"]


def test_no_schedule_is_tested_for_its_type() -> None:
    asked = [
        ast.unparse(node)
        for tree in TREES.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and ast.unparse(node.func) == "isinstance"
        and "chedule" in ast.unparse(node)
    ]
    assert asked == []
