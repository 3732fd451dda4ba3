"""Recordings as input of a fit: windows and checks."""
