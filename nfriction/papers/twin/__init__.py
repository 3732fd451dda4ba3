"""Twins: simulated recordings of the papers' rigs, as the real ones were never published."""

from nfriction.papers.twin.dataset import QUICK_DURATION, Twin, build, make, names
from nfriction.papers.twin.family import TRUTHS, draw, held_out

__all__ = ["QUICK_DURATION", "TRUTHS", "Twin", "build", "draw", "held_out", "make", "names"]
