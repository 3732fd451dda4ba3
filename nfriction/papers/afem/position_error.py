"""Position error of simulated windows for many candidates at once, in compiled rollouts."""

from collections.abc import Mapping

import torch
from torch import Tensor

from nfriction.fitting.data.windows import Windows
from nfriction.friction.models import FrictionModel
from nfriction.plant import Plant
from nfriction.simulation.compiled import integrate_compiled
from nfriction.simulation.protocols import RolloutInputs
from nfriction.simulation.rollout import integrate


class PositionError:
    """Position error of simulated windows as a function of a schedule's parameter vector.

    Args:
        plant: the mechanism.
        friction: the friction model; its schedule is overwritten and restored.
        windows: what was measured, with the states from which simulations start.
        mixing: matrix (joint, joint) from joint coordinates to those of the recording.
        substeps: integration steps to a sample.
        drive: class of every sample, (window, step, joint), that takes the acceleration's place
            in choosing the coefficients; None to let the simulated motion drive them.
        memory: of the coefficients at the start of each window, (window, joint, state_size).
        threads: candidates are shared out among this many.
    """

    def __init__(
        self,
        plant: Plant,
        friction: FrictionModel,
        windows: Windows,
        mixing: Tensor,
        *,
        substeps: int = 1,
        drive: Tensor | None = None,
        memory: Tensor | None = None,
        threads: int = 1,
    ) -> None:
        self.plant, self.friction, self.windows = plant, friction, windows
        self.mixing, self.substeps, self.threads = mixing, substeps, threads
        self.drive, self.memory = drive, memory
        self.values = int(windows.weight.sum()) * windows.q0.shape[1]

    def mean_square(self, vectors: Tensor) -> Tensor:
        """Mean square of the error [rad^2] of candidates (m, parameter), shape (m,)."""
        total = torch.zeros(len(vectors), dtype=torch.float64)
        own = self._parameters(vectors)
        for w in range(len(self.windows)):
            total += self._residuals(w, vectors, own).square().sum((1, 2))
        return total / self.values

    def residuals(self, vector: Tensor) -> Tensor:
        """Error of one candidate [rad], (window, step + 1, joint)."""
        own = self._parameters(vector[None])
        return torch.cat([self._residuals(w, vector[None], own) for w in range(len(self.windows))])

    def _residuals(self, w: int, vectors: Tensor, own: Mapping[str, Tensor]) -> Tensor:
        of = self.windows
        error = (self._positions(w, vectors, own) - of.q[w]) @ self.mixing.T
        return error * of.weight[w, :, None]

    def _positions(self, w: int, vectors: Tensor, own: Mapping[str, Tensor]) -> Tensor:
        """Positions of every candidate in one window, (m, step + 1, joint)."""
        of, m = self.windows, len(vectors)
        measured = None if self.drive is None else (torch.zeros_like(self.drive[w]), self.drive[w])
        memory = None if self.memory is None else self.memory[w]
        q0, qd0 = of.q0[w].expand(m, -1), of.qd0[w].expand(m, -1)
        states = integrate_compiled(
            self.plant, self.friction, q0, qd0, of.tau[w], of.step[w], self.substeps, measured,
            "auto", self.threads, own, memory,
        )  # fmt: skip
        if states is not None:
            return states[0]
        schedule = self.friction.schedule
        before, rows = schedule.parameter_vector(), []
        for vector in vectors:
            schedule.set_parameter_vector(vector)
            rows.append(
                integrate(
                    self.plant, self.friction,
                    RolloutInputs(
                        of.q0[w], of.qd0[w], of.tau[w], of.step[w], self.substeps, measured, memory
                    ),
                ).q
            )  # fmt: skip
        schedule.set_parameter_vector(before)
        return torch.stack(rows)

    def _parameters(self, vectors: Tensor) -> dict[str, Tensor]:
        """The friction model's parameters at each vector, by name, (m, *shape)."""
        schedule = self.friction.schedule
        before, rows = schedule.parameter_vector(), []
        for vector in vectors:
            schedule.set_parameter_vector(vector)
            rows.append({n: p.detach().clone() for n, p in self.friction.named_parameters()})
        schedule.set_parameter_vector(before)
        return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
