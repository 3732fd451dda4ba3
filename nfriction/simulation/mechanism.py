"""Plant and friction as one module, and whether all that moves it can be seen."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from nfriction.friction.coefficients import Schedule
from nfriction.friction.models import FrictionModel
from nfriction.simulation.compiled import NoFriction
from nfriction.simulation.protocols import remembering
from nfriction.simulation.rk4 import acceleration


class Mechanism(nn.Module):
    """Plant and friction as one module whose tensors can be exchanged for a call."""

    def __init__(self, plant: nn.Module, friction: nn.Module) -> None:
        super().__init__()
        self.plant = cast(Any, plant)
        self.friction = cast(Any, friction)

    def forward(self, function: Callable[..., Any], *args: Any) -> Any:
        return function(self.plant, self.friction, *args)

    def tensors(self) -> dict[str, Tensor]:
        """Parameters and floating-point buffers by name."""
        named = (*self.named_parameters(), *self.named_buffers())
        return {name: t for name, t in named if t.is_floating_point()}

    def is_local(self) -> bool:
        """Whether a joint's coefficients follow that joint's motion alone, as schedules promise."""
        return isinstance(getattr(self.friction, "schedule", None), Schedule)

    def has_slopes(self) -> bool:
        """Whether such a schedule tells its coefficients' derivatives by the motion itself."""
        return self.is_local() and hasattr(self.friction.schedule, "slopes")

    def has_plant_slopes(self) -> bool:
        """Whether the plant tells its own derivatives, and the friction is a law's, elementwise."""
        told = getattr(self.plant, "has_slopes", None)
        lawful = getattr(type(self.friction), "torque", None) is FrictionModel.torque
        return lawful and self.is_local() and told is not None and told()

    def plant_asks(self, tensors: Mapping[str, Tensor]) -> bool:
        """Whether the plant's own tensors are differentiated by, of these in place of them."""
        return any(t.requires_grad for name, t in tensors.items() if name.startswith("plant."))

    def is_closed(self, q: Tensor, qd: Tensor, tau: Tensor) -> bool:
        """Whether gradients can flow to nothing but the states and this module's own tensors."""
        own = {n: t.detach().requires_grad_(t.requires_grad) for n, t in self.tensors().items()}
        with torch.enable_grad():
            given = [x.detach().expand_as(q).requires_grad_() for x in (q, qd, tau)]
            found = torch.func.functional_call(self, own, (_sample, *given))
        known = {id(t) for t in (*own.values(), *given)}
        return all(id(leaf) in known for leaf in _leaves(found))


def _sample(plant: Any, friction: Any, q: Tensor, qd: Tensor, tau: Tensor) -> tuple[Tensor, Tensor]:
    """Coefficients and acceleration of a state; its torque stands for the acceleration."""
    held = friction.coefficients(qd, tau)
    return held, acceleration(plant, friction, q, qd, tau, held)


def _leaves(outputs: Sequence[Tensor]) -> list[Tensor]:
    """Tensors at which the graph of `outputs` ends."""
    nodes = [y.grad_fn for y in outputs if y.grad_fn is not None]
    seen, leaves = set(nodes), []
    while nodes:
        node = nodes.pop()
        if hasattr(node, "variable"):
            leaves.append(node.variable)
        for after, _ in node.next_functions:
            if after is not None and after not in seen:
                seen.add(after)
                nodes.append(after)
    return leaves


def mechanism_of(
    plant: Any,
    friction: Any,
    q0: Tensor,
    qd0: Tensor,
    tau: Tensor,
    step: Tensor,
    measured: tuple[Tensor, Tensor] | None,
) -> Mechanism | None:
    """What `differentiable` needs, or None where a gradient would miss something.

    Arguments as there; memory, a sample time or a measured motion with gradients, and modules that
    read tensors which are not theirs, have to be recorded step by step.
    """
    friction = NoFriction(plant.joints) if friction is None else friction
    if not (isinstance(plant, nn.Module) and isinstance(friction, nn.Module)):
        return None
    if remembering(cast(Any, friction)) or any(x.requires_grad for x in (step, *(measured or ()))):
        return None
    mechanism = Mechanism(plant, friction)
    return mechanism if mechanism.is_closed(q0, qd0, tau[..., 0, :]) else None
