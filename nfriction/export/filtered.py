"""A controller of raw positions: the causal filter before a controller of the motion."""

import math
from typing import Final

import torch
from torch import Tensor, nn

from nfriction.export.unfiltered import Controller, MemoryController, masked
from nfriction.signals import SecondOrderLowPass

# Numbers a joint that the causal filter carries: last position, last velocity, two by low-pass.
FILTER_STATE = 6


class FilteredController(nn.Module):
    """A controller that takes raw positions at a fixed rate and filters them itself.

    Velocity is the difference of the position through a causal second-order low-pass filter,
    acceleration the difference of that velocity through the same filter again. A position that is
    not finite leaves the filter as it was.

    Args:
        inner: the controller behind the filter.
        low_pass: the filter, which also tells the sample time.

    Shape:
        q, load: (*batch, joint); state (*batch, joint, number); outputs as in `Controller`.

    References:
        TLRIP paper: a second-order IIR filter on the velocity (there from frequency counting, which
        needs time stamps of encoder edges).
    """

    remembers: Final[bool]

    def __init__(self, inner: Controller | MemoryController, low_pass: SecondOrderLowPass) -> None:
        super().__init__()
        self.inner = inner
        self.joints = inner.joints
        self.coefficient_count = inner.coefficient_count
        self.cutoff_hz, self.damping = float(low_pass.cutoff_hz), float(low_pass.damping)
        self.sample_time = float(low_pass.sample_time)
        numerator, denominator = (c.tolist() for c in low_pass.coefficients)
        self.b0, self.b1, self.b2 = numerator
        _, self.a1, self.a2 = denominator
        self.remembers = isinstance(inner, MemoryController)
        self.state_size = FILTER_STATE + (
            inner.state_size if isinstance(inner, MemoryController) else 0
        )

    def initial_state(self, q: Tensor) -> Tensor:
        """State of a filter that has rested at `q`, (*batch, joint); serves as a reset too."""
        rest = torch.zeros_like(q)
        position = torch.where(q.abs() < math.inf, q, rest)
        state = torch.stack([position, rest, rest, rest, rest, rest], -1)
        if self.remembers:
            memory = self.inner.initial_state(rest, rest)  # type: ignore[operator]
            state = torch.cat([state, memory], -1)
        return state

    def for_finite(
        self, q: Tensor, load: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What `forward` gives where all is finite."""
        q_last, qd_last, first, second, third, fourth = state[..., :6].unbind(-1)
        qd, first, second = self._low_pass((q - q_last) / self.sample_time, first, second)
        qdd, third, fourth = self._low_pass((qd - qd_last) / self.sample_time, third, fourth)
        following = torch.stack([q, qd, first, second, third, fourth], -1)
        # A constant, by which TorchScript compiles the one branch only; mypy knows no such thing.
        if self.remembers:
            tau_f, coefficients, status, memory = self.inner.for_finite(  # type: ignore
                qd, qdd, load, state[..., 6:]
            )
            return tau_f, coefficients, status, torch.cat([following, memory], -1)
        tau_f, coefficients, status = self.inner.for_finite(qd, qdd, load)  # type: ignore
        return tau_f, coefficients, status, following

    def forward(
        self, q: Tensor, load: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Torque [N m], coefficients, status and next state for one sample of position [rad]."""
        tau_f, coefficients, status, following = self.for_finite(q, load, state)
        finite = q.abs() + load.abs() < math.inf
        tau_f, coefficients, status = masked(finite, tau_f, coefficients, status)
        # The load plays no part in the filter: one that is not finite does not stop it.
        following = torch.where(q.abs().unsqueeze(-1) < math.inf, following, state)
        return tau_f, coefficients, status, following

    def _low_pass(self, x: Tensor, s0: Tensor, s1: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Output and next state of the filter, in transposed direct form II."""
        y = self.b0 * x + s0
        return y, self.b1 * x - self.a1 * y + s1, self.b2 * x - self.a2 * y
