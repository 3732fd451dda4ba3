"""Estimation of friction and plant terms from recordings."""

from nfriction.fitting.estimate import Fit, fit

__all__ = ["Fit", "fit"]
