"""Signs in recordings that they are not what the plant and the fit assume."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from nfriction.fitting.data.inputs import is_undriven_pendulum, largest_torques, weighs
from nfriction.fitting.data.windows import begins_at_rest
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion, count_seen

Array = NDArray[np.float64]

ZEROED_PER_RECORDING = (
    "Every recording begins at rest with all encoders at zero; assumed that they were zeroed "
    'there, in whatever pose. If not: `encoder_reference="shared"`.'
)
# Density of lead [kg/m^3].
LEAD = 11_340.0
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
        weighs(plant)
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
    heavy = _implausible_masses(plant) if is_undriven_pendulum(plant, joint) else ()
    return (*_spikes(given, options), *still, *heavy)


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


def _spikes(recordings: Sequence[Recording], options: FitOptions) -> Iterator[str]:
    """Single samples far off both of their neighbours, to the same side."""
    for recording in recordings:
        q, time = recording.q, recording.time
        before, after = q[1:-1] - q[:-2], q[1:-1] - q[2:]
        near, other = np.sort(np.abs([before, after]), axis=0)
        # Steps, as at a gap in time, and samples beside a spike are far off one neighbour alone.
        height = np.where((before * after > 0) & (2 * near > other), near, 0.0)
        curved = np.quantile(np.abs(before + after) / 2, 0.99, axis=0)
        # A joint may show no count.
        far = height > options.spike_ratio * np.fmax(curved, count_seen(q))
        for name, column in zip(recording.names, far.T, strict=True):
            peaks = np.flatnonzero(column) + 1
            if len(peaks):
                when = ", ".join(f"{time[k]:.6g}" for k in peaks[:3])
                more = f" and {len(peaks) - 3} more" if len(peaks) > 3 else ""
                yield (
                    f"{recording.name or 'A recording'}: {name} jumps for one sample at {when} s"
                    f"{more}; such spikes are errors of the sensor, leave these samples out."
                )


def _implausible_masses(plant: Plant) -> Iterator[str]:
    """Warn of masses that look like g; a free swing shows only their ratios."""
    data = plant.to_dict()
    if "length" not in data:
        return  # a rotor: its size is not known
    for k, (mass, length) in enumerate(zip(data["mass"], data["length"], strict=True)):
        if mass > LEAD * length**3:
            yield (
                f"Link {k + 1} of {mass:g} kg and {length:g} m would be heavier than a cube of "
                "lead that long; a free swing does not show the scale of masses, so friction is "
                "too large by the same factor if they are in g."
            )
