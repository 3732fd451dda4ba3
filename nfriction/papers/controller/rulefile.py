"""Rule tables as small JSON files that a user writes for his own joint.

A file looks like this (see also `nfriction/fuzzy/data/`)::

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

A set is the range [low, high] that it spans (`membership.sets_from_ranges`), or for full control
`{"shape": "gaussian", "parameters": [centre, sigma]}` with a shape of `membership.SHAPES`; a
variable uses one way or the other. Sets are written from the smallest values to the largest. The
universe may be left out where ranges give it. The table has a row for each set of the other input
and in it a cell for each set of the input that `columns` names, in their order; a cell gives a
term for each output, in their order. Instead of `table`, `rules` may list rules one by one, with
any number of inputs: `{"if": ["slow", "*"], "then": ["low"], "weight": 1}`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from nfriction.fuzzy.membership import FuzzySet, sets_from_ranges
from nfriction.io import strict_json
from nfriction.io.atomic import write_atomically
from nfriction.papers.controller.rulebase import ANY, Rule, RuleBase, Variable

FORMAT = "nfriction-rules/1"
MAX_BYTES = 1_000_000


def load_rules(path: str | Path) -> RuleBase:
    """Rule base from a JSON file in the schema of this module.

    Raises:
        ValueError: if the file is no such rule base; the message names the place and the mend.
    """
    path = Path(path)
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path.name}: rule files are at most {MAX_BYTES} bytes.")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path.name}: a rule file is UTF-8 text ({error}).") from error
    return parse_rules(text, path.name)


def parse_rules(text: str, source: str = "rules") -> RuleBase:
    """Rule base from JSON text; `source` names it in errors."""
    try:
        document = strict_json.parse(text, _unique)
        return _rule_base(document)
    except RecursionError:
        raise ValueError(f"{source}: nested too deeply for a rule base.") from None
    except ValueError as error:
        raise ValueError(f"{source}: {shortened(error)}") from error


def format_rules(rules: RuleBase) -> str:
    """JSON text that `parse_rules` reads back to an equal rule base."""
    lines = [
        f'  "format": {json.dumps(FORMAT)}',
        f'  "name": {json.dumps(rules.name)}',
        f'  "inputs": {_format_variables(rules.inputs)}',
        f'  "outputs": {_format_variables(rules.outputs)}',
        _format_table(rules) or _format_list(rules),
    ]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def save_rules(rules: RuleBase, path: str | Path) -> None:
    """Write a rule base as a JSON file, whole or not at all."""
    write_atomically(path, format_rules(rules).encode())


def _rule_base(document: Any) -> RuleBase:
    _check_keys("the file", document, {"format", "inputs", "outputs"}, {"name", "table", "rules"})
    if document["format"] != FORMAT:
        raise ValueError(f'"format" must be {FORMAT!r}, got {document["format"]!r}.')
    if ("table" in document) == ("rules" in document):
        raise ValueError('give either a "table" or a list of "rules".')
    inputs, outputs = (
        _variables(document["inputs"], "inputs"),
        _variables(document["outputs"], "outputs"),
    )
    if "table" in document:
        rules = _table_rules(document["table"], inputs, outputs)
    else:
        rules = _listed_rules(document["rules"])
    return RuleBase(_text(document.get("name", ""), "name"), inputs, outputs, rules)


def _variables(entries: Any, kind: str) -> tuple[Variable, ...]:
    if not isinstance(entries, dict):
        raise ValueError(f'"{kind}" must map names to variables, got {_brief(entries)}.')
    return tuple(_variable(name, entry) for name, entry in entries.items())


def _variable(name: str, entry: Any) -> Variable:
    where = f"variable {name!r}"
    _check_keys(where, entry, {"unit", "sets"}, {"universe"})
    sets = entry["sets"]
    if not isinstance(sets, dict) or not sets:
        raise ValueError(f'{where}: "sets" must map names to ranges, got {_brief(sets)}.')
    universe = entry.get("universe")
    if all(isinstance(value, list) for value in sets.values()):
        ranges = [_pair(value, f"{where}: set {term!r}") for term, value in sets.items()]
        try:
            members = sets_from_ranges(list(sets), ranges)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error
        universe = [ranges[0][0], ranges[-1][1]] if universe is None else universe
    elif all(isinstance(value, dict) for value in sets.values()):
        members = tuple(_shaped_set(where, term, value) for term, value in sets.items())
        if universe is None:
            raise ValueError(f'{where}: sets given by shape need a "universe": [low, high].')
    else:
        raise ValueError(f"{where}: give every set as a range or every set by its shape.")
    return Variable(
        name, _text(entry["unit"], f"{where}: unit"), _pair(universe, f"{where}: universe"), members
    )


def _shaped_set(where: str, term: str, value: dict[str, Any]) -> FuzzySet:
    where = f"{where}: set {term!r}"
    _check_keys(where, value, {"shape", "parameters"}, set())
    numbers = value["parameters"]
    if not isinstance(numbers, list):
        raise ValueError(f'{where}: "parameters" must be a list of numbers, got {_brief(numbers)}.')
    shape = _text(value["shape"], f"{where}: shape")
    return FuzzySet(term, shape, tuple(_number(number, where) for number in numbers))


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
    unknown = [row for row in table if row != "columns" and row not in rows.terms]
    if unknown:
        raise ValueError(
            f'"table": unknown row {unknown[0]!r}; {rows.name!r} has the terms {rows.terms}.'
        )
    rules = []
    for row in rows.terms:
        if row not in table:
            raise ValueError(f'"table": row {row!r} of {rows.name!r} is missing.')
        cells = table[row]
        if not isinstance(cells, list) or len(cells) != len(columns.terms):
            raise ValueError(
                f'"table": row {row!r} needs a cell for each of {columns.terms}, '
                f"got {_brief(cells)}."
            )
        for column, cell in zip(columns.terms, cells, strict=True):
            where = f'"table": cell {row!r} x {column!r}'
            if not isinstance(cell, list) or len(cell) != len(outputs):
                raise ValueError(
                    f"{where} needs a term for each of {[out.name for out in outputs]}, "
                    f"got {_brief(cell)}."
                )
            for term, output in zip(cell, outputs, strict=True):
                if term not in output.terms:
                    raise ValueError(
                        f"{where}: unknown term {_brief(term)}; {output.name!r} has {output.terms}."
                    )
            given = (column, row) if across == 0 else (row, column)
            rules.append(Rule(given, tuple(cell)))
    return tuple(rules)


def _listed_rules(entries: Any) -> tuple[Rule, ...]:
    if not isinstance(entries, list):
        raise ValueError(f'"rules" must be a list, got {_brief(entries)}.')
    rules = []
    for number, entry in enumerate(entries, 1):
        where = f"rule {number}"
        _check_keys(where, entry, {"if", "then"}, {"weight"})
        rules.append(
            Rule(
                _terms(entry["if"], f"{where}: if"),
                _terms(entry["then"], f"{where}: then"),
                _number(entry.get("weight", 1.0), f"{where}: weight"),
            )
        )
    return tuple(rules)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    for name, value in pairs:
        if name in entries:
            raise ValueError(f"{name!r} comes twice in the same place; every name once.")
        entries[name] = value
    return entries


def _check_keys(where: str, entry: Any, needed: set[str], allowed: set[str]) -> None:
    if not isinstance(entry, dict):
        raise ValueError(f"{where} must be an object in braces, got {_brief(entry)}.")
    missing, unknown = needed - set(entry), set(entry) - needed - allowed
    if missing:
        raise ValueError(f"{where}: {sorted(missing)} missing.")
    if unknown:
        raise ValueError(
            f"{where}: unknown {sorted(unknown)}; known are {sorted(needed | allowed)}."
        )


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{where}: expected a number, got {_brief(value)}.")
    try:
        return float(value)
    except OverflowError as error:
        raise ValueError(f"{where}: the number is too large.") from error


def _pair(value: Any, where: str) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError(f"{where}: expected [low, high], got {_brief(value)}.")
    return _number(value[0], where), _number(value[1], where)


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{where}: expected text, got {_brief(value)}.")
    return value


def _terms(value: Any, where: str) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise ValueError(f"{where}: expected a list of terms, got {_brief(value)}.")
    return tuple(_text(term, where) for term in value)


def shortened(error: ValueError) -> str:
    """What an error says, though it may cite a name of any length."""
    text = str(error)
    return text if len(text) <= 500 else text[:497] + "..."


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _format_variables(variables: tuple[Variable, ...]) -> str:
    blocks = []
    for variable in variables:
        sets = ",\n".join(
            f"        {json.dumps(term.name)}: "
            + json.dumps({"shape": term.shape, "parameters": list(term.parameters)})
            for term in variable.sets
        )
        blocks.append(
            f"    {json.dumps(variable.name)}: {{\n"
            f'      "unit": {json.dumps(variable.unit)},\n'
            f'      "universe": {json.dumps(list(variable.universe))},\n'
            f'      "sets": {{\n{sets}\n      }}\n    }}'
        )
    return "{\n" + ",\n".join(blocks) + "\n  }"


def _format_table(rules: RuleBase) -> str:
    """The table of a full grid of two inputs, or nothing; its order of rules must be ours too."""
    if len(rules.inputs) != 2 or any(term == "columns" for term in rules.inputs[1].terms):
        return ""
    columns, rows = rules.inputs
    in_order = [(column, row) for row in rows.terms for column in columns.terms]
    if [rule.given for rule in rules.rules] != in_order:
        return ""
    if any(rule.weight != 1.0 or ANY in rule.then for rule in rules.rules):
        return ""
    cells = {rule.given: list(rule.then) for rule in rules.rules}
    body = ",\n".join(
        f"    {json.dumps(row)}: {json.dumps([cells[column, row] for column in columns.terms])}"
        for row in rows.terms
    )
    return f'  "table": {{\n    "columns": {json.dumps(columns.name)},\n{body}\n  }}'


def _format_list(rules: RuleBase) -> str:
    body = ",\n".join(
        "    "
        + json.dumps({"if": list(rule.given), "then": list(rule.then), "weight": rule.weight})
        for rule in rules.rules
    )
    return f'  "rules": [\n{body}\n  ]'
