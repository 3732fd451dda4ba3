"""Blocks of recordings that fits leave out, and the errors of what the rest taught on them."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nfriction.evaluation.score import score
from nfriction.fitting.data.inputs import apply_encoder_offsets
from nfriction.fitting.result.fit_result import FitResult
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion, kalman_smoother

# A block of fewer samples than this says nothing [samples].
SHORTEST = 100


class Block(NamedTuple):
    """A part of a recording, with its motion in joint coordinates."""

    recording: Recording
    motion: Motion


class Split(NamedTuple):
    """A stretch of a recording, and the recording without it."""

    unseen: Block
    seen: Block


def leave_blocks_out(plant: Plant, recording: Recording, count: int) -> list[Split]:
    """A recording without each of as many blocks of time, which share their ends with the rest.

    The whole recording is smoothed once: a block's ends are then as well known as its middle.

    Raises:
        ValueError: if the blocks would have fewer than 100 samples.
    """
    if len(recording) < SHORTEST * count:
        raise ValueError(
            f"{recording.name or 'a recording'} has {len(recording)} samples, too few for "
            f"{count} blocks of at least {SHORTEST}; give fewer folds or longer recordings."
        )
    joint = recording.joint_coordinates(plant)
    motion = kalman_smoother(joint.time, joint.q)
    index = np.arange(len(recording))
    splits = []
    for first, last in pairwise(np.linspace(0, index[-1], count + 1).astype(int)):
        inside = (first <= index) & (index <= last)
        # A block at an end of the recording leaves no lone sample behind.
        rest = ((index <= first) & (first > 0)) | ((last <= index) & (last < index[-1]))
        splits.append(Split(*(Block(recording[m], _part(motion, m)) for m in (inside, rest))))
    return splits


def longest_stretch(recording: Recording) -> float:
    """Duration of the longest stretch without a gap [s]."""
    return max(float(recording.time[b] - recording.time[a]) for a, b in recording.segments)


def _part(motion: Motion, mask: NDArray[np.bool_]) -> Motion:
    return Motion(motion.time[mask], motion.q[mask], motion.qd[mask], motion.qdd[mask])


def at_found_zeros(found: FitResult, blocks: Sequence[Block]) -> list[Block]:
    """Blocks with the zeros that a fit found in the rest of their recordings, one block to each."""
    recordings, motions = apply_encoder_offsets(
        found.encoder_offsets,
        found.plant,
        [b.recording for b in blocks],
        [b.motion for b in blocks],
    )
    return [Block(*pair) for pair in zip(recordings, motions, strict=True)]


def block_errors(found: FitResult, blocks: Sequence[Block], horizon: float) -> list[float]:
    """Root mean square position error of simulations of `horizon` seconds over each block."""
    return [
        score(found.plant, found.model, block.recording, motion=block.motion, horizons=(horizon,))
        .windows[f"{horizon:g}"].all
        for block in at_found_zeros(found, blocks)
    ]  # fmt: skip
