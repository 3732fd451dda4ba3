"""Intervals put to the test by real recordings: pieces of one mechanism must agree within them."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from left_out import SETS, read

from nfriction import Recording
from nfriction.fitting.fit import fit
from nfriction.friction import model_by_name

WINDOWS = (0.5, 2.0)
# Pieces that move by less show nothing [rad or m]; more of them than so many take too long.
LEAST_TRAVEL, MOST = 0.3, 10


def intervals(data: Path, only: Sequence[str], models: Sequence[str], seconds: float) -> None:
    """Print how often what two pieces say lies as close as their intervals claim.

    The difference of two independent values that are each as uncertain as said lies within 1.96
    of its own standard deviations in 95 of 100 pairs, and within 0.67 in half of them.
    """
    print(f"{'set':7} {'model':10} pieces  values  within 95 % [%]  median |z|")
    for name in only:
        of = SETS[name]
        plant = of.plant()
        for law in models:
            found = []
            for piece in pieces(read(data, of), seconds):
                model = model_by_name(law)(plant.joints)
                told = fit(
                    model, plant, piece, windows=WINDOWS, encoder_reference=of.encoder_reference
                ).intervals
                found.append({i.name: i for i in told if np.isfinite(i.sd) and i.sd > 0})
            z = np.array([
                abs(one[n].value - other[n].value) / np.hypot(one[n].sd, other[n].sd)
                for one, other in combinations(found, 2)
                for n in one.keys() & other.keys()
            ])  # fmt: skip
            print(
                f"{name:7} {law:10} {len(found):6} {len(z):7} {100 * np.mean(z < 1.96):16.0f} "
                f"{np.median(z):11.2f}", flush=True,
            )  # fmt: skip


def pieces(recordings: Sequence[Recording], seconds: float) -> Iterator[Recording]:
    """Parts of recordings that do not overlap and move, at most so many."""
    count = 0
    for recording in recordings:
        samples = round(seconds / float(np.median(np.diff(recording.time))))
        for first in range(0, len(recording) - samples // 2, samples):
            piece = recording[first : first + samples + 1]
            if count < MOST and np.ptp(piece.q) > LEAST_TRAVEL:
                count += 1
                yield piece
