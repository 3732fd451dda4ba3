"""Scores, comparisons and their results."""
