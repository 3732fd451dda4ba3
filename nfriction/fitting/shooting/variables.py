"""The unknowns of a trajectory fit: where they stand in one vector, their bounds and priors."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nfriction.fitting.data.windows import Windows
from nfriction.fitting.plant_parameters import PlantParameter
from nfriction.friction.coefficients import Schedule

# Smoothed start states are off by far less; the prior only keeps a window from running away.
START_Q_SD, START_QD_SD = 0.01, 0.3
# Of a start at rest, about what an encoder rounds, and less than it sees. Left free, a velocity
# that nothing had would take over what friction did while the links broke loose.
REST_Q_SD, REST_QD_SD = 1e-4, 1e-3


@dataclass(frozen=True, eq=False)
class Unknowns:
    """[friction parameters, plant parameters, q0 and qd0 of each window, zeros of each recording].

    A zero is what a recording's encoders fall short of the true angles. What is shared by all
    windows comes first.

    Args:
        schedule: has the friction parameters.
        terms: adjustable terms of the plant.
        windows: what was measured.
        plant_mean: where the prior of the plant's terms is centred; default the plant as given.
        zero_sd: what is expected of the zeros, (recording, joint) [rad or m]; without it none are
            sought.
    """

    schedule: Schedule
    terms: Sequence[PlantParameter]
    windows: Windows
    plant_mean: Tensor | None = None
    zero_sd: Tensor | None = None

    @property
    def friction_count(self) -> int:
        return self.schedule.parameter_vector().numel()

    @property
    def shared_count(self) -> int:
        return self.friction_count + len(self.terms)

    @property
    def state_count(self) -> int:
        """Of one window."""
        return 2 * self.windows.q0.shape[-1]

    @property
    def zero_count(self) -> int:
        return 0 if self.zero_sd is None else self.zero_sd.numel()

    def start(self, plant_vector: Tensor | None = None, zeros: Tensor | None = None) -> Tensor:
        """At the schedule's present parameters and the smoothed window states."""
        if plant_vector is None:
            plant_vector = torch.zeros(len(self.terms), dtype=torch.float64)
        if zeros is None:
            zeros = torch.zeros(self.zero_count, dtype=torch.float64)
        return torch.cat([self.schedule.parameter_vector(), plant_vector, self._smoothed(), zeros])

    def bounds(self) -> tuple[Tensor, Tensor]:
        lower, upper = self.schedule.bounds()
        own = len(self.windows) * self.state_count + self.zero_count
        free = torch.full((own,), torch.inf, dtype=torch.float64)
        low = torch.tensor([t.lower for t in self.terms], dtype=torch.float64)
        high = torch.tensor([t.upper for t in self.terms], dtype=torch.float64)
        return torch.cat([lower, low, -free]), torch.cat([upper, high, free])

    def prior(self) -> tuple[Tensor, Tensor]:
        """Prior precision and mean."""
        n = self.friction_count
        mean = torch.zeros(self.shared_count, dtype=torch.float64)
        sd = torch.full_like(mean, torch.inf)
        mean[:n], sd[:n] = self.schedule.prior()
        if self.plant_mean is not None:
            mean[n:] = self.plant_mean
        sd[n:] = torch.tensor([t.prior_sd for t in self.terms], dtype=torch.float64)
        zero_sd = sd.new_zeros(0) if self.zero_sd is None else self.zero_sd.reshape(-1)
        sd = torch.cat([sd, self._state_sd().reshape(-1), zero_sd])
        return sd.square().reciprocal(), torch.cat(
            [mean, self._smoothed(), torch.zeros_like(zero_sd)]
        )

    def split(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Friction parameters, plant parameters, window states (window, 2 joint)."""
        own = len(self.windows) * self.state_count
        friction, plant, state, _ = x.split(
            [self.friction_count, len(self.terms), own, self.zero_count]
        )
        return friction, plant, state.reshape(len(self.windows), -1)

    def split_zeros(self, x: Tensor) -> Tensor:
        """Zeros of each recording, in one row."""
        return x[len(x) - self.zero_count :]

    def zeros(self, x: Tensor) -> Tensor:
        """What is added to the measured angles of each window, (window, joint) [rad]."""
        q0 = self.windows.q0
        if not self.zero_count:
            return torch.zeros_like(q0)
        return self.split_zeros(x).reshape(-1, q0.shape[-1])[self._recording()]

    def places(self) -> Tensor:
        """Where each window's state and the zeros of its recording stand, (window, ·)."""
        states = torch.arange(len(self.windows) * self.state_count).reshape(len(self.windows), -1)
        states = states + self.shared_count
        if not self.zero_count:
            return states
        joints = self.windows.q0.shape[-1]
        first = self.shared_count + states.numel() + joints * self._recording()
        return torch.cat([states, first[:, None] + torch.arange(joints)], 1)

    def _recording(self) -> Tensor:
        """Of which recording each window is, (window,)."""
        return torch.tensor([place for place, *_ in self.windows.spans])

    def _smoothed(self) -> Tensor:
        """States that a smoother gave the windows, in one row."""
        return torch.cat([self.windows.q0, self.windows.qd0], -1).reshape(-1)

    def _state_sd(self) -> Tensor:
        """What is expected of the windows' states around these, (window, 2 joint)."""
        own = torch.ones_like(self.windows.q0)
        sd = torch.cat([START_Q_SD * own, START_QD_SD * own], -1)
        resting = list(self.windows.at_rest)
        sd[resting] = torch.cat([REST_Q_SD * own, REST_QD_SD * own], -1)[resting]
        return sd
