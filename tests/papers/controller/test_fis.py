"""MATLAB's `.fis` text: every function, all kinds of rules, errors that name their line."""

from pathlib import Path

import pytest
import torch

from nfriction.papers.controller.fis import load_fis, parse_fis
from nfriction.papers.controller.mamdani import MamdaniController

FLOAT64 = torch.float64

TEXT = """[System]
Name='joint'
Type='mamdani'
Version=2.0
NumInputs=2
NumOutputs=2
NumRules=3
AndMethod='min'
OrMethod='max'
ImpMethod='min'
AggMethod='max'
DefuzzMethod='centroid'

[Input1]
Name='velocity'
Range=[0 10]
NumMFs=3
MF1='fast':'trapmf',[5 8 10 10]
MF2='slow':'gaussmf',[2 0]
MF3='middle':'trimf',[2 4 6]

[Input2]
Name='acceleration'
Range=[-5 5]
NumMFs=2
MF1='braking':'gbellmf',[2 3 -5]
MF2='driving':'gauss2mf',[1 2 0.5 4]

[Output1]
Name='B'
Range=[0 1]
NumMFs=2
MF1='low':'gaussmf',[0.1 0]
MF2='high':'gaussmf',[0.2 1]

[Output2]
Name='C'
Range=[0 1]
NumMFs=2
MF1='low':'trimf',[-0.4 0 0.4]
MF2='high':'trimf',[0.6 1 1.4]

[Rules]
2 1, 1 2 (1) : 1
1 2, 2 0 (0.5) : 2
3 0, 1 1 (1) : 1
"""


def test_functions_use_matlabs_parameter_order() -> None:
    rules = parse_fis(TEXT)
    velocity, acceleration = rules.inputs
    assert velocity.terms == ["slow", "middle", "fast"]
    assert velocity.unit == "deg/s"
    held = {
        term.name: [float(term(torch.tensor(x, dtype=FLOAT64))) for x in points]
        for term, points in (
            (velocity.sets[0], (0.0, 2.0)),
            (velocity.sets[1], (4.0, 5.0)),
            (velocity.sets[2], (6.5, 9.0)),
            (acceleration.sets[0], (-5.0, -3.0)),
            (acceleration.sets[1], (3.0, 1.0, 4.5)),
        )
    }
    half_sigma = torch.exp(torch.tensor(-0.5, dtype=FLOAT64)).item()
    assert held["slow"] == pytest.approx([1, half_sigma])
    assert held["middle"] == pytest.approx([1, 0.5])
    assert held["fast"] == pytest.approx([0.5, 1])
    assert held["braking"] == pytest.approx([1, 0.5])
    assert held["driving"] == pytest.approx([1, half_sigma, half_sigma])


def test_or_is_the_maximum_of_both_conditions() -> None:
    controller = MamdaniController(parse_fis(TEXT))
    rules = controller.rule_base.rules
    assert [(rule.given, rule.then, rule.weight) for rule in rules] == [
        (("slow", "braking"), ("low", "high"), 1.0),
        (("fast", "*"), ("high", "*"), 0.5),
        (("*", "driving"), ("high", "*"), 0.5),
        (("middle", "*"), ("low", "low"), 1.0),
    ]
    x = torch.tensor([[8.0, -5.0]], dtype=FLOAT64)  # fast, not driving
    assert controller._rule_strengths(x)[1:3].amax().item() == 0.5


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Type='mamdani'", "Type='sugeno'", "mamdani"),
        ("AndMethod='min'", "AndMethod='prod'", "AndMethod"),
        ("[Input2]", "[Input1]", "twice"),
        ("'trimf',[2 4 6]", "'pimf',[2 4 6]", "unknown function 'pimf'"),
        ("[2 4 6]", "[2 4]", "takes 3"),
        ("[2 4 6]", "[2 x 6]", "expected numbers"),
        ("[2 4 6]", "[6 4 2]", "ascend"),
        ("[2 4 6]", "[2 4 inf]", "finite"),
        ("NumMFs=3", "NumMFs=three", "whole number"),
        ("NumRules=3", "NumRules=4", "3 lines"),
        ("Range=[0 10]", "Range=[0 10 20]", "\\[low high\\]"),
        ("2 1, 1 2 (1) : 1", "2 -1, 1 2 (1) : 1", "negated"),
        ("2 1, 1 2 (1) : 1", "4 1, 1 2 (1) : 1", "no set 4"),
        ("2 1, 1 2 (1) : 1", "2, 1 2 (1) : 1", "1 terms"),
        ("2 1, 1 2 (1) : 1", "2 1 -> 1 2", "expected"),
        ("Name='velocity'", "Name=velocity", "single quotes"),
        ("Version=2.0", "Version", "name=value"),
    ],
)
def test_errors_name_the_line(old: str, new: str, message: str) -> None:
    line = TEXT[: TEXT.index(old)].count("\n") + 1
    with pytest.raises(ValueError, match=f"line {line} .*{message}"):
        parse_fis(TEXT.replace(old, new, 1))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[Input2]", "[Input9]", r"\[Input2\] is missing"),
        ("MF3=", "MF4=", "no MF3"),
        ("OrMethod='max'", "OrMethod='probor'", "OrMethod"),
        ("(0.5)", "(7)", "weight"),
    ],
)
def test_other_errors_name_the_section_or_the_rule(old: str, new: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_fis(TEXT.replace(old, new, 1))


def test_units_and_files_are_checked(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="units"):
        parse_fis(TEXT, units=("deg/s",))
    with pytest.raises(ValueError, match="NumInputs"):
        parse_fis("[System]\nType='mamdani'\n")
    with pytest.raises(ValueError, match="section"):
        parse_fis("Name='x'")
    path = tmp_path / "long.fis"
    path.write_text("%" * 1_000_001)
    with pytest.raises(ValueError, match="at most"):
        load_fis(path)
