"""Coefficients by the papers' network: one radial basis network a joint, taught by a controller."""

from collections.abc import Sequence
from typing import Any, Final, Literal

import torch
from torch import Tensor, nn

from nfriction.friction.coefficients import Constant, Schedule
from nfriction.friction.laws import Law
from nfriction.friction.parameters import Sensitivity
from nfriction.fuzzy import RBFNetwork


class RBFCoefficients(Schedule):
    """A radial basis network of |velocity| and acceleration gives the coefficients of a law.

    Its numbers are those of the network itself, in SI, so what was trained on a controller's
    outputs is copied in as it is. Inputs are clamped to the universe on which it was trained, the
    outputs to theirs: a controller never leaves it, a network may. An untrained model is the
    constant law `initial`.

    Args:
        law: the law whose coefficients these are.
        joints: number of joints.
        initial: coefficients at the start in SI, (joint, coefficient) or (coefficient,).
        head_units: units of each joint's network; the papers take 10.
        acceleration: `"along_motion"` takes qdd sgn(qd), `"signed"` qdd as the papers do.

    References:
        TLRIP paper, neuro-fuzzy friction estimation (2-10-2 network a joint).
    """

    handles_range = True

    # Final, so that TorchScript takes it for a constant.
    turn: Final[float] = 3e-3  # where qdd sgn(qd) turns, in units of the velocity's universe

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
    ) -> None:
        super().__init__(law, joints)
        if acceleration not in ("along_motion", "signed"):
            raise ValueError(
                f'`acceleration` must be "along_motion" or "signed", got {acceleration!r}.'
            )
        self.along_motion = acceleration == "along_motion"
        self.head_units = head_units
        self.network = RBFNetwork(joints, 2, head_units, len(law.names))
        values = Constant(law, joints, initial).values
        for name, start in (
            ("input_lower", torch.tensor([0.0, -200.0], dtype=values.dtype).repeat(joints, 1)),
            ("input_upper", torch.tensor([20.0, 200.0], dtype=values.dtype).repeat(joints, 1)),
            ("output_lower", values.clone()),
            ("output_upper", values.clone()),
        ):
            self.register_buffer(name, start)
        # Bias alone: an untrained network is the constant law.
        nn.init.zeros_(self.network.output_weight)
        with torch.no_grad():
            self.network.output_bias.copy_(values)

    def inputs(self, qd: Tensor, qdd: Tensor) -> Tensor:
        """Inputs of the network in SI, clamped to their universe, (*batch, joint, 2)."""
        if self.along_motion:
            qdd = qdd * torch.tanh(qd / (self.turn * self.input_upper.select(-1, 0)))
        x = torch.stack([qd.abs(), qdd], -1)
        return torch.minimum(torch.maximum(x, self.input_lower), self.input_upper)

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        y = self.network(self.inputs(qd, qdd))
        return torch.minimum(torch.maximum(y, self.output_lower), self.output_upper)

    @torch.no_grad()
    def set_network(self, network: RBFNetwork, inputs: Tensor, outputs: Tensor) -> None:
        """Take over a trained network, a group for each joint.

        Args:
            network: from |velocity| and acceleration to the coefficients, in SI.
            inputs: universe of each input, lower then upper, (2, joint, 2).
            outputs: of each coefficient, (2, joint, coefficient).

        Raises:
            ValueError: if the network has another shape, a universe is no range, or one of a
                coefficient that is positive by physics begins below zero.
        """
        # The description has all sizes.
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
        # The clamp to the universe is all that keeps such a coefficient positive.
        if bool((self.positive & (outputs[0] < 0)).any()):
            raise ValueError("a coefficient that is positive by physics has a universe from >= 0.")
        self.network.load_state_dict(network.state_dict())
        self.input_lower.copy_(inputs[0])
        self.input_upper.copy_(inputs[1])
        self.output_lower.copy_(outputs[0])
        self.output_upper.copy_(outputs[1])

    def trained(self) -> tuple[nn.Parameter, nn.Parameter]:
        """The output layer, all that a trajectory fit varies: weights and bias."""
        return self.network.output_weight, self.network.output_bias

    def parameter_vector(self) -> Tensor:
        weight, bias = self.trained()
        return torch.cat([weight, bias[..., None]], -1).detach().reshape(-1)

    @torch.no_grad()
    def set_parameter_vector(self, vector: Tensor) -> None:
        weight, bias = self.trained()
        layer = vector.reshape(*bias.shape, -1)
        weight.copy_(layer[..., :-1])
        bias.copy_(layer[..., -1])

    def bounds(self) -> tuple[Tensor, Tensor]:
        vector = self.parameter_vector()
        mask = torch.tensor(self.fitted_mask, device=vector.device)[:, None]
        fitted = mask.expand(self.joints, -1, self.head_units + 1).reshape(-1)
        free = torch.full_like(vector, torch.inf)
        return torch.where(fitted, -free, vector), torch.where(fitted, free, vector)

    @torch.no_grad()
    def sensitivities(self, qd: Tensor, qdd: Tensor) -> Sensitivity:
        x = self.inputs(qd, qdd)
        y = self.network(x)
        # What is clamped does not move.
        free = ((y > self.output_lower) & (y < self.output_upper)).to(y.dtype)
        moving = ((x > self.input_lower) & (x < self.input_upper)).to(y.dtype)
        own = torch.eye(y.shape[-1], dtype=y.dtype, device=y.device)
        by_input = self.network.input_jacobian(x).permute(3, 0, 1, 2)
        by_speed, by_qdd = (by_input * free[..., None] * moving[:, :, None]).unbind(-1)
        # The network reads |qd|.
        by_qd = by_speed * qd.sign()[..., None]
        if self.along_motion:
            turn = self.turn * self.input_upper.select(-1, 0)
            sign = torch.tanh(qd / turn)
            by_qd = by_qd + by_qdd * (qdd * (1.0 - sign * sign) / turn)[..., None]
            by_qdd = by_qdd * sign[..., None]
        return Sensitivity(((free[..., None] * own, self.network.regressors(x)),), by_qd, by_qdd)

    def options(self) -> dict[str, Any]:
        return {
            "network": "rbf",
            "head_units": self.head_units,
            "acceleration": "along_motion" if self.along_motion else "signed",
        }

    def extra_repr(self) -> str:
        return ", ".join(f"{name}={value!r}" for name, value in self.options().items())
