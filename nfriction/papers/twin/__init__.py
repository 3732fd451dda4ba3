"""Twins: simulated recordings of the papers' rigs, whose own were never published."""

from nfriction.papers.twin.dataset import QUICK_DURATION, Twin, build, make, names

__all__ = ["QUICK_DURATION", "Twin", "build", "make", "names"]
