"""Neuro-fuzzy coefficients: a network that corrects a constant law, kept if it passes hold-out."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.data.checks import require_motion
from nfriction.fitting.data.inputs import adjustable_terms, apply_encoder_offsets
from nfriction.fitting.equation_error import coefficient_scale
from nfriction.fitting.fit import FitTask
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.result.fit_result import FitResult, result_from_shooting
from nfriction.fitting.result.identifiability import information
from nfriction.fitting.shooting.autocorrelation import (
    correlation_time,
    decimation,
    effective_noise,
)
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.shooting.variables import model_at
from nfriction.fitting.strategy.constant import (
    constant_prior,
    constant_start,
    fits_eccentricity,
    known_terms,
    regression,
)
from nfriction.fitting.strategy.continuation import (
    HorizonResult,
    ShootingFitter,
    loglik_tolerance,
    weighted_cost,
)
from nfriction.fitting.strategy.extrapolation_prior import prior_on_unvisited_cells
from nfriction.fitting.strategy.holdout import HoldoutScore, holdout_rmse, holdout_split
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.optim.evidence import GroupEvidence, group_evidence
from nfriction.recording import Recording
from nfriction.signals import Motion

# Consequents and head weights, the first groups of a network.
LINEAR_GROUPS = 2
# Share of a prior's width that holds a parameter where it is: no search feels what remains.
HELD = 1e-6
# Log ratio of evidences below which a hypothesis gains nothing worth mentioning (H. Jeffreys,
# Theory of Probability, 3rd ed. 1961, appendix B).
WORTH_MENTIONING = 0.5 * math.log(10.0)
INTERRUPTED = "Stopped before the network was found; its constant law is kept."


def fit_neurofuzzy(task: FitTask) -> FitResult:
    """Fit a neuro-fuzzy model from the constant fit of its law, see `fit`."""
    require_motion(task.plant, task.recordings)
    options, start = task.options, constant_start(task)
    law_prior = constant_prior(start.model, regression(task, start.model, task.plant), options)
    recordings, motions = apply_encoder_offsets(
        start.encoder_offsets, task.plant, task.recordings, task.motions
    )
    network = initialise_from_constant(task.model, start, recordings, motions, options)
    schedule = cast("NeuroFuzzy", network.schedule)
    terms = adjustable_terms(
        task.plant, recordings, options, eccentric=fits_eccentricity(options, start),
        per_recording=bool(start.encoder_offsets),
    )  # fmt: skip
    plant_sd = torch.tensor([t.prior_sd for t in terms], dtype=torch.float64)
    free = ShootingFitter(
        StepJacobian(task.plant, network, terms), network, recordings, task.measurement, options,
        task.callback, plant_prior=(known_terms(start, terms), plant_sd),
        # From smoothed states at full length a search creeps along constraints.
        defect_sd=None if options.continuity == "none" else options.penalty_sd,
        extrapolation=prior_on_unvisited_cells(schedule, motions, options),
    )  # fmt: skip
    law = replace(free, friction=start.model, friction_prior=law_prior, extrapolation=None)
    validation = _Validation(law, start, motions, start.longest_usable_horizon(options.windows))
    best = validation.best_trial(_with_narrowed_priors(free, start))
    if best is None:
        found = _constant_kept(task, network, start, INTERRUPTED, converged=False)
    elif best.score.score > 1:
        found = _constant_kept(task, network, start, str(best.score))
    else:
        end = validation.fit_all(best)
        found = result_from_shooting(task.model, end.problem, end.result, motions)
        found = replace(found, effective_parameters=effective_parameters(end))
    found = replace(
        found, motions=task.motions, encoder_offsets=start.encoder_offsets,
        continuity=options.continuity, skipped_horizons=start.skipped_horizons,
    )  # fmt: skip
    return found.with_warnings(start.data_warnings)


def input_range(
    motions: Sequence[Motion], along_motion: bool, options: FitOptions = DEFAULTS
) -> tuple[Tensor, Tensor]:
    """Largest |velocity| of motions, (joint,), and limits of their acceleration, (joint, 2)."""
    qd, qdd = (np.concatenate([getattr(m, name) for m in motions]) for name in ("qd", "qdd"))
    along = qdd * np.sign(qd) if along_motion else qdd
    limits = np.quantile(along, options.acceleration_quantiles, axis=0)
    return torch.as_tensor(np.abs(qd).max(0)), torch.as_tensor(limits.T)


def initialise_from_constant(
    model: FrictionModel,
    constant: FitResult,
    recordings: Sequence[Recording],
    motions: Sequence[Motion],
    options: FitOptions = DEFAULTS,
) -> FrictionModel:
    """A copy of a neuro-fuzzy model at a constant fit of its law, over the range of the motion.

    Its network is silent, its sets where the model has them; recordings and motions are in joint
    coordinates.
    """
    network = copy.deepcopy(model)
    schedule = cast("NeuroFuzzy", network.schedule)
    scale = coefficient_scale(model, constant.plant, recordings, motions)
    schedule.set_range(*input_range(motions, schedule.along_motion, options))
    schedule.set_reference(constant.model.schedule.coefficient_sets()["always"], scale)
    schedule.silence()
    return network


def revert_to_constant(
    model: FrictionModel, constant: FitResult, options: FitOptions = DEFAULTS
) -> None:
    """Set a neuro-fuzzy model to a constant fit of its law; coefficients of zero stay so."""
    schedule = cast("NeuroFuzzy", model.schedule)
    values = constant.model.schedule.coefficient_sets()["always"]
    schedule.set_reference(values, schedule.scale, options.zero_reference)
    schedule.silence()


def network_evidence(end: HorizonResult) -> GroupEvidence:
    """Evidence for the prior of each group of a network's parameters, relative to the present one.

    Of the marginal Gauss-Newton model: window states are integrated out, the plant's terms and the
    prior on unvisited motion are known priors beside those of the groups.
    """
    problem, x = end.problem, end.result.x
    variables = problem.variables
    schedule = cast("NeuroFuzzy", model_at(problem.friction, end.parts.friction).schedule)
    shared, count = variables.shared_count, variables.friction_count
    precision, mean = variables.prior()
    data = information(end.result.hessian, precision, shared).data
    known = torch.diag(precision[:shared])
    known[:count, :count] = 0.0
    if problem.extrapolation is not None:
        known[:count, :count] = problem.extrapolation.normal_equations(schedule)[1]
        data = data - known.where(torch.arange(shared)[:, None].lt(count), 0.0)
    groups = torch.full((shared,), -1)
    groups[:count] = schedule.groups()
    # In units of the present prior, in which every precision is one.
    sd = precision[:shared].rsqrt()
    data, known = (sd[:, None] * part * sd for part in (data, known))
    lower, upper = (bound[:shared] for bound in variables.bounds())
    fitted = (lower < upper).nonzero().flatten()
    values, vectors = torch.linalg.eigh(data[fitted][:, fitted])
    # Less than none is the rounding of states that grow by orders of magnitude.
    data = (vectors * values.clamp_min(0.0)) @ vectors.T
    offset = ((x - mean)[:shared] / sd)[fitted]
    ones = torch.ones(len(schedule.group_names()), dtype=torch.float64)
    return group_evidence(data, known[fitted][:, fitted], offset, groups[fitted], ones)


def log_evidence(end: HorizonResult) -> float:
    """Log evidence of a search's end, comparable at one noise; -inf where it is not finite."""
    if not torch.isfinite(end.result.hessian).all():
        return -math.inf
    return network_evidence(end).occam - float(end.result.cost)


def effective_parameters(end: HorizonResult) -> tuple[tuple[str, float, int], ...]:
    """Name of each group of a network, how many parameters the data determine, and its size."""
    schedule = cast("NeuroFuzzy", end.problem.friction.schedule)
    if not torch.isfinite(end.result.hessian).all():
        return ()
    gamma = network_evidence(end).gamma.tolist()
    sizes = schedule.groups().bincount().tolist()
    return tuple(zip(schedule.group_names(), gamma, sizes, strict=True))


def _with_narrowed_priors(free: ShootingFitter, start: FitResult) -> tuple[ShootingFitter, ...]:
    """Fitters with ever wider priors of the plant: the posterior sd of the constant fit first.

    Within the recorded motion plant and network can compensate each other; outside, where the
    network fades, such a plant is wrong.
    """
    assert free.plant_prior is not None
    mean, sd = free.plant_prior
    posterior = {i.name: i.sd for i in start.intervals}
    narrow = sd.new_tensor([posterior.get(t.name, math.inf) for t in free.jacobian.terms])
    narrow = torch.minimum(sd, narrow)
    near = replace(free, plant_prior=(mean, narrow))
    return (near,) if torch.equal(narrow, sd) else (near, free)


@dataclass(frozen=True)
class _Trial:
    """A network trained on some windows, its score on the others, and its priors."""

    score: HoldoutScore
    fitter: ShootingFitter
    end: HorizonResult


class _Validation:
    """Networks judged against a constant law on hold-out windows of one length [s]."""

    def __init__(
        self, law: ShootingFitter, start: FitResult, motions: tuple[Motion, ...], length: float
    ) -> None:
        assert law.plant_prior is not None
        self.law, self.motions, self.length, self.options = law, motions, length, law.options
        self.plant = law.plant_prior[0]
        self.train, self.test = holdout_split(law.recordings, motions, length, self.options.folds)
        # The noise against which the priors weigh is the residual of the constant law at the same
        # horizon; its cost scales the tolerance.
        self.noise = effective_noise(start.residuals)
        self.stride = decimation(start.residuals, self.options)
        cost = weighted_cost(start.residuals, self.noise)
        self.tolerance = loglik_tolerance(cost, self.options)

    def best_trial(self, fitters: Sequence[ShootingFitter]) -> _Trial | None:
        """The best of all priors; wider plant priors must earn their place. None if stopped."""
        values = self.law.friction.schedule.parameter_vector()
        same = self._search(self.law, values, "constant law, hold-out")
        of_same = self._error(same)
        if of_same is None:
            return None
        of_all = holdout_rmse(self.test, same.problem, values, self.plant)
        if of_all is None:
            return None
        best: _Trial | None = None
        for fitter in fitters:
            trial = self._trial(fitter, of_same, of_all)
            if trial is None:
                return None
            limit = math.inf if best is None else self.options.max_ratio_same * best.score.score
            if best is None or trial.score.score < limit:
                best = trial
        return best

    def fit_all(self, trial: _Trial) -> HorizonResult:
        """The network of a trial, fitted to all windows."""
        windows = trial.fitter.cut(self.motions, self.length)
        problem = trial.fitter.problem(
            windows, trial.end.problem.noise_sd, trial.end.parts.friction, stride=self.stride
        )
        start = problem.variables.start(trial.end.parts.plant)
        return trial.fitter.search(problem, start, self.tolerance, f"{self.length:g} s windows")

    def _trial(self, fitter: ShootingFitter, of_same: float, of_all: float) -> _Trial | None:
        """A network that starts silent, its sets moved if the evidence favours that."""
        schedule = cast("NeuroFuzzy", fitter.friction.schedule)
        mean, sd = schedule.prior()
        linear = schedule.groups() < LINEAR_GROUPS
        held = replace(fitter, friction_prior=(mean, torch.where(linear, sd, HELD * sd)))
        fitter, end = self._learn(held, self._search(held, mean, "network, hold-out"))
        if schedule.learn_sets and not end.stopped:
            assert fitter.friction_prior is not None
            learnt = torch.where(linear, fitter.friction_prior[1], sd)
            moved = replace(fitter, friction_prior=(mean, learnt))
            # At the same noise, or the evidence would compare different errors.
            noise = end.problem.noise_sd
            moved, other = self._learn(moved, self._go_on(moved, end, noise), noise)
            if other.stopped:
                return None
            if log_evidence(other) > log_evidence(end) + WORTH_MENTIONING:
                fitter, end = self._learn(moved, other)
        error = self._error(end)
        if error is None:
            return None
        ratios = [error / law if math.isfinite(error) else math.inf for law in (of_same, of_all)]
        return _Trial(HoldoutScore(ratios[0], ratios[1], self.options), fitter, end)

    def _learn(
        self, fitter: ShootingFitter, end: HorizonResult, noise: float | None = None
    ) -> tuple[ShootingFitter, HorizonResult]:
        """Priors of a network's groups by evidence, and its noise if none is given."""
        for _ in range(self.options.evidence_updates):
            if end.stopped or not torch.isfinite(end.result.hessian).all():
                break
            found = network_evidence(end)
            left = self._noise_of(end, float(found.gamma.sum())) if noise is None else noise
            gain = max(float(found.slope.abs().max()), self._noise_gain(end, left))
            if gain <= self.options.loglik_tolerance:
                break
            assert fitter.friction_prior is not None
            mean, sd = fitter.friction_prior
            groups = cast("NeuroFuzzy", fitter.friction.schedule).groups()
            fitter = replace(fitter, friction_prior=(mean, sd * found.precision.rsqrt()[groups]))
            end = self._go_on(fitter, end, left)
        return fitter, end

    def _go_on(self, fitter: ShootingFitter, end: HorizonResult, noise: float) -> HorizonResult:
        """Search of the training windows from another search's end."""
        problem = fitter.problem(self.train, noise, end.parts.friction, stride=self.stride)
        return fitter.search(problem, end.result.x, self.tolerance, "network, hold-out")

    def _noise_of(self, end: HorizonResult, gamma: float) -> float:
        """Noise of what a network leaves: MacKay's, of as many residuals as are independent."""
        residuals = end.residuals
        # Of white residuals a fit counts no more than every `stride`-th.
        lasting = max(correlation_time(residuals), float(self.stride))
        independent = residuals.numel() / lasting
        explained = gamma + len(self.train) * end.problem.variables.state_count
        left = max(independent - explained, 1.0)
        noise = end.rms * math.sqrt(lasting * independent / left)
        # A network contains its law, so it cannot leave more.
        return min(max(noise, self.options.min_noise), self.noise)

    def _noise_gain(self, end: HorizonResult, noise: float) -> float:
        """Gain in log likelihood by another noise, to first order."""
        before = end.problem.noise_sd
        return abs((noise / before) ** 2 - 1.0) * float(end.result.cost)

    def _search(self, fitter: ShootingFitter, friction: Tensor, name: str) -> HorizonResult:
        """Search of the training windows."""
        problem = fitter.problem(self.train, self.noise, friction, stride=self.stride)
        start = problem.variables.start(self.plant)
        return fitter.search(problem, start, self.tolerance, name)

    def _error(self, end: HorizonResult) -> float | None:
        """Hold-out RMSE of a search; None if it was stopped, half trained and unjudged."""
        if end.stopped:
            return None
        return holdout_rmse(self.test, end.problem, end.parts.friction, end.parts.plant)


def _constant_kept(
    task: FitTask, network: FrictionModel, start: FitResult, note: str, *, converged: bool = True
) -> FitResult:
    """The constant fit as the neuro-fuzzy model's."""
    revert_to_constant(network, start, task.options)
    task.model.load_state_dict(network.state_dict())
    return replace(
        start,
        model=task.model.requires_grad_(False),
        status=f"{start.status} {note}" if converged else f"Not converged: {note}",
        converged=start.converged and converged,
        warnings=(*start.warnings, note),
    )
