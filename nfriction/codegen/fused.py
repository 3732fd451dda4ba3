"""Plant and friction as the one function of which a rollout is made."""

from typing import Any, Protocol, cast

from torch import Tensor, nn


class Plant(Protocol):
    """What a rollout needs of a mechanism; a module, states of shape (joint,)."""

    joints: int

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor: ...
    def load(self, q: Tensor, qd: Tensor) -> Tensor: ...


class Friction(Protocol):
    """What a rollout needs of a friction model; a module.

    One whose coefficients have a memory also has `state_size` > 0, `initial_state(qd, qdd)`,
    `advance(qd, qdd, state)` and `coefficients_from(qd, qdd, state)`.
    """

    def coefficients(self, qd: Tensor, qdd: Tensor) -> Tensor: ...
    def torque(self, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor: ...


class Fused(nn.Module):
    """Plant and friction as one function, so that the load shares the dynamics' work."""

    def __init__(self, plant: Plant, friction: Friction, hold: bool) -> None:
        super().__init__()
        self.plant = cast(Any, plant)
        self.friction = cast(Any, friction)
        self.hold = hold
        self.remembers = int(getattr(friction, "state_size", 0)) > 0

    def forward(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        qd_held: Tensor,
        qdd_held: Tensor,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        if memory is None:
            c = self.friction.coefficients(qd_held if self.hold else qd, qdd_held)
        else:
            c = self.friction.coefficients_from(qd_held, qdd_held, memory)
        tau_f = self.friction.torque(qd, self.plant.load(q, qd), c)
        with_friction = self.plant.forward_dynamics(q, qd, tau - tau_f)
        without = self.plant.forward_dynamics(q, qd, tau)
        if memory is None:
            return with_friction, without
        begin = self.friction.initial_state(qd_held, qdd_held)
        return with_friction, without, begin, self.friction.advance(qd_held, qdd_held, memory)
