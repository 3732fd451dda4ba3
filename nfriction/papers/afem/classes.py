"""Classes of acceleration found in recordings: low, medium, high, joint by joint."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.papers.afem.adaptive import CLASSES, Adaptive, peak_envelope
from nfriction.recording import Array, Recording
from nfriction.signals import Motion

# By recording and joint: (class, start [s], end [s]).
Intervals = Mapping[str, Mapping[str, Sequence[tuple[str, float, float]]]]

# If the windowed peak varies by less than this ratio, there are no classes.
LEAST_VARIATION = 1.5
# Smaller accelerations [rad/s^2] count as zero; this keeps logarithms finite.
STILL = 1e-6
# Lower limit relative to a joint's largest acceleration: otherwise creeping to rest would be a
# separate class, and only two would remain for all swings.
DYNAMIC_RANGE = 1e-2


@dataclass(frozen=True)
class ClassOptions:
    """Classes, found or given, and the prior of their coefficients.

    Attributes:
        thresholds: given thresholds [rad/s^2], (joint, 2) or (2,).
        intervals: given intervals by recording and joint; other samples belong to the nearest.
        window: length of the moving window [s], longer than half a swing.
        least: a class with less data than this [s] uses its neighbour's coefficients.
        prior_sd: standard deviation of a class around the constant law, in units of a coefficient
            that explains a third of the friction (or of the coefficient itself, if larger).

    Raises:
        ValueError: if the standard deviation is not positive.
    """

    thresholds: Tensor | Sequence | None = None
    intervals: Intervals | None = None
    window: float = 1.0
    least: float = 0.5
    prior_sd: float = 0.5

    def __post_init__(self) -> None:
        if not self.prior_sd > 0:
            raise ValueError(f"`prior_sd` must be positive, got {self.prior_sd}.")


DEFAULTS = ClassOptions()


@dataclass(frozen=True)
class AccelerationClasses:
    """Classes of acceleration along recordings.

    A class with too few data uses the coefficients of a neighbour.
    """

    labels: tuple[Tensor, ...]  # class of every sample, 0 to 2, (sample, joint) of each recording
    stands_for: Tensor  # class whose coefficients each class uses, (joint, class)
    notes: tuple[str, ...]  # joints and classes with too few data, in words


def class_intervals(
    time: Array, labels: NDArray[np.integer[Any]]
) -> list[tuple[str, float, float]]:
    """Class, start and end [s] of every run of equal labels (sample,), as in Table 6."""
    edges = [0, *(np.flatnonzero(np.diff(labels)) + 1).tolist(), len(labels) - 1]
    return [
        (CLASSES[labels[a]], float(time[a]), float(time[b])) for a, b in pairwise(edges) if b > a
    ]


def find_classes(
    schedule: Adaptive,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    joints: Sequence[str],
    options: ClassOptions = DEFAULTS,
) -> AccelerationClasses:
    """Find classes of acceleration and set the schedule to them.

    Two thresholds divide the logarithm of the peak of |qdd| within a moving window so that the
    variance within the three classes is minimal (Otsu). The class of each sample is then that of
    the schedule; with given intervals it is that of the interval, and the thresholds are those
    that best separate the intervals.

    Args:
        schedule: changed in place: its thresholds, swing rate and sample time are set.
        recordings: in joint coordinates.
        motions: smoothed motion of each recording.

    Raises:
        ValueError: if no joint's acceleration varies enough to have classes, sample times differ,
            or intervals name an unknown recording, joint or class.
    """
    steps = [float(np.median(np.diff(r.time))) for r in recordings]
    if max(steps) > 1.1 * min(steps):
        raise ValueError(
            "recordings fitted by class of acceleration must share one sample time, as the class "
            f"has a memory of samples; got {min(steps):g} to {max(steps):g} s."
        )
    step = float(np.median(steps))
    schedule.set_sample_time(step)
    qdd = [torch.as_tensor(m.qdd, dtype=torch.float64) for m in motions]
    qd = [torch.as_tensor(m.qd, dtype=torch.float64) for m in motions]
    # Amplitude ratio of acceleration to velocity of a swing: its mean angular frequency.
    rate = torch.cat(qdd).square().mean(0).sqrt() / torch.cat(qd).square().mean(0).sqrt()
    # Worded for the status of the fit, which repeats them.
    notes: list[str] = []
    labels, thresholds = None, options.thresholds
    if options.intervals is not None:
        labels = [_labels(options.intervals, r, joints) for r in recordings]
        envelopes = [peak_envelope(a.abs(), schedule.fading) for a in qdd]
        thresholds = _separating(labels, envelopes)
    elif thresholds is None:
        thresholds = _by_otsu(qdd, step, options.window, joints, notes)
    schedule.set_classes(thresholds, rate.nan_to_num(0.0, 0.0))
    if labels is None:
        labels = [schedule.classes(v, a) for v, a in zip(qd, qdd, strict=True)]
    together = torch.cat(labels)
    seconds = torch.stack([(together == c).sum(0) for c in range(len(CLASSES))], -1) * step
    return AccelerationClasses(
        labels=tuple(labels),
        stands_for=_merged(seconds, options.least, joints, notes),
        notes=tuple(notes),
    )


def otsu(values: Array, bins: int = 128) -> tuple[float, float]:
    """Two thresholds that divide values into three classes of minimal variance (Otsu, 1979)."""
    count, edges = np.histogram(values, bins)
    centre = 0.5 * (edges[:-1] + edges[1:])
    # Cumulative sums, so that every pair of thresholds needs only a few operations.
    weight = np.concatenate([[0], np.cumsum(count)]).astype(np.float64)
    moment = np.concatenate([[0], np.cumsum(count * centre)])
    i, j = np.triu_indices(bins, 1)
    i, j = i[i > 0], j[i > 0]

    def between(a: Any, b: Any) -> Any:
        held = weight[b] - weight[a]
        return (moment[b] - moment[a]) ** 2 / np.maximum(held, 1.0)

    spread = between(np.zeros_like(i), i) + between(i, j) + between(j, np.full_like(j, bins))
    best = spread >= spread.max() * (1 - 1e-12)
    # All thresholds between two clusters are equivalent; the middle is farthest from both.
    low = int(np.median(i[best]))
    same = best & (i == i[best][np.abs(i[best] - low).argmin()])
    return float(edges[i[same][0]]), float(edges[int(np.median(j[same]))])


def _by_otsu(
    qdd: Sequence[Tensor], step: float, window: float, joints: Sequence[str], notes: list[str]
) -> list[tuple[float, float]]:
    """Thresholds of each joint for the peak of |qdd| within a moving window [s]."""
    from scipy.ndimage import maximum_filter1d  # slow to import

    # Longer than half a swing; otherwise every reversal would fall into the lowest class.
    width = max(1, round(window / step))
    peaks = np.concatenate([maximum_filter1d(np.abs(a.numpy()), width, axis=0) for a in qdd])
    highest = np.maximum(peaks.max(0), STILL)
    peaks = np.maximum(peaks, DYNAMIC_RANGE * highest)
    varies = highest / peaks.min(0)
    if (varies < LEAST_VARIATION).all():
        raise ValueError(
            "the acceleration hardly varies, so it has no classes: its peak within "
            f"{window:g} s goes from {peaks.min(0).round(3).tolist()} to "
            f"{highest.round(3).tolist()} rad/s^2. Give `thresholds` or `intervals`, recordings "
            "of more varied motion, or fit the constant law."
        )
    found = []
    for j, name in enumerate(joints):
        if varies[j] < LEAST_VARIATION:
            notes.append(f"acceleration of {name} hardly varies: it has one class")
            # Thresholds that the motion never reaches.
            found.append((2.0 * float(highest[j]), 4.0 * float(highest[j])))
        else:
            low, high = otsu(np.log(peaks[:, j]))
            found.append((float(np.exp(low)), float(np.exp(high))))
    return found


def _labels(intervals: Intervals, recording: Recording, joints: Sequence[str]) -> Tensor:
    """Class of every sample, from given intervals."""
    own = intervals.get(recording.name)
    if own is None or set(own) != set(joints):
        raise ValueError(
            f"`intervals` must give {recording.name!r} and its joints {list(joints)}, got "
            f"{ {name: list(of) for name, of in intervals.items()} }."
        )
    columns = []
    for joint in joints:
        for known, start, end in own[joint]:
            if known not in CLASSES or not end > start:
                raise ValueError(
                    f"an interval is (class, start, end) with a class of {CLASSES} and end > "
                    f"start [s], got {(known, start, end)} for {joint}."
                )
        time = recording.time
        starts, ends = (np.array([row[i] for row in own[joint]])[:, None] for i in (1, 2))
        # Distance to each interval, so that samples between two belong to the nearer one.
        gap = np.maximum(np.maximum(starts - time, time - ends), 0.0)
        gap[(time >= starts) & (time < ends)] = -1.0
        order = np.array([CLASSES.index(known) for known, _, _ in own[joint]])
        columns.append(torch.as_tensor(order[gap.argmin(0)]))
    return torch.stack(columns, -1)


def _separating(labels: Sequence[Tensor], envelopes: Sequence[Tensor]) -> Tensor:
    """Thresholds of the envelope that agree best with given labels, (joint, 2)."""
    known, envelope = torch.cat(list(labels)), torch.cat(list(envelopes)).clamp_min(STILL)
    rows = []
    for of_joint, size in zip(known.T, envelope.T, strict=True):
        ends = size.aminmax()
        low, high = (float(e.log10()) for e in ends)
        # Accelerations span decades; a linear grid would not resolve the lower threshold.
        grid = torch.logspace(low, high, 200, dtype=size.dtype)
        above = size[:, None] > grid
        row = []
        for border in range(2):
            upper = of_joint > border
            # Both sides have the same weight, regardless of their duration.
            wrong = above[~upper].double().mean(0).nan_to_num()
            wrong += (~above)[upper].double().mean(0).nan_to_num()
            row.append(float(grid[int(wrong.argmin())]))
        rows.append([row[0], max(row)])
    return torch.tensor(rows, dtype=torch.float64)


def _merged(seconds: Tensor, least: float, joints: Sequence[str], notes: list[str]) -> Tensor:
    """Class whose coefficients each class uses, (joint, class)."""
    rows = []
    for name, row in zip(joints, seconds.tolist(), strict=True):
        enough = [c for c, held in enumerate(row) if held >= least] or [int(np.argmax(row))]
        taken = []
        for c, held in enumerate(row):
            # The nearest class with data; of two equally near ones, the one with more.
            other = c if c in enough else min(enough, key=lambda e: (abs(e - c), -row[e]))
            taken.append(other)
            if other != c:
                notes.append(
                    f"{CLASSES[c]} class of {name} has {held:.2g} s of data: takes the "
                    f"coefficients of {CLASSES[other]}"
                )
        rows.append(taken)
    return torch.tensor(rows)
