"""Inputs of friction other than speed, selected by the residuals of a law.

A candidate is a term of the law with its own coefficient (`friction.inputs`). Its evidence is
that of the Gauss-Newton model at the fitted law; one linearisation includes every candidate.
The choice among the candidates is then made on hold-out windows and recordings.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from torch import Tensor

from nfriction.fitting.data.inputs import apply_encoder_offsets
from nfriction.fitting.result.fit_result import FitResult, InputGain
from nfriction.fitting.result.of_search import NOTHING, result_from_shooting
from nfriction.fitting.shooting.autocorrelation import decimation, effective_noise
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.continuation import (
    HorizonResult,
    ShootingFitter,
    loglik_tolerance,
    settle_states,
    weighted_cost,
)
from nfriction.fitting.strategy.holdout import StoppedError
from nfriction.fitting.task import FitTask, constant_prior, known_terms, regression, terms_after
from nfriction.friction.coefficients import Constant
from nfriction.friction.heat import Heated, HeatedConstant
from nfriction.friction.inputs import INPUTS, has_input, reads_load, with_inputs
from nfriction.friction.laws import Coefficient, Law
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import Quadratic
from nfriction.optim.levenberg_marquardt import LevenbergMarquardt
from nfriction.plant import PendulumChain, Plant
from nfriction.plant.rigs import from_dict
from nfriction.signals import Motion

Offsets = tuple[tuple[float, ...], ...]
# Cooling times, in durations of a recording, above which it shows no cooling: 3 % of the heat.
SLOW_COOLING = 30.0
# Waves of friction over the position, per turn or per stroke of an axis.
WAVES = (1, 2, 3, 4)
# Pieces of a wave; within one it changes by at most an eighth of its height.
PHASES = 24
# Alternatives among which an input is chosen for each joint: waves, and a quarter of a turn for the
# phase. The choice costs the logarithm of their number in evidence.
ALTERNATIVES = {"position": 4 * len(WAVES)}


def seeing_plant(plant: Plant, inputs: Sequence[str]) -> Plant:
    """The plant, with its bearing loads if the load is an input."""
    if "load" not in inputs or not plant.has_link_load:
        return plant
    return from_dict({**plant.to_dict(), "normal_load": "bearing"})


def with_waves_of(plant: Plant, other: Plant) -> Plant:
    """The other plant, with loads that follow the position if those of the plant do."""
    if not plant.has_position_load:
        return other
    return other.replace(load_waves=plant.load_waves, load_phase=plant.load_phase)


def candidates(task: FitTask) -> tuple[str, ...]:
    """Inputs that are possible with a law and a plant."""
    plant, free = task.plant, not reads_load(task.model.law)
    # Bearing loads are known for chains on a fixed pivot; a load-dependent law uses one already.
    known = plant.has_link_load or (isinstance(plant, PendulumChain) and plant.bearing_load)
    # The papers' network may have a hidden state of its own.
    heated = "network" not in task.model.options()
    placed = free and bool(_covered(task, _wave_rates(task)).any(0).all())
    possible = {"direction": True, "load": free and known, "position": placed, "heat": heated}
    return tuple(name for name in INPUTS if possible[name])


class _WavesTorque:
    """Torque of a law and of waves over the position, whose coefficients follow its own."""

    def __init__(self, law: Law) -> None:
        self.torque, self.own = law.torque, len(law.names)

    def __call__(self, qd: Tensor, load: Tensor, coefficients: Tensor, v_smooth: float) -> Tensor:
        own, waves = coefficients.tensor_split([self.own], -1)
        # Loads are the waves, (*batch, joint, wave), except where a caller gives those of a rest.
        load = load if load.ndim == waves.ndim else load[..., None]
        tau_f = self.torque(qd, torch.ones_like(qd), own, v_smooth)
        return tau_f + (waves * load).sum(-1) * torch.tanh(qd / v_smooth)


def _wave_rates(task: FitTask) -> Tensor:
    """Phase of each wave per position [1; rad/m], (wave,); waves of an axis fit into its stroke."""
    stroke = float(np.ptp(np.concatenate([m.q for m in task.motions])))
    turn = 2 * math.pi if task.plant.unit == "rad" else stroke
    return 2 * math.pi / turn * torch.tensor(WAVES, dtype=torch.float64)


def _covered(task: FitTask, rates: Tensor) -> Tensor:
    """True where the motion covers half a period of a wave, (wave, joint).

    Otherwise its largest and smallest friction would be extrapolated.
    """
    visited = torch.as_tensor(np.ptp(np.concatenate([m.q for m in task.motions]), axis=0))
    return torch.outer(rates, visited) >= math.pi


def with_position_load(task: FitTask, start: FitResult, rates: Tensor | None = None) -> FitTask:
    """The task with the plant's load (1 + cos(k q + p)) / 2, for k and p favoured by the evidence.

    All waves and joints are fitted at once; then each joint keeps the wave that it needs most.
    """
    rates = _wave_rates(task) if rates is None else rates
    covered = _covered(task, rates)

    def load(q: Tensor, qd: Tensor) -> Tensor:
        angle = rates * q[..., None]
        return torch.cat([torch.ones_like(q)[..., None], angle.cos(), angle.sin()], -1)

    def at(waves: Tensor, phases: Tensor) -> FitTask:
        return replace(task, plant=task.plant.replace(load_waves=waves, load_phase=phases))

    own, plants = start.model.law, [plant.replace() for plant in (task.plant, start.plant)]
    for plant in plants:
        # For this linearisation only: a load with a column for each wave.
        plant.load = load  # type: ignore[method-assign]
    names = ["dry", *(f"{part} {k}" for part in ("cosine", "sine") for k in WAVES)]
    waves = [Coefficient(name, "N m", positive=False, prior_scale=1.0) for name in names]
    law = Law(f"{own.name}_by_waves", (*own.coefficients, *waves), _WavesTorque(own))
    choice = _Choice.of(_fitter(task, start, law, plants), task, start, {n: n for n in names})
    if choice is None:
        return at(rates[0] + 0.0 * task.plant.load_phase, 0.0 * task.plant.load_phase)
    dry, *rest = (torch.tensor(choice.columns[name]) for name in names)
    pairs = torch.stack(rest).reshape(2, len(WAVES), -1)
    choice = choice.with_noise_beside([*dry.tolist(), *pairs.flatten().tolist()])
    best: list[int] = []
    for j in range(task.plant.joints):
        others = [p[:, best[i]] if i < j else p.flatten() for i, p in enumerate(pairs.unbind(-1))]
        others[j] = dry
        tried = [torch.cat([*others, pair]).tolist() for pair in pairs[..., j].unbind(-1)]
        evidence = [choice.evidence(columns)[0] for columns in tried]
        # The shortest wave, if the joint moves too little for any.
        covering = covered[:, j].nonzero().flatten().tolist() or [len(WAVES) - 1]
        best.append(max(covering, key=evidence.__getitem__))
    chosen = pairs[:, best, range(len(best))]
    cosine, sine = choice.evidence([*dry.tolist(), *chosen.flatten().tolist()])[2][chosen]
    return at(rates[best], torch.atan2(-sine, cosine))


def phase_bins(plant: Plant, q: np.ndarray) -> np.ndarray:
    """Piece of a wave of the friction by position at positions, (sample, joint)."""
    turns = (plant.load_waves.numpy() * q / (2 * math.pi)) % 1.0
    return np.minimum(PHASES * turns, PHASES - 1).astype(int)


def known_phases(plant: Plant, motions: Sequence[Motion]) -> np.ndarray:
    """True for pieces of a wave that motions visit, (joint, piece); all where there is no wave."""
    bins = phase_bins(plant, np.concatenate([m.q for m in motions]))
    pieces = [np.isin(np.arange(PHASES), bins[:, j]) for j in range(plant.joints)]
    return np.array(pieces) | (plant.load_waves.numpy() == 0)[:, None]


def longest_duration(motions: Sequence[Motion]) -> float:
    """Duration of the longest motion [s]."""
    return max(float(motion.time[-1] - motion.time[0]) for motion in motions)


def heated_schedule(
    law: Law, initial: Tensor, motions: Sequence[Motion], cooling_time: float
) -> HeatedConstant:
    """Constant coefficients of a law with heat, scaled to peak at 1 if friction stays cold.

    `initial` has no decrease with heat; the `cooling_time` is in seconds.
    """
    schedule = HeatedConstant(law, len(initial), initial)
    step = float(np.median(np.concatenate([np.diff(motion.time) for motion in motions])))
    schedule.set_heat(1.0, cooling_time, step)
    heat = [schedule.states(*map(torch.tensor, (m.qd, m.qdd, m.time))) for m in motions]
    # A joint without friction stays cold at any capacity.
    most = torch.cat(heat).amax((0, 2))
    schedule.set_heat(torch.where(most > 0, most, 1.0), cooling_time, step)
    return schedule


def widened_fitter(
    task: FitTask,
    start: FitResult,
    inputs: Sequence[str],
    cooling_time: float = math.nan,
    at: FitResult | None = None,
) -> ShootingFitter:
    """Fitter of constant coefficients of a law and of inputs, started from a fit of the law.

    `cooling_time` [s] is the time constant of the input heat; `at` is a fit with some of the inputs
    to start from instead.
    """
    law, at = with_inputs(start.model.law, inputs), at or start
    plant, fitted = (seeing_plant(plant, inputs) for plant in (task.plant, at.plant))
    return _fitter(task, at, law, (plant, with_waves_of(plant, fitted)), cooling_time)


def _fitter(
    task: FitTask, at: FitResult, law: Law, plants: Sequence[Plant], cooling_time: float = math.nan
) -> ShootingFitter:
    """Fitter of constant coefficients of a law, on a plant as given and as fitted before."""
    plant, fitted = plants
    values = at.model.schedule.coefficient_sets()["always"].T
    known = dict(zip(at.model.law.names, values, strict=True))
    initial = torch.stack([known.get(name, 0.0 * values[0]) for name in law.names], -1)
    schedule = Constant(law, at.model.joints, initial)
    if has_input(law, "heat"):
        schedule = heated_schedule(law, initial, task.motions, cooling_time)
        if has_input(at.model.law, "heat"):
            seen = cast("Heated", at.model.schedule)
            schedule.set_heat(seen.heat_capacity, seen.cooling_time, seen.sample_time)
    model = FrictionModel(law, schedule, at.model.v_smooth)
    torque, terms = regression(task, model, fitted), terms_after(task, at, law, plant)
    return ShootingFitter(
        StepJacobian(plant, model, terms), model, task.recordings, task.measurement, task.options,
        task.callback, friction_prior=constant_prior(model, torque, task.options),
        offset_sd=task.offset_sd,
    )  # fmt: skip


def widened_start(task: FitTask, start: FitResult, inputs: Sequence[str]) -> FitResult | None:
    """Constant fit of a law with inputs, started from that without; None if stopped.

    The task is without the encoder offsets of that fit; they are fitted again, because a law that
    lacks an input shifts them. Windows grow to those of the law, where it may be far from the law
    with inputs. The cooling time of heat minimises the residual over the shortest windows, between
    their length (within which a network responds to the motion itself) and `SLOW_COOLING` times the
    longest recording.
    """
    from scipy.optimize import minimize_scalar  # slow to import

    horizon = start.longest_usable_horizon(task.options.windows)
    lengths = tuple(length for length in task.options.windows if length <= horizon)
    shortest, longest = min(lengths), longest_duration(task.motions)

    def continued(
        windows: Sequence[float], cooling_time: float, end: HorizonResult | None
    ) -> HorizonResult:
        """The last of searches over these windows, each from the end of the previous one."""
        fitter, options = widened_fitter(task, start, inputs, cooling_time), task.options
        friction, offsets = fitter.friction.schedule.parameter_vector(), None
        plant, noise = known_terms(start, fitter.jacobian.terms), options.first_noise
        simulated = task.motions
        for k, length in enumerate(windows):
            if end is not None:
                noise, (friction, plant, _, offsets) = max(end.noise, options.min_noise), end.parts
                simulated = end.problem.simulated_motions(end.result.x, simulated)
            problem = fitter.problem(fitter.cut(simulated, length, task.motions), noise, friction)
            x, stopped = settle_states(problem, problem.variables.start(plant, offsets))
            near = float(problem.cost(x)) if end is None else weighted_cost(end.residuals, noise)
            last = k + 1 == len(windows)
            tolerance = loglik_tolerance(near, options) if last else options.loose_tolerance
            name = f"{problem.windows.length:g} s windows, law with inputs"
            end = fitter.search(problem, x, tolerance, name)
            if stopped or end.stopped or not math.isfinite(end.rms):
                raise StoppedError
        assert end is not None
        return end

    ends: list[HorizonResult] = []

    def best() -> HorizonResult | None:
        return min(ends, key=lambda end: end.rms, default=None)

    def residual(log_time: float) -> float:
        """Residual over the shortest windows, once another search no longer reduces it."""
        end, before = best(), math.inf
        # Repeated, because a window starts with the heat of the friction that was found before.
        while end is None or before > task.options.network_gain * end.rms:
            before = math.inf if end is None else end.rms
            end = continued((shortest,), math.exp(log_time), end)
        ends.append(end)
        return end.rms

    try:
        if "heat" in inputs and longest > shortest:
            between = math.log(shortest), math.log(SLOW_COOLING * longest)
            found = minimize_scalar(
                residual, bounds=between, method="bounded", options={"xatol": 0.2}
            )
            longest = math.exp(found.x)
        end = continued(lengths, longest, best())
    except StoppedError:
        return None
    model = copy.deepcopy(end.problem.friction)
    fitted = result_from_shooting(model, end.problem, end.result, task.motions)
    offsets = added(start.encoder_offsets, fitted.encoder_offsets)
    return replace(fitted, encoder_offsets=offsets, skipped_horizons=start.skipped_horizons)


def added(offsets: Offsets, more: Offsets) -> Offsets:
    """Encoder offsets of a fit to recordings without the offsets of an earlier one."""
    return tuple(map(tuple, np.add(offsets, more).tolist()))


def realigned(task: FitTask, before: FitResult, after: FitResult) -> FitTask:
    """A task without the encoder offsets of a fit, without those of a later fit instead."""
    moved = np.subtract(after.encoder_offsets, before.encoder_offsets).tolist()
    recordings, motions = apply_encoder_offsets(moved, task.plant, task.recordings, task.motions)
    return replace(task, recordings=recordings, motions=motions)


@torch.no_grad()
def friction_drives(found: FitResult, own: int) -> bool:
    """True if coefficients beyond a law's own make friction drive a joint in one direction.

    A constant torque missing from the plant looks like friction that is larger in one direction.
    """
    law, v_smooth = found.model.law, found.model.v_smooth
    for motion in found.motions:
        q, qd, qdd = (torch.as_tensor(x) for x in (motion.q, motion.qd, motion.qdd))
        load, fitted = found.plant.load(q, qd), found.model.coefficients(qd, qdd)
        without = fitted.clone()
        without[..., own:] = 0.0
        power, least = (qd * law.torque(qd, load, c, v_smooth) for c in (fitted, without))
        # A law may be wrong at some speeds; a constant torque does work only in one direction.
        for turning in (qd > 0, qd < 0):
            work, own_work = ((p * turning).sum(0) for p in (power, least))
            if (work < own_work.clamp(max=0.0)).any():
                return True
    return False


def chosen_inputs(
    task: FitTask, start: FitResult
) -> tuple[tuple[InputGain, ...], FitResult, FitTask]:
    """Inputs favoured by the evidence, the constant fit with them, and the task with their plant.

    Forward selection: each raises the evidence of the fit with the previous ones most. The task is
    one without encoder offsets. Raises StoppedError if the caller stops a search.
    """
    names, at, longest = candidates(task), start, longest_duration(task.motions)
    placed = with_position_load(task, start) if "position" in names else task
    # A plant gives only one of them.
    exclusive = ("load", "position")
    chosen: list[InputGain] = []
    seeing = task
    while True:
        found, held = [], [gain.name for gain in chosen]
        for kind in [n for n in exclusive if n in names] or ["load"]:
            tried = {n: INPUTS[n].name for n in names if n == kind or n not in exclusive}
            one = placed if kind == "position" else task
            choice = _Choice.of(widened_fitter(one, start, [*tried], longest, at), one, at, tried)
            best = choice.best(held, task.options.input_evidence) if choice else None
            found += [best] if best else []
        if not found:
            return tuple(chosen), at, realigned(seeing, start, at)
        _, gain = max(found, key=lambda one: one[0])
        widening = placed if gain.name == "position" else seeing
        widening = replace(widening, plant=seeing_plant(widening.plant, [gain.name]))
        widened = widened_start(widening, start, [*held, gain.name])
        if widened is None:
            raise StoppedError
        where = significant(widened, gain.name)
        if gain.name == "position" and where:
            where &= _recurring(task, start, seeing=widening)
        if widened.residual < at.residual and where:
            # As found by the search; the linearisation predicts only the choice.
            share = 1.0 - (widened.residual / at.residual) ** 2
            chosen.append(replace(gain, share=share))
            at, seeing = widened, widening
            names = tuple(n for n in names if {n, gain.name} != {*exclusive})
        else:
            # Another input may explain the same errors.
            names = tuple(n for n in names if n != gain.name)


def significant(found: FitResult, name: str) -> set[int]:
    """Joints at which the 95 % interval of an input's coefficient does not include zero.

    The intervals take into account that residuals are correlated, unlike the evidence.
    """
    own = {f"{INPUTS[name].name} of {joint}": j for j, joint in enumerate(found.plant.joint_names)}
    of_input = (i for i in found.intervals if i.name in own)
    return {own[i.name] for i in of_input if not i.low <= NOTHING <= i.high}


def _recurring(task: FitTask, start: FitResult, seeing: FitTask) -> set[int]:
    """Joints whose wave over the position is that of `seeing` without any one recording, too.

    Else it follows from what happened in one recording: a wave of some length fits any error.
    """
    waves, several = seeing.plant.load_waves, len(task.recordings) > 1
    same = torch.ones_like(waves, dtype=torch.bool)
    for one in task.recordings if several else ():
        rest = [(r, m) for r, m in zip(task.recordings, task.motions, strict=True) if r is not one]
        recordings, motions = zip(*rest, strict=True)
        part = replace(task, recordings=recordings, motions=motions)
        same &= with_position_load(part, start, _wave_rates(task)).plant.load_waves == waves
    return {*same.nonzero().flatten().tolist()}


@dataclass(frozen=True)
class _Choice:
    """Local models of errors and priors in the shared variables, with optimal window states."""

    errors: Quadratic
    prior: Quadratic
    bounds: tuple[Tensor, Tensor]  # of a step
    columns: dict[str, list[int]]  # of each candidate, one coefficient per joint

    @classmethod
    def of(
        cls, fitter: ShootingFitter, task: FitTask, start: FitResult, names: Mapping[str, str]
    ) -> "_Choice | None":
        # The shortest windows: over them the motion is most nearly linear in friction.
        model, values = fitter.friction, fitter.friction.schedule.parameter_vector()
        windows = fitter.cut(task.motions, min(task.options.windows))
        problem = fitter.problem(windows, effective_noise(start.residuals), values)
        variables = problem.variables
        x, stopped = settle_states(
            problem, variables.start(known_terms(start, fitter.jacobian.terms))
        )
        residuals = problem.errors(x)
        noise = max(effective_noise(residuals), task.options.min_noise)
        problem = replace(problem, noise_sd=noise, stride=decimation(residuals, task.options))
        local = problem.linearise(x)
        if stopped or not local.finite:
            return None
        shared, (precision, mean) = variables.shared_count, variables.prior()
        off, precision = (x - mean)[:shared], precision[:shared]
        prior = Quadratic(
            0.5 * off @ (precision * off), precision * off, torch.diag(precision)
        )  # fmt: skip
        lower, upper = ((bound - x)[:shared] for bound in variables.bounds())
        rows = torch.arange(variables.friction_count).reshape(model.joints, -1)
        place = model.law.names.index
        columns = {name: rows[:, place(c)].tolist() for name, c in names.items()}
        bounds = lower.clamp(max=0.0), upper.clamp(min=0.0)
        whole = _of_shared(local, shared)
        errors = Quadratic(
            whole.cost - prior.cost, whole.gradient - prior.gradient, whole.hessian - prior.hessian
        )  # fmt: skip
        return cls(errors, prior, bounds, columns)

    def with_noise_beside(self, held: Sequence[int]) -> "_Choice":
        """The same with the noise that is unexplained by the columns `held`."""
        k, e = self.evidence([])[1] / self.evidence(held)[1], self.errors
        return replace(self, errors=Quadratic(k * e.cost, k * e.gradient, k * e.hessian))

    def best(self, held: Sequence[str], least: float) -> tuple[float, InputGain] | None:
        """The input that raises the log evidence most beside those held, and by how much.

        None if by less than `least`.
        """
        columns = [column for name in held for column in self.columns[name]]
        before, left, _ = self.evidence(columns)
        gained, costs = {}, {}
        for name, more in self.columns.items():
            if name not in held:
                found, costs[name], _ = self.evidence([*columns, *more])
                gained[name] = found - before - len(more) * math.log(ALTERNATIVES.get(name, 1))
        best = max(gained, key=gained.__getitem__, default="")
        if not (best and gained[best] > least):
            return None
        each = [self.evidence([*columns, column])[1] for column in self.columns[best]]
        by_joint = tuple(1.0 - alone / left for alone in each)
        return gained[best], InputGain(best, 1.0 - costs[best] / left, by_joint)

    def evidence(self, held: Sequence[int]) -> tuple[float, float, Tensor]:
        """Log evidence with the columns `held`, up to a constant, cost of the errors, and step.

        Laplace's approximation at the minimum within the bounds.
        """
        others = {c for columns in self.columns.values() for c in columns}.difference(held)
        free = [k for k in range(len(self.prior.gradient)) if k not in others]
        lower, upper = (bound[free] for bound in self.bounds)

        def at(local: Quadratic, x: Tensor) -> Quadratic:
            gradient, hessian = local.gradient[free], local.hessian[free][:, free]
            slope = gradient + hessian @ x
            return Quadratic(local.cost + 0.5 * x @ (gradient + slope), slope, hessian)

        def model(x: Tensor) -> Quadratic:
            errors, prior = at(self.errors, x), at(self.prior, x)
            return Quadratic(
                errors.cost + prior.cost, errors.gradient + prior.gradient,
                errors.hessian + prior.hessian,
            )  # fmt: skip

        start = torch.zeros(len(free), dtype=torch.float64)
        end = LevenbergMarquardt().minimise(model, start, lower=lower, upper=upper)
        least, moved = model(end.x), lower < upper
        spread = torch.linalg.slogdet(least.hessian[moved][:, moved]).logabsdet
        known = self.prior.hessian.diagonal()[list(held)].log().sum()
        evidence = float(0.5 * (known - spread) - least.cost)
        step = torch.zeros_like(self.prior.gradient)
        step[free] = end.x
        return evidence, float(at(self.errors, end.x).cost), step


def _of_shared(local: Quadratic, shared: int) -> Quadratic:
    """Local model of the first variables, with the others at their optimum."""
    H, g = local.hessian, local.gradient
    solved = torch.linalg.solve(
        H[shared:, shared:], torch.cat([H[shared:, :shared], g[shared:, None]], 1)
    )
    across = H[:shared, shared:]
    return Quadratic(
        local.cost - 0.5 * g[shared:] @ solved[:, -1],
        g[:shared] - across @ solved[:, -1],
        H[:shared, :shared] - across @ solved[:, :-1],
    )
