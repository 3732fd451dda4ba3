"""Mechanisms without friction: pendulum chains, motors, positioning axes, published rigs."""

from nfriction.plant import rigs
from nfriction.plant.base import LinearAxis, Motor, Plant
from nfriction.plant.chain import Arm, PendulumChain, Rotor

__all__ = ["Arm", "LinearAxis", "Motor", "PendulumChain", "Plant", "Rotor", "rigs"]
