"""Extrapolation prior: a network is pulled toward its constant law at unvisited motions.

Fuzzy sets are wide: friction learned at the turning points of large swings also affects small
swings, slow and weakly accelerated, which the recordings do not contain.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.friction.coefficients import Schedule
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.signals import Motion


@dataclass(frozen=True, eq=False, repr=False)
class ExtrapolationPrior:
    """Points of the input range at which coefficients are pulled toward the constant law.

    `qd` and `qdd` are (point, joint); `weight` is 1 where no sample is near, otherwise 0; `sd` is
    the expected deviation in units of the coefficients' scale.
    """

    qd: Tensor
    qdd: Tensor
    weight: Tensor
    sd: float = DEFAULTS.unvisited_sd

    @torch.no_grad()
    def residuals(self, schedule: Schedule) -> Tensor:
        """Deviations of a neuro-fuzzy schedule's coefficients in units of `sd`, flattened."""
        network = cast("NeuroFuzzy", schedule)
        deviation = network(self.qd, self.qdd) - network.reference_coefficients()
        return (deviation * self._factor(network)).flatten()

    def normal_equations(self, schedule: Schedule) -> tuple[Tensor, Tensor]:
        """J^T r and J^T J of the residuals with respect to the parameter vector."""
        network = cast("NeuroFuzzy", schedule)
        by, factor = network.sensitivities(self.qd, self.qdd), self._factor(network)
        r = self.residuals(network).view_as(factor)
        slopes, joint = by.parameters, by.joint
        count = len(joint)
        gradient = torch.zeros(count, dtype=torch.float64)
        hessian = torch.zeros(count, count, dtype=torch.float64)
        # No parameter affects two joints.
        for j in range(network.joints):
            own = (joint == j).nonzero().squeeze(-1)
            active = self.weight[:, j] > 0
            rows = (slopes[active][..., own] * factor[active, j, :, None]).flatten(0, 1)
            gradient[own] = r[active, j].flatten() @ rows
            hessian[own[:, None], own] = rows.T @ rows
        return gradient, hessian

    def _factor(self, network: NeuroFuzzy) -> Tensor:
        return self.weight[..., None] / (self.sd * network.scale)


def prior_on_unvisited_cells(
    schedule: NeuroFuzzy, motions: Sequence[Motion], options: FitOptions = DEFAULTS
) -> ExtrapolationPrior:
    """Prior at the points of a schedule's trained range that no motion came near."""
    from scipy.ndimage import binary_dilation  # slow to import

    visits = visit_histogram(schedule, motions, options.cells)
    near = np.stack([binary_dilation(n > 0, iterations=options.visited_radius) for n in visits])
    places = np.arange(options.point_spacing // 2, options.cells, options.point_spacing)
    points = (torch.as_tensor(places, dtype=torch.float64) + 0.5) / options.cells
    velocity, acceleration = torch.cartesian_prod(points, points).unbind(-1)
    lower, upper = schedule.acceleration_lower, schedule.acceleration_upper
    weight = ~near[:, places[:, None], places].reshape(schedule.joints, -1)
    return ExtrapolationPrior(
        velocity[:, None] * schedule.velocity_range,
        lower + acceleration[:, None] * (upper - lower),
        torch.as_tensor(weight.T, dtype=torch.float64),
        options.unvisited_sd,
    )


def visit_histogram(
    schedule: NeuroFuzzy, motions: Sequence[Motion], cells: int
) -> NDArray[np.float64]:
    """Number of samples in each cell of the trained range; samples outside count at its edge.

    Shape (joint, cell of |velocity|, cell of acceleration).
    """
    qd, qdd = (np.concatenate([getattr(m, name) for m in motions]) for name in ("qd", "qdd"))
    if schedule.along_motion:
        # The exact sign: at a turning point the network's smooth one would yield accelerations that
        # the motion never had.
        qdd = np.where(qd < 0, -qdd, qdd)
    lower, upper = (getattr(schedule, f"acceleration_{end}").numpy() for end in ("lower", "upper"))
    speed = np.abs(qd) / schedule.velocity_range.numpy()
    scaled = np.clip(np.stack([speed, (qdd - lower) / (upper - lower)]), 0.0, 1.0)
    edges = [np.linspace(0.0, 1.0, cells + 1)] * 2
    return np.stack([np.histogram2d(v, a, edges)[0] for v, a in np.moveaxis(scaled, -1, 0)])
