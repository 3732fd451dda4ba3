"""Fuzzy sets, ANFIS layers and radial basis functions."""

from nfriction.fuzzy.anfis import Anfis
from nfriction.fuzzy.hybrid import HybridResult, hybrid_step, train_hybrid
from nfriction.fuzzy.membership import FuzzySet, sets_from_ranges
from nfriction.fuzzy.rbf import AnfisRBF, RBFNetwork

__all__ = [
    "Anfis", "AnfisRBF", "FuzzySet", "HybridResult", "RBFNetwork",
    "hybrid_step", "sets_from_ranges", "train_hybrid",
]  # fmt: skip
