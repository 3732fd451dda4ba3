"""A comparison's folder as one self-contained HTML page."""

from nfriction.report.page import JointRules, Rule, Term, rules_in_words, to_html, write_report
from nfriction.report.run import Run, RunError, read_run

__all__ = [
    "JointRules", "Rule", "Run", "RunError", "Term", "read_run", "rules_in_words", "to_html",
    "write_report",
]  # fmt: skip
