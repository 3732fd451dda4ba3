"""Several starts for a nonlinear law: its own, and two from the law that it contains."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from nfriction.fitting.data.windows import Windows
from nfriction.fitting.robust_loss import RobustLoss
from nfriction.fitting.strategy.continuation import (
    Continuation,
    EquationError,
    HorizonResult,
    ShootingFitter,
    horizon_continuation,
    loglik_tolerance,
    loses,
    weighted_cost,
)
from nfriction.friction.laws import Law
from nfriction.signals import Motion


def warm_start_from_nested(
    own: Continuation,
    fitter: ShootingFitter,
    nested: ShootingFitter,
    start: tuple[Tensor, Tensor],
    motions: tuple[Motion, ...],
    equation_error: EquationError,
) -> Continuation:
    """The lowest end of a law, also searched from its nested law, unless it loses by that.

    Args:
        own: search of the law itself.
        fitter, nested: of the law, and of the nested one.
        start: parameters of the nested law, and of the plant.
        motions, equation_error: see `horizon_continuation`.
    """
    stages = f", {nested.friction.law.name} law"
    base = horizon_continuation(nested, *start, motions, of=stages)
    best = best_of_starts(fitter, own.end, base.end, equation_error)
    if best.problem is own.end.problem:
        return own.ending(best)
    longer = best.problem.windows.spans != own.end.problem.windows.spans
    if (longer or len(own.stages) > 1) and not best.stopped and loses(own.stages, best):
        return own
    return Continuation((*own.stages[:-1], best), base.skipped, base.lossy)


def best_of_starts(
    fitter: ShootingFitter,
    own: HorizonResult,
    nested: HorizonResult,
    equation_error: EquationError,
) -> HorizonResult:
    """A law's own end, or a lower one that it reaches from where its nested law ended.

    A nonlinear law has several minima, and the plant decides to which of them the torques lead. So
    it is searched again from the coefficients that they imply on the nested law's plant and, while
    it is above the nested law, from that law itself. Priors guide each search; the ends are
    compared by their residuals alone. Longer windows win where only the nested law could follow
    them.
    """
    if nested.stopped:
        return own.as_stopped()
    windows, options, law = _windows_from(nested), fitter.options, fitter.friction.law
    same = windows.spans == own.problem.windows.spans
    # If one of the two failed at the longest windows, its residuals are no measure.
    if not same and len(windows) >= len(own.problem.windows):
        return own
    # With the larger noise of the two, priors would outweigh the data.
    sizes = (own.noise, nested.noise, own.problem.noise_sd, nested.problem.noise_sd)
    noise = max(min(size for size in sizes if math.isfinite(size)), options.min_noise)
    implied = equation_error(own.problem.plant_at(nested.parts.plant))[0]
    embedded = embed_nested(law, nested.parts.friction.reshape(len(implied), -1), implied)
    loss = own.problem.loss
    best, lowest = own, _misfit(own, noise, loss) if same else math.inf
    limit = _misfit(nested, noise, loss)
    tolerance = loglik_tolerance(min(lowest, limit), options)
    for coefficients in (implied, embedded):
        if coefficients is embedded and lowest <= limit:
            break
        problem = fitter.problem(windows, noise, coefficients.reshape(-1))
        start = problem.variables.start(nested.parts.plant, nested.parts.offsets)
        name = f"from the {nested.problem.friction.law.name} law"
        found = fitter.search(problem, start, tolerance, name)
        misfit = _misfit(found, noise, loss)
        surer = found.result.converged and not best.result.converged
        if misfit < lowest * (1 - tolerance) or (surer and misfit < lowest * (1 + tolerance)):
            best, lowest = found, misfit
        if found.stopped:
            return best.as_stopped()
    return best


def embed_nested(law: Law, nested: Tensor, shapes: Tensor) -> Tensor:
    """Coefficients at which a law equals its nested law, (joint, coefficient).

    Those in which the law is nonlinear are taken from `shapes`.
    """
    linear = torch.tensor([c.linear for c in law.coefficients])
    embedded = torch.where(linear, 0.0, shapes)
    embedded[:, [law.names.index(name) for name in law.nested_coefficients]] = nested
    return embedded


def _windows_from(found: HorizonResult) -> Windows:
    """The windows of a stage at the states that it found, except for those that are known."""
    windows = found.problem.windows
    states = found.problem.variables.split(found.result.x).states
    q0, qd0 = (x.clone() for x in states.chunk(2, -1))
    known = list(windows.at_rest)
    q0[known], qd0[known] = windows.q0[known], windows.qd0[known]
    return replace(windows, q0=q0, qd0=qd0)


def _misfit(found: HorizonResult, noise: float, loss: RobustLoss) -> float:
    """Half the sum of squares of residuals and defects; infinite where the motion diverged.

    All that are compared have the same loss.
    """
    problem, x = replace(found.problem, loss=loss), found.result.x
    defects = 0.5 * float(problem.defects(x).square().sum())
    misfit = weighted_cost(problem.counted_errors(x), noise) + defects
    return misfit if math.isfinite(misfit) else math.inf
