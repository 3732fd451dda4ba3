"""Least squares with bounds, and Bayesian regularisation."""
