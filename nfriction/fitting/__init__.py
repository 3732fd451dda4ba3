"""Estimation of friction and plant terms from recordings."""

from nfriction.fitting.adaptive import fit_adaptive, fit_by_search
from nfriction.fitting.by_class import refine_adaptive
from nfriction.fitting.classes import AccelerationClasses, find_classes
from nfriction.fitting.estimate import fit
from nfriction.fitting.neurofuzzy import NetworkFit, train_network, train_on_controller
from nfriction.fitting.outcome import Fit
from nfriction.fitting.search import SearchState

__all__ = [
    "AccelerationClasses",
    "Fit",
    "NetworkFit",
    "SearchState",
    "find_classes",
    "fit",
    "fit_adaptive",
    "fit_by_search",
    "refine_adaptive",
    "train_network",
    "train_on_controller",
]
