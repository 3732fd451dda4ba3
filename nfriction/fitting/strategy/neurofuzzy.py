"""Neuro-fuzzy coefficients: a network that corrects a constant law, kept if it passes hold-out.

First, the network is trained with fixed sets, and hold-out windows select the priors. Training
continues with the residual noise, with the prior of each group of parameters set by evidence, and
moves the sets if the evidence favours that; this is repeated with ever smaller noise as long as the
hold-out windows improve. Every window is held out in turn, and the gain over the law must exceed
its scatter. Further inputs (`inputs`) are kept if a network with them, trained alike, is better on
hold-out windows. With several recordings, none may be worse on hold-out recordings.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.data.inputs import apply_encoder_offsets, require_motion
from nfriction.fitting.data.windows import Windows
from nfriction.fitting.equation_error import coefficient_scale
from nfriction.fitting.options import DEFAULTS, FitOptions
from nfriction.fitting.result.fit_result import FitResult
from nfriction.fitting.result.identifiability import information
from nfriction.fitting.result.of_search import result_from_shooting
from nfriction.fitting.result.paired_test import improves, mean_gain
from nfriction.fitting.shooting.autocorrelation import decimation, effective_noise
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.shooting.variables import model_at
from nfriction.fitting.strategy import holdout, inputs
from nfriction.fitting.strategy.constant import constant_start
from nfriction.fitting.strategy.continuation import (
    HorizonResult,
    ShootingFitter,
    loglik_tolerance,
    settle_states,
    weighted_cost,
)
from nfriction.fitting.strategy.extrapolation_prior import prior_on_unvisited_cells
from nfriction.fitting.task import FitTask, constant_prior, known_terms, regression, terms_after
from nfriction.friction.heat import Heated
from nfriction.friction.inputs import INPUTS, has_input
from nfriction.friction.models import FrictionModel
from nfriction.friction.neurofuzzy import NeuroFuzzy, NeuroFuzzyModel
from nfriction.optim.group_evidence import GroupEvidence, group_evidence
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

LOST = (
    "Network rejected: over windows of {:.3g} s, to which its constant law was fitted, it was "
    "{:.3g} % worse; the constant law is kept."
)
INTERRUPTED = "Stopped before the network was found; its constant law is kept."


def fit_neurofuzzy(task: FitTask) -> FitResult:
    """Fit a neuro-fuzzy model from the constant fit of its law, see `fit`."""
    require_motion(task.plant, task.recordings)
    model = task.model
    if isinstance(model, NeuroFuzzyModel) and model.selected:
        task = replace(task, model=_seeing(model, None))  # those of an earlier fit do not count
    given = (isinstance(task.model, NeuroFuzzyModel) and task.model.inputs) or ()
    task = replace(task, plant=inputs.seeing_plant(task.plant, given))
    widens = bool({"heat", "position"} & {*given})
    own = replace(task, model=_seeing(model, ())) if widens else task
    start = constant_start(own)
    recordings, motions = apply_encoder_offsets(
        start.encoder_offsets, task.plant, task.recordings, task.motions
    )
    aligned = replace(task, recordings=recordings, motions=motions)
    if "position" in given:
        aligned = inputs.with_position_load(aligned, start)
    widened = inputs.widened_start(aligned, start, given) if widens else start
    if widened is None:
        fitter = inputs.widened_fitter(aligned, start, given, inputs.longest_duration(motions))
        plant = inputs.with_waves_of(aligned.plant, start.plant)
        start = replace(start, model=fitter.friction, plant=plant)
    else:
        aligned = inputs.realigned(aligned, start, widened)
    contest = _Contest(aligned, widened or start)
    chosen: tuple[inputs.InputGain, ...] = ()
    try:
        if widened is None:
            raise holdout.StoppedError
        contest.train()
        if isinstance(task.model, NeuroFuzzyModel) and task.model.inputs is None:
            chosen, contest = _with_chosen_inputs(contest)
    except holdout.StoppedError:
        contest.stop()
    if isinstance(model, NeuroFuzzyModel) and (chosen or model.selected):
        model.see([gain.name for gain in chosen] or None)
        model.selected = bool(chosen)
    found = replace(
        contest.result(model), motions=task.motions, skipped_horizons=start.skipped_horizons,
        inputs=chosen,
    )  # fmt: skip
    said = [gain.words(found.plant.joint_names) for gain in chosen]
    # Only what the constant fit shows: a network's parameters have no intervals.
    shown = {k: inputs.significant(contest.start, k) for k in INPUTS if has_input(model.law, k)}
    if shown.get("position"):
        said.append(_ripple(found.plant, sorted(shown["position"]), contest.task.motions))
    if shown.get("heat"):
        cooling_time = cast("Heated", model.schedule).cooling_time
        slow = cooling_time > inputs.longest_duration(motions)
        longer = ", longer than the recordings last" * slow
        said.append(f"Heat cools within {cooling_time:.2g} s{longer}.")
    found = replace(found, status=" ".join([found.status, *said]))
    richer = contest.accepted or contest.start is not start
    if richer and task.leaves_noise(found):
        return found  # without what the fit of the law alone warned of, such as a delay
    if not richer:
        return found.with_warnings(start.data_warnings, unmodelled=start.unmodelled)
    of_task, of_law = (*task.data_warnings, *task.smoothed), ", as found with the constant law."
    texts, unmodelled = (
        [x if x in of_task else x.removesuffix(".") + of_law for x in of_start]
        for of_start in (start.data_warnings, start.unmodelled)
    )
    return found.with_warnings(texts, unmodelled=unmodelled)


def _seeing(model: FrictionModel, names: Sequence[str] | None) -> FrictionModel:
    """A copy of a neuro-fuzzy model with other inputs."""
    copied = cast("NeuroFuzzyModel", copy.deepcopy(model))
    copied.see(names)
    return copied


def _ripple(plant: Plant, joints: Sequence[int], motions: Sequence[Motion]) -> str:
    """Sentences on where friction of these joints is largest, and where it is known."""
    rows = [*zip(plant.joint_names, plant.load_phase, plant.load_waves, strict=True)]
    peaks, unit = (rows[j] for j in joints), plant.unit
    at = ", ".join(
        f"{-p / k:.3g} and every {2 * math.pi / k:.3g} {unit} ({n})" for n, p, k in peaks
    )
    angles = " joint angles (relative, from upright) of" if plant.unit == "rad" else ""
    q = np.concatenate([m.q for m in motions])
    phases = inputs.known_phases(plant, motions)
    known = "".join(
        f" That of {plant.joint_names[j]} is known only at the recorded positions, from "
        f"{q[:, j].min():.3g} to {q[:, j].max():.3g} {unit}."
        for j in joints
        if not phases[j].all()
    )
    zeros = "as long as encoders keep their zeros"
    return f"Friction by position is largest at{angles} {at}, {zeros}.{known}"


def _with_chosen_inputs(plain: "_Contest") -> tuple[tuple[inputs.InputGain, ...], "_Contest"]:
    """Inputs that improve the network on hold-out windows, if it needs any, and their contest."""
    task = plain.task
    if plain.accepted and plain.validation.explains(plain.squares):
        return (), plain
    chosen, start, seeing = inputs.chosen_inputs(task, plain.start)
    if not chosen:
        return (), plain
    model = _seeing(task.model, [gain.name for gain in chosen])
    rival = _Contest(replace(seeing, model=model), start)
    new, old, chance = rival.validation, plain.validation, task.options.input_chance
    least = task.options.network_gain
    # An input may show only in the network: the law alone need not gain.
    worse = improves(old.of_law, new.of_law, chance)
    if worse or (new.several and _worse(old.law_by_recording, new.law_by_recording, chance)):
        return (), plain
    rival.train()
    better = improves(rival.squares, plain.squares, least=least)
    # Friction of the constant law may drive a joint even if that of its network does not.
    drives = inputs.friction_drives(rival.found, len(task.model.law.names))
    return (chosen, rival) if better and not drives else ((), plain)


def _worse(old: Tensor, new: Tensor, chance: float) -> bool:
    """True if squared errors on hold-out recordings (recording,) rose by more than their scatter.

    Also if each of at least three rose, since the test of so few has little power. Two both rise by
    chance in a quarter of all cases.
    """
    return improves(old, new, chance) or (len(old) > 2 and bool((new > old).all()))


class _Contest:
    """A network and the constant law that it has to beat.

    Encoder offsets are removed from the recordings and motions of the task.
    """

    def __init__(self, task: FitTask, start: FitResult) -> None:
        self.task, self.start, options = task, start, task.options
        law_prior = constant_prior(start.model, regression(task, start.model, task.plant), options)
        self.network = initialise_from_constant(
            task.model, start, task.recordings, task.motions, options
        )
        terms = terms_after(task, start, start.model.law, task.plant)
        plant_sd = torch.tensor([t.prior_sd for t in terms], dtype=torch.float64)
        schedule = cast("NeuroFuzzy", self.network.schedule)
        self.free = ShootingFitter(
            StepJacobian(task.plant, self.network, terms), self.network, task.recordings,
            task.measurement, options, task.callback,
            plant_prior=(known_terms(start, terms), plant_sd), offset_sd=task.offset_sd,
            extrapolation=prior_on_unvisited_cells(schedule, task.motions, options),
        )  # fmt: skip
        law = replace(self.free, friction=start.model, friction_prior=law_prior, extrapolation=None)
        length = start.longest_usable_horizon(options.windows)
        self.validation = Validation(law, start, task.motions, length)
        self.best: Trial | None = None
        self.end: HorizonResult | None = None  # of the network fitted to all windows
        self.rejected, self.stopped = INTERRUPTED, False

    @property
    def accepted(self) -> bool:
        """True if the network beats the law."""
        return not self.rejected

    @property
    def squares(self) -> Tensor:
        """Squared errors of the network if it is accepted, else of the law, (window,)."""
        assert self.best is not None
        return self.best.squares if self.accepted else self.validation.of_law

    @property
    def found(self) -> FitResult:
        """The law's fit, with the model and plant of the network if it is accepted."""
        if self.rejected or self.end is None:
            return self.start
        problem, parts = self.end.problem, self.end.parts
        model, plant = model_at(problem.friction, parts.friction), problem.plant_at(parts.plant)
        return replace(self.start, model=model, plant=plant)

    def train(self) -> None:
        """Find the best network, and reject it unless it beats the law; raises `StoppedError`."""
        validation, before = self.validation, None
        self.best = validation.best_trial(_with_narrowed_priors(self.free, self.start))
        # Usually less than ten rounds; gains in the mean of windows could form a circle.
        for _ in range(self.task.options.max_steps):
            if not self.best.finite or self.best is before:
                break
            before, self.best = self.best, validation.trained_on(self.best)
        self.rejected = self._compared()
        if not self.rejected:
            self.rejected = validation.lost_by_recording(self.best)
        if not self.rejected:
            self.end = validation.fit_all(self.best)
            self.rejected = validation.lost_over_long_windows(self.end)

    def _compared(self) -> str:
        """Reason to reject a network that does not beat the law on hold-out windows, or ""."""
        assert self.best is not None
        pair, least = (self.best.squares, self.validation.of_law), self.task.options.network_gain
        return "" if improves(*pair, least=least) else holdout.verdict(*pair, least=least)

    def stop(self) -> None:
        """Keep the network as far as it is trained, after the caller stopped a search."""
        self.stopped = True
        if self.best is not None:
            self.end = (self.end or self.best.end).as_stopped()
            self.rejected = self._compared() if self.rejected == INTERRUPTED else self.rejected

    def result(self, model: FrictionModel) -> FitResult:
        """The network, or its law if it is rejected, written into a model of the same kind."""
        end, best = self.end, self.best
        if self.rejected or end is None or best is None:
            revert_to_constant(self.network, self.start, self.task.options)
            model.load_state_dict(self.network.state_dict())
            seen = getattr(self.task.model, "inputs", None) or ()
            law = f"constant law with {' and '.join(seen)}" if seen else "constant law"
            note = self.rejected.replace("constant law is kept", f"{law} is kept")
            return constant_kept(self.start, model, note, converged=not self.stopped)
        found = copy.deepcopy(end.problem.friction)
        result = result_from_shooting(found, end.problem, end.result, self.task.motions)
        model.load_state_dict(found.state_dict())
        cast("NeuroFuzzy", model.schedule).prior_sd = best.prior_sd
        schedules = (cast("NeuroFuzzy", m.schedule) for m in (found, self.network))
        pairs = zip(*(s.network.anfis.partition.parameters() for s in schedules), strict=True)
        # Constants of a hidden state, such as the fall by heat, are those of the law's fit.
        kept = {c.name for c in model.law.coefficients if c.fitted and c.stores}
        known = tuple(i for i in self.start.intervals if i.name.split(" of ")[0] in kept)
        moved = "" if all(torch.equal(*pair) for pair in pairs) else " Its sets moved."
        return replace(
            result,
            model=model.requires_grad_(False),
            encoder_offsets=inputs.added(self.start.encoder_offsets, result.encoder_offsets),
            status=result.status + moved,
            intervals=known + result.intervals,
            effective_parameters=effective_parameters(end),
        )


def input_range(
    motions: Sequence[Motion], along_motion: bool, options: FitOptions = DEFAULTS
) -> tuple[Tensor, Tensor]:
    """Largest |velocity| of motions, (joint,), and range of their acceleration, (joint, 2)."""
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
    """A copy of a neuro-fuzzy model set to a constant fit of its law, for the range of the motion.

    Its network's output is zero; recordings and motions are in joint coordinates.
    """
    network = copy.deepcopy(model)
    schedule = cast("NeuroFuzzy", network.schedule)
    schedule.learn_sets = False  # only its weights become zero; sets move later, by evidence
    scale = coefficient_scale(model, constant.plant, recordings, motions)
    schedule.set_range(*input_range(motions, schedule.along_motion, options))
    schedule.set_reference(constant.model.schedule.coefficient_sets()["always"], scale)
    schedule.set_parameter_vector(torch.zeros_like(schedule.parameter_vector()))
    if has_input(model.law, "heat"):
        law = cast("Heated", constant.model.schedule)
        heat = law.heat_capacity, law.cooling_time, law.sample_time
        cast("Heated", schedule).set_heat(*heat)
    return network


def revert_to_constant(
    model: FrictionModel, constant: FitResult, options: FitOptions = DEFAULTS
) -> None:
    """Set a neuro-fuzzy model to a constant fit of its law; zero coefficients stay zero."""
    schedule = cast("NeuroFuzzy", model.schedule)
    values = constant.model.schedule.coefficient_sets()["always"]
    schedule.set_reference(values, schedule.scale, options.zero_reference)
    schedule.set_parameter_vector(torch.zeros_like(schedule.parameter_vector()))


def _with_narrowed_priors(free: ShootingFitter, start: FitResult) -> tuple[ShootingFitter, ...]:
    """Fitters with ever wider plant priors, starting with the posterior sd of the constant fit.

    Within the recorded motion, errors of plant and network can compensate each other; outside it,
    where the network tapers off, that plant would be wrong.
    """
    assert free.plant_prior is not None
    mean, sd = free.plant_prior
    posterior = {i.name: i.sd for i in start.intervals}
    narrow = sd.new_tensor([posterior.get(t.name, math.inf) for t in free.jacobian.terms])
    narrow = torch.minimum(sd, narrow)
    near = replace(free, plant_prior=(mean, narrow))
    return (near,) if torch.equal(narrow, sd) else (near, free)


def local_model(end: HorizonResult) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Curvature of errors and of known priors, offsets and groups, for `group_evidence`.

    From the Gauss-Newton model at the end of a search, with window states marginalised, in units of
    the network's prior, so that each group has precision 1. The priors of the plant and on
    unvisited motions are known.
    """
    problem, variables = end.problem, end.problem.variables
    schedule = cast("NeuroFuzzy", model_at(problem.friction, end.parts.friction).schedule)
    shared, count = variables.shared_count, variables.friction_count
    precision, mean = variables.prior()
    data = information(end.result.hessian, precision, shared).data
    known = torch.zeros_like(data)
    if problem.extrapolation is not None:
        known[:count, :count] = problem.extrapolation.normal_equations(schedule)[1]
        data = data - known
    known.diagonal()[count:] += precision[count:shared]
    unit = precision[:shared].rsqrt()
    data, known = (unit[:, None] * part * unit for part in (data, known))
    own = schedule.groups()
    groups = torch.cat([own, own.new_full((shared - count,), -1)])
    lower, upper = (bound[:shared] for bound in variables.bounds())
    fitted = (lower < upper).nonzero().flatten()
    values, vectors = torch.linalg.eigh(data[fitted][:, fitted])
    # Negative eigenvalues are round-off from states that grow by orders of magnitude.
    data = (vectors * values.clamp_min(0.0)) @ vectors.T
    offset = (end.result.x - mean)[:shared] / unit
    return data, known[fitted][:, fitted], offset[fitted], groups[fitted]


def network_evidence(end: HorizonResult) -> GroupEvidence:
    """Evidence for the prior of each group of a network, relative to the current prior."""
    groups = len(cast("NeuroFuzzy", end.problem.friction.schedule).group_names())
    return group_evidence(*local_model(end), torch.ones(groups, dtype=torch.float64))


def log_evidence(end: HorizonResult) -> float:
    """Log evidence up to a constant, comparable only at equal noise; -inf if not finite."""
    if not end.result.hessian.isfinite().all():
        return -math.inf
    return network_evidence(end).occam - float(end.result.cost)


def effective_parameters(end: HorizonResult) -> tuple[tuple[str, float, int], ...]:
    """Per group of a network: name, number of parameters that the data determine, and size."""
    if not torch.isfinite(end.result.hessian).all():
        return ()
    schedule = cast("NeuroFuzzy", end.problem.friction.schedule)
    sizes, gamma = schedule.groups().bincount().tolist(), network_evidence(end).gamma.tolist()
    return tuple(zip(schedule.group_names(), gamma, sizes, strict=True))


@dataclass(frozen=True)
class Trial:
    """A model trained on the windows of the first split, and its priors.

    Its squared errors are those on hold-out windows: of the first split, or of all when judged.
    """

    squares: Tensor
    fitter: ShootingFitter
    end: HorizonResult
    tolerance: float
    prior_sd: float = math.nan

    @property
    def finite(self) -> bool:
        """False if the motion diverges."""
        return bool(self.squares.isfinite().all() and self.end.result.hessian.isfinite().all())


class Validation:
    """Comparison of networks with a constant law on hold-out windows of one length [s]."""

    def __init__(
        self, law: ShootingFitter, start: FitResult, motions: tuple[Motion, ...], length: float
    ) -> None:
        assert law.plant_prior is not None
        self.law, self.motions, self.length, self.options = law, motions, length, law.options
        self.plant = law.plant_prior[0]
        self.smoothed = holdout.holdout_windows(law.recordings, motions, length, self.options.folds)
        self.of_start = start.residuals
        # The noise that sets the weight of the priors is the residual of the constant law at the
        # same horizon; its cost scales the tolerance.
        self.noise = effective_noise(start.residuals)
        self.stride = decimation(start.residuals, self.options)
        # Below this a network would learn noise, and rounding that a periodic motion repeats.
        self.explained = self.options.explained_ratio * (start.noise or 0.0)
        cost = weighted_cost(start.residuals, self.noise)
        self.tolerance = loglik_tolerance(cost, self.options)

    @cached_property
    def windows(self) -> Windows:
        """Hold-out windows from the best states of the law, as smoothed ones may be far off."""
        values = self.law.friction.schedule.parameter_vector()
        problem = self.law.problem(self.smoothed, self.noise, values)
        x, stopped = settle_states(problem, problem.variables.start(self.plant))
        if stopped:
            raise holdout.StoppedError
        return self.smoothed.starting_at(problem.variables.split(x).states)

    @cached_property
    def splits(self) -> list[tuple[Windows, Windows]]:
        """Training and test windows, see `holdout_splits`."""
        return holdout.holdout_splits(self.windows, self.options.folds)

    @cached_property
    def of_law(self) -> Tensor:
        """Squared errors of the law on each hold-out window, (window,)."""
        return self.judged(self.law_trial).squares

    @cached_property
    def law_by_recording(self) -> Tensor:
        """Mean squared error of the law on hold-out recordings, (recording,)."""
        return self.by_recording(self.law_trial)

    @cached_property
    def law_trial(self) -> Trial:
        """The law, fitted to the windows of the first split."""
        values = self.law.friction.schedule.parameter_vector()
        return self.trial(self.law, values, "constant law, hold-out")

    @property
    def several(self) -> bool:
        """True if whole recordings can be held out."""
        return len({place for place, *_ in self.smoothed.spans}) > 1

    def explains(self, squares: Tensor) -> bool:
        """True if squared errors of most windows, (window,), are no larger than the noise."""
        return bool((squares <= self.explained**2).double().mean() > 0.5)

    def best_trial(self, fitters: Sequence[ShootingFitter]) -> Trial:
        """The trial with the best prior; a wider plant prior is used only if clearly better."""
        assert len(self.of_law)  # the law first: a network is judged relative to it
        best: Trial | None = None
        for fitter in fitters:
            schedule = cast("NeuroFuzzy", fitter.friction.schedule)
            # From zero, because a network would stay where another prior left it.
            zeros = torch.zeros_like(schedule.parameter_vector())
            trials = []
            for share in self.options.prior_shares:
                sd = share * schedule.prior_sd
                under = replace(fitter, friction_prior=(zeros, torch.full_like(zeros, sd)))
                trial = self.trial(under, zeros, "network, hold-out")
                trials.append(replace(trial, prior_sd=sd))
            found = self.judged(min(trials, key=lambda trial: float(trial.squares.sum())))
            if best is None or improves(found.squares, best.squares):
                best = found
        assert best is not None
        return best

    def trained_on(self, trial: Trial) -> Trial:
        """A trial trained further at its residual noise, or unchanged if that gains nothing.

        With the law's error as noise, sets could hardly move. They move if the evidence favours it.
        Windows explained by measurement noise cannot discriminate; then training continues as long
        as its noise falls, since with too large a noise the priors outweigh the data.
        """
        residuals, used = trial.end.residuals, trial.end.problem.noise_sd
        noise = max(min(effective_noise(residuals), self.noise), self.options.min_noise)
        explained = self.explains(trial.squares)
        if explained and self.options.explained_ratio * noise >= used:
            return trial
        # If correlations are shorter than the law's, more samples are used.
        stride = min(decimation(residuals, self.options), trial.end.problem.stride)
        # Sets that the data have moved stay unknown, so that the error bars include theirs.
        learnt = cast("NeuroFuzzy", trial.end.problem.friction.schedule).learn_sets
        better = self._adapted(trial, noise, stride, learn_sets=learnt)
        if not learnt:
            moved = self._adapted(better, noise, stride, learn_sets=True)
            gained = log_evidence(moved.end) - log_evidence(better.end)
            better = moved if gained > self.options.evidence_gain else better
        judged = self.judged(replace(better, squares=self._errors(better.end, self.splits[0][1])))
        # The gain need not exceed its scatter: the last rounds of training each gain little.
        if judged.finite and mean_gain(judged.squares, trial.squares)[0] > 0:
            return judged
        return judged if explained and not improves(trial.squares, judged.squares) else trial

    def _adapted(self, trial: Trial, noise: float, stride: int, *, learn_sets: bool) -> Trial:
        """A trial trained further, with the prior of each group tightened if evidence favours that.

        Priors are never widened, because beyond them the errors are not quadratic in the sets.
        """
        model = model_at(trial.fitter.friction, trial.end.parts.friction)
        schedule = cast("NeuroFuzzy", model.schedule)
        schedule.learn_sets = learn_sets
        mean, sd = schedule.prior()
        weights = sum(p.numel() for p in schedule.weights())
        assert trial.fitter.friction_prior is not None
        mean[:weights], sd[:weights] = (part[:weights] for part in trial.fitter.friction_prior)
        rest = trial.end.result.x[len(trial.end.parts.friction) :]
        x = torch.cat([schedule.parameter_vector(), rest])
        best, groups = None, schedule.groups()
        for _ in range(self.options.evidence_updates + 1):
            fitter = replace(trial.fitter, friction=model, friction_prior=(mean, sd))
            problem = fitter.problem(self.splits[0][0], noise, x[: len(mean)], stride=stride)
            tolerance = self.options.evidence_gain / max(float(problem.cost(x)), 1.0)
            end = fitter.search(problem, x, tolerance, "network's sets, hold-out")
            if end.stopped:
                raise holdout.StoppedError
            found = replace(trial, fitter=fitter, end=end, tolerance=tolerance)
            gain = log_evidence(found.end) - (log_evidence(best.end) if best else -math.inf)
            if not gain > self.options.evidence_gain:
                break
            best, x = found, end.result.x
            sd = sd * network_evidence(end).precision.clamp_min(1.0).rsqrt()[groups]
        return best or found

    def fit_all(self, trial: Trial) -> HorizonResult:
        """The network of a trial, fitted to all windows."""
        return self._further(trial, self.windows, f"{self.length:g} s windows")

    def lost_by_recording(self, trial: Trial) -> str:
        """Reason to reject a network that is worse than its law on hold-out recordings, or "".

        Windows between those of training show the same motion, and hide that a network follows what
        is particular to a recording. A gain is not required, because there is less to train on.
        """
        if not self.several:
            return ""
        law, found = self.law_by_recording, self.by_recording(trial)
        lost = _worse(law, found, self.options.input_chance)
        return holdout.verdict(found, law, "recordings") if lost else ""

    def lost_over_long_windows(self, end: HorizonResult) -> str:
        """Reason to reject a network that is worse than its law over the law's windows, or "".

        Hold-out windows may be shorter, and insensitive to small torque errors; and the last search
        may end at a worse minimum.
        """
        if end.stopped:
            return ""
        # From the states of the network's own fit: smoothed ones may lead to another minimum.
        simulated = end.problem.simulated_motions(end.result.x, self.motions)
        windows = self.law.cut(simulated, self.length, self.motions)
        law, (friction, plant, *_) = self.law.friction.schedule.parameter_vector(), end.parts
        loss = end.problem.loss
        of_law = loss.counted(self.of_start).square()
        # The law may have been fitted to windows of other lengths.
        if of_law.shape != windows.q.shape:
            problem = replace(self.law.problem(windows, self.noise, law), loss=loss)
            of_law = holdout.settled(windows, problem, law, self.plant)
        network = holdout.settled(windows, end.problem, friction, plant)
        worse = 100 * (float((network.mean() / of_law.mean()).sqrt()) - 1)
        return LOST.format(windows.length, worse) if worse > 0 else ""

    def _further(self, trial: Trial, windows: Windows, name: str) -> HorizonResult:
        """The network of a trial, fitted further to other windows."""
        (friction, plant, *_), before = trial.end.parts, trial.end.problem
        problem = trial.fitter.problem(windows, before.noise_sd, friction, stride=before.stride)
        start, least = problem.variables.start(plant), self.options.loglik_tolerance
        return trial.fitter.search(problem, start, trial.tolerance, name, least)

    def trial(self, fitter: ShootingFitter, friction: Tensor, name: str) -> Trial:
        """A search on the first split."""
        problem = fitter.problem(self.splits[0][0], self.noise, friction, stride=self.stride)
        # The noise is that of the law, so the cost of a network falls far below that of the law.
        start, least = problem.variables.start(self.plant), self.options.loglik_tolerance
        end = fitter.search(problem, start, self.tolerance, name, least)
        return Trial(self._errors(end, self.splits[0][1]), fitter, end, self.tolerance)

    def judged(self, trial: Trial) -> Trial:
        """A trial with its error on every window, from searches on the other windows."""
        found = [trial.squares]
        for train, test in self.splits[1:]:
            end = self._further(trial, train, "other windows, hold-out")
            found.append(self._errors(end, test))
        return replace(trial, squares=torch.cat(found))

    def by_recording(self, trial: Trial) -> Tensor:
        """Mean squared error of a trial on recordings, (recording,), from searches on the others.

        Windows of one recording share a search, so they are no independent samples.
        """
        found = []
        for train, test in holdout.recording_splits(self.windows, self.options.folds):
            squares = self._errors(self._further(trial, train, "other recordings, hold-out"), test)
            place = torch.tensor([place for place, *_ in test.spans])
            found += [squares[place == k].mean() for k in place.unique()]
        return torch.stack(found)

    def _errors(self, end: HorizonResult, test: Windows) -> Tensor:
        """Squared errors of a search on hold-out windows, (window,)."""
        if end.stopped:
            raise holdout.StoppedError
        friction, plant, *_ = end.parts
        return holdout.settled(test, end.problem, friction, plant).clamp_min(self.explained**2)


def constant_kept(
    start: FitResult, model: FrictionModel, note: str, *, converged: bool = True
) -> FitResult:
    """The constant fit, as the fit of a model set to its law; a note gives the reason."""
    return replace(
        start,
        model=model.requires_grad_(False),
        status=f"{start.status} {note}" if converged else f"Not converged: {note}",
        converged=start.converged and converged,
        warnings=(*start.warnings, note),
    )
