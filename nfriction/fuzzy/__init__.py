"""Fuzzy sets, the rule-table controller, ANFIS layers and radial basis functions."""

from nfriction.fuzzy.anfis import Anfis
from nfriction.fuzzy.anfis_rbf import AnfisRBF
from nfriction.fuzzy.fis import load_fis, parse_fis
from nfriction.fuzzy.hybrid import HybridResult, hybrid_step, train_hybrid
from nfriction.fuzzy.mamdani import MamdaniController, paper_controller
from nfriction.fuzzy.membership import FuzzySet, coverage, sets_from_ranges
from nfriction.fuzzy.rbf import RBFHead, RBFNetwork
from nfriction.fuzzy.rulebase import Rule, RuleBase, Variable
from nfriction.fuzzy.rulefile import format_rules, load_rules, parse_rules, save_rules
from nfriction.fuzzy.rulereport import RuleReport

__all__ = [
    "Anfis",
    "AnfisRBF",
    "FuzzySet",
    "HybridResult",
    "MamdaniController",
    "RBFHead",
    "RBFNetwork",
    "Rule",
    "RuleBase",
    "RuleReport",
    "Variable",
    "coverage",
    "format_rules",
    "hybrid_step",
    "load_fis",
    "load_rules",
    "paper_controller",
    "parse_fis",
    "parse_rules",
    "save_rules",
    "sets_from_ranges",
    "train_hybrid",
]
