"""Recordings cut into windows of equal length with an initial state each."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from nfriction.recording import Recording
from nfriction.signals import Motion

# What moves faster over its first sample is not at rest [rad/s or m/s]; an encoder that flickers
# by one count at 500 Hz seems to move at 0.2 rad/s.
AT_REST = 0.3


@dataclass(frozen=True)
class Windows:
    """Windows of recordings, in joint coordinates.

    Attributes:
        q: measured position [rad], (window, step + 1, joint).
        tau: torque held over each step [N m], (window, step, joint).
        step: [s], (window, step); zero where a window ends early.
        weight: 1 where a sample counts, 0 where it pads, (window, step + 1).
        q0, qd0: smoothed state at the start, (window, joint).
        spans: of each window, the recording's place among those given, its first and last sample.
        at_rest: windows of which the start is known: where the encoders stood, and no velocity.
    """

    q: Tensor
    tau: Tensor
    step: Tensor
    weight: Tensor
    q0: Tensor
    qd0: Tensor
    spans: tuple[tuple[int, int, int], ...] = ()
    at_rest: tuple[int, ...] = ()

    def __len__(self) -> int:
        return self.q.shape[0]

    def seams(self) -> list[tuple[int, int]]:
        """Pairs of windows of which the second begins where the first ends."""
        begins = {(place, first): w for w, (place, first, _) in enumerate(self.spans)}
        ends = ((w, begins.get((place, last))) for w, (place, _, last) in enumerate(self.spans))
        return [(w, after) for w, after in ends if after is not None]

    def subset(self, chosen: Tensor) -> "Windows":
        """Some of the windows, by a mask (window,)."""
        index = chosen.nonzero().flatten().tolist()
        return Windows(
            q=self.q[index], tau=self.tau[index], step=self.step[index],
            weight=self.weight[index], q0=self.q0[index], qd0=self.qd0[index],
            spans=tuple(self.spans[i] for i in index if self.spans),
            at_rest=tuple(k for k, i in enumerate(index) if i in self.at_rest),
        )  # fmt: skip


def checked_lengths(windows: Iterable[float]) -> tuple[float, ...]:
    """Lengths of windows [s], at least one; whatever else is given is refused."""
    try:
        # Texts are no lengths, though Python takes some for numbers.
        lengths = tuple(float(1.0 * w) for w in windows)
    except TypeError:
        lengths = ()
    if not lengths or not all(0 < w < math.inf for w in lengths):
        raise ValueError(
            f"`windows` must be positive lengths [s] such as (0.5, 2.0), got {windows!r}; a single "
            f"one is (2.0,)."
        )
    return lengths


def cut_windows(
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    length: float,
    *,
    from_rest: bool = False,
) -> Windows:
    """Cut recordings into windows of about `length` seconds that cover all but their gaps.

    Args:
        recordings: in joint coordinates; a recording shorter than `length` is one window.
        motions: the smoothed motion of each recording.
        length: [s].
        from_rest: recordings begin at rest, so that their first windows start there and not from
            the smoothed motion; one that moves at once is taken for what was cut out of another.

    Raises:
        ValueError: if a recording has so few samples that no window fits.
    """
    if not length > 0:
        raise ValueError(f"`length` must be positive [s], got {length}.")
    pieces = []
    for place, (recording, motion) in enumerate(zip(recordings, motions, strict=True)):
        for first, last in recording.segments:
            span = recording.time[last] - recording.time[first]
            count = max(1, int(span / length + 0.5))
            if count > last - first:
                raise ValueError(
                    f"{recording.name or 'a recording'} has {last - first + 1} samples in "
                    f"{span:g} s, too few for windows of {length:g} s; use longer windows."
                )
            edges = np.linspace(first, last, count + 1).astype(int)
            pieces += [(place, recording, motion, int(a), int(b)) for a, b in pairwise(edges)]
    steps = max(b - a for *_, a, b in pieces)
    joints = recordings[0].q.shape[1]
    q = np.zeros((len(pieces), steps + 1, joints))
    tau = np.zeros((len(pieces), steps, joints))
    step = np.zeros((len(pieces), steps))
    weight = np.zeros((len(pieces), steps + 1))
    for i, (_, recording, _, a, b) in enumerate(pieces):
        n = b - a
        q[i, : n + 1] = recording.q[a : b + 1]
        q[i, n + 1 :] = recording.q[b]
        step[i, :n] = np.diff(recording.time[a : b + 1])
        weight[i, : n + 1] = 1.0
        if recording.tau is not None:
            tau[i, :n] = recording.tau[a:b]
    start = [np.stack([getattr(m, name)[a] for _, _, m, a, _ in pieces]) for name in ("q", "qd")]
    q_, tau_, step_, weight_, q0, qd0 = (
        torch.as_tensor(x, dtype=torch.float64) for x in (q, tau, step, weight, *start)
    )
    spans = tuple((place, a, b) for place, _, _, a, b in pieces)
    resting = tuple(
        i for i, (_, r, _, a, _) in enumerate(pieces) if from_rest and a == 0 and begins_still(r)
    )
    for i in resting:
        q0[i], qd0[i] = q_[i, 0], 0.0
    return Windows(q_, tau_, step_, weight_, q0, qd0, spans, resting)


def begins_still(recording: Recording) -> bool:
    """Whether a recording may begin at rest, for all that its first sample tells."""
    moved = np.abs(recording.q[1] - recording.q[0]).max()
    return bool(moved <= AT_REST * (recording.time[1] - recording.time[0]))
