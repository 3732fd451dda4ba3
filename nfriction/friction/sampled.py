"""A law with memory at a fixed sample rate, as controllers compute it.

A controller gets the motion at its samples and takes the velocity to be held until the next one.
The law's internal state is then a hidden state of the coefficients, so that everything that handles
such states (exports with init, reset, step and their NaN policy) also handles the law.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from nfriction.friction.coefficients import Schedule
from nfriction.friction.laws import Coefficient, Law
from nfriction.friction.models import FrictionModel
from nfriction.friction.parameters import Sensitivity, positive_number


def sampled(model: FrictionModel, sample_time: float) -> FrictionModel:
    """The model of a law with memory as one without, whose coefficients have a hidden state.

    Its coefficients are those of the law, followed by its internal state after the sample. The
    hidden state before a first sample is that of a joint at rest, undeflected.

    Args:
        model: of a law with memory, whose coefficients have no hidden state of their own.
        sample_time: time between samples [s].

    Raises:
        ValueError: if the coefficients have a hidden state, or the sample time is not positive.
    """
    step = positive_number("sample_time", sample_time, "s")
    law = model.law
    if law.memory is None or model.state_size:
        raise ValueError(
            "only a law with memory can be sampled, with coefficients that have no hidden state; "
            f"got {law.name!r} with {type(model.schedule).__name__}."
        )
    model.check_loads(None)
    # Signed and without bounds: no fit varies them.
    states = tuple(Coefficient(f"state_{k + 1}", "-", False) for k in range(law.state_size))
    flat = Law(law.name, (*law.coefficients, *states), _Torque(law.memory.torque, law.state_size))
    return FrictionModel(flat, _Sampled(model, flat, step), model.v_smooth)


# A module and no closure, which TorchScript would not compile.
class _Torque(nn.Module):
    """Torque of the law, its state the last of the coefficients."""

    def __init__(self, torque: Callable[..., Tensor], size: int) -> None:
        super().__init__()
        self.torque = torque
        self.size = size

    def forward(self, qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
        count = coefficients.size(-1) - self.size
        state = coefficients[..., count:]
        return self.torque(state, qd, load, coefficients[..., :count])


class _Sampled(Schedule):
    """Coefficients, and the state of the law that has them, which the load moves if `loaded`."""

    # The law has no trained range, and a clamped velocity would move its state too little.
    handles_range = True
    step: Tensor
    rest: Tensor

    def __init__(self, model: FrictionModel, flat: Law, sample_time: float) -> None:
        super().__init__(flat, model.joints)
        assert model.law.memory is not None
        self.state_size = model.law.state_size
        self.sample_time = sample_time
        self.given = model.schedule
        self.law_advance = model.law.memory.advance
        # With two loads, its state moves to two places if it depends on the load.
        c = model.schedule.rest_coefficients().detach()
        qd = torch.linspace(-1.0, 1.0, 7, dtype=c.dtype)[:, None].expand(-1, model.joints)
        start = model.law.initial_state(qd)
        moved = [self.law_advance(start, qd, x, c, sample_time) for x in (qd + 2.0, 0.0 * qd)]
        self.loaded = not torch.equal(*moved)
        step = torch.tensor(sample_time, dtype=torch.float64)
        self.register_buffer("step", step, persistent=False)
        self.register_buffer("rest", step.new_zeros(self.state_size), persistent=False)

    def set_sample_time(self, sample_time: float) -> None:
        self.sample_time = sample_time
        self.step.fill_(sample_time)

    def forward(self, qd: Tensor, qdd: Tensor) -> Tensor:
        first = self.advance(qd, qdd, self.initial_state(qd, qdd))
        return self.coefficients_from(qd, qdd, first)

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor:
        return qd.unsqueeze(-1) * self.rest

    def advance(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        return self.advance_loaded(qd, qdd, 0.0 * qd, state)

    def advance_loaded(self, qd: Tensor, qdd: Tensor, load: Tensor, state: Tensor) -> Tensor:
        """The same under a load, for laws whose state it moves."""
        return self.law_advance(state, qd, load, self.given(qd, qdd), self.step)

    def coefficients_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor:
        c = self.given(qd, qdd)
        # Adding zeros broadcasts; ONNX has no form of `expand`.
        return torch.cat([c + 0.0 * state[..., :1], state], -1)

    def parameter_vector(self) -> Tensor:
        return self.given.parameter_vector()

    def set_parameter_vector(self, vector: Tensor) -> None:
        self.given.set_parameter_vector(vector)

    def parameter_names(self, joint_names: Sequence[str]) -> list[str]:
        return self.given.parameter_names(joint_names)

    def bounds(self) -> tuple[Tensor, Tensor]:
        return self.given.bounds()

    def sensitivities(self, qd: Tensor, qdd: Tensor) -> Sensitivity:
        raise NotImplementedError("a sampled law is for controllers; fit the law itself.")
