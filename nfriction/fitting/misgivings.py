"""What recordings give away before a fit: that they may not be what plant and fit take them for."""

import math
from collections.abc import Sequence
from dataclasses import replace

from nfriction.fitting.outcome import Plant
from nfriction.fitting.preparation import swings_freely
from nfriction.fitting.torque import friction_torque
from nfriction.recording import Recording
from nfriction.signals import Motion

# Measured from the right zero, a free swing leaves friction alone, from the other one twice its
# weight: those of the public benches are 40 times apart and more.
OTHER_ZERO = 5.0


def misgivings(
    plant: Plant, given: Sequence[Recording], joint: Sequence[Recording], motions: Sequence[Motion]
) -> tuple[str, ...]:
    """Sentences on what looks wrong about recordings; none where nothing does.

    Args:
        plant: the mechanism as given.
        given: the recordings as they are written.
        joint: the same in joint coordinates.
        motions: their smoothed motion.
    """
    return tuple(_other_zero(plant, given, joint, motions))


def _other_zero(
    plant: Plant, given: Sequence[Recording], joint: Sequence[Recording], motions: Sequence[Motion]
) -> list[str]:
    """Whether a free swing would need less friction if its angles counted from the other zero."""
    if not swings_freely(plant, joint):
        return []
    turned = []
    for motion in motions:
        q = motion.q.copy()
        q[:, 0] += math.pi
        turned.append(replace(motion, q=q))
    as_said, else_ = (_left_over(plant, joint, of) for of in (motions, turned))
    if not as_said > OTHER_ZERO * else_:
        return []
    said = given[0].convention_on(plant).measured_from
    other = "upright" if said == "hanging" else "hanging"
    return [
        f"The angles look measured from {other}, not from {said}: friction would then have to make "
        f"up for {else_:.3g} N m, and not for {as_said:.3g}. Correct `convention` of the rig, or "
        "of the recordings."
    ]


def _left_over(plant: Plant, joint: Sequence[Recording], motions: Sequence[Motion]) -> float:
    """Root mean square of the torque that friction has to make up for [N m]."""
    pairs = zip(joint, motions, strict=True)
    squares = [friction_torque(plant, r, m)[2].square() for r, m in pairs]
    count = sum(part.numel() for part in squares)
    return math.sqrt(sum(float(part.sum()) for part in squares) / max(count, 1))
