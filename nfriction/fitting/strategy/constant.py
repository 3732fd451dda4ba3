"""Constant coefficients: regression on torques first, then shooting windows of growing length."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeGuard

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.data.inputs import adjustable_terms, advanced_torques
from nfriction.fitting.equation_error import TorqueFit, fit_equation_error, prior_sd
from nfriction.fitting.fit import FitTask
from nfriction.fitting.options import Continuity, FitOptions
from nfriction.fitting.plant_parameters import TORQUE_DELAY, PlantParameter
from nfriction.fitting.result.fit_result import (
    FitResult,
    result_from_equation_error,
    result_from_shooting,
)
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.continuation import (
    HorizonResult,
    ShootingFitter,
    horizon_continuation,
    loglik_tolerance,
)
from nfriction.fitting.strategy.multistart import warm_start_from_nested
from nfriction.friction.coefficients import Constant
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import Quadratic
from nfriction.plant import PendulumChain, Plant

TOO_LONG = (
    "Windows of {:g} s were skipped: the motion forgets its start within them, or law or plant are "
    "wrong."
)

LOSSY = (
    "Windows of {:g} s were skipped: they would give parameters that are worse at shorter ones. "
    "Errors of the torque add up over long windows, or law or plant are wrong."
)


def fit_constant(task: FitTask) -> FitResult:
    """Fit constant coefficients, by torques and then by simulated windows."""
    model, options, start = task.model, task.options, task.start
    begun = start.plant if start else task.plant
    torque = regression(task, model, begun)
    if options.method == "equation_error":
        return result_from_equation_error(model, task.plant, start, task.motions, torque)

    def equation_error(plant: Plant) -> Tensor:
        implied = regression(task, model, plant)
        return torch.cat([implied.coefficients[None], implied.starts])

    eccentric = fits_eccentricity(options, start)
    fitter = _fitter(task, model, torque, eccentric)
    friction = torque.coefficients.reshape(-1)
    plant = known_terms(start, fitter.jacobian.terms, task.delay)
    linear = all(c.linear or not c.fitted for c in model.law.coefficients)
    search = horizon_continuation(
        fitter, friction, plant, task.motions, None if linear else equation_error
    )
    if (law := model.law.nested_law) is not None and not search.end.stopped:
        contained = FrictionModel(law, Constant(law, model.joints), model.v_smooth)
        by_torque = regression(task, contained, begun)
        search = warm_start_from_nested(
            search, fitter, _fitter(task, contained, by_torque, eccentric),
            (by_torque.coefficients.reshape(-1), plant), task.motions, equation_error,
        )  # fmt: skip
    found = search.end
    undecided = start is None and options.eccentricity == "auto" and options.fit_plant
    if undecided and isinstance(task.plant, PendulumChain) and not found.stopped:
        richer = _fitter(task, model, torque, eccentric=True)
        tolerance = loglik_tolerance(found.result.cost, options)
        found = richer_by_evidence(found, richer, tolerance) or found
    fitted = result_from_shooting(model, found.problem, found.result, task.motions)
    lengths = zip(options.windows, search.stages, strict=False)
    fitted = replace(
        fitted,
        continuity=options.continuity,
        stages=tuple((float(length), stage.rms) for length, stage in lengths),
        skipped_horizons=search.skipped,
    )
    reason = LOSSY if search.lossy else TOO_LONG
    return fitted.with_warnings([reason.format(length) for length in search.skipped])


def regression(task: FitTask, model: FrictionModel, plant: Plant) -> TorqueFit:
    """Constant coefficients that torques imply on a plant."""
    recordings = advanced_torques(task.recordings, task.delay)
    return fit_equation_error(
        model.law, plant, recordings, task.motions, model.v_smooth, task.options
    )


def _fitter(
    task: FitTask, model: FrictionModel, torque: TorqueFit, eccentric: bool
) -> ShootingFitter:
    options, plant = task.options, task.plant
    terms = adjustable_terms(
        plant, task.recordings, options, eccentric=eccentric, per_recording=task.per_recording
    )
    sd = options.encoder_offset_sd
    shape = (len(task.recordings), plant.joints)
    return ShootingFitter(
        StepJacobian(plant, model, terms), model, task.recordings, task.measurement, options,
        task.callback, friction_prior=constant_prior(model, torque, options),
        offset_sd=torch.full(shape, sd, dtype=torch.float64) if task.per_recording else None,
        defect_sd=options.defect_sd,
    )  # fmt: skip


def constant_prior(
    model: FrictionModel, torque: TorqueFit, options: FitOptions
) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of a law's constant coefficients, each (parameter,)."""
    sd = prior_sd(model.law, torque, options).reshape(-1)
    return torch.zeros_like(sd), sd


def known_terms(
    start: FitResult | None, terms: Sequence[PlantParameter], delay: float = 0.0
) -> Tensor:
    """Plant terms of an earlier fit by name, 0 where it has none but for the delay, (term,)."""
    known = {TORQUE_DELAY: delay}
    if start is not None:
        known |= {name: value for name, value, _ in start.plant_terms}
    return torch.tensor([known.get(t.name, 0.0) for t in terms], dtype=torch.float64)


def fits_eccentricity(options: FitOptions, start: FitResult | None) -> bool:
    """True if a search has encoder terms: `"on"`, or `"auto"` after a fit that has them."""
    terms = start.plant_terms if start else ()
    found = any(name.startswith("encoder ") for name, _, _ in terms)
    return options.eccentricity == "on" or (options.eccentricity == "auto" and found)


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


def _newton_decrease(local: Quadratic, chosen: Tensor) -> float:
    """Decrease of the cost that its quadratic model predicts when the chosen variables move."""
    slope = local.gradient[chosen]
    return 0.5 * float(slope @ torch.linalg.lstsq(local.hessian[chosen][:, chosen], slope).solution)


def _log_volume(local: Quadratic, chosen: Tensor) -> float:
    return float(torch.linalg.slogdet(local.hessian[chosen][:, chosen]).logabsdet)


def is_constant_fit(
    start: FitResult | None, model: FrictionModel, continuity: Continuity = "none"
) -> TypeGuard[FitResult]:
    """True for an output-error fit of the model's law with constant coefficients."""
    return (
        start is not None
        and start.model.law == model.law
        and not start.model.schedule.follows_motion
        and start.residuals.numel() > 0
        and start.continuity == continuity
    )


def constant_start(task: FitTask) -> FitResult:
    """The constant fit of a model's law; `task.start` if it is one of the same recordings."""
    model, start = task.model, task.start
    if is_constant_fit(start, model, task.options.continuity) and _offsets_match(start, task):
        return start
    constant = FrictionModel(model.law, Constant(model.law, model.joints), model.v_smooth)
    return fit_constant(replace(task, model=constant)).with_warnings(task.data_warnings)


def _offsets_match(start: FitResult, task: FitTask) -> bool:
    """True if a fit has encoder offsets of just these recordings, or rightly none."""
    if not task.per_recording:
        return not start.encoder_offsets
    pairs = zip(start.motions, task.motions, strict=False)
    same = all(np.array_equal(a.q, b.q) for a, b in pairs)
    return len(start.encoder_offsets) == len(task.motions) and same
