"""How well a rule base covers its universes and a recording."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nfriction.fuzzy.membership import coverage
from nfriction.papers.controller.rulebase import RuleBase, Variable

_POINTS = 2001
COVERED = 0.5
"""Membership that some set should have everywhere."""


@dataclass(frozen=True)
class InputCoverage:
    """Coverage of one input.

    Attributes:
        name, unit: of the variable.
        least: smallest of the largest memberships over the universe.
        gaps: intervals of the universe, in `unit`, where no set holds at 0.5.
        poorly_covered: share of the samples that fall where no set holds at 0.5.
        outside: share of the samples beyond the universe.
    """

    name: str
    unit: str
    least: float
    gaps: tuple[tuple[float, float], ...]
    poorly_covered: float
    outside: float


@dataclass(frozen=True)
class RuleReport:
    """Gaps in the coverage of the inputs, and rules never fired by a recording.

    Attributes:
        inputs: one for each input.
        fired: strength from which a rule counts as fired.
        never_fired: conditions of the rules that never do.
        rules, samples: how many there were.
    """

    inputs: tuple[InputCoverage, ...]
    fired: float
    never_fired: tuple[tuple[str, ...], ...]
    rules: int
    samples: int

    def __str__(self) -> str:
        lines = [f"{self.samples} samples, {self.rules} rules"]
        for entry in self.inputs:
            lines.append(
                f"{entry.name} [{entry.unit}]: coverage at least {entry.least:.3f}, "
                f"{entry.poorly_covered:.1%} of the samples below {COVERED}, "
                f"{entry.outside:.1%} outside the universe"
            )
            lines += [f"  gap from {low:.6g} to {high:.6g}" for low, high in entry.gaps]
        lines.append(f"{len(self.never_fired)} rules never reach a strength of {self.fired}")
        lines += ["  " + " and ".join(condition) for condition in self.never_fired]
        return "\n".join(lines)


def rule_report(
    rules: RuleBase, x: Tensor, memberships: list[Tensor], strengths: Tensor, *, fired: float
) -> RuleReport:
    """Report on samples `x` (samples, inputs) with their memberships and rule strengths."""
    if len(x) == 0 or not bool(torch.isfinite(x).all()):
        raise ValueError("the recording must have samples, all finite; drop the others first.")
    inputs = tuple(
        _input_coverage(variable, x[:, i], memberships[i])
        for i, variable in enumerate(rules.inputs)
    )
    strongest = strengths.amax(0)
    never = tuple(
        rule.given
        for rule, strength in zip(rules.rules, strongest.tolist(), strict=True)
        if strength < fired
    )
    return RuleReport(inputs, fired, never, len(rules.rules), len(x))


def _input_coverage(variable: Variable, x: Tensor, memberships: Tensor) -> InputCoverage:
    low, high = variable.universe
    universe = torch.linspace(low, high, _POINTS, dtype=torch.float64)
    held = torch.stack([term(universe) for term in variable.sets], -1)
    return InputCoverage(
        name=variable.name,
        unit=variable.unit,
        least=float(coverage(held)),
        gaps=_intervals(universe, held.amax(-1) < COVERED),
        poorly_covered=float((memberships.amax(-1) < COVERED).double().mean()),
        outside=float(((x < low) | (x > high)).double().mean()),
    )


def _intervals(universe: Tensor, inside: Tensor) -> tuple[tuple[float, float], ...]:
    """First and last point of every run of True."""
    edges = torch.nn.functional.pad(inside.long(), (1, 1)).diff()
    starts, ends = (edges == 1).nonzero()[:, 0], (edges == -1).nonzero()[:, 0] - 1
    return tuple(zip(universe[starts].tolist(), universe[ends].tolist(), strict=True))
