"""Mechanisms without friction: pendulum chains, positioning axes, published rigs."""

from nfriction.plant import rigs
from nfriction.plant.arm import Arm
from nfriction.plant.axis import LinearAxis
from nfriction.plant.base import Plant
from nfriction.plant.chain import PendulumChain

__all__ = ["Arm", "LinearAxis", "PendulumChain", "Plant", "rigs"]
