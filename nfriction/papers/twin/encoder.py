"""What an incremental encoder and a sampling clock make of a motion."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Encoder:
    """An incremental encoder whose four edges to a line are counted.

    Attributes:
        lines: to a revolution.
        eccentricity: amplitude of the error that repeats every revolution [counts].
        phase: angle at which that error crosses zero [rad].
        edges: displacement of each of the four edges of a line [counts], within ± 0.5.
    """

    lines: int = 2048
    eccentricity: float = 0.0
    phase: float = 0.0
    edges: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @property
    def quantum(self) -> float:
        """Angle of one count [rad]."""
        return math.tau / (4 * self.lines)

    @classmethod
    def drawn(cls, random: np.random.Generator, lines: int = 2048) -> Encoder:
        """An encoder of usual quality: eccentric by 0.3 counts, edges off by 0.05 counts (rms)."""
        phase = float(random.uniform(0.0, math.tau))
        first, second, third, fourth = (0.05 * random.standard_normal(4)).tolist()
        return cls(lines, 0.3, phase, (first, second, third, fourth))

    def read(self, q: Array) -> Array:
        """The positions [rad] that the counter tells for true positions, any shape."""
        place = q / self.quantum + self.eccentricity * np.sin(q - self.phase)
        count = np.floor(place + 0.5)
        # The edge below a count lies half a count down, displaced.
        edges = np.array(self.edges)
        below = count - 0.5 + edges[count.astype(np.int64) % 4]
        above = count + 0.5 + edges[(count.astype(np.int64) + 1) % 4]
        return self.quantum * (count + (place >= above) - (place < below))


def jitter(random: np.random.Generator, samples: int, deviation: float) -> Array:
    """How late each sample is taken [s], (samples,): normal, cut at three deviations.

    The first sample starts the clock, so it is late by nothing.
    """
    late = deviation * np.clip(random.standard_normal(samples), -3.0, 3.0)
    late[0] = 0.0
    return late
