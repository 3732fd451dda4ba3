"""Recordings cut into shooting windows of equal length, each with its own initial state."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from nfriction.friction.memory import holding_share
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion
from nfriction.simulation.protocols import Rollout


@dataclass(frozen=True)
class Windows:
    """Windows of recordings, in joint coordinates [rad; m].

    Attributes:
        q: measured position, (window, step + 1, joint).
        tau: torque held over each step [N m; N], (window, step, joint).
        step: [s], (window, step); zero where a window ends early.
        weight: 1 for a sample, 0 for padding, (window, step + 1).
        q0, qd0: initial state of the smoothed motion, the mean of its prior, (window, joint).
        spans: index of each window's recording, its first and its last sample.
        at_rest: windows whose initial state is known: the measured position, and no velocity.
        recordings, motions: from which the windows are cut, in joint coordinates.
        begin: initial state from which a search starts, (window, 2 joint); by default q0, qd0.
        law_state: of a law with memory at the start of each window, relative to that of a contact
            that slips slowly, (window, joint, state).
        hidden_state: of the coefficients at the start of each window, (window, joint, state).
    """

    q: Tensor
    tau: Tensor
    step: Tensor
    weight: Tensor
    q0: Tensor
    qd0: Tensor
    spans: tuple[tuple[int, int, int], ...] = ()
    at_rest: tuple[int, ...] = ()
    recordings: tuple[Recording, ...] = ()
    motions: tuple[Motion, ...] = ()
    begin: Tensor | None = None
    law_state: Tensor | None = None
    hidden_state: Tensor | None = None

    def __len__(self) -> int:
        return self.q.shape[0]

    @property
    def length(self) -> float:
        """Length of the longest window, to two digits [s]."""
        return float(f"{float(self.step.sum(1).max()):.2g}")

    def subset(self, chosen: Tensor) -> "Windows":
        """Some of the windows, by a mask (window,)."""
        index = chosen.nonzero().flatten().tolist()
        return replace(
            self, q=self.q[index], tau=self.tau[index], step=self.step[index],
            weight=self.weight[index], q0=self.q0[index], qd0=self.qd0[index],
            spans=tuple(self.spans[i] for i in index if self.spans),
            at_rest=tuple(k for k, i in enumerate(index) if i in self.at_rest),
            begin=None if self.begin is None else self.begin[index],
            law_state=None if self.law_state is None else self.law_state[index],
            hidden_state=None if self.hidden_state is None else self.hidden_state[index],
        )  # fmt: skip

    @property
    def initial(self) -> Tensor:
        """Initial state from which a search starts, (window, 2 joint)."""
        return torch.cat([self.q0, self.qd0], -1) if self.begin is None else self.begin

    def starting_at(self, states: Tensor) -> "Windows":
        """The same windows, searched from these states, (window, ...), unless they are known."""
        smoothed, known = torch.cat([self.q0, self.qd0], -1), list(self.at_rest)
        begin = states[:, : smoothed.shape[-1]].clone()
        begin[known] = smoothed[known]
        return replace(self, begin=begin)

    def with_states(self, plant: Plant, model: FrictionModel) -> "Windows":
        """The windows with the state of the friction at the start of each.

        A hidden state of the coefficients follows from the preceding motion. Deflections of a law
        with memory are those that balance the torques: the preceding motion would show them only if
        it were known to a fraction of the displacement over which contacts yield.
        """
        motions = [[torch.tensor(x) for x in (m.qd, m.qdd, m.time)] for m in self.motions]
        hidden = law_state = None
        if model.state_size:
            along = [model.schedule.states(*motion) for motion in motions]
            hidden = torch.stack([along[place][first] for place, first, _ in self.spans])
        if model.law.memory:
            qdd = torch.stack([motions[place][1][first] for place, first, _ in self.spans])
            found = self.tau[:, 0] - plant.inverse_dynamics(self.q0, self.qd0, qdd)
            share, slipping = holding_share(model, found)
            law_state = share[..., None].expand(-1, -1, slipping.shape[-1])
        return replace(self, hidden_state=hidden, law_state=law_state)

    @torch.no_grad()
    def states_along(self, model: FrictionModel, motion: Rollout) -> Tensor | None:
        """Hidden state of the coefficients at every step, (window, step + 1, joint, state).

        Along a motion from the windows' starts; None without such a state.
        """
        if not model.state_size:
            return None
        qd, qdd = motion.qd.transpose(0, 1), motion.qdd.transpose(0, 1)
        first = self.hidden_state
        first = model.initial_state(qd[0], qdd[0]) if first is None else first
        return model.schedule.states_from(first, qd, qdd).transpose(0, 1)

    def torque_at(self, delay: float) -> tuple[Tensor, Tensor]:
        """Torque that was recorded `delay` [s] later, and its slope over the delay.

        Both are (window, step, joint), held over each step and at the ends of a recording.
        """
        tau, slope = torch.zeros_like(self.tau), torch.zeros_like(self.tau)
        for w, (place, first, last) in enumerate(self.spans):
            recording = self.recordings[place]
            # Over one sample, because interpolation has kinks at the samples.
            half = 0.5 * recording.sample_time
            at = recording.time[first:last] + delay
            around = (recording.torque_at(at + shift) for shift in (0.0, half, -half))
            now, ahead, behind = map(torch.as_tensor, around)
            tau[w, : last - first] = now
            slope[w, : last - first] = (ahead - behind) / (2 * half)
        return tau, slope


def cut_windows(
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    length: float,
    *,
    smoothed: Sequence[Motion] | None = None,
    rest_speed: float | None = None,
) -> Windows:
    """Cut recordings into windows of about `length` seconds that cover all but gaps and final rest.

    Args:
        recordings, motions: in joint coordinates; a recording shorter than `length` is one window.
        length: [s].
        smoothed: motions that show the final rest if `motions` are simulated.
        rest_speed: recordings that begin slower than this [rad/s] start from rest instead of from
            the smoothed motion; by default none does.

    Raises:
        ValueError: if a recording has so few samples that no window fits.
    """
    if not length > 0:
        raise ValueError(f"`length` must be positive [s], got {length}.")
    spans = [
        (place, first, last)
        for place, recording in enumerate(recordings)
        for first, last in _cut(recording, (smoothed or motions)[place], length)
    ]
    steps = max(last - first for _, first, last in spans)
    joints = recordings[0].q.shape[1]
    q = np.zeros((len(spans), steps + 1, joints))
    tau = np.zeros((len(spans), steps, joints))
    step = np.zeros((len(spans), steps))
    weight = np.zeros((len(spans), steps + 1))
    start = np.zeros((2, len(spans), joints))
    at_rest = []
    for w, (place, first, last) in enumerate(spans):
        recording, n = recordings[place], last - first
        q[w, : n + 1] = recording.q[first : last + 1]
        # Steps of zero length and weight: padding changes neither motion nor cost.
        q[w, n + 1 :] = recording.q[last]
        step[w, :n] = np.diff(recording.time[first : last + 1])
        weight[w, : n + 1] = 1.0
        if recording.tau is not None:
            tau[w, :n] = recording.tau[first:last]
        start[:, w] = motions[place].q[first], motions[place].qd[first]
        if rest_speed is not None and first == 0 and begins_at_rest(recording, rest_speed):
            at_rest.append(w)
            start[0, w], start[1, w] = recording.q[0], 0.0
    q_, tau_, step_, weight_, q0, qd0 = map(torch.as_tensor, (q, tau, step, weight, *start))
    return Windows(
        q_, tau_, step_, weight_, q0, qd0,
        tuple(spans), tuple(at_rest), tuple(recordings), tuple(motions),
    )  # fmt: skip


def moving_segments(recording: Recording, motion: Motion) -> Iterator[tuple[int, int]]:
    """First and last sample of each segment between gaps, without the rest in which it ends.

    There dry friction may have any value up to breakaway, and a smoothed sign creeps instead.
    """
    # Three standard deviations of a reading.
    noise = 3 * np.std(recording.q - motion.q, axis=0)
    for first, last in recording.segments:
        away = (np.abs(motion.q[first:last] - motion.q[last]) > noise).any(axis=1).nonzero()[0]
        yield first, (first + 1 + int(away[-1]) if len(away) else last)


def _cut(recording: Recording, motion: Motion, length: float) -> Iterator[tuple[int, int]]:
    """First and last sample of each window."""
    for first, last in moving_segments(recording, motion):
        duration = recording.time[last] - recording.time[first]
        # Windows of equal length, since a short remainder would hardly determine its initial state.
        count = max(1, int(duration / length + 0.5))
        if count > last - first:
            raise ValueError(
                f"{recording.name or 'a recording'} has {last - first + 1} samples in "
                f"{duration:g} s, too few for windows of {length:g} s; check the unit of its time, "
                "or use longer windows."
            )
        yield from pairwise(np.linspace(first, last, count + 1).astype(int).tolist())


def begins_at_rest(recording: Recording, rest_speed: float) -> bool:
    """True if the first sample is slower than `rest_speed` [rad/s]."""
    moved = np.abs(recording.q[1] - recording.q[0]).max()
    return bool(moved <= rest_speed * (recording.time[1] - recording.time[0]))
