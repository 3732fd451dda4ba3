"""Mechanisms without friction: pendulum chains, positioning axes, published rigs."""

from nfriction.plant import rigs
from nfriction.plant.base import LinearAxis, Plant
from nfriction.plant.chain import Arm, PendulumChain

__all__ = ["Arm", "LinearAxis", "PendulumChain", "Plant", "rigs"]
