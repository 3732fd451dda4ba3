"""What a rule-table controller knows, as plain data: variables, their sets, and the rules."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

from nfriction.fuzzy.membership import FuzzySet

MAX_SETS, MAX_VARIABLES, MAX_RULES = 64, 16, 10_000

ANY = "*"
"""In place of a term: the rule does not ask for (or speak about) this variable."""

SI_FACTOR = {
    "rad/s": 1.0,
    "rad/s^2": 1.0,
    "deg/s": math.pi / 180.0,
    "deg/s^2": math.pi / 180.0,
    "1": 1.0,
}
"""Units an input may be written in, and how much one of it is in SI."""


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
        if ANY in self.terms:
            raise ValueError(f"{where}: {ANY!r} stands for any term and cannot name a set.")
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
    """If every input is its term, then every output is its term; `*` skips a variable."""

    given: tuple[str, ...]
    then: tuple[str, ...]
    weight: float = 1.0


@dataclass(frozen=True)
class RuleBase:
    """Variables and rules of a Mamdani controller, validated.

    Args:
        name: what the controller is for.
        inputs, outputs: variables in the order in which rules name their terms.
        rules: in any order.
    """

    name: str
    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    rules: tuple[Rule, ...]

    def __post_init__(self) -> None:
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
        if not 1 <= len(self.rules) <= MAX_RULES:
            raise ValueError(f"1 to {MAX_RULES} rules are allowed, got {len(self.rules)}.")
        for number, rule in enumerate(self.rules, 1):
            _check_terms(f"rule {number}: if", rule.given, self.inputs)
            _check_terms(f"rule {number}: then", rule.then, self.outputs)
            if not 0.0 < rule.weight <= 1.0:
                raise ValueError(f"rule {number}: weight must be in (0, 1], got {rule.weight}.")


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
    if all(term == ANY for term in terms):
        raise ValueError(f"{where}: at least one variable must have a term.")


def _refuse_duplicates(where: str, names: list[str]) -> None:
    for index, name in enumerate(names):
        if name in names[:index]:
            raise ValueError(f"{where}: {name!r} comes twice; every one needs its own.")
