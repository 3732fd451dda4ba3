"""Signs in recordings that they are not what the plant and the fit assume."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nfriction.fitting.data.inputs import is_undriven_pendulum, largest_torques
from nfriction.fitting.data.windows import begins_at_rest
from nfriction.fitting.equation_error import friction_torque
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.plant import PendulumChain, Plant
from nfriction.recording import Recording
from nfriction.signals import Motion, count_seen

Array = NDArray[np.float64]

ZEROED_PER_RECORDING = (
    "Every recording begins at rest with all encoders at zero; assumed that they were zeroed "
    'there, in whatever pose. If not: `encoder_reference="shared"`.'
)
# Error of angles from one conversion to the next, with room.
ROUNDING = 1e-9


def looks_zeroed_per_recording(
    plant: Plant, recordings: Sequence[Recording], options: FitOptions = DEFAULTS
) -> bool:
    """True if encoders seem to have been set to zero at the start of each recording.

    Dry friction holds links wherever they stop. Where a driven chain begins several recordings at
    rest, and all its encoders read zero each time, they were set to it.
    """
    return (
        isinstance(plant, PendulumChain)
        and bool(largest_torques(recordings).any())
        and len(recordings) > 1
        and all(
            begins_at_rest(r, options.rest_speed) and np.abs(r.q[0]).max() <= options.zero_reading
            for r in recordings
        )
    )


def data_warnings(
    plant: Plant,
    given: Sequence[Recording],
    joint: Sequence[Recording],
    motions: Sequence[Motion],
    options: FitOptions = DEFAULTS,
) -> tuple[str, ...]:
    """Warnings about recordings as written and in joint coordinates, a sentence each."""
    still = _still_joints(plant, given, joint, options.min_counts)
    return (*still, *_other_vertical(plant, given, joint, motions, options.reference_ratio))


def require_motion(plant: Plant, joint: Sequence[Recording]) -> None:
    """Raise a ValueError that names joints which never move: no network can follow them."""
    still = [plant.joint_names[j] for j in np.flatnonzero(_ranges(joint) == 0)]
    if still:
        raise ValueError(
            f"{', '.join(still)} never moves in {', '.join(r.name or 'a recording' for r in joint)}"
            ", and neuro-fuzzy coefficients follow the motion; record it moving."
        )


def _ranges(joint: Sequence[Recording]) -> Array:
    """Range of each joint in the recording in which it moves most, (joint,)."""
    ranges = np.max([np.ptp(r.q, axis=0) for r in joint], axis=0)
    # The difference of two absolute angles that turn together is rounding.
    largest = max(float(np.abs(r.q).max()) for r in joint)
    return np.where(ranges > ROUNDING * largest, ranges, 0.0)


def _still_joints(
    plant: Plant, given: Sequence[Recording], joint: Sequence[Recording], min_counts: int
) -> Iterator[str]:
    if plant.position_quantum is None:
        # A joint that nowhere shows its count is not measured by it.
        count = np.fmin.reduce([count_seen(r.q) for r in given])
    else:
        count = np.full(plant.joints, plant.position_quantum)
    for name, extent, one in zip(plant.joint_names, _ranges(joint), count, strict=True):
        if extent == 0:
            yield f"{name} never moves: its friction is not observable."
        elif extent < min_counts * one:
            yield (
                f"{name} moves by {extent:.3g} {plant.unit}, {extent / one:.0f} of its encoder's "
                "counts: its friction is hardly observable."
            )


def _other_vertical(
    plant: Plant,
    given: Sequence[Recording],
    joint: Sequence[Recording],
    motions: Sequence[Motion],
    ratio: float,
) -> Iterator[str]:
    """Warn if a free swing needs far less friction with its angles measured from the other end."""
    if not is_undriven_pendulum(plant, joint):
        return
    turned = [replace(m, q=m.q + np.eye(1, m.q.shape[1]) * math.pi) for m in motions]
    stated, opposite = (_friction_rms(plant, joint, of) for of in (motions, turned))
    if stated > ratio * opposite:
        reference = given[0].resolve_convention(plant).measured_from
        other = "upright" if reference == "hanging" else "hanging"
        yield (
            f"The angles look measured from {other}, not from {reference}: friction would then "
            f"have to explain {opposite:.3g} N m, and not {stated:.3g}. Correct `convention` of "
            "the rig, or of the recordings."
        )


def _friction_rms(plant: Plant, joint: Sequence[Recording], motions: Sequence[Motion]) -> float:
    """Root mean square of the torque that friction would have to explain [N m]."""
    pairs = zip(joint, motions, strict=True)
    squares = [friction_torque(plant, r, m)[2].square() for r, m in pairs]
    count = sum(part.numel() for part in squares)
    return math.sqrt(sum(float(part.sum()) for part in squares) / max(count, 1))
