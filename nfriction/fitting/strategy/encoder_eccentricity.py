"""Whether recordings tell that encoders are eccentric: by the evidence of a richer plant."""

import torch
from torch import Tensor

from nfriction.fitting.strategy.continuation import Refinement, Stage
from nfriction.optim.least_squares import Quadratic
from nfriction.plant import PendulumChain, Plant

TERMS = ("encoder_cosine", "encoder_sine")


def may_be_eccentric(plant: Plant) -> bool:
    """Whether the plant's encoders turn with joints."""
    return isinstance(plant, PendulumChain)


def richer_by_evidence(base: Stage, richer: Refinement, tolerance: float) -> Stage | None:
    """The stage with encoder terms where the data ask for them, else None.

    The two plants are compared by their evidence in Laplace's approximation: what the fall of the
    cost is worth, less what the new terms could have said. Errors count as few as they last long.
    A first look predicts the fall from derivatives alone, which saves a search in vain.

    Args:
        base: fit without the terms, at the last window length.
        richer: search whose plant terms are those of `base`, then the encoders'.
        tolerance: of the search, a relative fall of the cost.

    References:
        D. J. C. MacKay, Neural Computation 4 (1992), 415-447.
    """
    extra = len(richer.terms) - len(base.problem.unknowns.terms)
    if not base.noise > 0 or extra < 1:
        return None
    problem = richer.problem(base.problem.windows, base.noise)
    vector = torch.cat([base.vector, torch.zeros(extra, dtype=torch.float64)])
    shared, old = problem.unknowns.shared_count, base.problem.unknowns.shared_count
    added = torch.arange(old, shared)
    start = torch.cat(
        [base.result.x[:old], torch.zeros(extra, dtype=torch.float64), base.result.x[old:]]
    )
    before = problem.quadratic(start)
    lower, upper = problem.unknowns.bounds()
    known = (start > lower) & (start < upper)
    known[added] = False
    both = known.clone()
    both[added] = True
    occam = 0.5 * float(problem.unknowns.prior()[0][added].log().sum())
    occam -= 0.5 * (_log_volume(before, both) - _log_volume(before, known))
    if _newton_fall(before, both) - _newton_fall(before, known) + occam <= 0:
        return None
    stage = richer.search(problem, vector, tolerance, "eccentric encoders", base.zeros)
    gain = float(before.cost) - float(stage.result.cost)
    after = Quadratic(stage.result.cost, stage.result.gradient, stage.result.hessian)
    occam = 0.5 * float(problem.unknowns.prior()[0][added].log().sum())
    occam -= 0.5 * (_log_volume(after, both) - _log_volume(before, known))
    return stage if gain + occam > 0 else None


def _newton_fall(local: Quadratic, chosen: Tensor) -> float:
    """Fall of the cost that its quadratic model promises when the chosen unknowns move."""
    slope = local.gradient[chosen]
    return 0.5 * float(slope @ torch.linalg.lstsq(local.hessian[chosen][:, chosen], slope).solution)


def _log_volume(local: Quadratic, chosen: Tensor) -> float:
    return float(torch.linalg.slogdet(local.hessian[chosen][:, chosen]).logabsdet)
