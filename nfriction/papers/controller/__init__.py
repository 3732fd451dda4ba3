"""The papers' fuzzy controller: rule tables, min-max inference, centroid; FIS files."""

from nfriction.papers.controller.fis import load_fis, parse_fis
from nfriction.papers.controller.mamdani import MamdaniController, paper_controller
from nfriction.papers.controller.rulebase import Rule, RuleBase, Variable
from nfriction.papers.controller.rulefile import format_rules, load_rules, parse_rules, save_rules
from nfriction.papers.controller.rulereport import RuleReport

__all__ = [
    "MamdaniController", "Rule", "RuleBase", "RuleReport", "Variable", "format_rules", "load_fis",
    "load_rules", "paper_controller", "parse_fis", "parse_rules", "save_rules",
]  # fmt: skip
