"""Constant coefficients: first regression on torques, then shooting windows of growing length.

A nonlinear law is fitted from several starts: its own, and two from its nested law.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TypeGuard

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.adjusted_plant import TORQUE_DELAY
from nfriction.fitting.data.inputs import adjustable_terms
from nfriction.fitting.equation_error import TorqueFit
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.of_search import result_from_equation_error, result_from_shooting
from nfriction.fitting.robust_loss import RobustLoss
from nfriction.fitting.shooting.sensitivity import StepJacobian
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
from nfriction.fitting.strategy.further_terms import delay_warning, richer_by_evidence
from nfriction.fitting.strategy.presliding import TRAVELLED, ambiguous_stiffness, presliding_starts
from nfriction.fitting.task import (
    FitTask,
    constant_prior,
    fits_eccentricity,
    known_terms,
    regression,
)
from nfriction.friction.coefficients import Constant
from nfriction.friction.models import FrictionModel
from nfriction.plant import PendulumChain, Plant
from nfriction.signals import Motion

# Causes of skipped windows that a user should know.
SKIPPED = {
    "too long": "the motion is chaotic within them, or law or plant are wrong",
    "lossy": (
        "their parameters would be worse at shorter windows; errors of the torque add up over long "
        "windows, and a wrong law or plant has the same effect"
    ),
}


def fit_constant(task: FitTask) -> FitResult:
    """Fit constant coefficients to torques and then to simulated windows."""
    model, options, start = task.model, task.options, task.start
    begun = start.plant if start else task.plant
    torque = regression(task, model, begun)
    if options.method == "equation_error":
        return result_from_equation_error(model, task.plant, start, task.motions, torque)

    def equation_error(plant: Plant) -> Iterable[Tensor]:
        implied = regression(task, model, plant)
        return with_presliding(torch.cat([implied.coefficients[None], implied.starts]), plant)

    def with_presliding(sliding: Tensor, rig: Plant) -> Iterable[Tensor]:
        if not model.law.memory:
            return sliding
        # Samples of a contact that yields would be mistaken for sliding with less friction.
        apart = regression(task, model, rig, TRAVELLED).coefficients
        return presliding_starts(fitter, sliding, apart, plant, task.motions)

    eccentric = fits_eccentricity(options, start)
    fitter = _fitter(task, model, torque, eccentric)
    plant = _begin(task, fitter, torque)
    friction = next(iter(with_presliding(torque.coefficients[None], begun))).reshape(-1)
    linear = all(c.linear or not c.fitted for c in model.law.coefficients)
    other_starts = None if linear else equation_error
    search = horizon_continuation(fitter, friction, plant, task.motions, other_starts)
    # A nonlinear law may end in a local minimum that its nested law does not have.
    law, lowest = model.law.nested_law, search.reason in ("", "noisy") and search.end.explained
    if law is not None and not (search.end.stopped or lowest):
        contained = FrictionModel(law, Constant(law, model.joints), model.v_smooth)
        by_torque = regression(task, contained, begun)
        nested = _fitter(task, contained, by_torque, eccentric)
        begin = _begin(task, nested, by_torque)
        search = warm_start_from_nested(
            search, fitter, nested, (by_torque.coefficients.reshape(-1), begin), task.motions,
            equation_error,
        )  # fmt: skip
    found = search.end
    # Terms that few rigs need come last, since they could absorb friction that is not yet fitted.
    undecided = start is None and options.eccentricity == "auto" and options.fit_plant
    if undecided and isinstance(task.plant, PendulumChain) and not found.stopped:
        richer = _fitter(task, model, torque, eccentric=True)
        found = richer_by_evidence(found, richer, "eccentric encoders") or found
    ambiguous: list[str] = []
    if "sigma_0" in model.law.names and not found.stopped:
        ambiguous = ambiguous_stiffness(fitter, found, search.stages[0])
    fitted = result_from_shooting(model, found.problem, found.result, task.motions, ambiguous)
    fitted = replace(
        fitted,
        stages=tuple((stage.problem.windows.length, stage.rms) for stage in search.stages),
        skipped_horizons=search.skipped,
    )
    skipped = f"Windows of {' and '.join(f'{length:g}' for length in search.skipped)} s"
    driven = bool(found.problem.windows.tau.any())
    why = SKIPPED.get(search.reason)
    # Motion in two dimensions is not chaotic (Poincare, Bendixson), and no torque adds up errors.
    wrong = bool(why) and task.plant.joints == 1 and not driven
    why = "law or plant are wrong" if wrong else why
    said = [f"{skipped} were skipped: {why}."] if why else []
    if search.reason == "noisy":
        adding = "noise of the torque adds" if driven else "errors below the encoder's noise add"
        noisy = f"{skipped} were not needed: over them {adding} up"
        fitted = replace(fitted, status=f"{fitted.status.rstrip('.')}. {noisy}.")
    if driven and fitted.converged and not (options.fit_delay or task.mistakes):
        with_delay = replace(task, options=replace(options, fit_delay=True))
        rich = len(found.problem.jacobian.terms) > len(fitter.jacobian.terms)
        delayed = _fitter(with_delay, model, torque, eccentric or rich)
        late, biased = delay_warning(found, delayed, fitted.intervals)
        fitted = fitted.with_warnings(late, unmodelled=late if biased else ())
    early = [*_early_torque(task, fitted)]
    return fitted.with_warnings(said + early, unmodelled=(said if wrong else []) + early)


def _early_torque(task: FitTask, fitted: FitResult) -> Iterator[str]:
    """A warning if a wrong law may cause the fitted delay, since no torque acts before its time."""
    # A torque that is held until the next sample acts up to one step late.
    late = -max(recording.sample_time for recording in task.recordings)
    for i in fitted.intervals:
        if i.name == TORQUE_DELAY and i.high < late and not task.leaves_noise(fitted):
            yield (
                f"Positions seem to be recorded {-1e3 * i.value:.2g} ms later than torques: they "
                "may be filtered, but a wrong law or rig has the same effect, and the residual is "
                "above the noise."
            )


def _begin(task: FitTask, fitter: ShootingFitter, torque: TorqueFit) -> Tensor:
    """Plant terms at the start: those of an earlier fit, and offsets that the torques imply."""
    terms, begun = fitter.jacobian.terms, task.start.plant if task.start else task.plant
    begin = known_terms(task.start, terms, task.delay)
    offsets = begun.torque_offset + torque.offset - task.plant.torque_offset
    for k, term in enumerate(terms):
        if "torque_offset" in term.change:
            value = offsets[int(term.change["torque_offset"].argmax())]
            begin[k] = value.clamp(term.lower, term.upper)
    return begin


def _fitter(
    task: FitTask, model: FrictionModel, torque: TorqueFit, eccentric: bool
) -> ShootingFitter:
    options, plant = task.options, task.plant
    terms = adjustable_terms(
        plant, model.law, task.recordings, options, eccentric=eccentric,
        per_recording=task.per_recording,
    )  # fmt: skip
    return ShootingFitter(
        StepJacobian(plant, model, terms), model, task.recordings, task.measurement, options,
        task.callback, friction_prior=constant_prior(model, torque, options),
        offset_sd=task.offset_sd,
    )  # fmt: skip


def is_constant_fit(start: FitResult | None, model: FrictionModel) -> TypeGuard[FitResult]:
    """True for an output-error fit of the model's law with constant coefficients."""
    return (
        start is not None
        and start.model.law == model.law
        and not start.model.schedule.follows_motion
        and start.residuals.numel() > 0
    )


def constant_start(task: FitTask) -> FitResult:
    """The constant fit of a model's law; `task.start` if it is such a fit to these recordings."""
    model, start = task.model, task.start
    if is_constant_fit(start, model) and _same_recordings(start, task):
        return start
    # With its values of coefficients that are not fitted.
    values = model.schedule.coefficient_sets().get("always")
    constant = FrictionModel(model.law, Constant(model.law, model.joints, values), model.v_smooth)
    return fit_constant(replace(task, model=constant)).with_warnings(task.data_warnings)


def _same_recordings(start: FitResult, task: FitTask) -> bool:
    """True if a fit is to exactly these recordings, with encoder offsets only if the task has."""
    pairs = zip(start.motions, task.motions, strict=False)
    same = len(start.motions) == len(task.motions)
    same = same and all(np.array_equal(a.q, b.q) for a, b in pairs)
    return same and bool(start.encoder_offsets) == task.per_recording


def warm_start_from_nested(
    own: Continuation,
    fitter: ShootingFitter,
    nested: ShootingFitter,
    start: tuple[Tensor, Tensor],
    motions: tuple[Motion, ...],
    equation_error: EquationError,
) -> Continuation:
    """The better search of a law: its `own`, or the one from its nested law unless that `loses`.

    `start` are parameters of the nested law, and of the plant; for the rest `horizon_continuation`.
    """
    base = horizon_continuation(nested, *start, motions, of=f", {nested.friction.law.name} law")
    best = best_of_starts(fitter, own.end, base.end, equation_error)
    if best.problem is own.end.problem:
        return own.ending(best)
    longer = best.problem.windows.spans != own.end.problem.windows.spans
    if (longer or len(own.stages) > 1) and not best.stopped and loses(own.stages, best):
        return own
    return Continuation((*own.stages[:-1], best), base.skipped, base.reason)


def best_of_starts(
    fitter: ShootingFitter, own: HorizonResult, nested: HorizonResult, equation_error: EquationError
) -> HorizonResult:
    """The end of a law's own search, or a lower one reached from the end of its nested law.

    A nonlinear law has several minima, and the plant determines which of them the torques lead to.
    So the search is repeated from the coefficients that they imply on the nested law's plant and,
    as long as its residual exceeds the nested law's, from that law itself. Priors guide each
    search; ends are compared only by their residuals. Longer windows win if only the nested law
    could follow them.
    """
    if nested.stopped:
        return own.as_stopped()
    options, law = fitter.options, fitter.friction.law
    windows = nested.problem.windows.starting_at(nested.parts.states)
    # Also as the mean of their prior, which its own stages move in the same way.
    q0, qd0 = windows.initial.chunk(2, -1)
    windows = replace(windows, q0=q0, qd0=qd0)
    same = windows.spans == own.problem.windows.spans
    # If one of the two failed at the longest windows, their residuals cannot be compared.
    if not same and len(windows) >= len(own.problem.windows):
        return own
    # With the larger of the two noises, priors would outweigh the data.
    sizes = (own.noise, nested.noise, own.problem.noise_sd, nested.problem.noise_sd)
    noise = max(min(size for size in sizes if math.isfinite(size)), options.min_noise)
    names = [t.name for t in nested.problem.variables.terms]
    shared = [names.index(t.name) for t in own.problem.variables.terms]
    terms = nested.parts.plant[shared]
    plant = own.problem.plant_at(terms)
    implied = next(iter(equation_error(plant)))
    # Coefficients at which the law equals its nested law.
    embedded = torch.where(torch.tensor([c.linear for c in law.coefficients]), 0.0, implied)
    places = [law.names.index(name) for name in law.nested_coefficients]
    embedded[:, places] = nested.parts.friction.reshape(len(implied), -1)
    if "f_o" in law.names:
        offset = nested.problem.plant_at(nested.parts.plant).torque_offset
        embedded[:, law.names.index("f_o")] = plant.torque_offset - offset
    loss = own.problem.loss
    best, lowest = own, _misfit(own, noise, loss) if same else math.inf
    limit = _misfit(nested, noise, loss)
    tolerance = loglik_tolerance(min(lowest, limit), options)
    for coefficients in (implied, embedded):
        if coefficients is embedded and lowest <= limit:
            break
        problem = fitter.problem(windows, noise, coefficients.reshape(-1))
        start = problem.variables.start(terms, nested.parts.offsets)
        name = f"from the {nested.problem.friction.law.name} law"
        found = fitter.search(problem, start, tolerance, name)
        misfit = _misfit(found, noise, loss)
        surer = found.result.converged and not best.result.converged
        if misfit < lowest * (1 - tolerance) or (surer and misfit < lowest * (1 + tolerance)):
            best, lowest = found, misfit
        if found.stopped:
            return best.as_stopped()
    return best


def _misfit(found: HorizonResult, noise: float, loss: RobustLoss) -> float:
    """Half the sum of squares of residuals, infinite if the motion diverged.

    Stages that are compared must have the same loss.
    """
    problem, x = replace(found.problem, loss=loss), found.result.x
    misfit = weighted_cost(problem.counted_errors(x), noise)
    return misfit if math.isfinite(misfit) else math.inf
