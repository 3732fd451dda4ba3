"""Inputs of friction besides the speed, chosen by what a law leaves unexplained.

A candidate is a term of the law with a coefficient of its own (`friction.inputs`). Its gain is that
of one Gauss-Newton step from the fitted law, on contiguous blocks of the recordings that took no
part in the step: one linearisation of each block gives the gain of every candidate.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nfriction.fitting.data.inputs import adjustable_terms
from nfriction.fitting.data.windows import Windows
from nfriction.fitting.result.fit_result import FitResult, InputGain
from nfriction.fitting.result.of_search import result_from_shooting
from nfriction.fitting.result.paired_test import gains
from nfriction.fitting.shooting.autocorrelation import decimation, effective_noise
from nfriction.fitting.shooting.sensitivity import StepJacobian
from nfriction.fitting.strategy.continuation import (
    ShootingFitter,
    loglik_tolerance,
    settle_states,
    weighted_cost,
)
from nfriction.fitting.task import (
    FitTask,
    constant_prior,
    fits_eccentricity,
    known_terms,
    regression,
)
from nfriction.friction.coefficients import Constant
from nfriction.friction.inputs import INPUTS, with_inputs
from nfriction.friction.models import FrictionModel
from nfriction.optim.least_squares import Quadratic
from nfriction.optim.levenberg_marquardt import LevenbergMarquardt
from nfriction.plant import PendulumChain, Plant
from nfriction.plant.rigs import from_dict


def seeing_plant(plant: Plant, inputs: Sequence[str]) -> Plant:
    """The plant with the loads of its bearings where the load is an input."""
    if "load" not in inputs or not plant.has_link_load:
        return plant
    return from_dict({**plant.to_dict(), "normal_load": "bearing"})


def candidates(task: FitTask) -> tuple[str, ...]:
    """Inputs that a law and a plant can take."""
    plant, law = task.plant, task.model.law
    one = torch.ones(1, 1, dtype=torch.float64)
    coefficients = one.expand(1, 1, len(law.names))
    torques = [law.torque(one, load * one, coefficients, 1.0) for load in (1.0, 2.0)]
    # A bearing's load is known of chains on a fixed pivot; a law of the load has seen one.
    known = plant.has_link_load or (isinstance(plant, PendulumChain) and plant.bearing_load)
    loaded = known and torch.equal(*torques)
    return tuple(name for name in INPUTS if name != "load" or loaded)


def widened_fitter(task: FitTask, start: FitResult, inputs: Sequence[str]) -> ShootingFitter:
    """Fitter of a law's constant coefficients and those of inputs, from a fit of the law."""
    law, plant = with_inputs(start.model.law, inputs), seeing_plant(task.plant, inputs)
    known = start.model.schedule.coefficient_sets()["always"]
    initial = torch.cat([known, known.new_zeros(len(known), len(inputs))], 1)
    model = FrictionModel(law, Constant(law, start.model.joints, initial), start.model.v_smooth)
    terms = adjustable_terms(
        plant, task.recordings, task.options, eccentric=fits_eccentricity(task.options, start),
        per_recording=bool(start.encoder_offsets),
    )  # fmt: skip
    torque = regression(task, model, seeing_plant(start.plant, inputs))
    return ShootingFitter(
        StepJacobian(plant, model, terms), model, task.recordings, task.measurement, task.options,
        task.callback, friction_prior=constant_prior(model, torque, task.options),
    )  # fmt: skip


def widened_start(task: FitTask, start: FitResult, inputs: Sequence[str]) -> FitResult | None:
    """Constant fit of a law with inputs, from that without; None if stopped."""
    fitter = widened_fitter(task, start, inputs)
    windows = fitter.cut(task.motions, start.longest_usable_horizon(task.options.windows))
    noise = max(effective_noise(start.residuals), task.options.min_noise)
    problem = fitter.problem(windows, noise, fitter.friction.schedule.parameter_vector())
    known = known_terms(start, fitter.jacobian.terms)
    x, stopped = settle_states(problem, problem.variables.start(known))
    if stopped:
        return None
    tolerance = loglik_tolerance(weighted_cost(start.residuals, noise), task.options)
    end = fitter.search(problem, x, tolerance, "law with further inputs")
    if end.stopped or not math.isfinite(end.rms):
        return None
    model = copy.deepcopy(fitter.friction)
    found = result_from_shooting(model, end.problem, end.result, task.motions)
    return replace(
        found, encoder_offsets=start.encoder_offsets, skipped_horizons=start.skipped_horizons
    )


@torch.no_grad()
def drives(found: FitResult, own: int) -> bool:
    """True if coefficients beyond a law's own let friction drive a joint in one direction.

    A constant torque that the plant lacks looks like friction larger in one direction.
    """
    law, v_smooth = found.model.law, found.model.v_smooth
    for motion in found.motions:
        q, qd, qdd = (torch.as_tensor(x) for x in (motion.q, motion.qd, motion.qdd))
        load, fitted = found.plant.load(q, qd), found.model.coefficients(qd, qdd)
        without = fitted.clone()
        without[..., own:] = 0.0
        power, least = (qd * law.torque(qd, load, c, v_smooth) for c in (fitted, without))
        # At some speeds the shape of a law may be off; a constant torque does work on one side.
        for turning in (qd > 0, qd < 0):
            work, own_work = ((p * turning).sum(0) for p in (power, least))
            if (work < own_work.clamp(max=0.0)).any():
                return True
    return False


def chosen_inputs(task: FitTask, start: FitResult) -> tuple[InputGain, ...]:
    """Inputs that explain motion on blocks left out, the best first; each beside those before.

    Args:
        task: with recordings and motions free of encoder offsets.
        start: constant fit of the law.
    """
    names = candidates(task)
    fitter = widened_fitter(task, start, names)
    choice = _Choice.of(fitter, task, start, names)
    return () if choice is None else tuple(choice.forward(task.options.input_chance))


@dataclass(frozen=True)
class _Choice:
    """Local models of blocks over the shared variables, states at their best, and the prior's."""

    blocks: Sequence[Quadratic]
    prior: Quadratic
    bounds: tuple[Tensor, Tensor]  # of a step
    columns: dict[str, list[int]]  # of each candidate, a coefficient a joint

    @classmethod
    def of(
        cls, fitter: ShootingFitter, task: FitTask, start: FitResult, names: Sequence[str]
    ) -> "_Choice | None":
        windows = fitter.cut(task.motions, start.longest_usable_horizon(task.options.windows))
        noise, model = effective_noise(start.residuals), fitter.friction
        stride = decimation(start.residuals, task.options)
        known = known_terms(start, fitter.jacobian.terms)
        found = []
        for block in contiguous_blocks(windows, task.options.folds):
            problem = fitter.problem(
                windows.subset(block), noise, model.schedule.parameter_vector(), stride=stride
            )
            x, stopped = settle_states(problem, problem.variables.start(known))
            local = problem.linearise(x)
            if stopped or not local.finite:
                return None
            variables = problem.variables
            shared, (precision, mean) = variables.shared_count, variables.prior()
            off, pull = (x - mean)[:shared], (precision * (x - mean))[:shared]
            prior = Quadratic(0.5 * off @ pull, pull, torch.diag(precision[:shared]))
            found.append(_of_errors(local, prior))
        lower, upper = ((bound - x)[:shared] for bound in variables.bounds())
        rows = torch.arange(variables.friction_count).reshape(model.joints, -1)
        own = rows.shape[1] - len(names)
        columns = {name: rows[:, own + k].tolist() for k, name in enumerate(names)}
        return cls(found, prior, (lower.clamp(max=0.0), upper.clamp(min=0.0)), columns)

    def forward(self, chance: float) -> list[InputGain]:
        """Inputs one after the other, as long as one gains by more than its scatter over blocks."""
        chosen: list[InputGain] = []
        held: list[int] = []
        while len(chosen) < len(self.columns):
            before = self.left_out(held)
            shares = {}
            for name, columns in self.columns.items():
                if columns[0] in held:
                    continue
                after = self.left_out([*held, *columns])
                if gains(after, before, chance):
                    shares[name] = float(1.0 - after.sum() / before.sum())
            if not shares:
                break
            best = max(shares, key=lambda name: shares[name])
            by_joint = tuple(
                float(1.0 - self.left_out([*held, column]).sum() / before.sum())
                for column in self.columns[best]
            )
            chosen.append(InputGain(best, shares[best], by_joint))
            held += self.columns[best]
        return chosen

    def left_out(self, held: Sequence[int]) -> Tensor:
        """Cost of each block after a step by the others, (block,), with the columns `held`."""
        every = {c for columns in self.columns.values() for c in columns}
        free = [k for k in range(len(self.prior.gradient)) if k not in every or k in held]
        lower, upper = (bound[free] for bound in self.bounds)
        costs = []
        for place, block in enumerate(self.blocks):
            others = [b for k, b in enumerate(self.blocks) if k != place]
            parts = [_subset(q, free) for q in (self.prior, *others)]
            gradient = torch.stack([p.gradient for p in parts]).sum(0)
            hessian = torch.stack([p.hessian for p in parts]).sum(0)
            cost = sum(float(p.cost) for p in parts)

            def model(
                x: Tensor, c: float = cost, g: Tensor = gradient, H: Tensor = hessian
            ) -> Quadratic:
                return Quadratic(c + g @ x + 0.5 * x @ H @ x, g + H @ x, H)

            start = torch.zeros(len(free), dtype=torch.float64)
            step = LevenbergMarquardt().minimise(model, start, lower=lower, upper=upper).x
            own = _subset(block, free)
            costs.append(own.cost + own.gradient @ step + 0.5 * step @ own.hessian @ step)
        return torch.stack([torch.as_tensor(c) for c in costs])


def contiguous_blocks(windows: Windows, folds: int) -> list[Tensor]:
    """Masks (window,) of contiguous stretches, up to `folds` of each recording."""
    place = torch.tensor([span[0] for span in windows.spans])
    blocks = []
    for recording in place.unique().tolist():
        own = (place == recording).nonzero().flatten()
        for part in own.tensor_split(min(folds, len(own))):
            mask = torch.zeros(len(windows), dtype=torch.bool)
            mask[part] = True
            blocks.append(mask)
    return blocks


def _of_errors(local: Quadratic, prior: Quadratic) -> Quadratic:
    """Local model over the shared variables by the errors alone, the others at their best."""
    shared = len(prior.gradient)
    H, g = local.hessian, local.gradient
    solved = torch.linalg.solve(
        H[shared:, shared:], torch.cat([H[shared:, :shared], g[shared:, None]], 1)
    )
    across = H[:shared, shared:]
    return Quadratic(
        local.cost - prior.cost - 0.5 * g[shared:] @ solved[:, -1],
        g[:shared] - prior.gradient - across @ solved[:, -1],
        H[:shared, :shared] - prior.hessian - across @ solved[:, :-1],
    )


def _subset(local: Quadratic, index: Sequence[int]) -> Quadratic:
    rows = list(index)
    return Quadratic(local.cost, local.gradient[rows], local.hessian[rows][:, rows])
