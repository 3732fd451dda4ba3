"""Recordings cut into windows of equal length with an initial state each."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from nfriction.recording import Recording
from nfriction.signals import Motion


@dataclass(frozen=True)
class Windows:
    """Windows of recordings, in joint coordinates.

    Attributes:
        q: measured position [rad], (window, step + 1, joint).
        tau: torque held over each step [N m], (window, step, joint).
        step: [s], (window, step); zero where a window ends early.
        weight: 1 where a sample counts, 0 where it pads, (window, step + 1).
        q0, qd0: smoothed state at the start, (window, joint).
        names: recording that each window comes from.
        spans: of each window, the recording's place among those given, its first and last sample.
    """

    q: Tensor
    tau: Tensor
    step: Tensor
    weight: Tensor
    q0: Tensor
    qd0: Tensor
    names: tuple[str, ...]
    spans: tuple[tuple[int, int, int], ...] = ()

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
            names=tuple(self.names[i] for i in index),
            spans=tuple(self.spans[i] for i in index if self.spans),
        )  # fmt: skip


def cut_windows(
    recordings: Sequence[Recording], motions: Sequence[Motion], length: float
) -> Windows:
    """Cut recordings into windows of about `length` seconds that cover all but their gaps.

    Args:
        recordings: in joint coordinates; a recording shorter than `length` is one window.
        motions: the smoothed motion of each recording.
        length: [s].

    Raises:
        ValueError: if a recording has so few samples that no window fits.
    """
    if not length > 0:
        raise ValueError(f"`length` must be positive [s], got {length}.")
    pieces = []
    for place, (recording, motion) in enumerate(zip(recordings, motions, strict=True)):
        for first, last in recording.spans:
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
    names = tuple(r.name for _, r, *_ in pieces)
    spans = tuple((place, a, b) for place, _, _, a, b in pieces)
    return Windows(q_, tau_, step_, weight_, q0, qd0, names, spans)
