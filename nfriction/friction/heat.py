"""Friction that falls as its joint warms: schedules with the heat of each joint as a hidden state.

The heat h of a joint is a leaky integral of the power P that its friction dissipates,

    h' = P / C - h / T,

and friction falls by exp(-k_h h): the viscosity of lubricants falls exponentially with temperature.
h has no unit; a fit takes the C with which cold friction would heat its recordings to 1 at most. P
is taken at the load at rest. A motion starts cold unless a hidden state is given.

References:
    O. Reynolds, Phil. Trans. R. Soc. 177 (1886), 157-234, for the viscosity.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nfriction.friction.coefficients import Constant, Schedule
from nfriction.friction.laws import Coefficient, Law
from nfriction.friction.parameters import positive_number

# The last two coefficients of a law with heat; the second is the hidden state.
FALL = Coefficient("k_h", "-", prior_scale=1.0, stores=True)
HEAT = Coefficient("h", "-", positive=False, fitted=False, stores=True)


class Heated(Schedule):
    """Mixin for schedules of a law whose last coefficients are k_h and h, see `with_inputs`.

    Its constants are stored as logarithms, which keeps them positive.

    Attributes:
        heat_capacity: C, of each joint [J].
        cooling_time: T [s].
        sample_time: at which the heat advances [s].
    """

    state_size = 1
    log_heat_capacity: Tensor
    log_cooling_time: Tensor
    log_sample_time: Tensor

    def __init__(self, law: Law, joints: int, *args: Any, **options: Any) -> None:
        super().__init__(law, joints, *args, **options)
        self.law_torque = law.torque
        for name, shape in (
            ("heat_capacity", (joints,)),
            ("cooling_time", ()),
            ("sample_time", ()),
        ):
            self.register_buffer(f"log_{name}", torch.zeros(shape, dtype=torch.float64))

    @property
    def heat_capacity(self) -> Tensor:
        return torch.exp(self.log_heat_capacity)

    @property
    def cooling_time(self) -> float:
        return math.exp(self.log_cooling_time)

    @property
    def sample_time(self) -> float:
        return math.exp(self.log_sample_time)

    @torch.no_grad()
    def set_heat(
        self, capacity: Tensor | Sequence[float] | float, cooling_time: float, sample_time: float
    ) -> None:
        """Set C [J] of each joint or of all, T [s] and the sample time [s], all positive."""
        given = torch.as_tensor(capacity, dtype=torch.float64)
        if given.shape not in ((), (1,), (self.joints,)):
            raise ValueError(
                f"`capacity` must be 1 number or {self.joints}, got shape {tuple(given.shape)}."
            )
        for value in given.flatten().tolist():
            positive_number("capacity", value, "J")
        self.log_heat_capacity.copy_(given.log())
        self.log_cooling_time.fill_(math.log(positive_number("cooling_time", cooling_time, "s")))
        self.log_sample_time.fill_(math.log(positive_number("sample_time", sample_time, "s")))

    def set_sample_time(self, sample_time: float) -> None:
        """Set the time between samples [s]."""
        self.set_heat(self.heat_capacity, self.cooling_time, sample_time)

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return torch.zeros_like(qd).unsqueeze(-1)

    def advance(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        held = self.coefficients_from(qd, qdd, state)
        power = self._power(qd, held)
        # As an increment: in single precision the factor that remains would round to 1.
        lost = -torch.expm1(-torch.exp(self.log_sample_time - self.log_cooling_time))
        gained = torch.exp(self.log_sample_time - self.log_heat_capacity) * power
        return state + (gained - lost * state.select(-1, 0)).unsqueeze(-1)

    def _power(self, qd: Tensor, coefficients: Tensor) -> Tensor:
        """Power that friction dissipates [W]; none where it drives."""
        # With a sharp sign, as the power of dry friction is |qd| F_c down to rest.
        return (qd * self.law_torque(qd, torch.ones_like(qd), coefficients, 1e-9)).clamp_min(0.0)

    def coefficients_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        cold = self(qd, qdd)
        # Adding zeros broadcasts; ONNX has no form of `expand`.
        return torch.cat([cold[..., :-1] + 0.0 * state, state], -1)

    @torch.no_grad()
    def states_from(self, first: Tensor, qd: Tensor, qdd: Tensor, time: Any = None) -> Tensor:
        # As `advance` from sample to sample, with the power of cold friction from one call.
        cold = self.coefficients_from(qd, qdd, self.initial_state(qd, qdd))
        steps = np.full(len(qd) - 1, self.sample_time)
        if time is not None and len(steps):
            steps = np.diff(time.numpy())
        # In a gap a joint cools; how it moves then is not known.
        step = np.median(steps) if len(steps) else self.sample_time
        gained = (step / self.heat_capacity * self._power(qd, cold)).numpy()
        falls, kept = cold[..., -2].numpy(), np.exp(-steps / self.cooling_time)
        rows = np.empty_like(gained)
        rows[0] = first[..., 0]
        for k in range(1, len(rows)):
            rows[k] = kept[k - 1] * rows[k - 1] + gained[k] * np.exp(-falls[k] * rows[k - 1])
        return torch.from_numpy(rows)[..., None]


class HeatedConstant(Heated, Constant):
    """Constant coefficients of a law with heat."""
