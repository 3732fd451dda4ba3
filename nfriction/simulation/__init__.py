"""Rollouts of plants with friction: compiled, stepped in torch, differentiated."""

from nfriction.simulation.protocols import Friction, Plant, RememberingFriction
from nfriction.simulation.rollouts import Rollout, Scheme, integrate, rollout
from nfriction.simulation.steps import (
    RK4_STABILITY,
    acceleration,
    required_substeps,
    rk4_step,
    stability_limit,
)

__all__ = [
    "RK4_STABILITY",
    "Friction",
    "Plant",
    "RememberingFriction",
    "Rollout",
    "Scheme",
    "acceleration",
    "integrate",
    "required_substeps",
    "rk4_step",
    "rollout",
    "stability_limit",
]
