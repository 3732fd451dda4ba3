"""Import of Mamdani controllers from MATLAB's `.fis` text files."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from nfriction.fuzzy.membership import FuzzySet
from nfriction.io.files import shortened
from nfriction.papers.controller.rules import ANY, Rule, RuleBase, Variable, read_text

_METHODS = {"AndMethod": "min", "ImpMethod": "min", "AggMethod": "max", "DefuzzMethod": "centroid"}

# MATLAB's function: our shape, and the positions of our parameters in its list.
_FUNCTIONS = {
    "gaussmf": ("gaussian", (1, 0)),
    "gauss2mf": ("two_sided_gaussian", (1, 0, 3, 2)),
    "gbellmf": ("bell", (2, 0, 1)),
    "trimf": ("triangle", (0, 1, 2)),
    "trapmf": ("trapezoid", (0, 1, 2, 3)),
}

_TERM = re.compile(r"'([^']*)'\s*:\s*'([^']*)'\s*,\s*\[([^\]]*)\]\s*")
_RULE = re.compile(r"([-\d\s]+),([-\d\s]+)\(([^()]*)\)\s*:\s*([12])\s*")


class _FileVariable(NamedTuple):
    """A variable, and the names of its sets in the order of the file, to which rules refer."""

    variable: Variable
    terms: list[str]


@dataclass(frozen=True)
class _Line:
    number: int
    text: str

    def error(self, message: str) -> ValueError:
        return ValueError(f"line {self.number} ({shortened(self.text, 60)}): {message}")


def load_fis(path: str | Path, units: Sequence[str] = ("deg/s", "deg/s^2")) -> RuleBase:
    """Rule base from a `.fis` file; see `parse_fis`."""
    path = Path(path)
    text = read_text(path)
    try:
        return parse_fis(text, units)
    except ValueError as error:
        raise ValueError(f"{path.name}: {shortened(error)}") from error


def parse_fis(text: str, units: Sequence[str] = ("deg/s", "deg/s^2")) -> RuleBase:
    """Rule base from the text of a `.fis` file.

    Supports Mamdani systems with min, max and centroid, and the functions gaussmf, gauss2mf,
    gbellmf, trimf and trapmf. Sets are sorted in ascending order. A rule joined by OR becomes one
    rule for each of its conditions, which gives the same output under max.

    Args:
        units: of the inputs, which the format does not contain; "1" for dimensionless.
    Raises:
        ValueError: if the system is not supported; the message names the line.
    """
    sections = _sections(text)
    system = sections.get("System", {})
    for key in ("Type", "NumInputs", "NumOutputs", "NumRules"):
        if key not in system:
            raise ValueError(f"[System] needs {key}; is this a .fis file?")
    if _quoted(system["Type"]).lower() != "mamdani":
        raise system["Type"].error("only systems of type 'mamdani' are read.")
    for key, method in _METHODS.items():
        # A missing method means the default, which is the method here.
        if key in system and _quoted(system[key]) != method:
            raise system[key].error(f"{key} must be {method!r}.")
    count = _count(system, "NumInputs")
    if len(units) != count:
        raise ValueError(f"`units` needs one for each of {count} inputs, got {list(units)}.")
    inputs = _variables(sections, "Input", units)
    outputs = _variables(sections, "Output", ["1"] * _count(system, "NumOutputs"))
    lines = list(sections.get("Rules", {}).values())
    if len(lines) != _count(system, "NumRules"):
        raise system["NumRules"].error(f"but [Rules] has {len(lines)} lines.")
    rules = [rule for line in lines for rule in _rules(line, system, inputs, outputs)]
    name = _quoted(system["Name"]) if "Name" in system else ""
    return RuleBase(
        name,
        tuple(one.variable for one in inputs),
        tuple(one.variable for one in outputs),
        tuple(rules),
    )


def _sections(text: str) -> dict[str, dict[str, _Line]]:
    """Lines by section and key; the key of a rule is its number."""
    sections: dict[str, dict[str, _Line]] = {}
    section: dict[str, _Line] | None = None
    heading = ""
    for number, raw in enumerate(text.splitlines(), 1):
        stripped = raw.strip()
        line = _Line(number, stripped)
        # Comments in MATLAB.
        if not stripped or stripped.startswith("%"):
            continue
        if stripped.startswith("[") and stripped.endswith("]"):
            heading = stripped[1:-1].strip()
            # Continuing would mix two systems into one.
            if heading in sections:
                raise line.error("this section comes twice.")
            section = sections[heading] = {}
            continue
        if section is None:
            raise line.error("expected a section such as [System] first.")
        key, equals, value = (part.strip() for part in stripped.partition("="))
        # Rules have no `name=`; they are numbered.
        if heading == "Rules":
            key, value = str(len(section)), stripped
        elif not equals:
            raise line.error("expected `name=value`.")
        if key in section:
            raise line.error(f"{key} comes twice in [{heading}].")
        section[key] = _Line(number, value)
    return sections


def _variables(
    sections: dict[str, dict[str, _Line]], kind: str, units: Sequence[str]
) -> list[_FileVariable]:
    variables = []
    for index, unit in enumerate(units, 1):
        heading = f"{kind}{index}"
        if heading not in sections:
            raise ValueError(f"section [{heading}] is missing.")
        section = sections[heading]
        for key in ("Name", "Range", "NumMFs"):
            if key not in section:
                raise ValueError(f"[{heading}] needs {key}.")
        terms = [_term(section, heading, number + 1) for number in range(_count(section, "NumMFs"))]
        low_high = _numbers(section["Range"], section["Range"].text.strip("[]"))
        if len(low_high) != 2:
            raise section["Range"].error("expected [low high].")
        # Rules in the file number the sets in its own order.
        ascending = sorted(terms, key=lambda term: term.core)
        name, universe = _quoted(section["Name"]), (low_high[0], low_high[1])
        variable = Variable(name, unit, universe, tuple(ascending))
        variables.append(_FileVariable(variable, [term.name for term in terms]))
    return variables


def _term(section: dict[str, _Line], heading: str, number: int) -> FuzzySet:
    if f"MF{number}" not in section:
        raise section["NumMFs"].error(f"but [{heading}] has no MF{number}.")
    line = section[f"MF{number}"]
    match = _TERM.fullmatch(line.text)
    if match is None:
        raise line.error("expected 'name':'function',[numbers].")
    name, function, listed = match.groups()
    if function not in _FUNCTIONS:
        raise line.error(f"unknown function {function!r}; read are {list(_FUNCTIONS)}.")
    shape, places = _FUNCTIONS[function]
    numbers = _numbers(line, listed)
    if len(numbers) != len(places):
        raise line.error(f"{function} takes {len(places)} numbers, got {len(numbers)}.")
    try:
        return FuzzySet(name, shape, tuple(numbers[place] for place in places))
    except ValueError as error:
        raise line.error(str(error)) from error


def _rules(
    line: _Line, system: dict[str, _Line], inputs: list[_FileVariable], outputs: list[_FileVariable]
) -> list[Rule]:
    match = _RULE.fullmatch(line.text)
    if match is None:
        raise line.error("expected `input terms, output terms (weight) : 1 or 2`.")
    given = _named(line, match[1], inputs)
    then = _named(line, match[2], outputs)
    weight = _numbers(line, match[3])
    if len(weight) != 1:
        raise line.error("expected one weight in parentheses.")
    # With at most one condition, OR equals AND.
    asked = [i for i, term in enumerate(given) if term != ANY]
    if match[4] == "1" or len(asked) < 2:
        return [Rule(given, then, weight[0])]
    if "OrMethod" in system and _quoted(system["OrMethod"]) != "max":
        raise line.error("a rule joined by OR needs OrMethod='max'.")
    return [
        Rule(tuple(term if i == one else ANY for i, term in enumerate(given)), then, weight[0])
        for one in asked
    ]


def _named(line: _Line, text: str, variables: list[_FileVariable]) -> tuple[str, ...]:
    parts = text.split()
    # The limit on digits keeps very long numbers from int().
    if not all(re.fullmatch(r"-?\d{1,6}", part) for part in parts):
        raise line.error("terms are whole numbers.")
    numbers = [int(part) for part in parts]
    if len(numbers) != len(variables):
        raise line.error(
            f"{len(numbers)} terms for {[one.variable.name for one in variables]}; 0 for any."
        )
    names = []
    for number, (variable, terms) in zip(numbers, variables, strict=True):
        # MATLAB denotes NOT by a minus sign.
        if number < 0:
            raise line.error("negated terms are not supported; write the opposite set.")
        if number > len(terms):
            raise line.error(f"{variable.name!r} has no set {number}.")
        names.append(terms[number - 1] if number else ANY)
    return tuple(names)


def _numbers(line: _Line, text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.replace(",", " ").split())
    except ValueError as error:
        raise line.error("expected numbers.") from error


def _count(section: dict[str, _Line], key: str) -> int:
    line = section[key]
    if not re.fullmatch(r"\d{1,6}", line.text):
        raise line.error(f"{key} must be a whole number.")
    return int(line.text)


def _quoted(line: _Line) -> str:
    if len(line.text) < 2 or not (line.text[0] == line.text[-1] == "'"):
        raise line.error("expected text in single quotes.")
    return line.text[1:-1]
