"""Intervals put to the test by real recordings: pieces of one mechanism must agree within them."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from left_out import SETS, Set, read

from nfriction import Recording, rollout
from nfriction.fitting.data.inputs import integration_substeps
from nfriction.fitting.fit import fit
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction import model_by_name
from nfriction.signals import count_seen
from nfriction.simulation.validate import required_substeps

WINDOWS = (0.5, 2.0)
# Pieces that move by less show nothing [rad or m]; more of them than so many take too long.
LEAST_TRAVEL, MOST = 0.3, 10


def intervals(data: Path, only: Sequence[str], models: Sequence[str], seconds: float) -> None:
    """Print how often what two pieces say lies as close as their intervals claim.

    The difference of two independent values that are each as uncertain as said lies within 1.96
    of its own standard deviations in 95 of 100 pairs, and within 0.67 in half of them. A law or
    plant that is wrong errs otherwise at every amplitude, which no interval covers; so each fit is
    also simulated, and fitted again, where it is the truth that 95 % of the intervals should hold.
    """
    print(
        f"{'set':7} {'model':10} pieces  values  within 95 % [%]  median |z|  simulated: held [%]"
    )
    for name in only:
        of = SETS[name]
        for law in models:
            found, held = [], []
            for piece in pieces(read(data, of), seconds):
                first = fitted(of, law, piece)
                found.append({i.name: i for i in first.intervals if 0 < i.sd < np.inf})
                again = fitted(of, law, simulated(first, piece))
                truth = {i.name: i.value for i in first.intervals}
                held += [
                    i.low <= truth[i.name] <= i.high for i in again.intervals if i.name in truth
                ]
            z = np.array([
                abs(one[n].value - other[n].value) / np.hypot(one[n].sd, other[n].sd)
                for one, other in combinations(found, 2)
                for n in one.keys() & other.keys()
            ])  # fmt: skip
            print(
                f"{name:7} {law:10} {len(found):6} {len(z):7} {100 * np.mean(z < 1.96):16.0f} "
                f"{np.median(z):11.2f} {100 * np.mean(held):20.0f}", flush=True,
            )  # fmt: skip


def fitted(of: Set, law: str, piece: Recording) -> FitResult:
    plant = of.plant()
    return fit(
        model_by_name(law)(plant.joints), plant, piece, windows=WINDOWS,
        encoder_reference=of.encoder_reference,
    )  # fmt: skip


def simulated(found: FitResult, piece: Recording) -> Recording:
    """Readings of the encoders if the fit were the truth; torques are as recorded.

    By the integration steps of the fit, as finer ones would show the error of these as well.
    """
    plant, (motion,), start = found.plant, found.motions, np.array(found.encoder_offsets or [[0]])
    step = piece.longest_step
    substeps = max(rule(plant, found.model, step) for rule in (integration_substeps,
                                                               required_substeps))  # fmt: skip
    run = rollout(
        plant, found.model, torch.tensor(motion.q[0] + start[0]), torch.tensor(motion.qd[0]),
        None if piece.tau is None else torch.tensor(piece.tau[:-1]),
        sample_time=torch.tensor(np.diff(piece.time)), substeps=substeps, gradients=False,
    )  # fmt: skip
    convention = piece.resolve_convention(plant)
    q = convention.position_from_joint(run.q.numpy() - start, plant.first_link)
    count = np.broadcast_to(plant.position_quantum or count_seen(piece.q), q.shape[1:])
    return piece._replace(q=np.where(count > 0, count * np.rint(q / count), q))


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
