"""Estimation of friction and plant terms from recordings."""
