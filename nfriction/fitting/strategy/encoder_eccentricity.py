"""Eccentricity of encoders, fitted if the evidence favours it (`eccentricity="auto"`)."""

import torch

from nfriction.fitting.strategy.continuation import HorizonResult, ShootingFitter
from nfriction.optim.least_squares import Quadratic


def richer_by_evidence(
    base: HorizonResult, richer: ShootingFitter, tolerance: float
) -> HorizonResult | None:
    """The stage with encoder terms if the data ask for them, else None.

    The two plants are compared by their evidence in Laplace's approximation: the decrease of the
    cost less the Occam factor of the new terms, with residuals inflated for autocorrelation. A
    first prediction of the decrease from derivatives alone may save the search. The terms of
    `richer` are those of `base`, then the encoders'.

    References:
        D. J. C. MacKay, Neural Computation 4 (1992), 415-447.
    """
    extra = len(richer.jacobian.terms) - len(base.problem.jacobian.terms)
    if not base.noise > 0 or extra < 1:
        return None
    problem = richer.problem(base.problem.windows, base.noise, base.parts.friction)
    variables = problem.variables
    shared, old = variables.shared_count, base.problem.variables.shared_count
    zeros = torch.zeros(extra, dtype=torch.float64)
    at_base = torch.cat([base.result.x[:old], zeros, base.result.x[old:]])
    before = problem.linearise(at_base)
    lower, upper = variables.bounds()
    known = (at_base > lower) & (at_base < upper)
    known[old:shared] = False
    both = known.clone()
    both[old:shared] = True
    log_prior = 0.5 * float(variables.prior()[0][old:shared].log().sum())

    def occam(after: Quadratic) -> float:
        return log_prior - 0.5 * (_log_volume(after, both) - _log_volume(before, known))

    if _newton_decrease(before, both) - _newton_decrease(before, known) + occam(before) <= 0:
        return None
    start = variables.start(torch.cat([base.parts.plant, zeros]), base.parts.offsets)
    found = richer.search(problem, start, tolerance, "eccentric encoders")
    end = found.result
    gain = float(before.cost) - float(end.cost)
    return found if gain + occam(Quadratic(end.cost, end.gradient, end.hessian)) > 0 else None


def _newton_decrease(local: Quadratic, chosen: torch.Tensor) -> float:
    """Decrease of the cost that its quadratic model predicts when the chosen variables move."""
    slope = local.gradient[chosen]
    return 0.5 * float(slope @ torch.linalg.lstsq(local.hessian[chosen][:, chosen], slope).solution)


def _log_volume(local: Quadratic, chosen: torch.Tensor) -> float:
    return float(torch.linalg.slogdet(local.hessian[chosen][:, chosen]).logabsdet)
