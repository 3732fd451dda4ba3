"""Neuro-fuzzy coefficients: a network that corrects a constant law, kept if it passes hold-out."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.data.inputs import adjustable_terms, apply_encoder_offsets, require_motion
from nfriction.fitting.equation_error import coefficient_scale
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.of_search import result_from_shooting
from nfriction.fitting.shooting.autocorrelation import decimation, effective_noise
from nfriction.fitting.shooting.sensitivity import StepJacobian
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
from nfriction.fitting.task import FitTask
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.recording import Recording
from nfriction.signals import Motion

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
        cast("NeuroFuzzy", task.model.schedule).prior_sd = best.prior_sd
    found = replace(
        found, motions=task.motions, encoder_offsets=start.encoder_offsets,
        skipped_horizons=start.skipped_horizons,
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

    Its network is zero; recordings and motions are in joint coordinates.
    """
    network = copy.deepcopy(model)
    schedule = cast("NeuroFuzzy", network.schedule)
    scale = coefficient_scale(model, constant.plant, recordings, motions)
    schedule.set_range(*input_range(motions, schedule.along_motion, options))
    schedule.set_reference(constant.model.schedule.coefficient_sets()["always"], scale)
    schedule.set_parameter_vector(torch.zeros_like(schedule.parameter_vector()))
    return network


def revert_to_constant(
    model: FrictionModel, constant: FitResult, options: FitOptions = DEFAULTS
) -> None:
    """Set a neuro-fuzzy model to a constant fit of its law; coefficients of zero stay so."""
    schedule = cast("NeuroFuzzy", model.schedule)
    values = constant.model.schedule.coefficient_sets()["always"]
    schedule.set_reference(values, schedule.scale, options.zero_reference)
    schedule.set_parameter_vector(torch.zeros_like(schedule.parameter_vector()))


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
    prior_sd: float
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
            trials = []
            for share in self.options.prior_shares:
                trial = self._trial(fitter, share, of_same, of_all)
                if trial is None:
                    return None
                trials.append(trial)
            trial = min(trials, key=lambda trial: trial.score.score)
            limit = math.inf if best is None else self.options.max_ratio_same * best.score.score
            if best is None or trial.score.score < limit:
                best = trial
        return best

    def fit_all(self, trial: _Trial) -> HorizonResult:
        """The network of a trial, fitted to all windows."""
        windows = trial.fitter.cut(self.motions, self.length)
        problem = trial.fitter.problem(
            windows, self.noise, trial.end.parts.friction, stride=self.stride
        )
        start = problem.variables.start(trial.end.parts.plant)
        return trial.fitter.search(problem, start, self.tolerance, f"{self.length:g} s windows")

    def _trial(
        self, fitter: ShootingFitter, share: float, of_same: float, of_all: float
    ) -> _Trial | None:
        """A network under a prior, from zero: from another prior's end it would stay there."""
        widest = cast("NeuroFuzzy", fitter.friction.schedule).prior_sd
        zeros = torch.zeros_like(fitter.friction.schedule.parameter_vector())
        prior = (zeros, torch.full_like(zeros, share * widest))
        fitter = replace(fitter, friction_prior=prior)
        end = self._search(fitter, zeros, "network, hold-out")
        error = self._error(end)
        if error is None:
            return None
        ratios = [error / law if math.isfinite(error) else math.inf for law in (of_same, of_all)]
        score = HoldoutScore(ratios[0], ratios[1], self.options)
        return _Trial(score, fitter, share * widest, end)

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
