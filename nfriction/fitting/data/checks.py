"""What recordings give away before a fit: that they may not be what plant and fit take them for."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nfriction.fitting.data.inputs import swings_freely, zeroed_each
from nfriction.fitting.equation_error import friction_torque
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion, count_seen

Array = NDArray[np.float64]

ZEROED_EACH = (
    "Every recording begins at rest with all encoders at zero, so they were taken for set to zero "
    'there, wherever the links stood; `zeroed="once"` where they were not.'
)
# Measured from the right zero, a free swing leaves friction alone, from the other one twice its
# weight: those of the public benches are 40 times apart and more.
OTHER_ZERO = 5.0
# Of angles, from one operation to the next, with room.
ROUNDING = 1e-9
# Of so few counts an encoder's rounding is most of what a joint seems to do.
FEW_COUNTS = 10


def as_it_looks(plant: Plant, given: Sequence[Recording]) -> tuple[bool, tuple[str, ...]]:
    """Whether encoders look zeroed at the start of each recording, and what then is to be said."""
    each = zeroed_each(plant, given)
    return each, (ZEROED_EACH,) if each else ()


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
    return (*_still_joints(plant, given, joint), *_other_zero(plant, given, joint, motions))


def refuse_motionless(plant: Plant, joint: Sequence[Recording]) -> None:
    """Refuse to fit coefficients that follow the motion where a joint has none.

    Raises:
        ValueError: naming the joints.
    """
    still = [plant.joint_names[j] for j in np.flatnonzero(_spans(joint) == 0)]
    if still:
        raise ValueError(
            f"{', '.join(still)} never moves in {', '.join(r.name or 'a recording' for r in joint)}"
            ", and neuro-fuzzy coefficients follow the motion; record it moving."
        )


def _spans(joint: Sequence[Recording]) -> Array:
    """How far each joint moves in the recording in which it moves most, (joint,)."""
    spans = np.max([np.ptp(r.q, axis=0) for r in joint], axis=0)
    # The difference of two absolute angles that turn as one is rounding.
    largest = max(float(np.abs(r.q).max()) for r in joint)
    return np.where(spans > ROUNDING * largest, spans, 0.0)


def _still_joints(
    plant: Plant, given: Sequence[Recording], joint: Sequence[Recording]
) -> Iterator[str]:
    """Joints that move by a few counts of their encoders at most."""
    if plant.position_quantum is None:
        # A joint that nowhere shows its count is not measured by it.
        count = np.fmin.reduce([count_seen(r.q) for r in given])
    else:
        count = np.full(plant.joints, plant.position_quantum)
    for name, span, one in zip(plant.joint_names, _spans(joint), count, strict=True):
        if span == 0:
            yield f"{name} never moves: of its friction the recordings tell nothing."
        elif span < FEW_COUNTS * one:
            yield (
                f"{name} moves by {span:.3g} {plant.unit}, {span / one:.0f} of its encoder's "
                "counts: of its friction the recordings tell hardly anything."
            )


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
    said = given[0].resolve_convention(plant).measured_from
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
