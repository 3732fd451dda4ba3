"""Robust losses: outliers, such as spikes of a sensor, count less than their square.

With z = (error / scale)^2, a sample costs scale^2 rho(z) / 2 in place of error^2 / 2, and its
weight in the normal equations is rho'(z). Names and definitions are those of
`scipy.optimize.least_squares`.

References:
    P. J. Huber, Robust Statistics, Wiley (1981), ch. 7.
    P. W. Holland, R. E. Welsch, Communications in Statistics A6 (1977), 813-827 (scales).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.options import Loss
from nfriction.recording import Recording

# Scales in standard deviations of normal noise at which an estimate without outliers needs 5 % more
# samples than least squares.
EFFICIENT: dict[Loss, float] = {"soft_l1": 1.287, "huber": 1.345, "cauchy": 2.385}
# Median of the absolute value of a standard normal variable.
MEDIAN = 0.6745
# Samples with a smaller weight are named.
NAMED_BELOW = 0.5


class Outliers(NamedTuple):
    """Consecutive samples of a joint to which a robust loss gives less than half weight.

    `first` and `last` are times [s], `weight` is the smallest one.
    """

    recording: str
    joint: str
    first: float
    last: float
    weight: float

    def __str__(self) -> str:
        span = f"{self.first:.6g}" + f"-{self.last:.6g}" * (self.last > self.first)
        return f"{self.recording or 'a recording'}, {self.joint} at {span} s"


@dataclass(frozen=True, eq=False)
class RobustLoss:
    """A loss by name, and the error above which it grows less than the square, (joint,)."""

    name: Loss
    scale: Tensor

    @classmethod
    def of_errors(cls, name: Loss, errors: Tensor, least: float) -> "RobustLoss":
        """The loss with the scale of errors (sample, joint), from their median.

        Their standard deviation is taken to be at least `least`.
        """
        sd = errors.abs().median(0).values / MEDIAN
        return cls(name, EFFICIENT[name] * sd.clamp_min(least))

    def weight(self, errors: Tensor) -> Tensor:
        """rho'(z): weight of each error (..., joint), 1 where it is small."""
        if self.name == "linear":
            return torch.ones_like(errors)
        z = (errors / self.scale).square()
        if self.name == "soft_l1":
            return (1 + z).rsqrt()
        return z.clamp_min(1.0).rsqrt() if self.name == "huber" else 1 / (1 + z)

    def counted(self, errors: Tensor) -> Tensor:
        """Errors (..., joint) whose squares are the loss: scale sqrt(rho(z)), with their sign."""
        if self.name == "linear":
            return errors
        z = (errors / self.scale).square()
        if self.name == "soft_l1":
            rho = 2 * z / (1 + (1 + z).sqrt())
        elif self.name == "huber":
            rho = torch.where(z <= 1, z, 2 * z.sqrt() - 1)
        else:
            rho = torch.log1p(z)
        return torch.sign(errors) * self.scale * rho.sqrt()


SQUARES = RobustLoss("linear", torch.ones(()))


def named_outliers(recording: Recording, weight: np.ndarray) -> Iterator[Outliers]:
    """Runs of consecutive samples with a weight (sample, joint) below a half."""
    for name, column in zip(recording.names, weight.T, strict=True):
        low = np.concatenate([[False], column < NAMED_BELOW, [False]])
        turns = np.flatnonzero(low[1:] != low[:-1])
        for first, end in zip(turns[::2], turns[1::2], strict=True):
            begun, ended = recording.time[[first, end - 1]].tolist()
            yield Outliers(recording.name, name, begun, ended, float(column[first:end].min()))


def outlier_warning(outliers: Sequence[Outliers]) -> tuple[str, ...]:
    """The outliers in a sentence, with the times of the three of smallest weight."""
    if not outliers:
        return ()
    least = sorted(outliers, key=lambda o: o.weight)
    more = f" and {len(least) - 3} more" if len(least) > 3 else ""
    return (
        f"The robust loss gives less than half weight to {'; '.join(map(str, least[:3]))}{more} "
        "(`outliers`): errors of the sensor or, if there are many, of the model.",
    )
