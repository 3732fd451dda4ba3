"""Anchors of a network: it is held to its constant law at motions that recordings never came near.

Fuzzy sets reach far: what they learn of friction at the turning points of large swings they also
say of small swings, slow and weakly accelerated, of which the recordings tell nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from torch import Tensor

from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.signals import Motion

# Cells along each input, how many of them a sample vouches for around its own, and at every how
# many-th one a network is held where none does.
CELLS, NEAR, SPACING = 60, 5, 5
# By how much coefficients may deviate there, in units of their scale.
ANCHOR_SD = 0.2


@dataclass(frozen=True, eq=False, repr=False)
class Anchors:
    """Motions of each joint, and where its coefficients are held to those of the constant law.

    Attributes:
        qd, qdd: velocity and acceleration, (point, joint).
        weight: 1 where no sample came near, else 0, (point, joint).
    """

    qd: Tensor
    qdd: Tensor
    weight: Tensor

    @torch.no_grad()
    def residuals(self, schedule: NeuroFuzzy) -> Tensor:
        """Deviation of the coefficients over what is expected, in one row."""
        deviation = schedule(self.qd, self.qdd) - schedule.reference_coefficients()
        return (deviation * self._factor(schedule)).flatten()

    def normal_equations(self, schedule: NeuroFuzzy) -> tuple[Tensor, Tensor]:
        """J^T r and J^T J of the residuals, over the parameter vector."""
        by, factor = schedule.sensitivities(self.qd, self.qdd), self._factor(schedule)
        r = self.residuals(schedule).view_as(factor)
        slopes, count = by.parameters, len(by.joint)
        gradient = torch.zeros(count, dtype=torch.float64)
        hessian = torch.zeros(count, count, dtype=torch.float64)
        # No parameter acts on two joints.
        for j in range(schedule.joints):
            own = (by.joint == j).nonzero().squeeze(-1)
            held = self.weight[:, j] > 0
            rows = (slopes[held][..., own] * factor[held, j, :, None]).flatten(0, 1)
            gradient[own] = r[held, j].flatten() @ rows
            hessian[own[:, None], own] = rows.T @ rows
        return gradient, hessian

    def _factor(self, schedule: NeuroFuzzy) -> Tensor:
        return self.weight[..., None] / (ANCHOR_SD * schedule.scale)


def anchors_where_unseen(schedule: NeuroFuzzy, motions: Sequence[Motion]) -> Anchors:
    """Where in a schedule's trained range motions never came near.

    Args:
        schedule: with its range set.
        motions: smoothed, in joint coordinates.
    """
    near = np.stack(
        [binary_dilation(n > 0, iterations=NEAR) for n in visits(schedule, motions, CELLS)]
    )
    places = np.arange(SPACING // 2, CELLS, SPACING)
    points = (torch.as_tensor(places, dtype=torch.float64) + 0.5) / CELLS
    velocity, acceleration = torch.cartesian_prod(points, points).unbind(-1)
    lower, upper = schedule.acceleration_lower, schedule.acceleration_upper
    weight = ~near[:, places[:, None], places].reshape(schedule.joints, -1)
    return Anchors(
        velocity[:, None] * schedule.velocity_range,
        lower + acceleration[:, None] * (upper - lower),
        torch.as_tensor(weight.T, dtype=torch.float64),
    )


def visits(schedule: NeuroFuzzy, motions: Sequence[Motion], cells: int) -> NDArray[np.float64]:
    """Samples in each cell of the trained range, those outside in the edge's.

    Returns:
        Shape (joint, cell of |velocity|, cell of acceleration).
    """
    qd, qdd = (np.concatenate([getattr(m, name) for m in motions]) for name in ("qd", "qdd"))
    if schedule.along_motion:
        # Not the network's own passage: at a turning point it runs through accelerations that the
        # motion never had.
        qdd = np.where(qd < 0, -qdd, qdd)
    lower, upper = (getattr(schedule, f"acceleration_{end}").numpy() for end in ("lower", "upper"))
    speed = np.abs(qd) / schedule.velocity_range.numpy()
    scaled = np.clip(np.stack([speed, (qdd - lower) / (upper - lower)]), 0.0, 1.0)
    edges = [np.linspace(0.0, 1.0, cells + 1)] * 2
    return np.stack([np.histogram2d(v, a, edges)[0] for v, a in np.moveaxis(scaled, -1, 0)])
