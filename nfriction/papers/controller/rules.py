"""Rule bases of fuzzy controllers: variables, their sets, rules, and their JSON files.

A file looks like this (see also `nfriction/papers/controller/data/`)::

    {
      "format": "nfriction-rules/1",
      "name": "joint 2",
      "inputs": {
        "velocity": {"unit": "deg/s", "sets": {"slow": [0, 300], "fast": [200, 1000]}},
        "acceleration": {"unit": "deg/s^2", "universe": [-6000, 8000],
                         "sets": {"braking": [-6000, 500], "driving": [-500, 8000]}}
      },
      "outputs": {
        "B": {"unit": "N m s/rad", "sets": {"low": [0, 6e-4], "high": [4e-4, 1e-3]}}
      },
      "table": {
        "columns": "velocity",
        "braking": [["low"], ["high"]],
        "driving": [["low"], ["low"]]
      }
    }

A set is given by the range [low, high] that it spans (`membership.sets_from_ranges`) or, for full
control, by `{"shape": "gaussian", "parameters": [centre, sigma]}` with a shape of
`membership.SHAPES`; all sets of a variable use the same form. Sets are listed from the smallest
values to the largest, the velocity before the acceleration; outputs are in SI units. The universe
may be omitted if ranges define it. The table has one row for each set of the other input, with one
cell for each set of the input named in `columns`, in order; a cell gives one term per output, in
order. Instead of `table`, `rules` may list rules one by one for any number of inputs:
`{"if": ["slow", "*"], "then": ["low"], "weight": 1}`.
"""

import json
import math
import re
import reprlib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from nfriction.fuzzy.membership import FuzzySet, sets_from_ranges
from nfriction.io.files import numbers, parse_json, shortened, write_atomically
from nfriction.plant.base import check_keys

FORMAT = "nfriction-rules/1"
# Limits on untrusted files: inference costs rules times points of the output universe.
MAX_BYTES = 1_000_000
MAX_SETS, MAX_VARIABLES, MAX_RULES = 64, 16, 10_000

ANY = "*"
"""Wildcard in place of a term: the rule does not depend on (or set) this variable."""

SI_FACTOR = {
    "rad/s": 1.0,
    "rad/s^2": 1.0,
    "deg/s": math.pi / 180.0,
    "deg/s^2": math.pi / 180.0,
    "1": 1.0,
}
"""Units in which an input may be written, and their values in SI."""
_SI_UNIT = r"|[1-]|(1/)?(N|m|s|rad|kg)(\^\d)?([ /](N|m|s|rad|kg)(\^\d)?)*"


@dataclass(frozen=True)
class Variable:
    """An input or output: its name, unit, universe and sets in ascending order."""

    name: str
    unit: str
    universe: tuple[float, float]
    sets: tuple[FuzzySet, ...]

    def __post_init__(self) -> None:
        where = f"variable {self.name!r}"
        low, high = self.universe
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(f"{where}: universe must be finite with low < high, got {low, high}.")
        if not 1 <= len(self.sets) <= MAX_SETS:
            raise ValueError(f"{where}: needs 1 to {MAX_SETS} sets, got {len(self.sets)}.")
        _refuse_duplicates(f"{where}: sets", self.terms)
        # A rule could never refer to a set of that name.
        if ANY in self.terms:
            raise ValueError(f"{where}: {ANY!r} means any term and cannot name a set.")
        # Ascending sets have a linguistic order, which plots and reports use.
        for before, after in pairwise(self.sets):
            if before.core > after.core:
                raise ValueError(
                    f"{where}: sets must ascend, but {after.name!r} at {after.core} comes "
                    f"after {before.name!r} at {before.core}."
                )

    @property
    def terms(self) -> list[str]:
        """Names of the sets."""
        return [term.name for term in self.sets]


@dataclass(frozen=True)
class Rule:
    """If every input is its term, then every output is its term; `*` means any term."""

    given: tuple[str, ...]
    then: tuple[str, ...]
    weight: float = 1.0


@dataclass(frozen=True)
class RuleBase:
    """Variables and rules of a Mamdani controller, validated."""

    name: str  # purpose of the controller
    inputs: tuple[Variable, ...]  # in the order in which rules name their terms
    outputs: tuple[Variable, ...]  # likewise
    rules: tuple[Rule, ...]  # in any order

    def __post_init__(self) -> None:
        # Checked here and not in the readers, to include rules built in Python.
        for kind, variables in (("inputs", self.inputs), ("outputs", self.outputs)):
            if not 1 <= len(variables) <= MAX_VARIABLES:
                raise ValueError(f"{kind}: 1 to {MAX_VARIABLES} variables, got {len(variables)}.")
            _refuse_duplicates(kind, [variable.name for variable in variables])
        for variable in self.inputs:
            if variable.unit not in SI_FACTOR:
                raise ValueError(
                    f"input {variable.name!r}: unknown unit {variable.unit!r}; use one of "
                    f"{list(SI_FACTOR)}."
                )
        first, *others = self.inputs
        if others and first.unit.endswith("s^2"):
            raise ValueError(f"input {first.name!r} in {first.unit}: list the velocity first.")
        for v in self.outputs:
            if not re.fullmatch(_SI_UNIT, v.unit):
                raise ValueError(f"output {v.name!r} needs SI, such as 'N m', got {v.unit!r}.")
        if not 1 <= len(self.rules) <= MAX_RULES:
            raise ValueError(f"1 to {MAX_RULES} rules are allowed, got {len(self.rules)}.")
        for number, rule in enumerate(self.rules, 1):
            _check_terms(f"rule {number}: if", rule.given, self.inputs)
            _check_terms(f"rule {number}: then", rule.then, self.outputs)
            # With weight zero a rule never fires; above 1, its strength is not a membership.
            if not 0.0 < rule.weight <= 1.0:
                raise ValueError(f"rule {number}: weight must be in (0, 1], got {rule.weight}.")


def load_rules(path: str | Path) -> RuleBase:
    """Rule base from a JSON file in the schema of this module.

    Raises:
        ValueError: if it is not a rule base; the message names the place and the remedy.
    """
    path = Path(path)
    return parse_rules(read_text(path), path.name)


def save_rules(rules: RuleBase, path: str | Path) -> None:
    """Write rules as a file that `load_rules` reads."""

    def described(variables: tuple[Variable, ...]) -> dict[str, object]:
        return {
            v.name: {
                "unit": v.unit, "universe": v.universe,
                "sets": {s.name: {"shape": s.shape, "parameters": s.parameters} for s in v.sets},
            }
            for v in variables
        }  # fmt: skip

    content = {
        "format": FORMAT, "name": rules.name,
        "inputs": described(rules.inputs), "outputs": described(rules.outputs),
        "rules": [{"if": r.given, "then": r.then, "weight": r.weight} for r in rules.rules],
    }  # fmt: skip
    write_atomically(path, json.dumps(content, indent=1).encode())


def read_text(path: Path) -> str:
    """Text of a rule file; raises ValueError if it is too large or not UTF-8."""
    # Before it is read into memory.
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path.name}: rule files are at most {MAX_BYTES} bytes.")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path.name}: a rule file is UTF-8 text ({error}).") from error


def parse_rules(text: str, source: str = "rules") -> RuleBase:
    """Rule base from JSON text; `source` names it in errors."""
    try:
        document = parse_json(text, _unique)
        return _rule_base(document)
    # Python's parser recurses into brackets, and a malicious file may open thousands of them.
    except RecursionError:
        raise ValueError(f"{source}: nested too deeply for a rule base.") from None
    except ValueError as error:
        raise ValueError(f"{source}: {shortened(error)}") from error


def _rule_base(document: Any) -> RuleBase:
    check_keys("the file", document, ("format", "inputs", "outputs"), ("name", "table", "rules"))
    if document["format"] != FORMAT:
        raise ValueError(f'"format" must be {FORMAT!r}, got {document["format"]!r}.')
    # With both, they could contradict each other.
    if ("table" in document) == ("rules" in document):
        raise ValueError('give either a "table" or a list of "rules".')
    inputs, outputs = (_variables(document[kind], kind) for kind in ("inputs", "outputs"))
    if "rules" in document:
        rules = _listed_rules(document["rules"])
    else:
        rules = _table_rules(document["table"], inputs, outputs)
    name = _expect(document.get("name", ""), str, "name", "text")
    return RuleBase(name, inputs, outputs, rules)


def _variables(entries: Any, kind: str) -> tuple[Variable, ...]:
    entries = _expect(entries, dict, f'"{kind}"', "names of variables")
    return tuple(_variable(name, entry) for name, entry in entries.items())


def _variable(name: str, entry: Any) -> Variable:
    where = f"variable {name!r}"
    check_keys(where, entry, ("unit", "sets"), ("universe",))
    sets, universe = entry["sets"], entry.get("universe")
    if not isinstance(sets, dict) or not sets:
        raise ValueError(f'{where}: "sets" must map names to ranges, got {reprlib.repr(sets)}.')
    if all(isinstance(value, list) for value in sets.values()):
        ranges = [_pair(value, f"{where}: set {term!r}") for term, value in sets.items()]
        try:
            members = sets_from_ranges(list(sets), ranges)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error
        # The shoulders reach 1 at these ends, so nothing changes beyond them.
        universe = [ranges[0][0], ranges[-1][1]] if universe is None else universe
    elif all(isinstance(value, dict) for value in sets.values()):
        members = tuple(_set(f"{where}: set {term!r}", term, v) for term, v in sets.items())
        if universe is None:
            # Gaussians have no ends from which to derive it.
            raise ValueError(f'{where}: sets given by shape need a "universe": [low, high].')
    else:
        raise ValueError(f"{where}: give every set as a range or every set by its shape.")
    unit = _expect(entry["unit"], str, f"{where}: unit", "text")
    return Variable(name, unit, _pair(universe, f"{where}: universe"), members)


def _set(where: str, term: str, value: dict[str, Any]) -> FuzzySet:
    check_keys(where, value, ("shape", "parameters"))
    parameters = _expect(value["parameters"], list, where, '"parameters": a list of numbers')
    shape = _expect(value["shape"], str, f"{where}: shape", "text")
    return FuzzySet(term, shape, tuple(_number(number, where) for number in parameters))


def _table_rules(
    table: Any, inputs: tuple[Variable, ...], outputs: tuple[Variable, ...]
) -> tuple[Rule, ...]:
    if len(inputs) != 2:
        raise ValueError(f'a "table" needs two inputs, got {len(inputs)}; list "rules" instead.')
    names = [variable.name for variable in inputs]
    if not isinstance(table, dict) or table.get("columns") not in names:
        raise ValueError(f'"table": "columns" must name one of the inputs {names}.')
    across = names.index(table["columns"])
    columns, rows = inputs[across], inputs[1 - across]
    check_keys('"table"', table, ("columns", *rows.terms))
    rules = []
    for row in rows.terms:
        cells = _one_for_each(table[row], columns.terms, f'"table": row {row!r}', "cell")
        for column, cell in zip(columns.terms, cells, strict=True):
            where = f'"table": cell {row!r} x {column!r}'
            then = _one_for_each(cell, [out.name for out in outputs], where, "term")
            for term, output in zip(then, outputs, strict=True):
                if term not in output.terms:
                    raise ValueError(
                        f"{where}: unknown term {reprlib.repr(term)}; {output.name!r} has "
                        f"{output.terms}."
                    )
            rules.append(Rule((column, row) if across == 0 else (row, column), tuple(then)))
    return tuple(rules)


def _listed_rules(entries: Any) -> tuple[Rule, ...]:
    rules = []
    for number, entry in enumerate(_expect(entries, list, '"rules"', "a list"), 1):
        where = f"rule {number}"
        check_keys(where, entry, ("if", "then"), ("weight",))
        given, then = (
            tuple(
                _expect(term, str, f"{where}: {part}", "text")
                for term in _expect(entry[part], list, f"{where}: {part}", "a list of terms")
            )
            for part in ("if", "then")
        )
        rules.append(Rule(given, then, _number(entry.get("weight", 1.0), f"{where}: weight")))
    return tuple(rules)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    for name, value in pairs:
        # Python's parser keeps the last of two equal keys, and the first would be lost silently.
        if name in entries:
            raise ValueError(f"{name!r} comes twice in the same place; every name once.")
        entries[name] = value
    return entries


def _expect(value: Any, kind: type, where: str, form: str) -> Any:
    if not isinstance(value, kind):
        raise ValueError(f"{where}: expected {form}, got {reprlib.repr(value)}.")
    return value


def _one_for_each(value: Any, names: list[str], where: str, part: str) -> list[Any]:
    if not isinstance(value, list) or len(value) != len(names):
        raise ValueError(f"{where} needs a {part} for each of {names}, got {reprlib.repr(value)}.")
    return value


def _pair(value: Any, where: str) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError(f"{where}: expected [low, high], got {reprlib.repr(value)}.")
    return _number(value[0], where), _number(value[1], where)


def _number(value: Any, where: str) -> float:
    # `numbers` would also accept a list.
    if isinstance(value, list):
        raise ValueError(f"{where}: expected a number, got {reprlib.repr(value)}.")
    return float(numbers(where, value))


def _check_terms(where: str, terms: tuple[str, ...], variables: tuple[Variable, ...]) -> None:
    if len(terms) != len(variables):
        raise ValueError(
            f"{where} names {len(terms)} terms for {len(variables)} variables "
            f"{[variable.name for variable in variables]}; write {ANY!r} for any."
        )
    for term, variable in zip(terms, variables, strict=True):
        if term != ANY and term not in variable.terms:
            raise ValueError(
                f"{where}: unknown term {term!r} of {variable.name!r}; it has {variable.terms}."
            )
    # Such a rule would always fire, or have no effect.
    if all(term == ANY for term in terms):
        raise ValueError(f"{where}: at least one variable must have a term.")


def _refuse_duplicates(where: str, names: list[str]) -> None:
    for index, name in enumerate(names):
        if name in names[:index]:
            raise ValueError(f"{where}: {name!r} comes twice; names must be unique.")
