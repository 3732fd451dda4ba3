"""Fitting strategies: order of horizons and starts, and hold-out validation."""
