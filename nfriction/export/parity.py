"""Parity of an artefact with its model: torque, coefficients and status over many samples."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from nfriction.export.errors import ContractError

# Coefficients come out of longer sums than the torque, some of them small differences.
COEFFICIENT_SLACK = 20.0


@dataclass(frozen=True)
class Parity:
    """Largest differences of an artefact from its model.

    Attributes:
        points: samples compared.
        torque_error: largest |difference| of the torque over the largest |torque| of the joint.
        coefficient_error: the same of the coefficients, over the largest of each coefficient.
        edges: samples whose status, or whose NaN, are not those of the model.
        tolerance: largest torque error allowed; the coefficients have 20 times that.
    """

    points: int
    torque_error: float
    coefficient_error: float
    edges: int
    tolerance: float

    @property
    def passed(self) -> bool:
        """True where all of it is within tolerance."""
        return (
            self.points > 0
            and self.torque_error <= self.tolerance
            and self.coefficient_error <= COEFFICIENT_SLACK * self.tolerance
            and not self.edges
        )

    def __str__(self) -> str:
        return (
            f"{self.points} points: torque {self.torque_error:.1e} and coefficients "
            f"{self.coefficient_error:.1e} of full scale, {self.edges} wrong at the edges "
            f"(tolerance {self.tolerance:.0e})"
        )


def compare(expected: Sequence[Any], found: Sequence[Any], tolerance: float) -> Parity:
    """Compare torque, coefficients and status with those of the model.

    Args:
        expected, found: torque (sample, joint), coefficients (sample, joint, coefficient) and
            status (sample, joint).
        tolerance: see `Parity`.

    Raises:
        ContractError: if the shapes differ.
    """
    model, artefact = ([_array(x) for x in side] for side in (expected, found))
    shapes = [[x.shape for x in side] for side in (model, artefact)]
    if shapes[0] != shapes[1]:
        raise ContractError(f"the artefact gives shapes {shapes[1]}, the model {shapes[0]}.")
    wrong = model[2] != artefact[2]
    wrong |= np.isnan(model[0]) != np.isnan(artefact[0])
    wrong |= (np.isnan(model[1]) != np.isnan(artefact[1])).any(-1)
    return Parity(
        points=len(model[0]),
        torque_error=_error(model[0], artefact[0], axis=(0,)),
        coefficient_error=_error(model[1], artefact[1], axis=(0, 1)),
        edges=int(wrong.sum()),
        tolerance=tolerance,
    )


def _error(expected: np.ndarray, found: np.ndarray, axis: tuple[int, ...]) -> float:
    """Largest difference over the largest value along `axis`; where either is NaN is not seen."""
    difference = np.nan_to_num(np.abs(found - expected), nan=0.0, posinf=math.inf)
    scale = np.nan_to_num(np.abs(expected), nan=0.0).max(axis, initial=0.0)
    worst = difference.max(axis, initial=0.0)
    return float(np.where(worst > 0, worst / np.maximum(scale, 1e-300), 0.0).max(initial=0.0))


def _array(x: Any) -> np.ndarray:
    return np.asarray(x.detach().cpu() if isinstance(x, Tensor) else x, dtype=np.float64)
