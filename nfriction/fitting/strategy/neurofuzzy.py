"""Neuro-fuzzy coefficients: a network that corrects a constant law as far as blocks left out show.

A network learns from all windows, with priors and noise by evidence. Then it learns anew without
each of some blocks of consecutive windows; the errors there give the share of the correction that
each joint takes, and decide whether it is worth having (`nfriction.fitting.strategy.holdout`).
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.data.inputs import adjustable_terms, apply_encoder_offsets, require_motion
from nfriction.fitting.data.windows import Windows, cut_windows
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
from nfriction.fitting.shooting.problem import ShootingProblem
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.shooting.variables import Parts, model_at
from nfriction.fitting.strategy.constant import constant_start, fits_eccentricity, known_terms
from nfriction.fitting.strategy.continuation import (
    HorizonResult,
    ShootingFitter,
    loglik_tolerance,
    settle_states,
)
from nfriction.fitting.strategy.extrapolation_prior import prior_on_unvisited_cells
from nfriction.fitting.strategy.holdout import (
    Correction,
    Judgement,
    cut_for_folds,
    judge,
    training_blocks,
)
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy
from nfriction.optim.evidence import GroupEvidence, group_evidence, maximise_group_evidence
from nfriction.recording import Recording
from nfriction.signals import Motion

# Steps between two updates of priors by evidence, which needs no minimum, only to be near one.
STEPS_PER_UPDATE = 2
# Steps of a search that starts at the minimum over all windows and leaves out some.
STEPS_WITHOUT_BLOCK = 4
# Log ratio of evidences below which a hypothesis gains nothing worth mentioning (H. Jeffreys,
# Theory of Probability, 3rd ed. 1961, appendix B).
WORTH_MENTIONING = 0.5 * math.log(10.0)
INTERRUPTED = "Stopped before the network was found; its constant law is kept."


def fit_neurofuzzy(task: FitTask) -> FitResult:
    """Fit a neuro-fuzzy model from the constant fit of its law, see `fit`."""
    require_motion(task.plant, task.recordings)
    options, start = task.options, constant_start(task)
    recordings, motions = apply_encoder_offsets(
        start.encoder_offsets, task.plant, task.recordings, task.motions
    )
    network = initialise_from_constant(task.model, start, recordings, motions, options)
    terms = adjustable_terms(
        task.plant, recordings, options, eccentric=fits_eccentricity(options, start),
        per_recording=bool(start.encoder_offsets),
    )  # fmt: skip
    fitter = ShootingFitter(
        StepJacobian(task.plant, network, terms), network, recordings, task.measurement, options,
        task.callback,
        # From smoothed states at full length a search creeps along constraints.
        defect_sd=None if options.continuity == "none" else options.penalty_sd,
        extrapolation=prior_on_unvisited_cells(network_of(network), motions, options),
    )  # fmt: skip
    length = start.longest_usable_horizon(options.windows)
    training = _Training(fitter, start, cut_windows(recordings, motions, length))
    trained = training.learn()
    judged = None
    if trained is not None:
        shorter = cut_for_folds(recordings, motions, length, options.folds)
        judged = training.judge(trained, shorter)
    if trained is None or judged is None:
        found = _constant_kept(task, network, start, INTERRUPTED, converged=False)
    elif not judged.kept:
        found = _constant_kept(task, network, start, judged.rejection())
    else:
        end = shrunk(trained.end, judged.shares, training.plant)
        own = copy.deepcopy(end.problem.friction)
        found = result_from_shooting(own, end.problem, end.result, motions)
        task.model.load_state_dict(own.state_dict())
        found = replace(
            found,
            model=task.model.requires_grad_(False),
            status=f"{found.status} {judged.statement(task.plant.joint_names)}",
            effective_parameters=effective_parameters(trained),
            uncertainty=found.uncertainty and replace(found.uncertainty, law=start.uncertainty),
        )
    found = replace(
        found, motions=task.motions, encoder_offsets=start.encoder_offsets,
        continuity=options.continuity, skipped_horizons=start.skipped_horizons,
    )  # fmt: skip
    return found.with_warnings(start.data_warnings)


def network_of(model: FrictionModel) -> NeuroFuzzy:
    """The neuro-fuzzy coefficients of a model that has such."""
    return cast("NeuroFuzzy", model.schedule)


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


@dataclass(frozen=True, eq=False)
class NetworkPrior:
    """Prior of a network's parameters and of the plant's terms.

    Attributes:
        mean, sd: of the parameters, (parameter,).
        near: standard deviation of each plant term around that of the constant law, beside its
            own prior, (term,).
    """

    mean: Tensor
    sd: Tensor
    near: Tensor

    def plant_sd(self, own: Tensor) -> Tensor:
        """Standard deviation of the plant's terms by both priors; `own` is that as given."""
        return (self.near**-2 + own**-2).rsqrt()

    def updated(self, precision: Tensor, groups: Tensor) -> "NetworkPrior":
        """With new precisions of the groups relative to the present ones; the last is `near`'s."""
        factor = precision.rsqrt()
        near = self.near * factor[-1] if len(self.near) else self.near
        return NetworkPrior(self.mean, self.sd * factor[groups], near)


@dataclass(frozen=True, eq=False)
class Trained:
    """A network at the end of a search with its priors."""

    prior: NetworkPrior
    end: HorizonResult

    @property
    def finite(self) -> bool:
        """False where the motion diverges."""
        return bool(torch.isfinite(self.end.result.hessian).all())

    @property
    def group_names(self) -> tuple[str, ...]:
        """Names of the groups of parameters: the network's, and `"plant"` where it is fitted."""
        names = network_of(self.end.problem.friction).group_names()
        return (*names, "plant") if len(self.prior.near) else names

    def log_evidence(self) -> float:
        """Log evidence, comparable at one noise; -inf where it is not finite."""
        if not self.finite:
            return -math.inf
        return network_evidence(self).occam - float(self.end.result.cost)


class LocalModel(NamedTuple):
    """Marginal Gauss-Newton model of a search's end, in units of the present prior.

    Window states are integrated out. See `nfriction.optim.evidence.group_evidence`.
    """

    data: Tensor
    known: Tensor
    slope: Tensor
    offset: Tensor
    groups: Tensor


def local_model(trained: Trained) -> LocalModel:
    """Model for the evidence of groups, each of precision 1.

    The plant's own prior and that on unvisited motion are known priors beside those of the groups.
    """
    end, near = trained.end, trained.prior.near
    problem, variables = end.problem, end.problem.variables
    schedule = network_of(model_at(problem.friction, end.parts.friction))
    shared, count = variables.shared_count, variables.friction_count
    precision, mean = variables.prior()
    hessian, gradient = end.result.hessian, end.result.gradient
    data = information(hessian, precision, shared).data
    states = torch.linalg.solve_ex(hessian[shared:, shared:], gradient[shared:])[0]
    slope = gradient[:shared] - hessian[:shared, shared:] @ states
    known = torch.zeros_like(data)
    if problem.extrapolation is not None:
        known[:count, :count] = problem.extrapolation.normal_equations(schedule)[1]
        data = data - known
    known.diagonal()[count:] += precision[count:shared] - near**-2
    unit = torch.cat([precision[:count].rsqrt(), near])
    data, known = (unit[:, None] * part * unit for part in (data, known))
    own = schedule.groups()
    groups = torch.cat([own, torch.full_like(near, int(own[-1]) + 1, dtype=own.dtype)])
    lower, upper = (bound[:shared] for bound in variables.bounds())
    fitted = (lower < upper).nonzero().flatten()
    values, vectors = torch.linalg.eigh(data[fitted][:, fitted])
    # Less than none is the rounding of states that grow by orders of magnitude.
    data = (vectors * values.clamp_min(0.0)) @ vectors.T
    offset = (end.result.x - mean)[:shared] / unit
    # Of errors and known priors: without that of the groups.
    slope = unit * slope - offset
    return LocalModel(data, known[fitted][:, fitted], slope[fitted], offset[fitted], groups[fitted])


def network_evidence(trained: Trained) -> GroupEvidence:
    """Evidence for the prior of each group of parameters, relative to the present one."""
    data, known, _, offset, groups = local_model(trained)
    ones = torch.ones(len(trained.group_names), dtype=torch.float64)
    return group_evidence(data, known, offset, groups, ones)


def effective_parameters(trained: Trained) -> tuple[tuple[str, float, int], ...]:
    """Name of each group of a network, how many parameters the data determine, and its size."""
    if not trained.finite:
        return ()
    own = network_of(trained.end.problem.friction).groups().bincount().tolist()
    sizes = [*own, len(trained.prior.near)]
    gamma = network_evidence(trained).gamma.tolist()
    return tuple(zip(trained.group_names, gamma, sizes, strict=False))


class _Training:
    """Searches for a network that corrects a constant fit, on given windows."""

    def __init__(self, fitter: ShootingFitter, start: FitResult, windows: Windows) -> None:
        self.fitter, self.windows, self.options = fitter, windows, fitter.options
        # The noise against which priors weigh at first is the law's residual at the same horizon.
        self.noise = effective_noise(start.residuals)
        self.stride = decimation(start.residuals, self.options)
        terms = fitter.jacobian.terms
        self.plant = known_terms(start, terms)
        self.plant_sd = self.plant.new_tensor([t.prior_sd for t in terms])
        posterior = {i.name: i.sd for i in start.intervals}
        near = self.plant.new_tensor([posterior.get(t.name, math.inf) for t in terms])
        # Within the recorded motion plant and network can compensate each other; outside, where
        # the network fades, such a plant is wrong. So it begins near the law's.
        self.near = torch.minimum(self.plant_sd, near)

    def learn(self) -> Trained | None:
        """A network that starts silent, its sets moved if the evidence favours that.

        None if it was stopped, half trained.
        """
        model = copy.deepcopy(self.fitter.friction)
        schedule = network_of(model)
        learn_sets, schedule.learn_sets = schedule.learn_sets, False
        prior = NetworkPrior(*schedule.prior(), self.near)
        problem = self._problem(model, prior, self.noise)
        held = self._adapt(prior, problem, problem.variables.start(self.plant))
        if held is None or not learn_sets:
            return held
        # At the same noise, or the evidence would compare different errors.
        parts, noise = held.end.parts, held.end.problem.noise_sd
        model = model_at(held.end.problem.friction, parts.friction)
        schedule = network_of(model)
        schedule.learn_sets = True
        mean, sd = schedule.prior()
        sd[: len(parts.friction)] = held.prior.sd
        problem = self._problem(model, NetworkPrior(mean, sd, held.prior.near), noise)
        x = torch.cat([schedule.parameter_vector(), held.end.result.x[len(parts.friction) :]])
        moved = self._adapt(NetworkPrior(mean, sd, held.prior.near), problem, x, same_noise=True)
        if moved is None:
            return None
        if not moved.log_evidence() > held.log_evidence() + WORTH_MENTIONING:
            return held
        return self._adapt(moved.prior, moved.end.problem, moved.end.result.x)

    def judge(self, trained: Trained, windows: Windows) -> Judgement | None:
        """Share of a network that every joint takes by blocks of windows left out; None if stopped.

        The windows may be shorter than those that it learnt from, so that there are enough.
        """
        problem = replace(trained.end.problem, windows=windows)
        parts = trained.end.parts
        x, stopped = settle_states(
            problem, problem.variables.start(parts.plant, friction=parts.friction)
        )
        if stopped:
            return None
        parts = problem.variables.split(x)
        # From a minimum over all windows, that over most of them is a few steps away.
        brief = replace(self.options, max_steps=STEPS_WITHOUT_BLOCK)
        fitter = replace(self._fitter(problem.friction, trained.prior), options=brief)
        left_out = []
        for seen in training_blocks(len(windows), self.options.folds):
            most = replace(problem, windows=windows.subset(seen))
            x = torch.cat([parts.friction, parts.plant, parts.states[seen].flatten()])
            tolerance = loglik_tolerance(float(most.cost(x)), self.options)
            end = fitter.search(most, x, tolerance, "network, block left out")
            if end.stopped:
                return None
            rest = replace(problem, windows=windows.subset(~seen))
            ended = end.parts._replace(states=parts.states[~seen])
            left_out.append(correction(rest, ended, self.plant))
        return judge(left_out)

    def _adapt(
        self, prior: NetworkPrior, problem: ShootingProblem, x: Tensor, *, same_noise: bool = False
    ) -> Trained | None:
        """Search with the prior of each group by evidence, and the noise unless it is to stay."""
        # A minimum first: near the start, sets that have not moved yet would seem useless.
        found = self._search(prior, problem, x)
        for _ in range(self.options.evidence_updates):
            if found.end.stopped:
                return None
            if not found.finite:
                break
            evidence, gain = maximise_group_evidence(
                *local_model(found), self.options.loglik_tolerance
            )
            noise = found.end.problem.noise_sd
            left = noise if same_noise else self._noise_of(found, float(evidence.gamma.sum()))
            if max(gain, self._noise_gain(found, left)) <= self.options.loglik_tolerance:
                break
            model = found.end.problem.friction
            prior = found.prior.updated(evidence.precision, network_of(model).groups())
            problem = self._problem(model, prior, left)
            other = self._search(prior, problem, found.end.result.x, STEPS_PER_UPDATE)
            # Where the quadratic model reaches too far, its precisions are no better.
            if left == noise and not other.log_evidence() > found.log_evidence():
                break
            found = other
        found = self._search(found.prior, found.end.problem, found.end.result.x)
        return None if found.end.stopped else found

    def _fitter(self, model: FrictionModel, prior: NetworkPrior) -> ShootingFitter:
        return replace(
            self.fitter,
            friction=model,
            friction_prior=(prior.mean, prior.sd),
            plant_prior=(self.plant, prior.plant_sd(self.plant_sd)),
        )

    def _problem(self, model: FrictionModel, prior: NetworkPrior, noise: float) -> ShootingProblem:
        vector = model.schedule.parameter_vector()
        fitter = self._fitter(model, prior)
        return fitter.problem(self.windows, noise, vector, stride=self.stride)

    def _search(
        self, prior: NetworkPrior, problem: ShootingProblem, x: Tensor, steps: int | None = None
    ) -> Trained:
        fitter = self._fitter(problem.friction, prior)
        if steps is not None:
            fitter = replace(fitter, options=replace(self.options, max_steps=steps))
        # Far from a minimum it is the start's cost, at the noise that the problem has.
        tolerance = loglik_tolerance(float(problem.cost(x)), self.options)
        return Trained(prior, fitter.search(problem, x, tolerance, "network"))

    def _noise_of(self, found: Trained, gamma: float) -> float:
        """Noise of what a network leaves: MacKay's, of as many residuals as are independent."""
        end = found.end
        residuals = end.residuals
        # Of white residuals a fit counts no more than every `stride`-th.
        lasting = max(correlation_time(residuals), float(self.stride))
        independent = residuals.numel() / lasting
        explained = gamma + len(self.windows) * end.problem.variables.state_count
        left = max(independent - explained, 1.0)
        noise = end.rms * math.sqrt(lasting * independent / left)
        # A network contains its law, so it cannot leave more.
        return min(max(noise, self.options.min_noise), self.noise)

    def _noise_gain(self, found: Trained, noise: float) -> float:
        """Gain in log likelihood by another noise, to first order."""
        before = found.end.problem.noise_sd
        return abs((noise / before) ** 2 - 1.0) * float(found.end.result.cost)


def correction(problem: ShootingProblem, parts: Parts, law_plant: Tensor) -> Correction:
    """The deviation of a network's parameters from its law, on a problem's windows."""
    schedule = network_of(problem.friction)
    names = schedule.group_names()
    leaning = names.index("direction") if "direction" in names else -1
    return Correction(
        problem, parts.friction, parts.plant, law_plant, parts.states,
        schedule.joint_of_weights(), schedule.groups() == leaning,
    )  # fmt: skip


def shrunk(end: HorizonResult, shares: Tensor, plant: Tensor) -> HorizonResult:
    """A search's end with shares (joint,) of its correction, from a law's plant terms on."""
    if bool((shares == 1).all()):
        return end
    problem, parts = end.problem, end.parts
    taken = correction(problem, parts, plant).shared_at(shares)
    x, _ = settle_states(problem, torch.cat([taken, end.result.x[len(taken) :]]))
    local = problem.linearise(x)
    lower, upper = problem.variables.bounds()
    result = replace(
        end.result, x=x, cost=float(local.cost), gradient=local.gradient, hessian=local.hessian,
        at_lower=x <= lower, at_upper=x >= upper,
    )  # fmt: skip
    return replace(end, result=result)


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
