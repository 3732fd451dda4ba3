"""The two papers reproduced on simulated twins of their rigs: every model, table and figure."""

from nfriction.reproduction.procedure import controllers_from_classes, papers_neuro_fuzzy
from nfriction.reproduction.running import reproduce
from nfriction.reproduction.settings import FULL, QUICK, Settings

__all__ = [
    "FULL",
    "QUICK",
    "Settings",
    "controllers_from_classes",
    "papers_neuro_fuzzy",
    "reproduce",
]
