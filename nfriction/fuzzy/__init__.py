"""Fuzzy sets, ANFIS layers and radial basis functions."""

from nfriction.fuzzy.anfis import Anfis
from nfriction.fuzzy.membership import FuzzySet, sets_from_ranges
from nfriction.fuzzy.rbf import AnfisRBF, RBFNetwork

__all__ = ["Anfis", "AnfisRBF", "FuzzySet", "RBFNetwork", "sets_from_ranges"]
