"""Coefficients from the papers' network: one RBF network per joint, trained on a controller."""

import math
from collections.abc import Sequence
from typing import Any, Final, Literal

import numpy as np
import torch
from scipy.signal import lfilter
from torch import Tensor, nn

from nfriction.friction.coefficients import Constant, Schedule
from nfriction.friction.laws import Law
from nfriction.friction.parameters import Sensitivity, positive_number
from nfriction.fuzzy import RBFNetwork
from nfriction.simulation.protocols import at_sample_time


class RBFCoefficients(Schedule):
    """A radial basis network of |velocity| and acceleration gives the coefficients of a law.

    Jerk and snap, the first two derivatives of the acceleration, can be further inputs. They are
    computed after a first-order low-pass filter, and snap after another one, causally as in a
    controller; the states of these filters are the hidden state.

    The network works in SI units, so a network trained on a controller's outputs is copied in
    unchanged. Inputs and outputs are clamped to their universes in training: a controller never
    leaves its own, but a network may. An untrained model is the constant law `initial`.

    Args:
        initial: coefficients at the start in SI, (joint, coefficient) or (coefficient,).
        head_units: units of each joint's network; 10 in the papers.
        acceleration: `"along_motion"` uses qdd sgn(qd), `"signed"` qdd like the papers; likewise
            for jerk and snap.
        derivatives: of the acceleration used as inputs: 0, 1 (jerk) or 2 (jerk and snap).
        smoothing: time constant of their filters [s]; by default for a cut-off of 20 Hz.
        sample_time: of these filters [s].

    References:
        TLRIP paper, neuro-fuzzy friction estimation (one 2-10-2 network per joint); its future work
        (jerk and snap).
    """

    handles_range = True
    fit_strategy = "nfriction.papers.nffem.fit_rbf:fit_rbf"

    # `Final`, so that it is a constant for TorchScript.
    turn: Final[float] = 3e-3  # width of the sign in qdd sgn(qd), relative to the velocity universe
    remembers: Final[bool]

    input_lower: Tensor
    input_upper: Tensor
    output_lower: Tensor
    output_upper: Tensor

    def __init__(
        self,
        law: Law,
        joints: int,
        initial: Tensor | Sequence | None = None,
        *,
        head_units: int = 10,
        acceleration: Literal["along_motion", "signed"] = "along_motion",
        derivatives: int = 0,
        smoothing: float = 8e-3,
        sample_time: float = 1e-3,
    ) -> None:
        super().__init__(law, joints)
        if derivatives not in (0, 1, 2):
            raise ValueError(f"`derivatives` must be 0, 1 (jerk) or 2 (snap), got {derivatives!r}.")
        self.derivatives = int(derivatives)
        self.remembers = self.derivatives > 0
        self.state_size = self.derivatives + 1 if self.remembers else 0
        self.smoothing = positive_number("smoothing", smoothing)
        self.set_sample_time(sample_time)
        if acceleration not in ("along_motion", "signed"):
            raise ValueError(
                f'`acceleration` must be "along_motion" or "signed", got {acceleration!r}.'
            )
        self.along_motion = acceleration == "along_motion"
        self.head_units = head_units
        inputs = 2 + self.derivatives
        self.network = RBFNetwork(joints, inputs, head_units, len(law.names))
        values = Constant(law, joints, initial).values
        # As wide as the motion in the papers.
        size = torch.tensor([20.0, 200.0, 1e4, 1e6], dtype=values.dtype)[:inputs].repeat(joints, 1)
        zero_speed = torch.tensor([0.0, -1.0, -1.0, -1.0], dtype=values.dtype)[:inputs]
        self.register_buffer("input_lower", zero_speed * size)
        self.register_buffer("input_upper", size)
        self.register_buffer("output_lower", values.clone())
        self.register_buffer("output_upper", values.clone())
        # Only the bias is set: an untrained network is the constant law.
        nn.init.zeros_(self.network.output_weight)
        with torch.no_grad():
            self.network.output_bias.copy_(values)

    def set_sample_time(self, sample_time: float) -> None:
        """Set the sample time [s], on which the filters of jerk and snap depend.

        Raises:
            ValueError: if it is not positive and finite.
        """
        self.step = positive_number("sample_time", sample_time)
        # A network of only velocity and acceleration runs at any rate.
        self.sample_time = self.step if self.remembers else None
        self.gain = 1.0 - math.exp(-self.step / self.smoothing)

    def inputs(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        """Inputs of the network in SI, clamped to their universe, (*batch, joint, input)."""
        rest = qdd.unsqueeze(-1)
        if self.remembers:
            rest = torch.cat([rest, state.narrow(-1, 1, self.derivatives)], -1)
        if self.along_motion:
            rest = rest * torch.tanh(qd / (self.turn * self.input_upper.select(-1, 0))).unsqueeze(
                -1
            )
        x = torch.cat([qd.abs().unsqueeze(-1), rest], -1)
        return torch.minimum(torch.maximum(x, self.input_lower), self.input_upper)

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return self.coefficients_from(qd, qdd, self.initial_state(qd, qdd))

    def coefficients_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        y = self.network(self.inputs(qd, qdd, state))
        return torch.minimum(torch.maximum(y, self.output_lower), self.output_upper)

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Smoothed acceleration, jerk and snap, (*batch, joint, 1 + derivatives), or empty."""
        rest = torch.zeros_like(qdd)
        return torch.stack([qdd, rest, rest], -1).narrow(-1, 0, self.state_size)

    def advance(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        if not self.remembers:
            return state
        before = state.select(-1, 0)
        smoothed = before + self.gain * (qdd - before)
        jerk = (smoothed - before) / self.step
        if self.derivatives == 1:
            return torch.stack([smoothed, jerk], -1)
        snap = state.select(-1, 2)
        change = (jerk - state.select(-1, 1)) / self.step
        return torch.stack([smoothed, jerk, snap + self.gain * (change - snap)], -1)

    def states(self, qd: Tensor, qdd: Tensor, time: Tensor | None = None) -> Tensor:
        if time is not None and len(time) > 1:
            return at_sample_time(self, float(time.diff().median())).states(qd, qdd)
        if not self.remembers:
            return self.initial_state(qd, qdd)
        # As in the base class, but without torch operations for every sample.
        filtered, rate = ([self.gain], [1.0, self.gain - 1.0]), 1.0 / self.step
        start = (1.0 - self.gain) * qdd[:1].numpy()
        found = [lfilter(*filtered, qdd.numpy(), axis=0, zi=start)[0]]
        jerk = rate * np.diff(found[0], axis=0, prepend=found[0][:1])
        found.append(jerk)
        change = rate * np.diff(jerk, axis=0, prepend=jerk[:1])
        found.append(lfilter(*filtered, change, axis=0))
        return torch.tensor(np.stack(found[: self.derivatives + 1], -1))

    @torch.no_grad()
    def set_network(self, network: RBFNetwork, inputs: Tensor, outputs: Tensor) -> None:
        """Adopt a trained network with one group per joint.

        Args:
            network: from |velocity| and acceleration to the coefficients, in SI.
            inputs: universe of each input, lower then upper ends, (2, joint, 2).
            outputs: universe of each coefficient, (2, joint, coefficient).

        Raises:
            ValueError: if the network has another shape, a universe is empty, or that of a
                physically positive coefficient begins below zero.
        """
        # The string contains all sizes.
        ours, theirs = self.network.extra_repr(), network.extra_repr()
        if ours != theirs:
            raise ValueError(f"`network` must have {ours}, got {theirs}.")
        for name, given, like in (
            ("inputs", inputs, self.input_lower),
            ("outputs", outputs, self.output_lower),
        ):
            shape = (2, *like.shape)
            if given.shape != shape or not bool((given[0] <= given[1]).all()):
                raise ValueError(
                    f"`{name}` must be lower and upper ends {shape} with lower <= upper, got shape "
                    f"{tuple(given.shape)}."
                )
        # Only the clamp to the universe keeps such a coefficient positive.
        if bool((self.positive & (outputs[0] < 0)).any()):
            raise ValueError("a coefficient that is positive by physics has a universe from >= 0.")
        self.network.load_state_dict(network.state_dict())
        self.input_lower.copy_(inputs[0])
        self.input_upper.copy_(inputs[1])
        self.output_lower.copy_(outputs[0])
        self.output_upper.copy_(outputs[1])

    def parameter_vector(self) -> Tensor:
        # Only the output layer: a trajectory fit varies nothing else.
        weight, bias = self.network.output_weight, self.network.output_bias
        return torch.cat([weight, bias[..., None]], -1).detach().reshape(-1)

    @torch.no_grad()
    def set_parameter_vector(self, vector: Tensor) -> None:
        weight, bias = self.network.output_weight, self.network.output_bias
        layer = vector.reshape(*bias.shape, -1)
        weight.copy_(layer[..., :-1])
        bias.copy_(layer[..., -1])

    def bounds(self) -> tuple[Tensor, Tensor]:
        vector = self.parameter_vector()
        mask = torch.tensor(self.fitted_mask, device=vector.device)[:, None]
        fitted = mask.expand(self.joints, -1, self.head_units + 1).reshape(-1)
        free = torch.full_like(vector, torch.inf)
        return torch.where(fitted, -free, vector), torch.where(fitted, free, vector)

    def sensitivities(self, qd: Tensor, qdd: Tensor) -> Sensitivity:
        """Derivatives at motions (sample, joint), each sample treated as a first one."""
        return self.sensitivities_from(qd, qdd, self.initial_state(qd, qdd))

    @torch.no_grad()
    def sensitivities_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Sensitivity:
        x = self.inputs(qd, qdd, state)
        y = self.network(x)
        # A clamped output has zero derivatives.
        free = ((y > self.output_lower) & (y < self.output_upper)).to(y.dtype)
        moving = ((x > self.input_lower) & (x < self.input_upper)).to(y.dtype)
        own = torch.eye(y.shape[-1], dtype=y.dtype, device=y.device)
        by_input = self.network.input_jacobian(x).permute(3, 0, 1, 2)
        by_input = by_input * free[..., None] * moving[:, :, None]
        # The network reads |qd|.
        by_qd, by_qdd = by_input[..., 0] * qd.sign()[..., None], by_input[..., 1]
        if self.along_motion:
            turn = self.turn * self.input_upper.select(-1, 0)
            sign = torch.tanh(qd / turn)
            rest = torch.cat([qdd.unsqueeze(-1), state[..., 1:]], -1)
            turning = (by_input[..., 1:] * rest[:, :, None]).sum(-1)
            by_qd = by_qd + turning * ((1.0 - sign * sign) / turn)[..., None]
            by_qdd = by_qdd * sign[..., None]
        factors = ((free[..., None] * own, self.network.regressors(x)),)
        return Sensitivity(lambda: factors, by_qd, by_qdd)

    def options(self) -> dict[str, Any]:
        found: dict[str, Any] = {
            "network": "rbf",
            "head_units": self.head_units,
            "acceleration": "along_motion" if self.along_motion else "signed",
        }
        # Without further inputs nothing is smoothed, as in files older than these inputs.
        if self.remembers:
            found |= {
                "derivatives": self.derivatives,
                "smoothing": self.smoothing,
                "sample_time": self.step,
            }
        return found

    def extra_repr(self) -> str:
        return ", ".join(f"{name}={value!r}" for name, value in self.options().items())
