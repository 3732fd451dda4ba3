"""Figures from results, as matplotlib figures that need no display: `figure.savefig(path)`."""

from nfriction.plots.errors import horizon_curve, positions, rmse_bars
from nfriction.plots.fits import convergence, torque_over_velocity
from nfriction.plots.fuzzy import coefficient_surfaces, controller_surface, memberships
from nfriction.plots.saving import save_all

__all__ = [
    "coefficient_surfaces",
    "controller_surface",
    "convergence",
    "horizon_curve",
    "memberships",
    "positions",
    "rmse_bars",
    "save_all",
    "torque_over_velocity",
]
