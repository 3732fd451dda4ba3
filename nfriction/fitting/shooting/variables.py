"""Decision variables of a shooting problem: their order in one vector, bounds and priors."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from nfriction.fitting.adjusted_plant import PlantParameter
from nfriction.fitting.data.windows import Windows
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.friction.coefficients import Schedule
from nfriction.friction.memory import reference_coefficients, slipping_state
from nfriction.friction.models import FrictionModel
from nfriction.simulation.protocols import at_sample_time


def model_at(model: FrictionModel, vector: Tensor) -> FrictionModel:
    """A copy of a friction model at a parameter vector."""
    moved = copy.deepcopy(model)
    moved.schedule.set_parameter_vector(vector)
    return moved


def substepped(model: FrictionModel, substeps: int) -> FrictionModel:
    """A copy of a friction model for simulations that count substeps as samples."""
    copied = copy.deepcopy(model)
    sample_time = getattr(model.schedule, "sample_time", None) or math.nan
    copied.schedule = at_sample_time(copied.schedule, sample_time / substeps)
    return copied


def deflected(model: FrictionModel, shares: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """State of a law with memory, (window, joint, state), from shares of a slipping contact's.

    With such shares the initial torque is the same at any stiffness. The second result contains the
    state's derivatives with respect to all coefficients and shares, (window, joint state, column).
    """
    memory = model.law.memory
    if memory is None:
        return None, None
    coefficients = reference_coefficients(model).requires_grad_()
    with torch.enable_grad():
        slipping = slipping_state(memory, coefficients)
        # A law is elementwise, so the sum's gradient is each joint's own.
        rows = [
            torch.autograd.grad(x.sum(), coefficients, retain_graph=True)[0]
            for x in slipping.unbind(-1)
        ]
    slipping = slipping.detach()
    joints, size = slipping.shape
    share = shares.unflatten(-1, (joints, size))
    # Each joint's state depends on its own coefficients, (window, joint, state, joint, k).
    own = torch.eye(joints, dtype=torch.float64)[:, None, :, None]
    by_coefficient = own * (share[..., None] * torch.stack(rows, 1))[..., None, :]
    by_share = torch.diag(slipping.flatten()).expand(len(shares), -1, -1)
    by_parameter = by_coefficient.flatten(1, 2).flatten(2)
    if model.schedule.follows_motion:
        # The constants from which a network deviates are not among its parameters.
        count = model.schedule.parameter_vector().numel()
        by_parameter = by_parameter.new_zeros((*by_parameter.shape[:2], count))
    slope = torch.cat([by_parameter, by_share], -1)
    return share * slipping, slope


class Parts(NamedTuple):
    """The parts of a vector of decision variables.

    `friction` and `plant` are parameter vectors; `states` are position and velocity at the start of
    each window, and `Windows.law_state`, (window, any); `offsets` are those of the encoders,
    (recording, joint) or no rows.
    """

    friction: Tensor
    plant: Tensor
    states: Tensor
    offsets: Tensor


@dataclass(frozen=True, eq=False)
class DecisionVariables:
    """[friction parameters, plant terms, state of each window, offsets of each recording].

    The shared variables, those of all windows, come first.

    Args:
        schedule: its parameters are the start, and the values of parameters that are not fitted.
        friction_prior, plant_prior: mean and standard deviation; default those of schedule and
            terms.
        offset_sd: of the encoder offsets, (recording, joint) [rad; m]; None for no offsets.
    """

    schedule: Schedule
    terms: Sequence[PlantParameter]
    windows: Windows
    friction_prior: tuple[Tensor, Tensor] | None = None
    plant_prior: tuple[Tensor, Tensor] | None = None
    offset_sd: Tensor | None = None
    options: FitOptions = DEFAULTS

    @property
    def friction_count(self) -> int:
        return self.schedule.parameter_vector().numel()

    @property
    def shared_count(self) -> int:
        return self.friction_count + len(self.terms)

    @property
    def state_count(self) -> int:
        """Number of initial-state variables of one window."""
        return self._smoothed().numel() // len(self.windows)

    @property
    def offset_count(self) -> int:
        return 0 if self.offset_sd is None else self.offset_sd.numel()

    def start(
        self,
        plant: Tensor | None = None,
        offsets: Tensor | None = None,
        friction: Tensor | None = None,
    ) -> Tensor:
        """Vector at the windows' initial states; the other parts by default unchanged."""
        friction = self.schedule.parameter_vector() if friction is None else friction
        zeros = torch.zeros(len(self.terms) + self.offset_count, dtype=torch.float64)
        plant = zeros[: len(self.terms)] if plant is None else plant
        offsets = zeros[len(self.terms) :] if offsets is None else offsets.reshape(-1)
        states, initial = self._smoothed().reshape(len(self.windows), -1), self.windows.initial
        states[:, : initial.shape[-1]] = initial
        return torch.cat([friction, plant, states.reshape(-1), offsets])

    def split(self, x: Tensor) -> Parts:
        """The parts of a vector."""
        windows, joints = self.windows.q0.shape
        friction, plant, states, offsets = x.split(
            [self.friction_count, len(self.terms), windows * self.state_count, self.offset_count]
        )
        return Parts(friction, plant, states.reshape(windows, -1), offsets.reshape(-1, joints))

    def window_offsets(self, x: Tensor) -> Tensor:
        """Encoder offset of each window's recording, (window, joint)."""
        offsets = self.split(x).offsets
        return offsets[self._recording()] if len(offsets) else torch.zeros_like(self.windows.q0)

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds; equal for variables that are not fitted."""
        lower, upper = self.schedule.bounds()
        own = len(self.windows) * self.state_count + self.offset_count
        free = torch.full((own,), torch.inf, dtype=torch.float64)
        low = torch.tensor([t.lower for t in self.terms], dtype=torch.float64)
        high = torch.tensor([t.upper for t in self.terms], dtype=torch.float64)
        return torch.cat([lower, low, -free]), torch.cat([upper, high, free])

    def prior(self) -> tuple[Tensor, Tensor]:
        """Prior precision and mean."""
        mean, sd = self.friction_prior or self.schedule.prior()
        own_sd = torch.tensor([t.prior_sd for t in self.terms], dtype=torch.float64)
        plant_mean, plant_sd = self.plant_prior or (torch.zeros_like(own_sd), own_sd)
        offset_sd = sd.new_zeros(0) if self.offset_sd is None else self.offset_sd.reshape(-1)
        sd = torch.cat([sd, plant_sd, self._state_sd().reshape(-1), offset_sd])
        mean = torch.cat([mean, plant_mean, self._smoothed(), torch.zeros_like(offset_sd)])
        return sd.square().reciprocal(), mean

    def indices(self, *, alone: bool = False) -> Tensor:
        """Indices of each window's own variables, its state and its offsets, (window, any).

        In a vector of all variables, or without the shared ones if `alone`.
        """
        states = torch.arange(len(self.windows) * self.state_count).reshape(len(self.windows), -1)
        states = states + self.shared_count * (not alone)
        if not self.offset_count:
            return states
        joints = self.windows.q0.shape[-1]
        first = states[-1, -1] + 1 + joints * self._recording()
        return torch.cat([states, first[:, None] + torch.arange(joints)], 1)

    def _recording(self) -> Tensor:
        """Index of each window's recording, (window,)."""
        return torch.tensor([place for place, *_ in self.windows.spans])

    def _smoothed(self) -> Tensor:
        parts = [self.windows.q0, self.windows.qd0]
        if self.windows.law_state is not None:
            parts.append(self.windows.law_state.flatten(-2))
        return torch.cat(parts, -1).reshape(-1)

    def _state_sd(self) -> Tensor:
        """Prior standard deviation of the initial states, (window, 2 joint)."""
        joints = self.windows.q0.shape[-1]
        sd = torch.empty(len(self.windows), self.state_count, dtype=torch.float64)
        sd[:, 2 * joints :] = 1.0
        for rows, (of_q, of_qd) in (
            (slice(None), self.options.start_sd),
            (list(self.windows.at_rest), self.options.rest_sd),
        ):
            sd[rows, :joints] = of_q
            sd[rows, joints : 2 * joints] = of_qd
        return sd
