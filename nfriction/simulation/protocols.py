"""What a rollout needs of a mechanism and of its friction."""

from typing import Protocol, cast

from torch import Tensor


class Plant(Protocol):
    """What a rollout needs of a mechanism; all shapes (*batch, joint)."""

    joints: int

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor: ...
    def load(self, q: Tensor, qd: Tensor) -> Tensor: ...
    def max_inverse_inertia(self) -> Tensor: ...


class Friction(Protocol):
    """What a rollout needs of a friction model."""

    joints: int

    def coefficients(self, qd: Tensor, qdd: Tensor) -> Tensor: ...
    def torque(self, qd: Tensor, load: Tensor, coefficients: Tensor) -> Tensor: ...
    def zero_velocity_damping(self) -> Tensor: ...


class RememberingFriction(Friction, Protocol):
    """A friction model whose coefficients have a memory; see `Schedule`."""

    state_size: int

    def initial_state(self, qd: Tensor, qdd: Tensor) -> Tensor: ...
    def advance(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor: ...
    def coefficients_from(self, qd: Tensor, qdd: Tensor, state: Tensor) -> Tensor: ...


def remembering(friction: Friction | None) -> RememberingFriction | None:
    """The friction model if its coefficients have a memory."""
    if getattr(friction, "state_size", 0) > 0:
        return cast(RememberingFriction, friction)
    return None
