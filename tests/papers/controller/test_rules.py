"""Rule files: lossless round trips, and errors that name what is invalid."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from nfriction.papers.controller.mamdani import paper_controller
from nfriction.papers.controller.rules import (
    Rule,
    RuleBase,
    load_rules,
    parse_rules,
)

SMALL = {
    "format": "nfriction-rules/1",
    "name": "small",
    "inputs": {
        "velocity": {"unit": "deg/s", "sets": {"slow": [0, 300], "fast": [200, 1000]}},
        "acceleration": {
            "unit": "deg/s^2",
            "universe": [-9000, 9000],
            "sets": {"braking": [-6000, 500], "driving": [-500, 8000]},
        },
    },
    "outputs": {"B": {"unit": "N m s/rad", "sets": {"low": [0, 6e-4], "high": [4e-4, 1e-3]}}},
    "table": {
        "columns": "velocity",
        "braking": [["low"], ["high"]],
        "driving": [["low"], ["low"]],
    },
}


def test_a_file_that_is_no_text_is_named(tmp_path: Path) -> None:
    (tmp_path / "rules.json").write_bytes(b'{"name": "\xff"}')
    with pytest.raises(ValueError, match=r"rules\.json: a rule file is UTF-8 text"):
        load_rules(tmp_path / "rules.json")


def small() -> dict:
    return json.loads(json.dumps(SMALL))


def test_table_gives_one_rule_per_cell() -> None:
    rules = parse_rules(json.dumps(SMALL))
    assert {rule.given: rule.then for rule in rules.rules} == {
        ("slow", "braking"): ("low",),
        ("fast", "braking"): ("high",),
        ("slow", "driving"): ("low",),
        ("fast", "driving"): ("low",),
    }
    assert rules.inputs[0].universe == (0, 1000)
    assert rules.inputs[1].universe == (-9000, 9000)


@pytest.mark.parametrize("unit", ["N m", "-", "1", "rad/s", "s/rad", "N m s^2/rad^2", "1/s"])
def test_outputs_may_be_in_the_units_of_coefficients(unit: str) -> None:
    content = small()
    content["outputs"]["B"]["unit"] = unit
    assert parse_rules(json.dumps(content)).outputs[0].unit == unit


def test_columns_may_be_either_input() -> None:
    turned = small()
    turned["table"] = {
        "columns": "acceleration",
        "slow": [["low"], ["low"]],
        "fast": [["high"], ["low"]],
    }
    first, second = parse_rules(json.dumps(turned)), parse_rules(json.dumps(SMALL))
    assert set(first.rules) == set(second.rules)


def test_rules_may_be_listed_with_weights_and_wildcards() -> None:
    listed = small()
    del listed["table"]
    listed["rules"] = [
        {"if": ["slow", "*"], "then": ["low"], "weight": 0.5},
        {"if": ["fast", "driving"], "then": ["high"]},
    ]
    assert parse_rules(json.dumps(listed)).rules == (
        Rule(("slow", "*"), ("low",), 0.5), Rule(("fast", "driving"), ("high",)),
    )  # fmt: skip


def test_three_joints_of_the_paper_share_their_rules() -> None:
    bases = [paper_controller(joint).rule_base for joint in (2, 3, 4)]
    assert bases[0].rules == bases[1].rules == bases[2].rules
    assert len(bases[0].rules) == 25
    for base in bases:
        assert base.outputs[0].terms == ["VH", "H", "M", "L", "VL"]


def _set(*path: str, to: object) -> Callable[[dict], None]:
    def change(document: dict) -> None:
        for key in path[:-1]:
            document = document[key]
        document[path[-1]] = to

    return change


def _drop(*path: str) -> Callable[[dict], None]:
    def change(document: dict) -> None:
        for key in path[:-1]:
            document = document[key]
        del document[path[-1]]

    return change


VELOCITY = ("inputs", "velocity")
CHANGES = [
    (_set("format", to="other/3"), "format"),
    (_drop("outputs"), "missing keys.*outputs"),
    (_set("colour", to=1), "unknown.*colour"),
    (_drop("table"), "either"),
    (_set("rules", to=[]), "either"),
    (_set("table", "columns", to="time"), "columns"),
    (_set("table", "gliding", to=[["low"], ["low"]]), "unknown keys.*'gliding'"),
    (_drop("table", "driving"), "missing keys.*'driving'"),
    (_set("table", "driving", to=[["low"]]), "needs a cell for each"),
    (_set("table", "driving", to=[["low"], []]), "needs a term for each"),
    (_set("table", "driving", to=[["low"], ["none"]]), "'driving' x 'fast'.*unknown term 'none'"),
    (_set("table", "driving", to="low"), "needs a cell"),
    (_set(*VELOCITY, "unit", to="km/h"), "unknown unit"),
    (_set(*VELOCITY, "unit", to=3), "expected text"),
    (_set(*VELOCITY, "unit", to="rad/s^2"), "list the velocity first"),
    (_set("outputs", "B", "unit", to="mN m s/rad"), "needs SI"),
    (_set("outputs", "B", "unit", to="bananas"), "needs SI"),
    (_set(*VELOCITY, "sets", "slow", to=[300, 0]), "low < high"),
    (_set(*VELOCITY, "sets", "fast", to=[-100, 200]), "ascend"),
    (_set(*VELOCITY, "sets", "fast", to=[200, 1e999]), "finite"),
    (_set(*VELOCITY, "sets", "fast", to=[200, True]), "must be numbers"),
    (_set(*VELOCITY, "sets", "fast", to=[200]), r"\[low, high\]"),
    (_set(*VELOCITY, "sets", "fast", to={"shape": "gaussian"}), "every set"),
    (_set(*VELOCITY, "sets", to={}), "ranges"),
    (_set(*VELOCITY, "sets", to={str(n): [n, n + 2] for n in range(100)}), "1 to 64 sets"),
    (_set(*VELOCITY, "universe", to=[5, 5]), "universe"),
    (_set("inputs", to=[]), "inputs"),
]


@pytest.mark.parametrize(("change", "message"), CHANGES)
def test_unsound_files_are_refused(change: Callable[[dict], None], message: str) -> None:
    document = small()
    change(document)
    with pytest.raises(ValueError, match=message):
        parse_rules(json.dumps(document))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "mine.json"),
        ("[" * 100_000, "mine.json"),
        ('{"format": 1, "format": 2}', "'format' comes twice"),
        ('{"format": NaN}', "finite"),
        ("[]", "table of keys"),
    ],
)
def test_unsound_json_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_rules(text, "mine.json")


def test_long_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "long.json"
    path.write_text(" " * 1_000_001)
    with pytest.raises(ValueError, match="at most"):
        load_rules(path)


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ({"if": ["slow"], "then": ["low"]}, "names 1 terms for 2"),
        ({"if": ["slow", "gliding"], "then": ["low"]}, "unknown term 'gliding'"),
        ({"if": ["*", "*"], "then": ["low"]}, "at least one"),
        ({"if": ["slow", "*"], "then": ["low"], "weight": 2}, "weight"),
        ({"if": ["slow", "*"], "then": ["low"], "weight": [1]}, "expected a number"),
        ({"if": ["slow", "*"]}, "missing keys.*then"),
        ({"if": "slow", "then": ["low"]}, "list of terms"),
    ],
)
def test_unsound_listed_rules_are_refused(rule: dict, message: str) -> None:
    document = small()
    del document["table"]
    document["rules"] = [rule]
    with pytest.raises(ValueError, match=message):
        parse_rules(json.dumps(document))


def test_sets_must_ascend_and_have_unique_names() -> None:
    rules: RuleBase = paper_controller(2).rule_base
    variable = rules.inputs[0]
    with pytest.raises(ValueError, match="ascend"):
        replace(variable, sets=variable.sets[::-1])
    with pytest.raises(ValueError, match="twice"):
        replace(variable, sets=(variable.sets[0], variable.sets[0]))
    with pytest.raises(ValueError, match="twice"):
        replace(rules, inputs=(variable, variable))
