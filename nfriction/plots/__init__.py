"""Figures from results, as matplotlib figures that need no display: `figure.savefig(path)`.

They are as wide as one or both columns of a paper; `figure.set_figwidth(inches)` changes that.
"""

from nfriction.plots.comparison import (
    coefficient_intervals,
    horizon_curve,
    motion,
    positions,
    rmse_bars,
    save_all,
)
from nfriction.plots.drawing import animate, mechanism
from nfriction.plots.friction_torque import friction_curves, torque_over_velocity
from nfriction.plots.neurofuzzy import (
    coefficient_sections,
    coefficient_surfaces,
    coefficients_over_time,
    memberships,
)

__all__ = [
    "animate", "coefficient_intervals", "coefficient_sections", "coefficient_surfaces",
    "coefficients_over_time", "friction_curves",
    "horizon_curve", "mechanism", "memberships", "motion", "positions", "rmse_bars", "save_all",
    "torque_over_velocity",
]  # fmt: skip
