"""Friction models: laws times schedules of coefficients."""
