"""The papers' fuzzy controller: rule tables, min-max inference, centroid; FIS files."""

from nfriction.papers.controller.fis import load_fis, parse_fis
from nfriction.papers.controller.mamdani import (
    MamdaniController,
    controller_surface,
    paper_controller,
)
from nfriction.papers.controller.rules import (
    Rule,
    RuleBase,
    Variable,
    load_rules,
    parse_rules,
    save_rules,
)

__all__ = [
    "MamdaniController", "Rule", "RuleBase", "Variable", "controller_surface", "load_fis",
    "load_rules", "paper_controller", "parse_fis", "parse_rules", "save_rules",
]  # fmt: skip
