"""Constant coefficients: regression on torques first, then shooting windows of growing length.

A nonlinear law has several starts: its own, and two from the law that it contains.
"""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeGuard

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.data.inputs import adjustable_terms, advanced_torques
from nfriction.fitting.data.windows import Windows
from nfriction.fitting.diagnosis import delay_in_words
from nfriction.fitting.equation_error import (
    TorqueFit,
    fit_equation_error,
    prior_sd,
    steady_law,
)
from nfriction.fitting.options import FitOptions
from nfriction.fitting.plant_parameters import TORQUE_DELAY, PlantParameter
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.of_search import (
    result_from_equation_error,
    result_from_shooting,
    rounding,
)
from nfriction.fitting.robust_loss import RobustLoss
from nfriction.fitting.shooting.problem import ShootingProblem
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
from nfriction.fitting.task import FitTask
from nfriction.friction.coefficients import Constant
from nfriction.friction.laws import Law
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import Quadratic
from nfriction.plant import PendulumChain, Plant
from nfriction.signals import Motion

# Displacements over which a contact yields, over the range of the motion, and ratios of damping to
# stiffness [s]: from what hardly shows to what would be no presliding.
PRESLIDING = tuple(np.geomspace(1e-5, 1.0, 11).tolist())
BRISTLE_TIMES = (1e-4, 1e-3, 1e-2, 1e-1)
# Distance from a reversal, over that range, from where on a contact surely slides.
TRAVELLED = 0.1
# Rises of friction at rest over that at high speed: torques of joints that stick do not show them.
PEAKS = (0.1, 0.3, 1.0)
# Displacements that are searched from where the first leaves more than the encoder's rounding.
MOST_STARTS = 4

# Stiffness and damping of a rival over those found: its contacts relax at once.
STIFFER = (10.0, 0.01)

TOO_LONG = (
    "Windows of {:g} s were skipped: the motion forgets its start within them, or law or plant are "
    "wrong."
)

LATE = (
    "Perhaps {}: with that delay the residual would fall by about {:.0f} %, and coefficients may "
    "move by more than their intervals."
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

    def equation_error(plant: Plant) -> Iterable[Tensor]:
        implied = regression(task, model, plant)
        return with_presliding(torch.cat([implied.coefficients[None], implied.starts]), plant)

    def with_presliding(sliding: Tensor, rig: Plant) -> Iterable[Tensor]:
        if not model.law.memory:
            return sliding
        # Rows of a contact that yields would be taken for sliding, at a smaller friction.
        apart = regression(task, model, rig, TRAVELLED).coefficients
        return presliding_starts(fitter, sliding, apart, plant, task.motions)

    eccentric = fits_eccentricity(options, start)
    fitter = _fitter(task, model, torque, eccentric)
    plant = known_terms(start, fitter.jacobian.terms, task.delay)
    friction = next(iter(with_presliding(torque.coefficients[None], begun))).reshape(-1)
    linear = all(c.linear or not c.fitted for c in model.law.coefficients)
    search = horizon_continuation(
        fitter, friction, plant, task.motions,
        None if linear else equation_error,
    )  # fmt: skip
    # A law with a curved term may end in a local minimum that its nested law does not have.
    if (law := model.law.nested_law) is not None and not search.end.stopped:
        contained = FrictionModel(law, Constant(law, model.joints), model.v_smooth)
        by_torque = regression(task, contained, begun)
        search = warm_start_from_nested(
            search, fitter, _fitter(task, contained, by_torque, eccentric),
            (by_torque.coefficients.reshape(-1), plant), task.motions, equation_error,
        )  # fmt: skip
    found = search.end
    # Terms that few rigs need come last, since they can absorb friction that is not yet fitted.
    undecided = start is None and options.eccentricity == "auto" and options.fit_plant
    if undecided and isinstance(task.plant, PendulumChain) and not found.stopped:
        richer = _fitter(task, model, torque, eccentric=True)
        tolerance = loglik_tolerance(found.result.cost, options)
        found = richer_by_evidence(found, richer, tolerance) or found
    ambiguous: list[str] = []
    if "sigma_0" in model.law.names and not found.stopped:
        ambiguous = ambiguous_stiffness(fitter, found, search.stages[0])
    fitted = result_from_shooting(model, found.problem, found.result, task.motions, ambiguous)
    lengths = zip(options.windows, search.stages, strict=False)
    fitted = replace(
        fitted,
        stages=tuple((float(length), stage.rms) for length, stage in lengths),
        skipped_horizons=search.skipped,
    )
    reason = LOSSY if search.lossy else TOO_LONG
    said = [reason.format(length) for length in search.skipped]
    driven = bool(found.problem.windows.tau.any())
    if driven and found.result.converged and not (options.fit_delay or task.mistakes):
        with_delay = replace(task, options=replace(options, fit_delay=True))
        rich = len(found.problem.jacobian.terms) > len(fitter.jacobian.terms)
        said += delay_warning(found, _fitter(with_delay, model, torque, eccentric or rich))
    return fitted.with_warnings(said)


def regression(task: FitTask, model: FrictionModel, plant: Plant, beyond: float = 0.0) -> TorqueFit:
    """Constant coefficients that torques imply on a plant; see `fit_equation_error`."""
    recordings = advanced_torques(task.recordings, task.delay)
    return fit_equation_error(
        steady_law(model.law), plant, recordings, task.motions, model.v_smooth, task.options, beyond
    )


def presliding_starts(
    fitter: ShootingFitter, sliding: Tensor, apart: Tensor, plant: Tensor,
    motions: tuple[Motion, ...],
) -> Iterator[Tensor]:  # fmt: skip
    """Coefficients of a law with memory to start from, (joint, coefficient), the best first.

    `sliding` are sets of coefficients that torques imply, (set, joint, coefficient), which show how
    a joint slides alone; `apart`, (joint, coefficient), is the first by the torques far from
    reversals, and takes its place where short windows agree better with it. The displacement over
    which its contact yields is sought among shares of the joint's range, its damping among times,
    by the cost of short windows; the rise of friction at rest and its velocity likewise, in turn.
    Several displacements of the first set follow, and the best of every other one where the law has
    no such rise.
    """
    for place, coefficients in enumerate(sliding):
        if place and peaked(fitter.friction.law, coefficients):
            return
        found = _yielding_alike(fitter, coefficients, plant, motions)
        if not place:
            rivals = found, _yielding_alike(fitter, apart, plant, motions)
            found = min(rivals, key=lambda starts: starts[0].rank())
        yield from (start.coefficients for start in found[: 1 if place else MOST_STARTS])


def _yielding_alike(
    fitter: ShootingFitter, coefficients: Tensor, plant: Tensor, motions: tuple[Motion, ...]
) -> "list[_Start]":
    """The best coefficients of every share of the range, least cost of short windows first."""
    law, windows = fitter.friction.law, fitter.cut(motions, fitter.options.windows[0])
    ranges = np.max([np.ptp(m.q, axis=0) for m in motions], axis=0)

    def yields(share: float, time: float, base: Tensor, joints: Sequence[int]) -> _Start:
        trial = base.clone()
        for j in joints:
            trial[j] = yielding(law, base[j], share * float(ranges[j]), time)
        return tried(trial)

    def tried(trial: Tensor) -> _Start:
        problem = fitter.problem(windows, fitter.options.first_noise, trial.reshape(-1))
        return _Start(float(problem.cost(problem.variables.start(plant))), trial)

    def best(joints: Sequence[int], base: Tensor) -> list[_Start]:
        rows = ([yields(s, t, base, joints) for t in BRISTLE_TIMES] for s in PRESLIDING)
        return sorted((min(row, key=_Start.rank) for row in rows), key=_Start.rank)

    # All joints alike first, then each by itself.
    everyone = range(len(coefficients))
    found = best(everyone, coefficients)
    while peaks := [tried(trial) for trial in peaked(law, found[0].coefficients)]:
        peak = min(peaks, key=_Start.rank)
        if not peak.rank() < found[0].rank():
            break
        found = best(everyone, peak.coefficients)
    for j in range(len(coefficients)) if len(coefficients) > 1 else ():
        found = [*best([j], found[0].coefficients)[:1], *found]
    return sorted(found, key=_Start.rank)


class _Start(NamedTuple):
    cost: float
    coefficients: Tensor

    def rank(self) -> float:
        return self.cost if math.isfinite(self.cost) else math.inf


def ambiguous_stiffness(
    fitter: ShootingFitter, found: HorizonResult, stage: HorizonResult
) -> list[str]:
    """Names of stiffness and damping of bristles that the data leave open.

    Presliding below what the encoder resolves has minima of about equal cost at quite different
    stiffness. A search from far stiffer bristles finds another one; where it differs by more than
    a factor of two, and the likelihood does not prefer the first, neither is known; nor where a
    search ended early, and the other one explains the motion to the encoder's rounding.

    Args:
        fitter: of the law.
        found: its end.
        stage: of short windows, whose states hardly trap a search.
    """
    from scipy.special import chdtri  # slow to import

    problem, law = stage.problem, stage.problem.friction.law
    count, tolerance = problem.variables.shared_count, fitter.options.loose_tolerance
    # Terms that only the end may have come last.
    start = torch.cat([found.result.x[:count], stage.result.x[count:]])
    found = fitter.search(problem, start, tolerance, "stiffness")
    places = [law.names.index(name) for name in ("sigma_0", "sigma_1") if name in law.names]
    table = found.parts.friction.reshape(-1, len(law.names)).clone()
    table[:, places] *= torch.tensor(STIFFER[: len(places)])
    lower, upper = problem.friction.schedule.bounds()
    start = torch.cat([table.reshape(-1).clamp(lower, upper), found.result.x[table.numel() :]])
    rival = fitter.search(problem, start, tolerance, "stiffer bristles")
    # The noise of a first stage is a guess.
    lost = float(rival.result.cost - found.result.cost) * (problem.noise_sd / found.noise) ** 2
    # Of searches that ended before a minimum, costs are no likelihoods.
    early = not (found.result.converged and rival.result.converged)
    explained = early and rival.rms <= rounding(problem)
    if not (explained or lost < 0.5 * float(chdtri(len(table) * len(places), 0.05))):
        return []
    apart = (rival.parts.friction / found.parts.friction).log().abs().reshape(table.shape)
    names = problem.friction.schedule.parameter_names(problem.jacobian.plant.joint_names)
    return [
        names[j * table.shape[1] + k]
        for j in range(len(table)) if apart[j, places[0]] > math.log(2.0) for k in places
    ]  # fmt: skip


def peaked(law: Law, coefficients: Tensor) -> list[Tensor]:
    """Coefficients (joint, coefficient) with other rises of the friction at rest."""
    if not {"F_c", "F_d", "v_s"} <= set(law.names):
        return []
    found = []
    coulomb, rise, velocity = (law.names.index(name) for name in ("F_c", "F_d", "v_s"))
    for share, v_s in itertools.product(PEAKS, law.coefficients[velocity].initial_grid):
        trial = coefficients.clone()
        trial[:, rise], trial[:, velocity] = share * trial[:, coulomb], v_s
        found.append(trial)
    return found


def yielding(law: Law, coefficients: Tensor, displacement: float, time: float) -> Tensor:
    """Coefficients of one joint that slides alike, but yields over a displacement before.

    `time` is the ratio of the damping of a bristle to its stiffness [s]. Laws that name their
    coefficients otherwise stay as they are.
    """
    values = dict(zip(law.names, coefficients.tolist(), strict=True))
    widths = [name for name in values if name.startswith("d_") and f"k{name[1:]}" in values]
    if {"sigma_0", "F_c"} <= values.keys():
        values["sigma_0"] = values["F_c"] / max(displacement, 1e-12)
        values["sigma_1"] = time * values["sigma_0"]
    elif widths:
        scale = displacement / max(values[name] for name in widths)
        for name in widths:
            values[name] *= scale
            values["k" + name[1:]] /= scale
    found = torch.tensor([values[name] for name in law.names], dtype=torch.float64)
    lower, upper = Constant(law, 1, found).bounds()
    return found.clamp(lower, upper)


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
    further = _FurtherTerms.of(base, richer)
    # The prediction costs one step, the search it may save costs a whole fit.
    if further is None or further.predicted_gain() <= 0:
        return None
    problem, before = further.problem, further.before
    zeros = torch.zeros(further.count, dtype=torch.float64)
    start = problem.variables.start(torch.cat([base.parts.plant, zeros]), base.parts.offsets)
    found = richer.search(problem, start, tolerance, "eccentric encoders")
    end = found.result
    gain = float(before.cost) - float(end.cost)
    better = gain + further.occam(Quadratic(end.cost, end.gradient, end.hessian)) > 0
    return found if better else None


def delay_warning(found: HorizonResult, delayed: ShootingFitter) -> list[str]:
    """A sentence on the delay between torques and positions that the data ask for, if any.

    By derivatives alone: a delay below a sample hardly shows in the balance of torques, but it
    biases coefficients by more than their intervals.
    """
    further = _FurtherTerms.of(found, delayed)
    if further is None or further.predicted_gain() <= 0:
        return []
    delay = float(further.step()[further.first])
    fall = 1.0 - max(0.0, 1.0 - further.decrease() / float(further.before.cost)) ** 0.5
    return [LATE.format(delay_in_words(delay), 100 * fall)]


@dataclass(frozen=True)
class _FurtherTerms:
    """Local model of a stage with further plant terms, which begin at 0 behind its own."""

    problem: ShootingProblem
    before: Quadratic
    first: int
    count: int
    # Variables that may move, without and with the further terms.
    known: Tensor
    both: Tensor

    @classmethod
    def of(cls, base: HorizonResult, richer: ShootingFitter) -> "_FurtherTerms | None":
        count = len(richer.jacobian.terms) - len(base.problem.jacobian.terms)
        if not base.noise > 0 or count < 1:
            return None
        problem = richer.problem(base.problem.windows, base.noise, base.parts.friction)
        first = base.problem.variables.shared_count
        zeros = torch.zeros(count, dtype=torch.float64)
        at_base = torch.cat([base.result.x[:first], zeros, base.result.x[first:]])
        lower, upper = problem.variables.bounds()
        # Variables at a bound cannot move, so they take no volume of the posterior.
        known = (at_base > lower) & (at_base < upper)
        known[first : first + count] = False
        both = known.clone()
        both[first : first + count] = True
        return cls(problem, problem.linearise(at_base), first, count, known, both)

    def occam(self, after: Quadratic) -> float:
        """Logarithm of the Occam factor of the further terms."""
        precision = self.problem.variables.prior()[0][self.first : self.first + self.count]
        volume = _log_volume(after, self.both) - _log_volume(self.before, self.known)
        return 0.5 * (float(precision.log().sum()) - volume)

    def step(self) -> Tensor:
        """Gauss-Newton step with the further terms, (variable,)."""
        step = torch.zeros_like(self.before.gradient)
        step[self.both] = -_newton_step(self.before, self.both)
        return step

    def decrease(self) -> float:
        """Decrease of the cost by the further terms that derivatives predict."""
        return _newton_decrease(self.before, self.both) - _newton_decrease(self.before, self.known)

    def predicted_gain(self) -> float:
        """Gain of the log evidence that derivatives predict."""
        return self.decrease() + self.occam(self.before)


def _newton_step(local: Quadratic, chosen: Tensor) -> Tensor:
    slope = local.gradient[chosen]
    return torch.linalg.lstsq(local.hessian[chosen][:, chosen], slope).solution


def _newton_decrease(local: Quadratic, chosen: Tensor) -> float:
    """Decrease of the cost that its quadratic model predicts when the chosen variables move."""
    return 0.5 * float(local.gradient[chosen] @ _newton_step(local, chosen))


def _log_volume(local: Quadratic, chosen: Tensor) -> float:
    return float(torch.linalg.slogdet(local.hessian[chosen][:, chosen]).logabsdet)


def is_constant_fit(start: FitResult | None, model: FrictionModel) -> TypeGuard[FitResult]:
    """True for an output-error fit of the model's law with constant coefficients."""
    return (
        start is not None
        and start.model.law == model.law
        and not start.model.schedule.follows_motion
        and start.residuals.numel() > 0
    )


def constant_start(task: FitTask) -> FitResult:
    """The constant fit of a model's law; `task.start` if it is one of the same recordings."""
    model, start = task.model, task.start
    if is_constant_fit(start, model) and _offsets_match(start, task):
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
    implied = next(iter(equation_error(own.problem.plant_at(nested.parts.plant))))
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
    joints = windows.q0.shape[-1]
    q0, qd0 = (x.clone() for x in states[:, : 2 * joints].chunk(2, -1))
    known = list(windows.at_rest)
    q0[known], qd0[known] = windows.q0[known], windows.qd0[known]
    return replace(windows, q0=q0, qd0=qd0)


def _misfit(found: HorizonResult, noise: float, loss: RobustLoss) -> float:
    """Half the sum of squares of residuals; infinite where the motion diverged.

    All that are compared have the same loss.
    """
    problem, x = replace(found.problem, loss=loss), found.result.x
    misfit = weighted_cost(problem.counted_errors(x), noise)
    return misfit if math.isfinite(misfit) else math.inf
