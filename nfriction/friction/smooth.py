"""Smooth maps: to positive numbers, and out of a range."""

import torch
from torch import Tensor


def soft_positive(u: Tensor, roundness: float) -> Tensor:
    """A positive number for every u, and u itself away from zero: `(u + sqrt(u^2 + 4 r^2)) / 2`."""
    return 0.5 * (u + torch.sqrt(u * u + 4.0 * roundness * roundness))


def soft_positive_inverse(y: Tensor, roundness: float) -> Tensor:
    """The u for which `soft_positive(u, roundness)` is y > 0."""
    return y - roundness * roundness / y


def fading(beyond: Tensor, reach: float) -> Tensor:
    """1 within a range and 0 from `reach` outside it on, `(1 - |e|^2 / reach^2)^2` between.

    Args:
        beyond: e, how far each input lies outside, (..., input).
        reach: positive.
    """
    beyond = beyond / reach
    left = (1.0 - (beyond * beyond).sum(-1)).clamp_min(0.0)
    return left * left


def fading_slope(beyond: Tensor, reach: float) -> Tensor:
    """Derivative of `fading` by each input outside its range, (..., input)."""
    beyond = beyond / reach
    left = (1.0 - (beyond * beyond).sum(-1, keepdim=True)).clamp_min(0.0)
    return -4.0 / reach * left * beyond
